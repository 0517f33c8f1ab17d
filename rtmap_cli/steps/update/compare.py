"""The new lines against the old map: which stretches one has and the other lacks, and why.

Stations a metre apart of both sides are compared: an old one is *found* where a new line of its
class runs beside it, a new one *known* likewise. Exclusively: of two lines side by side on one
side, only the nearer one belongs to a line of the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import length
from rtmap_cli.maps.element import RING_CLASSES, Element
from rtmap_cli.maps.stations import MIN_COS, Stations, stations_of
from rtmap_cli.steps.update.accumulate import Heat
from rtmap_cli.steps.update.outlines import Line
from rtmap_cli.steps.update.settings import Settings

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

MISSING_OLD, MISSING_NEW, MOVED = "missing in old", "missing in new", "moved"
REASONS = (MISSING_OLD, MISSING_NEW, MOVED)

BRIDGE = 3
"""Stations between two stretches of one kind that do not part them."""
BEHIND = 0.75
"""Of the drives asked for, what the count behind a line must reach: drives never weigh the same."""
MOVE = 0.45
"""Lines that lie nearer (m) than this to their place in the map have not moved, however exact."""
MOVE_SIGMAS = 4.0
"""Offsets count from so many usual ones (of the class, robustly measured) on."""
MOVE_LENGTH = 8.0
PROFILE = 0.65
"""Half width (m, one sigma) of a line in the grid: what it adds to a line beside it."""
PARALLEL = 3.0
"""A lost stretch and a new one so near (m) to each other are one that moved."""
OVERLAP, CENTRES = 0.2, 3.0
"""Outlines that share as much, or whose centres lie so near (m), are one."""


@dataclass(frozen=True)
class Stretch:
    """What differs: ``reason``, the old element (None: it has none), ``points`` (n, 2) where the
    element lies now (of a missing one: where it lay), the ``confidence`` of the new line, and of a
    moved one where it lay ``before``."""

    reason: str
    class_name: str
    element_id: str | None
    points: Array
    confidence: float = 0.0
    drives: float = 0.0
    before: Array = field(default_factory=lambda: np.zeros((0, 2)))


def compare(
    old: Sequence[Element], new: Sequence[Line], heat: Heat, usual: float, settings: Settings
) -> list[Stretch]:
    """All stretches that differ between the elements and the extracted lines of one class."""
    if not old and not new:
        return []
    name = old[0].class_name if old else new[0].class_name
    if name in RING_CLASSES:
        return _rings(old, new, heat, usual, settings)
    return _lines(name, old, new, heat, usual, settings)


def looked_at(heat: Heat, xy: Array) -> Array:
    """(n,) how many drives looked at places of the map."""
    cells = np.floor(xy / heat.layout.cell).astype(np.int64)
    flat = np.append(heat.looked.ravel(), np.float32(0))
    return np.asarray(flat[heat.layout.places(cells)], np.float64)


def needed(heat: Heat, settings: Settings) -> int:
    """How many drives must have looked at what is lost, and stand behind what is new: as many as
    the settings say, if there are so many."""
    return max(min(settings.drives, int(heat.looked.max(initial=0))), 1)


def usual_of(old: Sequence[Element], heat: Heat, fallback: float) -> float:
    """The usual confidence of a class: the median over what was looked at of its elements and is
    there at all; ``fallback`` where the map has too few of them."""
    if not old:
        return fallback
    name = old[0].class_name
    field_ = heat.confidence(name)
    if name in RING_CLASSES:
        middle = np.array([e.xy[:-1].mean(axis=0) for e in old])
    else:
        middle = stations_of([e.xy for e in old]).xy
    value = heat.layout.value(field_, middle)
    good = value[(looked_at(heat, middle) >= 1) & (value > 0.1 * fallback)]
    return float(np.median(good)) if len(good) >= (3 if name in RING_CLASSES else 30) else fallback


# ---- lines


@dataclass(frozen=True)
class _Match:
    """Of each station the nearest of the other side (−1: none in reach), its distance (m), and
    whether it belongs to that line."""

    nearest: Int
    distance: Array
    found: Bool


def _match(a: Stations, b: Stations, settings: Settings) -> tuple[_Match, _Match]:
    """The stations of two sides matched both ways."""
    near_a, near_b = _nearest(a, b, settings.gate_m), _nearest(b, a, settings.gate_m)
    return (
        _judged(a, b, near_a, near_b[0], settings.same_m),
        _judged(b, a, near_b, near_a[0], settings.same_m),
    )


def _nearest(a: Stations, b: Stations, gate: float) -> tuple[Int, Array]:
    """Of every station of a the nearest of b that runs along it, and how far (m) it is."""
    nearest, distance = np.full(len(a), -1), np.full(len(a), np.inf)
    if not len(a) or not len(b):
        return nearest, distance
    count = min(12, len(b))
    far, which = b.tree.query(a.xy, count, distance_upper_bound=gate + 0.5)
    far, which = far.reshape(len(a), -1), which.reshape(len(a), -1)
    there = np.minimum(which, len(b) - 1)
    step = a.xy[:, None] - b.xy[there]
    along = (step * b.tangent[there]).sum(axis=-1)
    across = np.abs((step * b.normal[there]).sum(axis=-1))
    turn = np.abs((a.tangent[:, None] * b.tangent[there]).sum(axis=-1))
    good = np.isfinite(far) & (turn >= MIN_COS) & (np.abs(along) <= b.spacing[there] + 0.3)
    across = np.where(good, across, np.inf)
    best = across.argmin(axis=1)
    row = np.arange(len(a))
    distance = across[row, best]
    distance[distance > gate] = np.inf
    nearest = np.where(np.isfinite(distance), there[row, best], -1)
    return nearest, distance


def _judged(a: Stations, b: Stations, near: tuple[Int, Array], back: Int, same: float) -> _Match:
    nearest, distance = near
    reached = nearest >= 0
    mine = np.zeros(len(a), bool)
    ahead = back[nearest[reached]]
    mine[reached] = (ahead >= 0) & (a.chain[ahead] == a.chain[reached])
    return _Match(nearest, distance, (distance <= same) | (reached & mine))


def _lines(
    name: str,
    old: Sequence[Element],
    new: Sequence[Line],
    heat: Heat,
    usual: float,
    settings: Settings,
) -> list[Stretch]:
    a, b = stations_of([e.xy for e in old]), stations_of([line.points for line in new])
    in_old, in_new = _match(a, b, settings)
    looked = looked_at(heat, a.xy) if len(a) else np.zeros(0)
    need = needed(heat, settings)
    lost = (looked >= need) & ~in_old.found
    if len(a):
        lost &= _left(a, b, new, heat, name) < settings.lost * usual
    out = []
    for k, e in enumerate(old):
        for run in _runs(lost, ~in_old.found, a.of_line(k), settings.shortest_m, a):
            out.append(Stretch(MISSING_NEW, name, e.element_id, a.xy[run]))
    known = in_new.found
    for k in range(len(new)):
        for run in _runs(~known, ~known, b.of_line(k), settings.new_m, b):
            part = b.xy[run]
            sure, drives = _strength(heat, name, part)
            if sure >= settings.threshold * usual and drives >= BEHIND * need:
                out.append(Stretch(MISSING_OLD, name, None, part, sure, drives))
    out = _paired(out)
    return out + _moved(name, old, a, b, in_old, heat, settings)


def _strength(heat: Heat, name: str, xy: Array) -> tuple[float, float]:
    """Mean confidence along a line and how many drives stand behind it."""
    layout = heat.layout
    drives = float(np.median(layout.value(heat.drives(name), xy)))
    return float(layout.value(heat.confidence(name), xy).mean()), drives


def _left(a: Stations, b: Stations, new: Sequence[Line], heat: Heat, name: str) -> Array:
    """(n,) the confidence at old stations that no new line beside them explains."""
    layout, field_ = heat.layout, heat.confidence(name)
    half = layout.cell
    value = np.max([layout.value(field_, a.xy + k * half * a.normal) for k in (-1, 0, 1)], axis=0)
    if not len(b):
        return np.asarray(value, np.float64)
    far, which = b.tree.query(a.xy, distance_upper_bound=PARALLEL)
    there = np.minimum(which, len(b) - 1)
    # Seen from the side of the old line that is nearest to it.
    gap = np.maximum(np.where(np.isfinite(far), far, 1e3) - half, 0.0)
    beside = layout.value(field_, b.xy)[there] * np.exp(-0.5 * (gap / PROFILE) ** 2)
    return np.asarray(value - np.where(np.isfinite(far), beside, 0.0), np.float64)


def _runs(mark: Bool, bridge: Bool, order: Int, shortest: float, stations: Stations) -> list[Int]:
    """Stretches of one line whose stations are marked; short gaps that ``bridge`` are closed."""
    if not len(order):
        return []
    on = mark[order].copy()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(np.int8), [0]])))
    for stop, start in zip(edges[1:-1:2], edges[2::2], strict=True):
        if start - stop <= BRIDGE and bridge[order[stop:start]].all():
            on[stop:start] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(np.int8), [0]])))
    runs = [order[i:j] for i, j in zip(edges[::2], edges[1::2], strict=True) if j - i > 1]
    return [r for r in runs if length(stations.xy[r]) >= shortest]


def _paired(stretches: list[Stretch]) -> list[Stretch]:
    """Lost stretches with a new one beside them are moved ones."""
    import shapely

    lost = [s for s in stretches if s.reason == MISSING_NEW]
    fresh = [s for s in stretches if s.reason == MISSING_OLD]
    out, used = [], set()
    for s in fresh:
        line = shapely.LineString(s.points)
        best = None
        for k, gone in enumerate(lost):
            if k in used:
                continue
            other = shapely.LineString(gone.points)
            beside = shapely.distance(shapely.points(s.points), other) <= PARALLEL
            back = shapely.distance(shapely.points(gone.points), line) <= PARALLEL
            if min(beside.mean(), back.mean()) >= 0.6:
                best = k
        if best is None:
            out.append(s)
            continue
        used.add(best)
        gone = lost[best]
        out.append(
            Stretch(
                MOVED, s.class_name, gone.element_id, s.points, s.confidence, s.drives, gone.points
            )
        )
    return out + [s for k, s in enumerate(lost) if k not in used]


def _moved(
    name: str,
    old: Sequence[Element],
    a: Stations,
    b: Stations,
    match: _Match,
    heat: Heat,
    settings: Settings,
) -> list[Stretch]:
    """Stretches whose new line lies aside by more than offsets of the class usually are."""
    if not len(a) or not len(b):
        return []
    there = np.maximum(match.nearest, 0)
    offset = ((b.xy[there] - a.xy) * a.normal).sum(axis=1)
    known = match.found & (match.nearest >= 0)
    spread = 1.4826 * float(np.median(np.abs(offset[known]))) if known.any() else 0.0
    limit = max(MOVE, MOVE_SIGMAS * spread)
    out = []
    for k, e in enumerate(old):
        for side in (1.0, -1.0):
            far = known & (side * offset >= limit)
            close = known & (side * offset >= 0.5 * limit)
            for run in _runs(far, close, a.of_line(k), MOVE_LENGTH, a):
                points = b.xy[there[run]]
                kept = np.concatenate([[True], np.hypot(*np.diff(points, axis=0).T) > 0.2])
                if kept.sum() < 2:
                    continue
                sure, drives = _strength(heat, name, points)
                if drives < BEHIND * needed(heat, settings):
                    continue
                out.append(
                    Stretch(MOVED, name, e.element_id, points[kept], sure, drives, a.xy[run])
                )
    return out


# ---- outlines


def _rings(
    old: Sequence[Element], new: Sequence[Line], heat: Heat, usual: float, settings: Settings
) -> list[Stretch]:
    import shapely

    name = old[0].class_name if old else new[0].class_name
    shapes = [shapely.make_valid(shapely.Polygon(e.xy)) for e in old]
    fresh = [shapely.make_valid(shapely.Polygon(line.points)) for line in new]
    taken = {j for pair in _same(shapes, fresh) for j in [pair[1]]}
    held = {i for i, _ in _same(shapes, fresh)}
    out = []
    need = needed(heat, settings)
    field_ = heat.confidence(name)
    for i, e in enumerate(old):
        inner = _inner_points(e.xy)
        looked = looked_at(heat, inner)
        if i in held or (looked >= need).mean() < 0.5:
            continue
        seen = heat.layout.value(field_, inner)[looked >= need]
        if float(seen.mean()) < max(settings.lost, 0.25) * usual:
            out.append(Stretch(MISSING_NEW, name, e.element_id, e.xy))
    for j, line in enumerate(new):
        if j in taken or line.confidence < 1.5 * settings.threshold * usual:
            continue
        if line.drives >= BEHIND * need:
            out.append(Stretch(MISSING_OLD, name, None, line.points, line.confidence, line.drives))
    return out


def _same(old: Sequence[object], new: Sequence[object]) -> list[tuple[int, int]]:
    """Pairs of old and new outlines that may be one; one of either may be in several."""
    import shapely

    out = []
    for i, a in enumerate(old):
        for j, b in enumerate(new):
            if shapely.distance(a, b) > 0:
                continue
            common = shapely.intersection(a, b).area
            near = shapely.distance(shapely.centroid(a), shapely.centroid(b)) <= CENTRES
            smaller = min(shapely.area(a), shapely.area(b))
            if near or common >= 2 * OVERLAP * smaller:
                out.append((i, j))
    return out


def _inner_points(ring: Array) -> Array:
    """Points (n, 2) inside an outline: its centre and halfway to its vertices."""
    middle = ring[:-1].mean(axis=0)
    return np.concatenate([middle[None], middle + 0.5 * (ring[:-1] - middle)])
