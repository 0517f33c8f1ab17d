"""Where another map lies relative to this one: a shift, and what differs from place to place.

Two surveys of one town may be a metre apart as a whole and some decimetres more here and there.
The shift under which most lines lie on each other is searched for first; then a smooth field is
measured across all lines that both maps have (`maps/registration.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.maps.element import Element
from rtmap_cli.maps.registration import Votes, field_at
from rtmap_cli.maps.stations import GATE, MIN_COS, Stations
from rtmap_cli.steps.merge_maps.common import Common, Lines, in_common, lines_of

Array = NDArray[np.float64]

FARTHEST, STEP = 4.0, 0.5
"""The shift is looked for up to so many metres to each side, in such steps."""
SOME = 4000
"""Stations that are compared for it."""
WIDTH = 30.0
"""Sigma (m) of the kernel in which the field is measured."""
OWN_SIGMA, FIELD_SIGMA = 0.15, 0.3
"""Standard deviations (m) of a line in the field, and of the field itself."""
CELL = 5.0
"""What a line says within such a stretch (m) of it is one vote."""
ROUNDS = 3
"""The lines are assigned to each other and the field measured so many times."""


@dataclass(frozen=True)
class Displacement:
    """Of the other map relative to this one (metres): the common ``shift`` (2,) and height ``up``
    (0 where one of them has none), ``spread`` that is left across the lines (median of the absolute
    values; NaN without common lines) and the share of the other map's lines near this one's that
    lie on one of them (NaN when none does)."""

    shift: Array
    up: float
    spread: float
    shared: float


def put_onto_base(
    base: Mapping[str, Lines], elements: list[Element]
) -> tuple[list[Element], Displacement]:
    """The ``elements`` of another map, moved to where this one has the same things.

    ``base``: this map's lines by class.
    """
    classes = [c for c in dict.fromkeys(e.class_name for e in elements) if c in base]
    shift = _common_shift(base, {c: _of(elements, c) for c in classes})
    placed = [_moved(e, np.broadcast_to(shift, (len(e.points), 2))) for e in elements]
    total = shift.copy()
    for _ in range(ROUNDS):
        found = {c: _both(base[c], placed, c) for c in classes}
        votes = _votes(base, found)
        if votes is None:
            break
        mean = _mean_shift(votes)
        total += mean
        votes = replace(votes, offset=votes.offset - votes.normal @ mean)
        move = mean + field_at(votes, np.concatenate([e.xy for e in placed]), WIDTH)
        parts = np.split(move, np.cumsum([len(e.points) for e in placed])[:-1])
        placed = [_moved(e, part) for e, part in zip(placed, parts, strict=True)]
    found = {c: _both(base[c], placed, c) for c in classes}
    offsets = np.concatenate([np.zeros(0), *(np.abs(c.feet.offset) for _, c in found.values())])
    up = _height(base, found)
    placed = [replace(e, points=e.points - [0.0, 0.0, up]) for e in placed]
    spread = float(np.median(offsets)) if len(offsets) else np.nan
    return placed, Displacement(total, up, spread, _shared(base, found))


def _of(elements: list[Element], name: str) -> Lines:
    return lines_of([e for e in elements if e.class_name == name])


def _both(base: Lines, placed: list[Element], name: str) -> tuple[Lines, Common]:
    other = _of(placed, name)
    return other, in_common(base, other)


def _moved(element: Element, move: Array) -> Element:
    points = element.points.copy()
    points[:, :2] -= move
    if element.ring:
        points[-1] = points[0]
    return replace(element, points=points)


def _common_shift(base: Mapping[str, Lines], other: Mapping[str, Lines]) -> Array:
    """(2,) the shift (m) under which most lines lie on each other; the smaller one of equals."""
    steps = np.arange(-FARTHEST, FARTHEST + STEP / 2, STEP)
    shifts = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    shifts = shifts[np.argsort(np.hypot(*shifts.T), kind="stable")]
    total = sum(len(o.stations) for o in other.values())
    every = max(1, total // SOME)
    score = np.zeros(len(shifts))
    for name, lines in other.items():
        known = base[name].stations
        xy, tangent = lines.stations.xy[::every], lines.stations.tangent[::every]
        if not len(known) or not len(xy):
            continue
        for k, shift in enumerate(shifts):
            score[k] += _on_lines(known, xy - shift, tangent)
    # A shift that gains less than a hundredth is none: straight streets look alike along them.
    return np.asarray(shifts[int(np.argmax(score >= 0.99 * score.max()))], np.float64)


def _on_lines(known: Stations, xy: Array, tangent: Array) -> float:
    """How well points lie on lines: Σ 1 − (offset / gate)²."""
    _, at = known.tree.query(xy, distance_upper_bound=GATE)
    ok = at < len(known)
    at, xy, tangent = at[ok], xy[ok], tangent[ok]
    offset = ((xy - known.xy[at]) * known.normal[at]).sum(axis=1)
    parallel = np.abs((tangent * known.tangent[at]).sum(axis=1)) >= MIN_COS
    gain = np.maximum(1 - (offset / (GATE / 2)) ** 2, 0.0)
    return float((gain * parallel).sum())


def _votes(base: Mapping[str, Lines], found: Mapping[str, tuple[Lines, Common]]) -> Votes | None:
    """One vote per stretch of a line of this map that the other one has, too."""
    parts = []
    for name, (other, common) in found.items():
        known, feet = base[name].stations, common.feet
        if not len(feet):
            continue
        cell = np.floor(known.s[feet.station] / CELL).astype(np.int64)
        _, key = np.unique(
            known.line[feet.station] * (int(cell.max()) + 1) + cell, return_inverse=True
        )
        columns = np.column_stack(
            [other.stations.xy[feet.sample], known.normal[feet.station], feet.offset]
        )
        number = np.bincount(key)
        sums = [np.bincount(key, columns[:, c]) / number for c in range(5)]
        parts.append(np.stack(sums, axis=-1))
    if not parts:
        return None
    rows = np.concatenate(parts)
    normal = rows[:, 2:4] / np.maximum(np.hypot(*rows[:, 2:4].T), 1e-9)[:, None]
    n = len(rows)
    return Votes(
        rows[:, :2], normal, rows[:, 4], np.full(n, OWN_SIGMA**2), np.full(n, FIELD_SIGMA**2)
    )


def _mean_shift(votes: Votes) -> Array:
    """(2,) the shift that explains the votes best: least squares with Huber weights; small where
    nothing fixes it."""
    out = np.zeros(2)
    for _ in range(5):
        left = np.abs(votes.offset - votes.normal @ out)
        weight = np.minimum(1.0, 2 * OWN_SIGMA / np.maximum(left, 1e-9))
        matrix = (votes.normal * weight[:, None]).T @ votes.normal + np.eye(2)
        out[:] = np.linalg.solve(matrix, (votes.normal * weight[:, None]).T @ votes.offset)
    return out


def _height(base: Mapping[str, Lines], found: Mapping[str, tuple[Lines, Common]]) -> float:
    """Median of how much higher the other map has the same lines; 0 where heights are unknown."""
    parts = [np.zeros(0)]
    for name, (other, common) in found.items():
        here, there = heights(base[name]), heights(other)
        parts.append(there[common.feet.sample] - here[common.feet.station])
    up = np.concatenate(parts)
    up = up[np.isfinite(up)]
    return float(np.median(up)) if len(up) else 0.0


def heights(lines: Lines) -> Array:
    """(n,) heights of the stations, NaN where unknown."""
    return np.concatenate(
        [np.zeros(0), *(lines.at_stations(k, 2) for k in range(len(lines.elements)))]
    )


def _shared(base: Mapping[str, Lines], found: Mapping[str, tuple[Lines, Common]]) -> float:
    """Of the other map's metres that lie within ``FARTHEST`` of this one's lines of their class the
    share that are the same line."""
    same, near = 0.0, 0.0
    for name, (other, common) in found.items():
        known, stations = base[name].stations, other.stations
        if not len(known) or not len(stations):
            continue
        far, _ = known.tree.query(stations.xy)
        here = far <= FARTHEST
        same += float(stations.spacing[here & common.same].sum())
        near += float(stations.spacing[here].sum())
    return same / near if near else np.nan
