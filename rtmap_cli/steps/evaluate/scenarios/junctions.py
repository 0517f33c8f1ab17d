"""Junctions, islands and lanes of a map, read off its boundaries, crossings and dividers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import is_ring, length, resample_step
from rtmap_cli.maps.crop import joined
from rtmap_cli.maps.element import VectorMap

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

SAMPLE = 1.0
"""Spacing of points on boundaries, metres."""
NEAR = 60.0
"""Boundaries farther from the path than this (m) play no part."""
RADIUS = (3.0, 25.0)
"""Radius of the circles in which roads meet, metres."""
ARM_DEPTH = 20.0
"""A side road is at least this deep (m): its two kerbs are twice that apart along the boundary."""
ARM_WIDTH = 5.0
"""The kerbs of an arm are at least this far apart (m)."""
MEDIAN_WIDTH = 4.0
"""A closed boundary of mean width 2A/L below this (m) is a median, not the side of a road."""
MARGIN = 5.0
"""A vehicle this far (m) from the area of a junction is at it; a crossing whose centre is this far
from its circle belongs to it."""
LANE_WIDTH = 2.0
"""Dividers nearer to each other than this (m) are one."""
SIDEWAYS = 25.0
"""Lanes are counted up to this distance to each side (m)."""
PARALLEL = np.cos(np.radians(30.0))
"""Only lines within 30° of the heading part lanes."""


def ring_area(ring: Array) -> float:
    """Area inside a closed ring, m² (shoelace)."""
    x, y = (ring[:, :2] - ring[0, :2]).T
    return float(abs((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) / 2)


@dataclass(frozen=True)
class Island:
    """A closed boundary: centroid (2,) in the map frame, area in m², roundness 4πA/L²."""

    centre: Array
    area: float
    roundness: float


class RoadMap:
    """The elements near a path; ``medians`` are thin closed boundaries, ``sides`` the others."""

    def __init__(self, vector_map: VectorMap, path: Array) -> None:
        import shapely

        low, high = path.min(axis=0) - NEAR, path.max(axis=0) + NEAR
        lines: dict[str, list[Array]] = {"boundary": [], "divider": [], "ped_crossing": []}
        for element in joined(vector_map):
            apart = (element.xy.max(axis=0) < low) | (element.xy.min(axis=0) > high)
            if element.class_name in lines and not apart.any() and length(element.points) > 0:
                lines[element.class_name].append(element.xy)
        thin = [
            is_ring(p) and 2 * ring_area(p) / length(p) < MEDIAN_WIDTH for p in lines["boundary"]
        ]
        self.sides = [p for p, t in zip(lines["boundary"], thin, strict=True) if not t]
        self.medians = [p for p, t in zip(lines["boundary"], thin, strict=True) if t]
        self.dividers = lines["divider"]
        self.crossings = lines["ped_crossing"]
        self.walls = shapely.union_all([shapely.LineString(p) for p in self.sides])
        shapely.prepare(self.walls)
        self.path = path

    def islands(self) -> list[Island]:
        """The closed boundaries, medians too."""
        import shapely

        out = []
        for ring in (p for p in self.sides + self.medians if is_ring(p)):
            centre = shapely.get_coordinates(shapely.centroid(shapely.Polygon(ring)))[0]
            area = ring_area(ring)
            out.append(Island(centre, area, 4 * np.pi * area / length(ring) ** 2))
        return out

    def junctions(self) -> tuple[Array, Array, Array]:
        """Where roads meet: triangles (k, 3, 2), centres (k, 2) and radii (k,) of circles.

        A circle touches three sides and holds no boundary inside: the medial axis of the road
        forks at its centre (the circles are those of a Delaunay triangulation of points on the
        boundaries). Two points are of different sides when they are ``ARM_WIDTH`` apart and
        2 ``ARM_DEPTH`` along the boundary, or on different boundaries.
        """
        from scipy.spatial import Delaunay, QhullError, cKDTree

        nothing = np.zeros((0, 3, 2)), np.zeros((0, 2)), np.zeros(0)
        points, line, along, around = self._samples()
        if len(points) < 4:
            return nothing
        near = np.isfinite(cKDTree(self.path).query(points, distance_upper_bound=NEAR)[0])
        points, line, along, around = points[near], line[near], along[near], around[near]
        try:
            corners = Delaunay(points - self.path[0]).simplices
        except (QhullError, ValueError):
            return nothing
        apart = np.ones(len(corners), dtype=bool)
        for a, b in ((0, 1), (1, 2), (2, 0)):
            i, j = corners[:, a], corners[:, b]
            way = np.abs(along[i] - along[j])
            way = np.minimum(way, np.where(around[i] > 0, around[i] - way, np.inf))
            apart &= (line[i] != line[j]) | (way >= 2 * ARM_DEPTH)
            apart &= np.hypot(*(points[i] - points[j]).T) >= ARM_WIDTH
        triangles = points[corners[apart]]
        centre, radius = _circles(triangles)
        kept = (radius >= RADIUS[0]) & (radius <= RADIUS[1])
        return triangles[kept], centre[kept], radius[kept]

    def _samples(self) -> tuple[Array, NDArray[np.int64], Array, Array]:
        """Points (n, 2) on the sides, their line, place along it, and its length if closed."""
        points, line, along, around = (
            [np.zeros((0, 2))],
            [np.zeros(0)],
            [np.zeros(0)],
            [np.zeros(0)],
        )
        for k, side in enumerate(self.sides):
            closed, total = is_ring(side), length(side)
            p = resample_step(side, SAMPLE)
            s = np.linspace(0.0, total, len(p))
            if closed:
                p, s = p[:-1], s[:-1]
            points.append(p)
            line.append(np.full(len(p), k))
            along.append(s)
            around.append(np.full(len(p), total if closed else 0.0))
        return (
            np.concatenate(points),
            np.concatenate(line).astype(np.int64),
            np.concatenate(along),
            np.concatenate(around),
        )

    def at_junction(self) -> Bools:
        """(n,) True where the path is within ``MARGIN`` of the area of a junction, and no boundary
        lies between it and the centre. The area spans the three sides and the crossings there."""
        import shapely

        out = np.zeros(len(self.path), dtype=bool)
        triangles, centres, radii = self.junctions()
        if not len(centres):
            return out
        areas = shapely.polygons(triangles)
        zebras = [shapely.Polygon(p) for p in self.crossings if len(p) > 3]
        middles = shapely.STRtree(shapely.centroid(zebras)) if zebras else None
        for k, (centre, radius) in enumerate(zip(centres, radii, strict=True)):
            if middles is not None:
                reach = float(radius) + MARGIN
                near = middles.query(shapely.Point(centre), "dwithin", reach).tolist()
                parts = [areas[k], *(zebras[n] for n in near)]
                areas[k] = shapely.convex_hull(shapely.geometrycollections(parts))
        tree = shapely.STRtree(shapely.points(self.path))
        which, at = tree.query(areas, predicate="dwithin", distance=MARGIN)
        ways = shapely.linestrings(np.stack([self.path[at], centres[which]], axis=1))
        out[at[~shapely.intersects(self.walls, ways)]] = True
        return out

    def lanes(self, yaw: Array) -> NDArray[np.int64]:
        """(n,) lanes across the road at each place of the path: dividers and medians, plus one.

        Counted on the section across the heading ``yaw`` (n,), to the first boundary on each side
        or ``SIDEWAYS``; lines at more than 30° to the heading do not count.
        """
        import shapely

        across = np.column_stack([-np.sin(yaw), np.cos(yaw)])
        section = shapely.linestrings(
            np.stack([self.path - SIDEWAYS * across, self.path + SIDEWAYS * across], axis=1)
        )
        ends = np.tile([-SIDEWAYS, SIDEWAYS], (len(self.path), 1))
        for k, at, _ in _crossings(self.sides, section, self.path, across):
            side = int(at > 0)
            ends[k, side] = min(ends[k, side], at) if side else max(ends[k, side], at)
        found: list[list[float]] = [[] for _ in self.path]
        for k, at, way in _crossings(self.dividers + self.medians, section, self.path, across):
            heading = np.array([np.cos(yaw[k]), np.sin(yaw[k])])
            if ends[k, 0] < at < ends[k, 1] and abs(way @ heading) >= PARALLEL:
                found[k].append(at)
        return np.array([1 + _distinct(values) for values in found], dtype=np.int64)


def _distinct(values: list[float]) -> int:
    """How many of the values are at least ``LANE_WIDTH`` above the last one counted."""
    count, last = 0, -np.inf
    for value in sorted(values):
        if value - last >= LANE_WIDTH:
            count, last = count + 1, value
    return count


def _crossings(lines: list[Array], sections: Any, places: Array, across: Array) -> Any:
    """Triples: section, signed distance from its place (m), unit direction of the line there."""
    import shapely

    if not lines:
        return
    pairs = np.concatenate([np.stack([p[:-1], p[1:]], axis=1) for p in lines])
    way = pairs[:, 1] - pairs[:, 0]
    size = np.hypot(way[:, 0], way[:, 1])
    pairs, way = pairs[size > 0], way[size > 0] / size[size > 0, None]
    tree = shapely.STRtree(shapely.linestrings(pairs))
    at, which = tree.query(sections, predicate="intersects")
    offset = pairs[which, 0] - places[at]
    # The place p + u a on the segment's line: u = (offset × way) / (a × way).
    turned = np.column_stack([way[which, 1], -way[which, 0]])
    slope = (across[at] * turned).sum(axis=1)
    flat = np.abs(slope) < 1e-9
    u = (offset * turned).sum(axis=1) / np.where(flat, 1.0, slope)
    yield from zip(at[~flat].tolist(), u[~flat].tolist(), way[which][~flat], strict=True)


def _circles(corners: Array) -> tuple[Array, Array]:
    """Centres (n, 2) and radii (n,) of the circles through triangles (n, 3, 2)."""
    a = corners[:, 0]
    b, c = corners[:, 1] - a, corners[:, 2] - a
    bb, cc = (b**2).sum(axis=1), (c**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        d = 2 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
        offset = np.column_stack(
            [(c[:, 1] * bb - b[:, 1] * cc) / d, (b[:, 0] * cc - c[:, 0] * bb) / d]
        )
    return a + offset, np.hypot(offset[:, 0], offset[:, 1])
