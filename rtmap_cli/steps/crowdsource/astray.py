"""Traversals that lie elsewhere: found by what they saw, before they smear a map.

What a run saw is compared with what lies there by the map or, without one, by the other runs. A
run is astray when little of it is there, and much of it would be if the run were shifted by
metres. Changed streets and other towns fit nowhere better: they are not astray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import resample_step
from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.element import Element

Array = NDArray[np.float64]
Int = NDArray[np.int64]

CELL = 1.0
REACH = 2
"""What lies within so many cells of a point (about 2 m) is at its place: GNSS without a map is
that good."""
SURE = 0.3
"""Detections from this score on are compared."""
MOST = 600
"""Points of a run and class that are compared, evenly spread."""
ENOUGH = 60
"""Fewer points of a class say nothing."""
ALONG = 15.0
"""Without a map, only what lies so near (m) to the path of another run is compared."""
LITTLE, MUCH, GAIN = 0.6, 0.6, 0.25
"""Share of a class that is at its place, below which a run is looked for elsewhere; share of all
at the other place, and by how much it must be larger than here."""
ALIKE = 4.0
"""Two runs whose shifts differ by no more (m) are off alike."""
FARTHEST, NEAREST, STRIDE = 30, 5, 2
"""Shifts (cells) that are tried; smaller ones are errors as they come, for fusion to judge."""


@dataclass(frozen=True)
class Astray:
    """A run that is ``metres`` off the map or other runs; ``certain``: left out, else nobody
    can tell who is right."""

    run_id: str
    metres: float
    certain: bool
    off: str = "map"


@dataclass(frozen=True)
class _Seen:
    """Points of a run by class."""

    run_id: str
    points: dict[str, Array]
    path: Array


def find_astray(
    traversals: Sequence[Traversal], known: Sequence[Element], fused: frozenset[str]
) -> list[Astray]:
    """The runs of a region that lie elsewhere; those in ``fused`` are not judged.

    By the elements that are ``known`` there: certain, unless another run is off by as much (a new
    road beside an old one). Without them by each other: certain when two others agree.
    """
    seen = [_seen(t) for t in sorted(traversals, key=lambda t: t.run_id)]
    if known:
        there = _marks_of(known)
        found = {s.run_id: _shift(s.points, there) for s in seen if s.run_id not in fused}
        moved = {name: shift for name, shift in found.items() if shift.any()}
        return [
            Astray(name, float(np.hypot(*shift)), not _alike(name, moved))
            for name, shift in moved.items()
        ]
    cells = [{name: _cells(p) for name, p in s.points.items()} for s in seen]
    marks = {name: _Marks(cells, name) for name in sorted({n for c in cells for n in c})}
    out = []
    for k, s in enumerate(seen):
        others = [o.path for j, o in enumerate(seen) if j != k]
        if s.run_id in fused or not others:
            continue
        near = _near(s.points, np.concatenate(others))
        shift = _shift(near, {name: m.without(k) for name, m in marks.items()})
        if shift.any():
            out.append(Astray(s.run_id, float(np.hypot(*shift)), True, "other runs"))
    # Those who agree with each other are right, if there are two of them.
    return out if len(seen) - len(out) >= 2 else [replace(a, certain=False) for a in out]


def _alike(name: str, moved: dict[str, Array]) -> bool:
    """True when another run is off by as much in the same direction."""
    others = [shift for other, shift in moved.items() if other != name]
    return any(float(np.hypot(*(moved[name] - shift))) <= ALIKE for shift in others)


def _seen(traversal: Traversal) -> _Seen:
    points = {}
    sure = traversal.score >= SURE
    for name in sorted({str(c) for c in np.unique(traversal.class_name[sure].astype(str))}):
        xy = traversal.points[sure & (traversal.class_name == name)].reshape(-1, 2)
        points[name] = xy[:: max(1, len(xy) // MOST)]
    return _Seen(traversal.run_id, points, traversal.pose[:, :2])


def _near(points: dict[str, Array], path: Array) -> dict[str, Array]:
    """The points that another run has passed."""
    from scipy.spatial import cKDTree

    tree = cKDTree(path)
    return {
        name: xy[np.isfinite(tree.query(xy, distance_upper_bound=ALONG)[0])]
        for name, xy in points.items()
    }


def _cells(points: Array) -> Int:
    """(k,) keys of the cells within ``REACH`` of the points, sorted."""
    steps = np.arange(-REACH, REACH + 1)
    around = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    around = around[np.hypot(*around.T) <= REACH + 0.5]
    cell = np.unique(np.floor(points / CELL).astype(np.int64), axis=0)
    return np.unique(_key((cell[:, None] + around).reshape(-1, 2)))


def _key(cell: Int) -> Int:
    return (cell[..., 0] << 32) + cell[..., 1]


class _Marks:
    """The cells of a class that runs marked, with how many did."""

    def __init__(self, cells: Sequence[dict[str, Int]], name: str) -> None:
        none = np.zeros(0, np.int64)
        self.own = [c.get(name, none) for c in cells]
        self.keys, self.runs = np.unique(np.concatenate(self.own), return_counts=True)

    def without(self, k: int) -> Int:
        """Sorted keys that a run other than the k-th marked."""
        return self.keys[self.runs > np.isin(self.keys, self.own[k], assume_unique=True)]


def _marks_of(elements: Sequence[Element]) -> dict[str, Int]:
    """Cells at the elements, by class."""
    out: dict[str, list[Array]] = {}
    for e in elements:
        out.setdefault(e.class_name, []).append(resample_step(e.xy, CELL))
    return {name: _cells(np.concatenate(parts)) for name, parts in out.items()}


def _hits(points: Array, there: Int, shifts: Int) -> Array:
    """(n,) share of the points that lie on marked cells when shifted by ``shifts`` (n, 2) cells."""
    if not len(there):
        return np.zeros(len(shifts))
    cell = np.floor(points / CELL).astype(np.int64)
    out = np.zeros(len(shifts))
    for k, shift in enumerate(shifts):
        key = _key(cell + shift)
        at = np.minimum(np.searchsorted(there, key), len(there) - 1)
        out[k] = (there[at] == key).mean()
    return out


def _shift(points: dict[str, Array], there: dict[str, Int]) -> Array:
    """(2,) metres by which the points must be moved to lie where they should; 0 when they do lie
    there, or that cannot be told."""
    classes = [name for name, xy in points.items() if len(xy) >= ENOUGH and name in there]
    still = np.zeros((1, 2), np.int64)
    here = {n: float(_hits(points[n], there[n], still)[0]) for n in classes}
    if not classes or min(here.values()) >= LITTLE:
        return np.zeros(2)
    steps = np.arange(-FARTHEST, FARTHEST + 1, STRIDE)
    shifts = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    shifts = shifts[np.hypot(*shifts.T) >= NEAREST]
    weight = np.array([len(points[n]) for n in classes], np.float64)
    weight /= weight.sum()
    found = weight @ np.stack([_hits(points[n], there[n], shifts) for n in classes])
    best = int(found.argmax())
    before = float(weight @ np.array([here[n] for n in classes]))
    if found[best] < max(MUCH, before + GAIN):
        return np.zeros(2)
    # Shifts that fit as well lie around it, and along a straight street.
    alike = shifts[(found >= found[best] - 0.05) & (shifts @ shifts[best] > 0)]
    return np.asarray(alike.mean(axis=0) * CELL, np.float64)
