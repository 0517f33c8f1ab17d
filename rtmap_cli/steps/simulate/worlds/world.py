"""The world behind a map: asphalt, paint, curbs, and what stands beside the road."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import arc_length, is_ring, join_lines, normals, resample_step
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.steps.simulate.worlds.heights import Ground, ground_of
from rtmap_cli.steps.simulate.worlds.markings import arrows, rng_of, seams, stop_lines
from rtmap_cli.steps.simulate.worlds.roadside import roadside

Array = NDArray[np.float64]

OPEN_EDGE_MAX = 45.0
"""Gaps of a boundary up to this length (m) are closed by a straight, curbless edge."""


@dataclass(frozen=True)
class Paint:
    """Polygons of one colour (``white`` or ``yellow``), each (k, 2) in the map frame."""

    colour: str
    polygon: Array


@dataclass
class World:
    """What the renderer draws; build it with ``world_from_map``.

    ``surface``: the asphalt; ``curbs``: lines (n, 2) with a curb; ``soft``: asphalt edges where the
    curb is gone (the ground beside them is paved too). ``seed`` fixes the wear of paint, which
    is a field over the map frame: the same place looks the same in every drive. ``tiles`` caches
    the rasterised ground. ``ground`` holds the heights, None over a flat map; ``tar``
    are seams of tar, dark lines (n, 2).
    """

    vector_map: VectorMap
    surface: Any
    curbs: list[Array]
    soft: list[Array]
    paint: list[Paint]
    objects: Any
    seed: int = 0
    tiles: dict[tuple[float, int, int], Any] = field(default_factory=dict, repr=False)
    boxes: dict[str, Array] = field(default_factory=dict, repr=False)
    ground: Ground | None = None
    tar: list[Array] = field(default_factory=list, repr=False)


def world_from_map(
    vector_map: VectorMap, seed: int = 0, surface_map: VectorMap | None = None
) -> World:
    """The world that a map describes.

    Closed boundaries bound the asphalt by the even-odd rule (islands are holes); open pieces are
    joined end to end, and a gap of up to 45 m is closed without a curb. With ``surface_map`` (the
    map before a change) the asphalt is taken from there, so that a deleted boundary removes the
    curb and not the road. Widths of lines, dash lengths and wear come from ``seed``.
    """
    rng = np.random.default_rng([seed, 31])
    rings, curbs, gaps = _rings(vector_map)
    surface = _even_odd(rings)
    if surface_map is not None:
        old_rings, old_curbs, _ = _rings(surface_map)
        surface = _even_odd(old_rings)
        gaps = _missing(old_curbs, curbs)
    shapely.prepare(surface)
    paint = [p for e in vector_map.of_class("divider") for p in _line_paint(e, rng_of(e, seed))]
    width = float(rng.uniform(0.3, 0.55))
    for element in vector_map.of_class("ped_crossing"):
        paint += _crossing_paint(element, width, seed)
    besides = stop_lines(vector_map, seed) + arrows(vector_map, surface, seed)
    paint += [Paint("white", polygon) for polygon in besides]
    ground = ground_of(surface_map or vector_map)
    objects = roadside(surface, seed)
    return World(
        vector_map, surface, curbs, gaps, paint, objects, seed, ground=ground,
        tar=seams(vector_map, seed),
    )  # fmt: skip


def _rings(vector_map: VectorMap) -> tuple[list[Array], list[Array], list[Array]]:
    """(closed rings, curb lines, straight edges that close a gap)."""
    curbs = join_lines([e.xy for e in vector_map.of_class("boundary")], 0.05)
    rings = [c for c in curbs if is_ring(c, 0.05)]
    gaps: list[Array] = []
    for line in curbs:
        if is_ring(line, 0.05):
            continue
        gap = float(np.hypot(*(line[-1] - line[0])))
        total = float(arc_length(line)[-1])
        if len(line) > 2 and gap <= max(OPEN_EDGE_MAX, 0.25 * total) and total > 1.5 * gap:
            rings.append(np.concatenate([line, line[:1]]))
            if gap > 0.2:
                gaps.append(np.array([line[-1], line[0]]))
    return rings, curbs, gaps


def even_odd_surface(vector_map: VectorMap) -> Any:
    """The asphalt of a map as a shapely geometry; see ``world_from_map``."""
    surface = _even_odd(_rings(vector_map)[0])
    shapely.prepare(surface)
    return surface


def _even_odd(rings: list[Array]) -> Any:
    """Area inside an odd number of rings."""
    area: Any = shapely.Polygon()
    polygons = [shapely.polygons(r) for r in rings if len(r) > 3]
    for polygon in sorted(polygons, key=lambda p: -p.area):
        valid = polygon if polygon.is_valid else shapely.make_valid(polygon).buffer(0)
        area = area.symmetric_difference(valid)
    return area


def _missing(old: list[Array], new: list[Array]) -> list[Array]:
    """Stretches of old curbs of 1 m and more without a new one within 0.3 m."""
    if not old:
        return []
    cover = shapely.union_all([shapely.linestrings(c) for c in new]).buffer(0.3)
    left = shapely.difference(shapely.union_all([shapely.linestrings(c) for c in old]), cover)
    merged = shapely.line_merge(left)
    return [np.asarray(g.coords) for g in shapely.get_parts(merged) if g.length > 1.0]


def _line_paint(element: Element, rng: np.random.Generator) -> list[Paint]:
    """A divider as painted polygons: its mark tells the colour, the dashes and whether twice.

    A mark such as SOLID_DASHED_YELLOW is solid on the left of the line and dashed on the right.
    """
    mark = element.attributes.get("mark") or "SOLID_WHITE"
    if mark in ("NONE", "UNKNOWN"):
        return []
    colour = "yellow" if "YELLOW" in mark else "white"
    width = rng.uniform(0.14, 0.21)
    dash, gap = rng.uniform(2.5, 3.5), rng.uniform(4.0, 8.5)
    line = resample_step(element.xy, 2.0)
    first, second = "DASHED" in mark, "DASHED" in mark
    if mark.startswith("SOLID_DASHED"):
        first, second = False, True
    elif mark.startswith("DASHED_SOLID"):
        first, second = True, False
    if mark.startswith(("DOUBLE", "SOLID_DASHED", "DASHED_SOLID")):
        strokes = [(0.14, first), (-0.14, second)]
    else:
        strokes = [(0.0, first)]
    normal = normals(line)
    out: list[Paint] = []
    for offset, dashed in strokes:
        shifted = line + offset * normal
        pieces = _dashes(shifted, dash, gap) if dashed else _chunks(shifted)
        out += [Paint(colour, stroke(piece, width)) for piece in pieces]
    return out


def _dashes(line: Array, dash: float, gap: float) -> list[Array]:
    """Stretches of ``dash`` metres every ``dash + gap``; a rest of 0.5 m and more is painted."""
    s = arc_length(line)
    out = []
    for start in np.arange(0.25, s[-1] - 0.5, dash + gap):
        end = min(start + dash, s[-1])
        at = np.concatenate([[start], s[(s > start) & (s < end)], [end]])
        out.append(np.stack([np.interp(at, s, line[:, k]) for k in (0, 1)], axis=-1))
    return out


def _chunks(line: Array, count: int = 12) -> list[Array]:
    """Short overlapping pieces, so that a tile draws only what it touches."""
    return [line[k : k + count + 1] for k in range(0, max(1, len(line) - 1), count)]


def stroke(line: Array, width: float) -> Array:
    """The polygon of a line drawn with a width, flat ends."""
    n = normals(line) * (width / 2)
    return np.concatenate([line + n, (line - n)[::-1]])


def _crossing_paint(element: Element, width: float, seed: int) -> list[Paint]:
    """Zebra stripes, a ladder (stripes between two lines) or two outlines, white."""
    pattern = element.attributes.get("pattern", "")
    rng = rng_of(element, seed)
    if pattern not in ("zebra", "ladder", "outline"):
        pattern = str(rng.choice(["zebra", "ladder", "outline"], p=[0.45, 0.25, 0.3]))
    corners = crossing_corners(element.xy)
    if corners is None:
        return []
    a, b, c, d = corners
    # a → b and d → c run along the walkway (the long sides), a → d across it.
    span = float(np.hypot(*(b - a)) + np.hypot(*(c - d))) / 2
    out: list[Paint] = []
    if pattern in ("zebra", "ladder"):
        count = max(2, round(span / (2.1 * width)))
        for k in range(count):
            f, g = (k + 0.25) / count, (k + 0.75) / count
            quad = np.array([a + f * (b - a), a + g * (b - a), d + g * (c - d), d + f * (c - d)])
            out.append(Paint("white", quad))
    if pattern in ("ladder", "outline"):
        thick = 0.3 if pattern == "outline" else 0.2
        across = (d - a) / max(float(np.hypot(*(d - a))), 1e-6) * thick / 2
        for p, q, inward in ((a, b, across), (d, c, -across)):
            out.append(Paint("white", stroke(np.array([p + inward, q + inward]), thick)))
    return out


def crossing_corners(ring: Array) -> Array | None:
    """The four corners (4, 2) of a crossing, the long sides first → second and fourth → third.

    Rings with more vertices are replaced by their minimum rotated rectangle.
    """
    polygon = shapely.polygons(ring)
    if not polygon.is_valid or len(ring) != 5:
        hull = shapely.oriented_envelope(polygon.convex_hull)
        if hull.geom_type != "Polygon":
            return None
        ring = np.asarray(hull.exterior.coords)
    corners = ring[:4]
    sides = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
    if sides[0] + sides[2] < sides[1] + sides[3]:
        corners = np.roll(corners, -1, axis=0)
    return corners
