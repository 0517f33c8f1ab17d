"""Elements from the lanes, crossings and drivable areas of an Argoverse 2 map (UTM metres)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rtmap_cli.geometry.polylines import arc_length, length
from rtmap_cli.maps.element import Element

Array = NDArray[np.float64]
Line = tuple[str, str, Array]
"""AV2 id with side, mark, points (n, 3)."""

UNPAINTED = frozenset({"NONE", "UNKNOWN"})
SAME_LINE = 0.05
"""Lines nearer than this (m) are one painted line: half the width of a narrow one."""
MIN_OVERLAP = 2.0
"""Lines that run together for less (m) part at a fork and are left as they are."""
MIN_AREA = 0.1
"""m² below which a crossing is none."""
MEET = 0.01
"""Ends within this distance (m) meet: AV2 rounds coordinates to it."""


@dataclass(frozen=True)
class _Piece:
    """A stretch of painted line: AV2 ids it stands for, its mark, points (n, 3)."""

    names: tuple[str, ...]
    mark: str
    points: Array


def crossings(edges: Mapping[int, tuple[Array, Array]], notes: Counter[str]) -> list[Element]:
    """One ring per crossing: edge 1 forwards, edge 2 backwards (turned round where they cross)."""
    out = []
    for crossing_id, (first, second) in sorted(edges.items()):
        if len(first) < 2 or len(second) < 2:
            notes["crossings without two edges left out"] += 1
            continue
        ring = np.concatenate([first, second[::-1]])
        if not shapely.Polygon(ring[:, :2]).is_valid:
            ring = np.concatenate([first, second])
            notes["crossings with crossed edges set right"] += 1
        if not shapely.Polygon(ring[:, :2]).is_valid:
            ring = _hull(ring)
        if shapely.Polygon(ring[:, :2]).area < MIN_AREA:
            notes["crossings without area left out"] += 1
            continue
        closed = np.concatenate([ring, ring[:1]])
        out.append(
            Element(
                f"crossing-{crossing_id}",
                "ped_crossing",
                closed,
                attributes={"av2_ids": str(crossing_id)},
            )
        )
    return out


def dividers(lines: Sequence[Line], notes: Counter[str]) -> list[Element]:
    """Painted lines, each once, joined end to end where two ends of one mark (and no other) meet.

    ``lines`` are all lane boundaries in a fixed order; neighbours name a shared one twice, in the
    same or the opposite direction, sometimes with other vertices.
    """
    painted = []
    for name, mark, points in lines:
        if mark in UNPAINTED:
            continue
        clean = _without_repeats(points)
        if len(clean) < 2:
            notes["painted lines of one point left out"] += 1
            continue
        painted.append(_Piece((name,), mark, clean))
    pieces = _without_overlaps(_without_copies(painted, notes), notes)
    chains = _joined(pieces)
    seen: Counter[str] = Counter()
    out = []
    for chain in chains:
        name = chain.names[0]
        seen[name] += 1
        suffix = f"-{seen[name]}" if seen[name] > 1 else ""
        out.append(
            Element(
                f"divider-{name}{suffix}",
                "divider",
                chain.points,
                attributes={"mark": chain.mark, "av2_ids": ",".join(chain.names)},
            )
        )
    return out


def boundaries(areas: Mapping[int, Array], notes: Counter[str]) -> list[Element]:
    """Outline of the union of drivable areas as closed rings, the drivable side on the left."""
    polygons, sources = [], []
    for area_id, ring in sorted(areas.items()):
        if len(ring) < 3:
            notes["drivable areas of fewer than three points left out"] += 1
            continue
        polygon = shapely.Polygon(ring[:, :2])
        if not polygon.is_valid:
            notes["drivable areas that cross themselves set right"] += 1
            parts = shapely.get_parts(shapely.make_valid(polygon))
            polygon = shapely.unary_union([p for p in parts if p.geom_type == "Polygon"])
        polygons.append((area_id, polygon))
        sources.append(np.concatenate([ring, ring[:1]]))
    if not polygons:
        return []
    union = shapely.orient_polygons(shapely.unary_union([p for _, p in polygons]))
    rings = [
        _from_lowest(np.asarray(r.coords)[:, :2])
        for part in shapely.get_parts(union)
        if part.geom_type == "Polygon"
        for r in (part.exterior, *part.interiors)
    ]
    rings.sort(key=lambda ring: tuple(ring[0]))
    seen: Counter[int] = Counter()
    out = []
    for ring in rings:
        outline = shapely.LineString(ring)
        owners = [i for i, p in polygons if p.boundary.intersection(outline).length > MEET]
        owner = min(owners) if owners else polygons[0][0]
        seen[owner] += 1
        suffix = f"-{seen[owner]}" if seen[owner] > 1 else ""
        out.append(
            Element(
                f"boundary-{owner}{suffix}",
                "boundary",
                _boundary_heights(ring, sources),
                attributes={"av2_ids": ",".join(map(str, owners))},
            )
        )
    return out


def _without_repeats(points: Array) -> Array:
    step = np.hypot(*np.diff(points[:, :2], axis=0).T) if len(points) > 1 else np.zeros(0)
    return points[np.concatenate([[True], step > 1e-6])] if len(points) else points


def _without_copies(pieces: list[_Piece], notes: Counter[str]) -> list[_Piece]:
    """Lines of the same vertices (in either direction) once; the first one's direction stays."""
    found: dict[tuple[tuple[float, float], ...], _Piece] = {}
    for piece in pieces:
        rows = [(round(x, 3), round(y, 3)) for x, y in piece.points[:, :2].tolist()]
        key = min(tuple(rows), tuple(rows[::-1]))
        kept = found.get(key)
        if kept is None:
            found[key] = piece
            continue
        notes["shared lane boundaries taken once"] += 1
        notes["lines with two marks, the first one kept"] += kept.mark != piece.mark
        found[key] = _Piece(kept.names + piece.names, kept.mark, kept.points)
    return list(found.values())


def _without_overlaps(pieces: list[_Piece], notes: Counter[str]) -> list[_Piece]:
    """Stretches that run along an already kept line (other vertices, same paint) taken out.

    Longer lines come first, so that a short copy gives way to the line that it is a part of.
    """
    order = sorted(range(len(pieces)), key=lambda i: (-length(pieces[i].points), i))
    shapes = [shapely.LineString(p.points[:, :2]) for p in pieces]
    tree = shapely.STRtree(shapes)
    kept: dict[int, list[_Piece]] = {}
    for i in order:
        near = [
            j
            for j in tree.query(shapes[i], predicate="dwithin", distance=SAME_LINE).tolist()
            if kept.get(j)
        ]
        bands = [shapes[j].buffer(SAME_LINE, cap_style="flat") for j in near]
        covers = [b for b in bands if shapes[i].intersection(b).length >= MIN_OVERLAP]
        if not covers and bands and shapes[i].length < MIN_OVERLAP:
            covers = [b for b in bands if b.covers(shapes[i])]
        if not covers:
            kept[i] = [pieces[i]]
            continue
        notes["lane boundaries that overlap another one cut"] += 1
        rest = shapely.difference(shapes[i], shapely.unary_union(covers))
        kept[i] = [
            _Piece(pieces[i].names, pieces[i].mark, _heights_along(part, pieces[i].points))
            for part in shapely.get_parts(rest)
            if part.length > 2 * SAME_LINE
        ]
    return [piece for i in range(len(pieces)) for piece in kept[i]]


def _heights_along(part: shapely.LineString, points: Array) -> Array:
    """A stretch of a line with the heights of the line (n, 3) that it comes from."""
    line = shapely.LineString(points[:, :2])
    xy = np.asarray(part.coords)[:, :2]
    at = shapely.line_locate_point(line, shapely.points(xy))
    return np.column_stack([xy, np.interp(at, arc_length(points), points[:, 2])])


def _joined(pieces: list[_Piece]) -> list[_Piece]:
    """Pieces joined where exactly two ends meet and both have one mark; rings where they close.

    Ends of other marks count: at a fork nothing is joined, whatever its marks are.
    """
    if not pieces:
        return []
    ends = np.array([p.points[k, :2] for p in pieces for k in (0, -1)])
    near = cKDTree(ends).query_ball_point(ends, MEET)
    partner = {}
    for end, group in enumerate(near):
        others = [e for e in group if e != end]
        if len(others) == 1 and len(near[others[0]]) == 2:
            other = others[0]
            if pieces[end // 2].mark == pieces[other // 2].mark:
                partner[end] = other
    used: set[int] = set()
    out = []
    # Chains from their free ends first; what is left are rings.
    for start in [e for e in range(len(ends)) if e not in partner] + list(range(len(ends))):
        if start // 2 in used:
            continue
        chain, end = [], start
        while True:
            used.add(end // 2)
            chain.append(end)
            following = partner.get(end ^ 1)
            if following is None or following // 2 in used:
                break
            end = following
        out.append(_chain(pieces, chain, closed=partner.get(end ^ 1) == start))
    return out


def _chain(pieces: list[_Piece], chain: list[int], closed: bool) -> _Piece:
    """One line of the pieces entered at the ends ``chain``, in the direction of the first id."""
    first = min(chain, key=lambda end: pieces[end // 2].names)
    if first % 2:
        chain = [end ^ 1 for end in reversed(chain)]
    parts = [pieces[e // 2].points[:: -1 if e % 2 else 1] for e in chain]
    points = np.concatenate([parts[0], *(p[1:] for p in parts[1:])])
    if closed and len(points) > 3:
        points[-1] = points[0]
    names = sorted({name for e in chain for name in pieces[e // 2].names}, key=_id_order)
    return _Piece(tuple(names), pieces[chain[0] // 2].mark, points)


def _id_order(name: str) -> tuple[int, str]:
    lane, _, side = name.rpartition("-")
    return int(lane), side


def _from_lowest(ring: Array) -> Array:
    """A closed ring started at its lowest vertex (x, then y), direction kept."""
    open_ring = ring[:-1]
    start = int(np.lexsort((open_ring[:, 1], open_ring[:, 0]))[0])
    turned = np.roll(open_ring, -start, axis=0)
    return np.concatenate([turned, turned[:1]])


def _hull(points: Array) -> Array:
    """Those of the (n, 3) points that lie on their convex hull, in order around it."""
    hull = shapely.MultiPoint(points[:, :2]).convex_hull
    if hull.geom_type != "Polygon":
        return points[:3]  # All on one line: no area whichever are taken.
    corners = np.asarray(hull.exterior.coords)[:-1, :2]
    return points[cKDTree(points[:, :2]).query(corners)[1]]


def _boundary_heights(ring: Array, sources: list[Array]) -> Array:
    """(n, 3): heights of the drivable areas' own vertices, along their edges where areas cross."""
    vertices = np.concatenate([s[:-1] for s in sources])
    distance, nearest = cKDTree(vertices[:, :2]).query(ring)
    z = np.where(distance <= MEET, vertices[nearest, 2], np.nan)
    lines = [shapely.LineString(s[:, :2]) for s in sources]
    for k in np.flatnonzero(distance > MEET):
        point = shapely.Point(ring[k])
        on = [i for i, line in enumerate(lines) if line.distance(point) <= MEET]
        heights = [
            np.interp(lines[i].project(point), arc_length(sources[i]), sources[i][:, 2]) for i in on
        ]
        z[k] = np.mean(heights) if heights else np.nan
    return np.column_stack([ring, z])
