"""The new lines against the old map: which stretches one has and the other lacks, and why.

Of lines, what the old ones claim of the detections (``claims``) says station by station whether
they are found and how far aside they lie; new ones are lines of the grids of the rest. Outlines of
old and new are compared as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import length
from rtmap_cli.maps.element import RING_CLASSES, Element
from rtmap_cli.maps.stations import MIN_COS, Stations, stations_of
from rtmap_cli.steps.update.accumulate import Accumulated, Heat
from rtmap_cli.steps.update.claims import Claims
from rtmap_cli.steps.update.outlines import Line
from rtmap_cli.steps.update.settings import Settings

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

MISSING_OLD, MISSING_NEW, MOVED = "missing in old", "missing in new", "moved"
REASONS = (MISSING_OLD, MISSING_NEW, MOVED)

POOR = 1.5
"""A lost stretch goes on where the share found is below so many times its limit."""
CLOSE = 0.6
"""A moved stretch goes on where it lies aside by so much of its limit."""
BRIDGE = 1
"""Stations between two stretches of one kind that do not part them."""
BEHIND = 0.75
"""Of the drives asked for, what the count behind a line must reach: drives never weigh the same."""
MOVE = 0.45
"""Lines that lie nearer (m) than this to their place in the map have not moved, however exact."""
MOVE_SIGMAS = 4.0
"""Offsets count from so many usual ones (of the class, robustly measured) on."""
GAUSSIAN = {0.3: 0.385, 0.5: 0.674}
"""Quantiles of the absolute value of a unit Gaussian."""
MOST = 1.25
"""Offsets of whole places are hardly more often than that factor beyond the stated sigmas."""
MOVE_LENGTH = 8.0
SAME = 1.0
"""A new line so near (m) to a moved one is that one."""
PARALLEL = 3.0
"""A lost stretch and a new one so near (m) to each other are one that moved."""
OVERLAP, CENTRES = 0.2, 3.0
"""Outlines that share as much, or whose centres lie so near (m), are one."""


@dataclass(frozen=True)
class Stretch:
    """What differs: ``reason``, the old element (None: it has none), ``points`` (n, 2) where the
    element lies now (of a missing one: where it lay), the ``confidence`` of the new line, and of a
    moved one where it lay ``before`` and how far ``aside`` of that it lies, in limits of what
    counts."""

    reason: str
    class_name: str
    element_id: str | None
    points: Array
    confidence: float = 0.0
    drives: float = 0.0
    before: Array = field(default_factory=lambda: np.zeros((0, 2)))
    aside: float = 0.0


def compare(
    name: str,
    old: Sequence[Element],
    new: Sequence[Line],
    found: Accumulated,
    usual: float,
    settings: Settings,
) -> list[Stretch]:
    """All stretches that differ between the elements of a class and what was found: all outlines,
    or the lines of what the old ones leave."""
    if name in RING_CLASSES:
        return _rings(name, old, new, found.heat, usual, settings)
    return _lines(name, old, new, found.heat, found.claims.get(name), usual, settings)


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


def _lines(
    name: str,
    old: Sequence[Element],
    new: Sequence[Line],
    heat: Heat,
    claims: Claims | None,
    usual: float,
    settings: Settings,
) -> list[Stretch]:
    """Stretches of old lines that are not found or lie aside, and lines of what they leave."""
    need = needed(heat, settings)
    fresh = [
        Stretch(MISSING_OLD, name, None, line.points, line.confidence, line.drives)
        for line in new
        if length(line.points) >= settings.new_m
        and line.confidence >= settings.threshold * usual
        and line.drives >= BEHIND * need
    ]
    if claims is None:
        return fresh
    a = claims.stations
    looked, share = claims.looked >= need, claims.confidence / max(claims.usual, 1e-9)
    lost, poor = looked & (share < settings.lost), looked & (share < POOR * settings.lost)
    offset, limit = _offsets(claims, need)
    far = _to_fresh(a, fresh)
    gone = lost & np.isfinite(far)
    offset, limit = np.where(gone, far, offset), np.where(gone, MOVE, limit)
    moved = _moved(name, old, claims, offset, limit, need)
    lost, poor = lost & ~gone, poor & ~gone
    out = []
    for k, e in enumerate(old):
        for run in _runs(lost, poor, a.of_line(k), settings.shortest_m, a):
            out.append(Stretch(MISSING_NEW, name, e.element_id, a.xy[run]))
    return out + _beside(fresh, moved) + moved


def _offsets(claims: Claims, need: int) -> tuple[Array, Array]:
    """(n,) how far aside (m) stations of the old lines lie, and from where on they have moved: a
    line lies aside of its neighbours or, where all lanes have moved, of its own place."""
    place, beyond, sigma = claims.aside(need)
    usual = _usual(np.abs(beyond) / sigma)
    # Sigmas are not off by much more than that, or lines have moved all over the place.
    wide = min(_usual(np.abs(place) / sigma), max(MOST, usual))
    limits = [np.maximum(MOVE, MOVE_SIGMAS * f * sigma) for f in (wide, usual)]
    alone = np.abs(beyond) / limits[1] >= np.abs(place) / limits[0]
    return np.where(alone, beyond, place), np.where(alone, limits[1], limits[0])


def _to_fresh(a: Stations, fresh: Sequence[Stretch]) -> Array:
    """(n,) how far to the left (m) of old stations a new line runs along; NaN: none near."""
    out = np.full(len(a), np.nan)
    b = stations_of([s.points for s in fresh])
    if not len(a) or not len(b):
        return out
    far, which = b.tree.query(a.xy, distance_upper_bound=PARALLEL)
    there = np.minimum(which, len(b) - 1)
    step = b.xy[there] - a.xy
    along = np.abs((step * a.tangent).sum(axis=1)) <= 2.0 * b.spacing[there]
    turn = np.abs((a.tangent * b.tangent[there]).sum(axis=1))
    good = np.isfinite(far) & along & (turn >= MIN_COS)
    return np.where(good, (step * a.normal).sum(axis=1), out)


def _moved(
    name: str, old: Sequence[Element], claims: Claims, offset: Array, limit: Array, need: int
) -> list[Stretch]:
    """Stretches that lie aside by more than offsets of the class usually are."""
    a = claims.stations
    out = []
    for k, e in enumerate(old):
        for side in (1.0, -1.0):
            far, close = side * offset >= limit, side * offset >= CLOSE * limit
            for run in _runs(far, close, a.of_line(k), MOVE_LENGTH, a):
                run = run[np.isfinite(offset[run])]
                points = a.xy[run] + offset[run, None] * a.normal[run]
                sure = float(claims.confidence[run].mean())
                aside = float(np.mean(side * offset[run] / limit[run]))
                out.append(Stretch(MOVED, name, e.element_id, points, sure, need, a.xy[run], aside))
    return out


def _usual(sigmas: Array) -> float:
    """The factor that the sigmas of a class are off by, by the lower one of two quantiles: here
    and there lines that moved are most of a map."""
    felt = sigmas[np.isfinite(sigmas)]
    if not len(felt):
        return 1.0
    return min(float(np.quantile(felt, q)) / unit for q, unit in GAUSSIAN.items())


def _beside(fresh: list[Stretch], moved: Sequence[Stretch]) -> list[Stretch]:
    """New stretches without those that a moved one accounts for: its detections out of reach."""
    import shapely

    lines = [shapely.LineString(m.points) for m in moved]
    out = []
    for s in fresh:
        near = [(shapely.distance(shapely.points(s.points), x) <= SAME).mean() for x in lines]
        if max(near, default=0.0) < 0.5:
            out.append(s)
    return out


def _runs(sure: Bool, likely: Bool, order: Int, shortest: float, stations: Stations) -> list[Int]:
    """Stretches of one line that are ``likely`` and somewhere ``sure``; short gaps are closed."""
    if not len(order):
        return []
    on = likely[order] | sure[order]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(np.int8), [0]])))
    for stop, start in zip(edges[1:-1:2], edges[2::2], strict=True):
        if start - stop <= BRIDGE:
            on[stop:start] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(np.int8), [0]])))
    runs = [order[i:j] for i, j in zip(edges[::2], edges[1::2], strict=True) if j - i > 1]
    return [r for r in runs if sure[r].any() and length(stations.xy[r]) >= shortest]


# ---- outlines


def _rings(
    name: str,
    old: Sequence[Element],
    new: Sequence[Line],
    heat: Heat,
    usual: float,
    settings: Settings,
) -> list[Stretch]:
    import shapely

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
        if j in taken or line.confidence < settings.threshold * usual:
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
