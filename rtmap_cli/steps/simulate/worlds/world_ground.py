"""The ground as raster tiles of layers, anchored to the map frame and cached in the world.

A tile of level l covers (256 · resolution)² metres, resolution = base · 2^l, rows along +y. Its
eight uint8 channels are the shares of sidewalk, curb, asphalt, white and yellow paint (worn), the
asphalt's and the verge's texture, and old patches of asphalt: everything that a drive's
colours are mixed from, linearly. Tiles do not depend on the style of a drive.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rtmap_cli.steps.simulate.worlds.world import World

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

TILE = 256
MAX_TILES = 800
"""Tiles kept per world (0.5 MB each); the oldest are dropped."""
NOISE_SIZE = 1024
NOISE_STEP = 0.11
"""Metres per pixel of the noise; it repeats after 113 m."""
SUBPIXEL = 4
"""Fractional bits of the drawing coordinates."""


def opencv() -> Any:
    """The cv2 module on one thread; a clear error when the extra is not installed."""
    try:
        import cv2
    except ImportError:
        from rtmap_cli.errors import UsageError

        raise UsageError(
            "rendering needs OpenCV: pip install 'rtmap[simulate]' (opencv-python-headless)"
        ) from None
    cv2.setNumThreads(1)
    return cv2


@cache
def noise_fields() -> NDArray[np.float32]:
    """(1024, 1024, 4) periodic unit-variance noise of correlation 1, 5, 24 and 80 pixels."""
    rng = np.random.default_rng(7)
    out = np.empty((NOISE_SIZE, NOISE_SIZE, 4), np.float32)
    f = np.fft.fftfreq(NOISE_SIZE)
    square = f[:, None] ** 2 + f[None, : NOISE_SIZE // 2 + 1] ** 2
    for k, sigma in enumerate((0.7, 3.5, 16.0, 55.0)):
        white = np.fft.rfft2(rng.standard_normal((NOISE_SIZE, NOISE_SIZE)))
        smooth = np.fft.irfft2(white * np.exp(-2 * (np.pi * sigma) ** 2 * square))
        out[..., k] = smooth / smooth.std()
    return out


@cache
def _ground_noise() -> NDArray[np.float32]:
    """(5, 1024, 1024): what the ground takes of the noise, one pixel per NOISE_STEP metres.

    Texture of asphalt and verge (mean one half), blotches of old asphalt, fine and broad wear.
    """
    fine, middle, coarse, broad = np.moveaxis(noise_fields(), -1, 0)
    return np.stack(
        [
            np.clip(0.5 + 0.09 * fine + 0.05 * middle + 0.07 * coarse + 0.05 * broad, 0, 1),
            np.clip(0.5 + 0.06 * fine + 0.09 * middle + 0.12 * coarse, 0, 1),
            broad * 0.6 + coarse * 0.8 - 1.6,
            1.05 - 0.1 * np.abs(middle) - 0.08 * fine,
            0.6 + 0.5 * broad,
        ]
    )


def _noise(x0: float, y0: float, step: float) -> NDArray[np.float32]:
    """(5, 256, 256) noise of a tile with this lower left corner."""
    k = (np.arange(TILE) + 0.5) * step
    cols = np.floor((x0 + k) / NOISE_STEP).astype(np.int64) % NOISE_SIZE
    rows = np.floor((y0 + k) / NOISE_STEP).astype(np.int64) % NOISE_SIZE
    at = (rows[:, None] * NOISE_SIZE + cols).ravel()
    planes = [plane.take(at) for plane in _ground_noise().reshape(5, -1)]
    return np.stack(planes).reshape(5, TILE, TILE)


def layout_of(world: World) -> dict[str, Any]:
    """Spatial indices of what is drawn on the ground; computed once per world."""
    if "curb" in world.boxes:
        return world.boxes
    rng = np.random.default_rng([world.seed, 53])
    layout: dict[str, Any] = world.boxes
    layout["sidewalk_width"] = float(rng.uniform(1.4, 3.2)) if rng.random() < 0.75 else 0.0
    layout["curb_width"] = float(rng.uniform(0.14, 0.32))
    layout["wear"] = float(rng.uniform(0.0, 0.5 if rng.random() < 0.8 else 0.9))
    layout["patches"] = float(rng.uniform(0.0, 1.0))
    layout["offset"] = rng.uniform(0, 100, 2)
    layout["paint"] = _boxes([p.polygon for p in world.paint])
    layout["soft"] = _boxes(world.soft)
    layout["curb"] = _boxes(world.curbs)
    layout["tar"] = _boxes(world.tar)
    layout["tar_width"] = float(rng.uniform(0.05, 0.16))
    return layout


def _boxes(shapes: list[Array]) -> Array:
    """(n, 4) bounding boxes."""
    return np.array([(*s.min(axis=0), *s.max(axis=0)) for s in shapes]).reshape(-1, 4)


def _touching(boxes: Array, x0: float, y0: float, x1: float, y1: float) -> NDArray[np.int64]:
    hit = (boxes[:, 0] <= x1) & (boxes[:, 2] >= x0) & (boxes[:, 1] <= y1) & (boxes[:, 3] >= y0)
    return np.flatnonzero(hit)


def ground_window(
    world: World, x: float, y: float, half: float, level: int, base: float
) -> tuple[Image, Image, Array]:
    """Layers of the square of ``half`` metres around (x, y) in the map frame.

    Returns two (h, w, 4) images and the map coordinates (2,) of the centre of pixel (0, 0).
    """
    step = base * 2**level
    side = TILE * step
    i0, i1 = int(np.floor((x - half) / step)), int(np.ceil((x + half) / step))
    j0, j1 = int(np.floor((y - half) / step)), int(np.ceil((y + half) / step))
    out = np.empty((2, j1 - j0, i1 - i0, 4), np.uint8)
    for tj in range(j0 // TILE, (j1 - 1) // TILE + 1):
        for ti in range(i0 // TILE, (i1 - 1) // TILE + 1):
            key = (step, ti, tj)
            tile = world.tiles.get(key)
            if tile is None:
                if len(world.tiles) >= MAX_TILES:
                    del world.tiles[next(iter(world.tiles))]
                tile = world.tiles[key] = draw_tile(world, ti * side, tj * side, step, level)
            a0, a1 = max(i0, ti * TILE), min(i1, (ti + 1) * TILE)
            b0, b1 = max(j0, tj * TILE), min(j1, (tj + 1) * TILE)
            out[:, b0 - j0 : b1 - j0, a0 - i0 : a1 - i0] = tile[
                :, b0 - tj * TILE : b1 - tj * TILE, a0 - ti * TILE : a1 - ti * TILE
            ]
    return out[0], out[1], np.array([(i0 + 0.5) * step, (j0 + 0.5) * step])


def draw_tile(world: World, x0: float, y0: float, step: float, level: int) -> Image:
    """One tile (2, 256, 256, 4) with its lower left corner at (x0, y0) in the map frame."""
    cv2 = opencv()
    layout = layout_of(world)
    # Coverage comes from finer pixels (OpenCV's own anti-aliasing widens every polygon), one row
    # and column of them more on each side, because filling is inexact along the border.
    fine = 4 if level < 2 else 8
    size, scale = (TILE + 2) * fine, fine / step
    side = TILE * step
    margin = 4.0

    def pixels(points: Array) -> NDArray[np.int32]:
        p = ((points - (x0 - step, y0 - step)) * scale - 0.5) * (1 << SUBPIXEL)
        return np.round(p).astype(np.int32)

    def fill(area: Any) -> Image | None:
        rings = [pixels(r) for r in _rings_of(area)]
        if not rings:
            return None
        mask = np.zeros((size, size), np.uint8)
        cv2.fillPoly(mask, rings, 255, cv2.LINE_8, SUBPIXEL)
        return mask

    window = shapely.box(x0 - margin, y0 - margin, x0 + side + margin, y0 + side + margin)
    area = shapely.intersection(world.surface, window)
    asphalt = fill(area)
    outer = asphalt
    if layout["sidewalk_width"] and not area.is_empty:
        outer = fill(shapely.buffer(area, layout["sidewalk_width"], quad_segs=2))
    curb = _draw_curbs(cv2, world, layout, (x0, y0, side), pixels, size, scale)
    white, yellow = _draw_paint(cv2, world, layout, (x0, y0, side), pixels, size)
    tar: Image | None = None
    for k in _touching(layout["tar"], x0, y0, x0 + side, y0 + side) if level < 2 else ():
        tar = np.zeros((size, size), np.uint8) if tar is None else tar
        width = max(1, round(layout["tar_width"] * scale))
        cv2.polylines(tar, [pixels(world.tar[k])], False, 255, width, cv2.LINE_8, SUBPIXEL)
    soft = _touching(layout["soft"], x0 - 12, y0 - 12, x0 + side + 12, y0 + side + 12)
    layers = [asphalt, outer, curb, white, yellow, tar]
    inner = slice(fine, -fine)
    shares = []
    for mask in layers:
        share = np.zeros((TILE, TILE), np.float32)
        if mask is not None:
            small = mask[inner, inner]
            for wide in (4 * TILE, TILE):  # by four at once it is quick
                if len(small) > wide:
                    small = cv2.resize(small, (wide, wide), interpolation=cv2.INTER_AREA)
            np.multiply(small, np.float32(1 / 255), out=share)
        shares.append(share)
    if len(soft):
        paved = _soften(cv2, world, soft, (x0, y0, side))
        shares[:2] = [np.maximum(shares[0], paved), np.maximum(shares[1], paved)]
    return _mix(cv2, layout, x0, y0, step, shares)


def _rings_of(area: Any) -> list[Array]:
    return [
        np.asarray(ring.coords)
        for part in shapely.get_parts(area)
        if part.geom_type == "Polygon" and not part.is_empty
        for ring in (part.exterior, *part.interiors)
    ]


def _draw_curbs(
    cv2: Any, world: World, layout: dict[str, Any], box: tuple[float, float, float],
    pixels: Any, size: int, scale: float,
) -> Image | None:  # fmt: skip
    """Curbs as thin strips along the boundaries."""
    x0, y0, side = box
    mask: Image | None = None
    width = layout["curb_width"]
    window = (x0 - 2, y0 - 2, x0 + side + 2, y0 + side + 2)
    for k in _touching(layout["curb"], *window):
        line = shapely.clip_by_rect(shapely.linestrings(world.curbs[k]), *window)
        if line.is_empty:
            continue
        strip = shapely.buffer(line, width / 2, cap_style="flat", join_style="mitre")
        rings = [pixels(r) for r in _rings_of(strip)]
        if rings:
            mask = np.zeros((size, size), np.uint8) if mask is None else mask
            cv2.fillPoly(mask, rings, 255, cv2.LINE_8, SUBPIXEL)
    return mask


def _draw_paint(
    cv2: Any, world: World, layout: dict[str, Any], box: tuple[float, float, float],
    pixels: Any, size: int,
) -> tuple[Image | None, Image | None]:  # fmt: skip
    x0, y0, side = box
    masks: dict[str, Image] = {}
    for k in _touching(layout["paint"], x0, y0, x0 + side, y0 + side):
        paint = world.paint[k]
        if paint.colour not in masks:
            masks[paint.colour] = np.zeros((size, size), np.uint8)
        cv2.fillPoly(masks[paint.colour], [pixels(paint.polygon)], 255, cv2.LINE_8, SUBPIXEL)
    return masks.get("white"), masks.get("yellow")


def _soften(
    cv2: Any, world: World, soft: NDArray[np.int64], box: tuple[float, float, float]
) -> NDArray[np.float32]:
    """(256, 256) share of paving beside edges without a curb: full at the edge, 0 from 14 m on."""
    x0, y0, side = box
    margin, scale = 20.0, 2.0
    size = int(np.ceil((side + 2 * margin) * scale))
    near = np.zeros((size, size), np.uint8)
    for k in soft:
        points = ((world.soft[k] - (x0 - margin, y0 - margin)) * scale - 0.5) * (1 << SUBPIXEL)
        line = np.round(points).astype(np.int32)
        cv2.polylines(near, [line], False, 255, round(18 * scale), cv2.LINE_8, SUBPIXEL)
    near = cv2.GaussianBlur(near, (0, 0), 2.5 * scale)
    at = ((np.arange(TILE, dtype=np.float32) + 0.5) * side / TILE + margin) * scale - 0.5
    u, v = np.meshgrid(at.astype(np.float32), at.astype(np.float32))
    share: NDArray[np.float32] = cv2.remap(near, u, v, cv2.INTER_LINEAR).astype(np.float32)
    return share / np.float32(255)


def _mix(
    cv2: Any,
    layout: dict[str, Any],
    x0: float,
    y0: float,
    step: float,
    drawn: list[NDArray[np.float32]],
) -> Image:
    """Shares of the materials (they add up to at most one) and texture, as uint8 layers.

    ``drawn``: coverage of asphalt, asphalt with sidewalk, curb, white and yellow paint, tar in
    [0, 1].
    """
    asphalt, outer, curb, white, yellow, tar = drawn
    ox, oy = layout["offset"]
    noise = _noise(x0 + ox * 10, y0 + oy * 10, step)
    texture, verge, blotches, fine_wear, broad_wear = noise
    wear = np.clip(fine_wear - np.float32(layout["wear"]) * broad_wear, 0.12, 1.0)
    white, yellow = white * wear, yellow * wear
    white = np.minimum(white, 1 - yellow)
    left = 1 - white - yellow
    curb = curb * left
    left -= curb
    road = asphalt * left
    side = np.clip(outer - asphalt, 0, 1) * left
    patch = np.clip((blotches + np.float32(layout["patches"])) * 4, 0, 1)
    patch = np.maximum(patch, tar)
    first = cv2.merge([side, curb, road, white])
    second = cv2.merge([yellow, road * texture, (1 - road) * verge, road * patch])
    return np.stack([cv2.convertScaleAbs(layer, alpha=255.0) for layer in (first, second)])
