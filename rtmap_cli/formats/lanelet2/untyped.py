"""Bounds of lanelets that nobody gave a type: what they are, by where they lie."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import resample_step

Array = NDArray[np.float64]
Int = NDArray[np.int64]

NEAR = 0.3
"""Metres within which a bound runs along the edge of the road, or along another lanelet's."""
MOST = 0.8
"""Share of its length that must."""
STEP = 0.5
"""Metres between the points at which a bound is looked at."""


def classes_by_place(
    lines: Mapping[int, Array], areas: Mapping[int, Array], sides: Mapping[int, Sequence[int]]
) -> dict[int, str]:
    """Classes of those ``lines`` (n, 2) that bound lanelets; the others have none.

    A bound at the outline of the union of all lanelets (``areas``: rings (n, 2 or 3) by lanelet) is
    a ``boundary``; one that another lanelet has on its other side all along is a ``divider``. What
    crosses other lanelets, as bounds in junctions do, is neither, and of dividers drawn twice the
    one of the least id counts. ``sides``: lanelets of each line.
    """
    names = [k for k in sorted(lines) if sides[k]]
    if not names:
        return {}
    points, of = _samples([lines[k] for k in names])
    lanelets = list(areas)
    shapes = [shapely.make_valid(shapely.Polygon(areas[k][:, :2])) for k in lanelets]
    # Slits between neighbours whose bounds were drawn twice are no edges of the road.
    edge = shapely.union_all(shapes).buffer(NEAR).buffer(-NEAR).boundary
    at_edge = np.unique(_near(points, [edge])[0])
    place = {k: i for i, k in enumerate(lanelets)}
    own = {(i, place[k]) for i, name in enumerate(names) for k in sides[name]}

    def of_others(sample: Int, lanelet: Int) -> Int:
        """(n, 2) pairs of sample and lanelet, without the lanelets of the sample's own line."""
        pairs = np.stack([sample, lanelet], axis=1)
        keep = [(of[s], k) not in own for s, k in pairs.tolist()]
        return pairs[np.array(keep, bool)]

    beside = of_others(*_near(points, [s.boundary for s in shapes]))
    inside = of_others(*shapely.STRtree(shapes).query(shapely.points(points), "intersects"))
    deep = {tuple(p) for p in inside.tolist()} - {tuple(p) for p in beside.tolist()}
    shared = _share(at_edge, of), _share(beside[:, 0], of), _share([s for s, _ in deep], of)
    out = {}
    for name, edged, along, crossed in zip(names, *shared, strict=True):
        if edged >= MOST:
            out[name] = "boundary"
        elif (len(sides[name]) > 1 or along >= MOST) and crossed <= 1 - MOST:
            out[name] = "divider"
    return _once(out, lines)


def _once(classes: dict[int, str], lines: Mapping[int, Array]) -> dict[int, str]:
    """The classes without dividers that run where an earlier one does."""
    dividers = sorted(k for k, name in classes.items() if name == "divider")
    points, of = _samples([lines[k] for k in dividers])
    sample, near = _near(points, [shapely.LineString(lines[k]) for k in dividers])
    starts = np.searchsorted(of[sample], np.arange(len(dividers) + 1))
    twice: set[int] = set()
    for i, count in enumerate(np.bincount(of, minlength=len(dividers))):
        mine = slice(starts[i], starts[i + 1])
        pairs = zip(sample[mine].tolist(), near[mine].tolist(), strict=True)
        if len({s for s, k in pairs if k < i and k not in twice}) >= MOST * count:
            twice.add(i)
    gone = {dividers[i] for i in twice}
    return {k: name for k, name in classes.items() if k not in gone}


def _samples(lines: Sequence[Array]) -> tuple[Array, Int]:
    """Points every ``STEP`` metres of all lines, and the index of the line of each."""
    parts = [resample_step(line, STEP) for line in lines]
    if not parts:
        return np.zeros((0, 2)), np.zeros(0, np.int64)
    return np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(p) for p in parts])


def _near(points: Array, shapes: Sequence[shapely.Geometry]) -> tuple[Int, Int]:
    """Pairs (point, shape) within ``NEAR`` of each other, sorted; ``shapes`` are lines, taken by
    their segments, since a long line is near everything."""
    ends, owner = [], []
    for k, shape in enumerate(shapes):
        for part in shapely.get_parts(shape):
            xy = shapely.get_coordinates(part)
            ends.append(np.stack([xy[:-1], xy[1:]], axis=1))
            owner.append(np.full(len(xy) - 1, k))
    if not ends or not len(points):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    tree = shapely.STRtree(shapely.linestrings(np.concatenate(ends)))
    sample, segment = tree.query(shapely.points(points), "dwithin", NEAR)
    pairs = np.unique(np.stack([sample, np.concatenate(owner)[segment]]), axis=1)
    return pairs[0], pairs[1]


def _share(samples: Sequence[int] | Int, of: Int) -> Array:
    """Which share of the points of each line is among ``samples``."""
    found = np.bincount(of[np.unique(np.asarray(samples, np.int64))], minlength=of[-1] + 1)
    out: Array = found / np.bincount(of)
    return out
