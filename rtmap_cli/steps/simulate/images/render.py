"""Camera images of a world: the ground sampled per pixel, boxes drawn over it, light and noise.

The ground follows the heights of the map; over a map without any it is the plane under the vehicle
(ego z = ``ground_z``). Colours are mixed linearly from the layers of ``world_ground``.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import xyyaw_of
from rtmap_cli.logs.log import Camera, Occluder
from rtmap_cli.steps.simulate.images.render_boxes import draw_boxes, scene_boxes
from rtmap_cli.steps.simulate.images.slopes import Terrain, lattice
from rtmap_cli.steps.simulate.images.style import Style
from rtmap_cli.steps.simulate.worlds.world import World
from rtmap_cli.steps.simulate.worlds.world_ground import ground_window, noise_fields, opencv

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Image = NDArray[np.uint8]

HORIZON = 1e-3
"""Slope of a ray below which it meets no ground (1.6 km away)."""

HALF_WIDTHS = {
    0.125: (20.0, 40.0, 72.0, 128.0),
    0.0625: (16.0, 24.0, 40.0, 72.0, 128.0),
}
"""Half widths (m) of the ground windows, finest level first, by base resolution (m)."""


def render_cameras(
    world: World,
    map_SE3_ego: Array,
    cameras: Sequence[Camera],
    style: Style,
    occluders: Sequence[Occluder] = (),
    rng: np.random.Generator | None = None,
    ground_z: float = 0.0,
    body: Array | None = None,
) -> list[Image]:
    """What the cameras of a vehicle see: one (H, W, 3) uint8 RGB image per camera.

    ``map_SE3_ego`` is the true pose (over flat ground only x, y and yaw count), ``occluders`` are
    vehicles in the ego frame (on slopes they stand on the ground), ``ground_z`` is the height of
    the road in it (m). The body's small pitch, roll and heave,
    the exposure and the noise are drawn from ``rng`` (``body``, `body_motion`, if the caller wants
    to know what the vehicle does not). Distortion k1, k2, k3 is applied where a
    camera has any.
    """
    rng = rng or np.random.default_rng(0)
    cv2 = opencv()
    body = body_motion(style, rng) if body is None else body
    x, y, yaw = xyyaw_of(map_SE3_ego)
    base = base_resolution(cameras)
    windows = [
        ground_window(world, x, y, half, k, base) for k, half in enumerate(HALF_WIDTHS[base])
    ]
    palette = _palette(style)
    terrain = None
    if world.ground:
        terrain = Terrain.around(world.ground, map_SE3_ego, ground_z)
        body = terrain.level_SE3_ego @ body
    boxes = scene_boxes(world, map_SE3_ego, occluders, style, ground_z, terrain)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    images = []
    for camera in cameras:
        pose = body @ camera.ego_SE3_camera
        image = _ground_and_sky(
            cv2, camera, pose, windows, base, (float(x), float(y)), turn, palette, style,
            terrain or ground_z,
        )  # fmt: skip
        draw_boxes(cv2, image, camera, pose, boxes, style)
        images.append(_finish(cv2, image, camera, style, rng))
    return images


def base_resolution(cameras: Sequence[Camera]) -> float:
    """Ground resolution in metres that the sharpest camera asks for: 0.125 or 0.0625."""
    focal = max((float(c.intrinsics[0, 0]) for c in cameras), default=1.0)
    return 0.125 if focal < 420 else 0.0625


def body_motion(style: Style, rng: np.random.Generator) -> Array:
    """The vehicle's unknown pitch, roll and heave as a transform of the ego frame."""
    pitch, roll = rng.normal(0, 1, 2) * (style.pitch, style.roll)
    out = np.eye(4)
    about_y = np.array(
        [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
    )
    about_x = np.array(
        [[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]]
    )
    out[:3, :3] = about_y @ about_x
    out[2, 3] = rng.normal(0, style.heave)
    return out


def _palette(style: Style) -> tuple[Floats, Floats]:
    """Two (3, 5) matrices: colour = A · layers 0…3 + B · layers 4…7, last column constant."""
    verge = np.array(style.verge)
    asphalt = np.array(style.asphalt)
    grain = 110 * style.grain * asphalt / 90
    rough = 90 * style.grain * verge / 100
    a = np.stack(
        [
            np.array(style.sidewalk) - verge + 0.0,
            np.array(style.curb) - verge,
            # The textures have mean one half; it is taken out here so that they only modulate.
            asphalt - verge - grain / 2 + rough / 2,
            np.array(style.white) - verge + rough / 2,
            verge - rough / 2,
        ],
        axis=1,
    )
    b = np.stack(
        [np.array(style.yellow) - verge + rough / 2, grain, rough, asphalt * -0.22, verge * 0],
        axis=1,
    )
    a[:, 4] *= 255
    return (a / 255).astype(np.float32), (b / 255).astype(np.float32)


Optics = tuple[tuple[float, ...], tuple[float, ...]]
"""(fx, fy, cx, cy, skew) and distortion k1, k2, k3 of a camera."""


def optics_of(camera: Camera) -> Optics:
    k = camera.intrinsics
    key = (k[0, 0], k[1, 1], k[0, 2], k[1, 2], k[0, 1])
    return tuple(float(v) for v in key), tuple(camera.distortion)


@lru_cache(maxsize=64)
def pixel_rays(width: int, height: int, optics: Optics, rows: int) -> tuple[Floats, Floats]:
    """Normalised image coordinates (x, y) of ``rows`` samples per image row, undistorted."""
    v = (np.arange(height * rows) + 0.5) / rows - 0.5
    return _undistorted(*np.meshgrid(np.arange(width), v), optics)


@lru_cache(maxsize=64)
def lattice_rays(width: int, height: int, optics: Optics) -> tuple[Floats, Floats]:
    """Normalised image coordinates of the lattice on which hills are looked for."""
    return _undistorted(*lattice(width, height)[1:], optics)


def _undistorted(u: NDArray[Any], v: NDArray[Any], optics: Optics) -> tuple[Floats, Floats]:
    (fx, fy, cx, cy, skew), distortion = optics
    yd = (v - cy) / fy
    xd = (u - cx - skew * yd) / fx
    x, y = xd.copy(), yd.copy()
    if any(distortion):
        k1, k2, k3 = distortion
        for _ in range(12):
            r = x * x + y * y
            factor = np.maximum(1 + r * (k1 + r * (k2 + r * k3)), 0.3)
            x, y = xd / factor, yd / factor
    return x.astype(np.float32), y.astype(np.float32)


def _ground_and_sky(
    cv2: Any,
    camera: Camera,
    pose: Array,
    windows: list[tuple[Image, Image, Array]],
    base: float,
    origin: tuple[float, float],
    turn: Array,
    palette: tuple[Floats, Floats],
    style: Style,
    ground: Terrain | float,
) -> Floats:
    """The image before boxes: ground below the horizon, sky above, haze between; float32.

    ``ground``: hills, or the height of a plane in the frame of ``pose`` (m).
    """
    width, height = camera.width, camera.height
    optics = optics_of(camera)
    fx = optics[0][0]
    rows = 2 if fx < 420 else 1
    rx, ry = pixel_rays(width, height, optics, rows)
    r = pose[:3, :3].astype(np.float32)
    down = r[2, 0] * rx + r[2, 1] * ry + r[2, 2]
    slope = down
    if isinstance(ground, Terrain):
        rays = lattice_rays(width, height, optics)
        seen, lifted = ground.slant(cv2, width, height, rows, rays, pose)
        rise, down = np.float32(lifted), -seen
    else:
        rise = np.float32(pose[2, 3] - ground)
    out = np.empty((height, width, 3), np.float32)
    # The horizon may be tilted: the first rows hold no ground, the last ones no sky.
    low, high = down.reshape(height, -1).min(axis=1), down[::rows].max(axis=1)
    first = int(np.argmax(low < -HORIZON)) if (low < -HORIZON).any() else height
    last = height - int(np.argmax(high[::-1] >= -HORIZON)) if (high >= -HORIZON).any() else 0
    _paint_sky(out[:last], slope[: last * rows : rows], style)
    if first == height:
        return out
    part = slice(first * rows, None)
    down, rx, ry = down[part], rx[part], ry[part]
    depth = rise / np.maximum(-down, np.float32(HORIZON))
    # Ego ground coordinates, then the same relative to the vehicle in map axes.
    m = (turn @ pose[:2, :3]).astype(np.float32)
    zero = (turn @ pose[:2, 3]).astype(np.float32)
    mx = zero[0] + depth * (m[0, 0] * rx + m[0, 1] * ry + m[0, 2])
    my = zero[1] + depth * (m[1, 0] * rx + m[1, 1] * ry + m[1, 2])
    layers = _sample(cv2, mx, my, depth, fx, float(rise), rows, windows, base, origin)
    colour = cv2.transform(layers[0], palette[0])
    colour += cv2.transform(layers[1], palette[1])
    clear = np.exp(depth[::rows] * np.float32(-1 / style.visibility))[..., None]
    haze = np.array(style.haze, np.float32)
    colour -= haze
    colour *= clear
    colour += haze
    mixed = last - first
    if mixed > 0:
        below = down[: mixed * rows : rows] < -HORIZON
        out[first:last][below] = colour[:mixed][below]
    out[max(first, last) :] = colour[max(mixed, 0) :]
    return out


def _sample(
    cv2: Any,
    mx: Floats,
    my: Floats,
    depth: Floats,
    focal: float,
    rise: float,
    rows: int,
    windows: list[tuple[Image, Image, Array]],
    base: float,
    origin: tuple[float, float],
) -> tuple[Floats, Floats]:
    """Layers (h, w, 4) × 2 at ground points relative to the vehicle (map axes), float32.

    Each image row takes the level that fits its footprint and holds all of it; ``rows`` samples
    per image row are averaged, because the ground is foreshortened along the view.
    """
    count = len(depth) // rows
    middle = depth[::rows, depth.shape[1] // 2]
    # Geometric mean of the footprint across (s / f) and along the view (s² / (f·h)).
    footprint = middle / focal * np.sqrt(np.maximum(1.0, middle / rise / rows))
    wanted = np.clip(np.round(np.log2(np.maximum(footprint / base, 1e-3))), 0, len(windows) - 1)
    reach = np.maximum(np.abs(mx), np.abs(my)).reshape(count, -1)
    near = np.minimum(np.percentile(reach[:, ::8], 90, axis=1), 1e6)
    level = wanted.astype(np.int64)
    for k in range(len(windows) - 1):
        half = windows[k][0].shape[0] * base * 2**k / 2 - 1.0
        level[(near > half) & (level <= k)] = k + 1
    out = [np.empty((count, mx.shape[1], 4), np.float32) for _ in range(2)]
    cuts = np.flatnonzero(np.diff(level)) + 1
    for start, end in zip([0, *cuts], [*cuts, count], strict=True):
        k = int(level[start])
        step = np.float32(base * 2**k)
        zero = windows[k][2]
        part = slice(start * rows, end * rows)
        px = (mx[part] - np.float32(zero[0] - origin[0])) / step
        py = (my[part] - np.float32(zero[1] - origin[1])) / step
        fixed, weights = cv2.convertMaps(px, py, cv2.CV_16SC2)
        for n in range(2):
            layer = cv2.remap(
                windows[k][n], fixed, weights, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            if rows > 1:  # at half size linear interpolation is the mean of two rows
                layer = cv2.resize(
                    layer, (mx.shape[1], end - start), interpolation=cv2.INTER_LINEAR
                )
            out[n][start:end] = layer
    return out[0], out[1]


def _paint_sky(out: Floats, down: Floats, style: Style) -> None:
    """From haze at the horizon to the colour of the sky above."""
    share = np.clip(down * 2.5, 0, 1)[..., None]
    haze, sky = np.array(style.haze, np.float32), np.array(style.sky, np.float32)
    out[:] = haze + share * (sky - haze)


def _finish(
    cv2: Any, image: Floats, camera: Camera, style: Style, rng: np.random.Generator
) -> Image:
    """Exposure, blur, noise and gamma of one camera."""
    gain = np.array(style.gain) * np.exp(rng.normal(0, style.exposure))
    image *= gain.astype(np.float32)
    if style.blur:
        image = cv2.GaussianBlur(image, (0, 0), max(0.3, style.blur * camera.width / 224))
    if style.noise:
        field = noise_fields()[..., 0]
        h, w = min(camera.height, 1024), min(camera.width, 1024)
        i, j = rng.integers(0, 1025 - h), rng.integers(0, 1025 - w)
        grain = field[i : i + h, j : j + w] * np.float32(style.noise)
        if (h, w) != image.shape[:2]:
            tiles = (-(-camera.height // h), -(-camera.width // w))
            grain = np.tile(grain, tiles)[: camera.height, : camera.width]
        image += grain[..., None]
    lut = (255 * (np.arange(256) / 255.0) ** style.gamma + 0.5).astype(np.uint8)
    result: Image = cv2.LUT(cv2.convertScaleAbs(np.maximum(image, 0)), lut)
    return result
