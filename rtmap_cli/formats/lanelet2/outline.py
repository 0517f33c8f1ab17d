"""Outlines from bounds: which way round a lanelet's bounds run, how an area's border closes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import project
from rtmap_cli.geometry.rings import signed_area

Array = NDArray[np.float64]
Points = Mapping[int, Array]


def aligned(
    left: Sequence[int], right: Sequence[int], points: Points
) -> tuple[list[int], list[int]]:
    """Both bounds of a lanelet (node ids) in its direction.

    A file may hold either bound backwards. Lanelet2's rule (``geometry::align``): the middle of the
    right bound lies to the right of the left one, and the other way round.
    """
    a, b = list(left), list(right)
    if _leftward(_middle(b, points), a, points) > 0:
        a = a[::-1]
    if _leftward(_middle(a, points), b, points) < 0:
        b = b[::-1]
    return a, b


def _middle(nodes: list[int], points: Points) -> Array:
    if len(nodes) > 2:
        return points[nodes[len(nodes) // 2]][:2]
    return (points[nodes[0]][:2] + points[nodes[-1]][:2]) / 2


def _leftward(point: Array, nodes: list[int], points: Points) -> float:
    """Which side of a line a point lies on: positive to the left of it."""
    line = np.stack([points[n][:2] for n in nodes])
    _, _, segment = project(point[None], line)
    start, end = line[segment[0]], line[segment[0] + 1]
    along, off = end - start, point - start
    return float(along[0] * off[1] - along[1] * off[0])


def ring_of(left: Sequence[int], right: Sequence[int]) -> list[int]:
    """The nodes around a lanelet: left bound forwards, right bound backwards, closed."""
    ring: list[int] = []
    for node in [*left, *reversed(right), left[0]]:
        if not ring or ring[-1] != node:
            ring.append(node)
    return ring


def turn_tag(ring: Array) -> str:
    """How ``turned`` finds a closed ring again in what ``ring_of`` makes of its ``sides_of``."""
    left, right = sides_of(ring)
    around = ring_of(left, right)[:-1]
    return f"{around.index(0)} {'left' if signed_area(ring[:-1]) > 0 else 'right'}"


def turned(ring: Sequence[int], tag: str) -> list[int]:
    """The closed ring (ids) with the start and the direction that a ``turn_tag`` tells."""
    start, _, side = tag.partition(" ")
    open_ring = list(ring[:-1])
    first = int(start) % len(open_ring) if start.isdecimal() else 0
    open_ring = open_ring[first:] + open_ring[:first]
    if side == "left":
        open_ring = open_ring[:1] + open_ring[:0:-1]
    return [*open_ring, open_ring[0]]


def border_of(ways: Sequence[Sequence[int]]) -> list[int] | None:
    """The nodes around an area from its outer ways in order, each either way round; None where
    they do not close."""
    if not ways:
        return None
    if len(ways) == 1:
        ring = list(ways[0])
        ring += [] if ring[0] == ring[-1] else ring[:1]
        return ring if len(ring) > 3 else None
    first = list(ways[0])
    ring = first if first[-1] in (ways[1][0], ways[1][-1]) else first[::-1]
    for way in ways[1:]:
        step = list(way) if way[0] == ring[-1] else list(reversed(way))
        if step[0] != ring[-1]:
            return None
        ring = ring + step[1:]
    return ring if ring[0] == ring[-1] and len(ring) > 3 else None


def sides_of(ring: Array) -> tuple[list[int], list[int]]:
    """Left and right bound of a crosswalk as indices into its closed ring (n, 2 or 3).

    The bounds run along the longer pair of sides between the corners of the smallest rectangle
    around the ring; together they hold every vertex, so that ``ring_of`` gives the ring again.
    """
    count = len(ring) - 1
    order = list(range(count))
    if signed_area(ring[:-1]) > 0:
        order = order[::-1]
    if count == 3:
        return [order[0], order[1]], [order[0], order[2]]
    xy = ring[order, :2]
    corners = _corners(xy)
    start, stop = corners[0], corners[2]
    if _chain(xy, corners[0], corners[1]) + _chain(xy, corners[2], corners[3]) < _chain(
        xy, corners[1], corners[2]
    ) + _chain(xy, corners[3], corners[0]):
        start, stop = corners[1], corners[3]
    turned = order[start:] + order[:start]
    middle = (stop - start) % count
    return turned[:middle], turned[middle:][::-1]


def _corners(xy: Array) -> list[int]:
    """The vertices of an open ring (n > 3, 2) nearest to the corners of its smallest rectangle, in
    the order of the ring; a quarter of the ring apart where that tells no four."""
    import shapely

    box = shapely.minimum_rotated_rectangle(shapely.MultiPoint(xy))
    if box.geom_type == "Polygon":
        ends = np.asarray(box.exterior.coords)[:4]
        near = np.hypot(*np.moveaxis(xy[:, None] - ends, -1, 0)).argmin(axis=0)
        found = sorted(set(near.tolist()))
        if len(found) == 4:
            return found
    return [len(xy) * k // 4 for k in range(4)]


def _chain(xy: Array, start: int, stop: int) -> float:
    """Length of an open ring from one vertex to another (m)."""
    index = np.arange(start, stop + 1 if stop > start else stop + len(xy) + 1) % len(xy)
    return float(np.hypot(*np.diff(xy[index], axis=0).T).sum())
