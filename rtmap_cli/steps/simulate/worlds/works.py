"""A construction zone: for the length of the works a street is narrowed and its lanes are moved.

Along a stretch of the way one curb goes behind a barrier that stands some metres inside the road,
and the dividers beside it are painted anew, shifted away from it. Delineators stand along the
barrier, across the lane that is closed and between the lanes: they are on no map, but networks take
them for paint now and then.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.errors import NoAnswer
from rtmap_cli.geometry.polylines import arc_length, normals, resample_step, tangents
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.steps.simulate.worlds.changes import Change, cut_out, part_of

Array = NDArray[np.float64]

TAPER = 10.0
"""Metres over which the barrier comes in and goes out."""
NEAREST, FARTHEST = 2.8, 12.0
"""Distance (m) of the curb from the way, where works may be."""
REACH = 9.0
"""Dividers farther (m) from the way stay where they are."""
LEAST = 8.0
"""Shorter parts (m) of dividers stay, too."""
POSTS = 3.0
"""Distance (m) of the delineators of a row."""
BESIDE = 0.6
"""Distance (m) of delineators from barrier and paint."""
STEADY = 1.5
"""A curb does not jump by more (m) from one metre of the way to the next."""


@dataclass(frozen=True)
class Works:
    """The ``world`` during the works, its ``changes`` (before → works), and the rows of
    ``delineators`` (n, 2), map frame."""

    world: VectorMap
    changes: list[Change]
    delineators: list[Array]


def open_works(
    vector_map: VectorMap, path: Array, metres: float, rng: np.random.Generator
) -> Works:
    """A construction zone of some ``metres`` on a random side of a stretch of the ``path`` (n, 2).

    The barrier stands 2.0 to 2.6 m inside the curb and becomes the boundary; the curb behind it
    goes. Dividers within 9 m of the way move 0.9 to 1.5 m to the other side. NoAnswer when the path
    has no such stretch with a curb beside it.
    """
    way = resample_step(path, 1.0)
    size = int(metres) + 1
    for start in rng.permutation(max(len(way) - size + 1, 0))[:60].tolist():
        for side in rng.permutation([1.0, -1.0]).tolist():
            zone = _Zone(way[start : start + size], side)
            curb = zone.curb(vector_map)
            if curb is not None:
                return zone.opened(vector_map, *curb, rng)
    raise NoAnswer(f"the way has no {metres:g} m with a steady curb: choose shorter works")


class _Zone:
    """A stretch of the way (n, 2), a point every metre, with works on one ``side`` (1: left)."""

    def __init__(self, way: Array, side: float) -> None:
        self.way, self.side = way, side
        self.across = side * normals(way)
        s = arc_length(way)
        self.taper = np.clip(np.minimum(s, s[-1] - s) / min(TAPER, s[-1] / 4), 0.0, 1.0)

    def curb(self, vector_map: VectorMap) -> tuple[Element, tuple[float, float], Array] | None:
        """The boundary along the side, its stretch (stations, m) and its distance (n,) from the
        way; None where no single one runs there steadily."""
        rays = shapely.linestrings(np.stack([self.way, self.way + FARTHEST * self.across], axis=1))
        here = shapely.points(self.way)
        lines = [(e, shapely.linestrings(e.xy)) for e in vector_map.of_class("boundary")]
        far = [shapely.distance(here, shapely.intersection(rays, line)) for _, line in lines]
        if not far:
            return None
        nearest = np.where(np.isfinite(far), far, np.inf).argmin(axis=0)
        if len(set(nearest.tolist())) > 1:
            return None
        (curb, line), distance = lines[nearest[0]], far[nearest[0]]
        if not np.isfinite(distance).all() or distance.min() < NEAREST:
            return None
        if len(distance) > 1 and np.abs(np.diff(distance)).max() > STEADY:
            return None
        ends = shapely.points(self.way[[0, -1]] + distance[[0, -1], None] * self.across[[0, -1]])
        a, b = sorted(shapely.line_locate_point(line, ends).tolist())
        # Not the long way round a closed one.
        if not 0.7 < (b - a) / len(self.way) < 1.4:
            return None
        return curb, (a, b), np.asarray(distance, np.float64)

    def opened(
        self,
        vector_map: VectorMap,
        curb: Element,
        stations: tuple[float, float],
        distance: Array,
        rng: np.random.Generator,
    ) -> Works:
        """The works in the map."""
        elements = vector_map.by_id()
        depth, shift = float(rng.uniform(2.0, 2.6)), float(rng.uniform(0.9, 1.5))
        changes = [_taken(elements, curb, *stations, "works-curb")]
        edge = distance - depth * self.taper
        barrier = self.way + edge[:, None] * self.across
        changes.append(_placed(elements, curb, barrier, "works-curb"))
        lanes = []
        for k, e in enumerate(vector_map.of_class("divider")):
            run = self._along(e)
            if run is None:
                continue
            changes.append(_taken(elements, e, *run, f"works-lane-{k}"))
            points = self._shifted(part_of(e.points, *run, 2.0)[:, :2], shift)
            changes.append(_placed(elements, e, points, f"works-lane-{k}"))
            lanes.append(points)
        rows = [self.way + (edge - BESIDE)[:, None] * self.across]
        rows.append(self._across_the_lane(distance, depth))
        rows += [p + BESIDE * self.side * normals(p) for p in lanes[:1]]
        world = VectorMap(elements.values(), vector_map.crs)
        return Works(world, changes, [resample_step(row, POSTS) for row in rows])

    def _along(self, divider: Element) -> tuple[float, float] | None:
        """The stretch (stations, m) of a divider that runs beside the zone."""
        total = float(arc_length(divider.xy)[-1])
        at = np.arange(0.0, total, 1.0)
        if not len(at):
            return None
        places = shapely.get_coordinates(
            shapely.line_interpolate_point(shapely.linestrings(divider.xy), at)
        )
        step = places[:, None] - self.way
        nearest = np.hypot(step[..., 0], step[..., 1]).argmin(axis=1)
        far = np.hypot(*(places - self.way[nearest]).T)
        beside = (far < REACH) & (nearest > 0) & (nearest < len(self.way) - 1)
        if len(places) > 1:
            beside &= (tangents(places) * tangents(self.way)[nearest]).sum(axis=1) ** 2 > 0.8
        index = np.flatnonzero(beside)
        if len(index) < LEAST or (np.diff(index) > 1).any():
            return None
        return float(at[index[0]]), float(min(at[index[-1]] + 1.0, total))

    def _shifted(self, points: Array, shift: float) -> Array:
        """Points moved away from the works, by as much as the barrier is in."""
        step = points[:, None] - self.way
        nearest = np.hypot(step[..., 0], step[..., 1]).argmin(axis=1)
        return np.asarray(
            points - shift * self.taper[nearest, None] * self.across[nearest], np.float64
        )

    def _across_the_lane(self, distance: Array, depth: float) -> Array:
        """A slanting row of posts from the curb to the barrier, where the works begin."""
        n = int(np.argmax(self.taper >= 1.0)) + 1
        share = np.linspace(0.2, 1.0, n)
        away = distance[:n] - (depth + BESIDE) * share
        return np.asarray(self.way[:n] + away[:, None] * self.across[:n], np.float64)


def _taken(
    elements: dict[str, Element], element: Element, start: float, end: float, moved: str
) -> Change:
    """A stretch of an element that is gone for the works."""
    gone = part_of(element.points, start, end)[:, :2]
    cut_out(elements, element, start, end)
    return Change(element.element_id, "delete", element.class_name, gone, moved)


def _placed(elements: dict[str, Element], source: Element, points: Array, moved: str) -> Change:
    """What stands there instead, on the ground of what it stands for."""
    line = shapely.linestrings(source.xy)
    at = shapely.line_locate_point(line, shapely.points(points))
    z = np.interp(at, arc_length(source.xy), source.points[:, 2])
    new = np.column_stack([points, z])
    elements[moved] = Element(moved, source.class_name, new, attributes=source.attributes)
    return Change(moved, "insert", source.class_name, points, moved)
