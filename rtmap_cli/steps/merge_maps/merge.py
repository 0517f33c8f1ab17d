"""The map that two maps become."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import arc_length, is_ring, length
from rtmap_cli.geometry.rings import inside, polygon
from rtmap_cli.maps.element import RING_CLASSES, Element, VectorMap
from rtmap_cli.maps.existence import LIMIT
from rtmap_cli.maps.pieces import (
    GAP,
    free_id,
    left_over,
    own_ends,
    parts_of,
    put_onto,
    with_covariance,
)
from rtmap_cli.maps.refit import FusionModel, at_nodes, columns, planar, solve_vertices
from rtmap_cli.steps.merge_maps.common import SAME, Common, Lines, in_common, lines_of
from rtmap_cli.steps.merge_maps.displacement import Displacement, heights, put_onto_base

Array = NDArray[np.float64]
Int = NDArray[np.int64]

OVERLAP = 0.5
"""Closed elements that have this share of the smaller one in common are one."""
SPREADS, NEAREST = 4.0, 0.3
"""Lines so many times as far apart as the median (m at least) are two."""
MOSTLY = 0.5
"""A line is confirmed by the other map when so much of it is there."""
REACH = 6
"""Stations at the end of a line that tell whether the other map has it."""
MET = 0.02
"""Ends so near (m) to each other are one vertex."""
NEAR = 3.0
"""Heights (m along the line) are taken over from so near."""


@dataclass
class Merged:
    """The merged map and what became of things: ids ``inserted`` (only the other map had them),
    ``confirmed`` (both had them), of these ``moved`` (both state covariances and were fused)."""

    vector_map: VectorMap
    displacement: Displacement
    inserted: list[str] = field(default_factory=list)
    confirmed: list[str] = field(default_factory=list)
    moved: list[str] = field(default_factory=list)

    def counts(self) -> dict[str, int]:
        """Numbers of each kind."""
        return {name: len(getattr(self, name)) for name in ("inserted", "confirmed", "moved")}


def merge_maps(base: VectorMap, other: VectorMap, once: bool = False) -> Merged:
    """``other`` put onto ``base`` and merged with it; the frame is that of ``base``.

    What both have stays where ``base`` has it, or where both put it by Eq. 5 when both state
    covariances; log-odds of existence add up (the larger one holds when they come from the same
    runs: ``once``), and what ``base`` does not know of an element (heights, attributes) is taken
    over. What only ``other`` has is added, cut ends put onto the ends that they continue.
    """
    names = list(dict.fromkeys(e.class_name for e in base))
    lines = {name: lines_of(base.of_class(name)) for name in names}
    placed, displacement = put_onto_base(lines, list(other))
    out = Merged(base, displacement)
    kept = {e.element_id: e for e in base}
    taken = set(kept)
    for name in sorted({e.class_name for e in placed}):
        mine = [e for e in placed if e.class_name == name]
        there = lines.get(name) or lines_of([])
        fit = _rings if name in RING_CLASSES else _lines
        changed, new = fit(there, mine, once, out)
        kept |= {e.element_id: e for e in changed}
        for e in new:
            named = replace(e, element_id=free_id(e.element_id, taken))
            taken.add(named.element_id)
            out.inserted.append(named.element_id)
            kept[named.element_id] = named
    out.vector_map = VectorMap(kept.values(), base.crs)
    return out


def _lines(
    base: Lines, elements: list[Element], once: bool, out: Merged
) -> tuple[list[Element], list[Element]]:
    """This map's lines that the other one's change, and the new ones."""
    other = lines_of(elements)
    # Maps that agree well tell lines a foot apart from each other.
    spread = out.displacement.spread
    common = in_common(base, other, float(np.clip(SPREADS * spread, NEAREST, SAME)))
    return _confirmed_lines(base, other, common, once, out), _new_lines(base, other, common)


# ---- what both maps have


def _confirmed_lines(
    base: Lines, other: Lines, common: Common, once: bool, out: Merged
) -> list[Element]:
    """Those of ``base`` that are there in ``other``, with what that knows of them."""
    fused = _fused(base, other, common)
    feet, stations = common.feet, base.stations
    at, line = feet.station, other.stations.line[feet.sample]
    share = np.bincount(stations.line, stations.spacing * common.known, len(base.elements))
    total = np.bincount(stations.line, stations.spacing, len(base.elements))
    height = heights(other)[feet.sample]
    order = np.argsort(stations.line[at], kind="stable")
    first = np.searchsorted(stations.line[at], np.arange(len(base.elements) + 1), sorter=order)
    changed = []
    for k, (element, (points, covariance)) in enumerate(zip(base.elements, fused, strict=True)):
        mine = order[first[k] : first[k + 1]]
        if not len(mine):
            continue
        if points is not element.points:
            out.moved.append(element.element_id)
        new = element.with_points(points, covariance)
        new = _with_heights(new, stations.s[at[mine]], height[mine])
        if share[k] >= MOSTLY * total[k]:
            source = other.elements[int(np.bincount(line[mine]).argmax())]
            new = _confirmed(new, source, once)
            out.confirmed.append(element.element_id)
        changed.append(new)
    return changed


def _fused(base: Lines, other: Lines, common: Common) -> list[tuple[Array, Array | None]]:
    """Points and covariances of this map's lines by Eq. 5, where both maps state covariances."""
    out: list[tuple[Array, Array | None]] = [(e.points, e.covariance) for e in base.elements]
    stated = [_states(e) for e in base.elements]
    theirs = np.array([_states(e) for e in other.elements], bool)
    feet, stations = common.feet, base.stations
    sure = np.array(stated, bool)[stations.line[feet.station]]
    sure &= theirs[other.stations.line[feet.sample]]
    if not sure.any():
        return out
    at, offset = feet.station[sure], feet.offset[sure]
    variance = other.samples.across_sigma[feet.sample[sure]] ** 2
    n = len(stations)
    weight = np.bincount(at, 1 / variance, n)
    some = weight > 0
    mean = np.full(n, np.nan)
    mean[some] = np.bincount(at, offset / variance, n)[some] / weight[some]
    # Samples of one line are no independent witnesses: the best one counts.
    least = np.full(n, np.inf)
    np.minimum.at(least, at, variance)
    start = np.cumsum([0, *(len(e.points) for e in base.elements)])
    vertices = np.concatenate([e.xy for e in base.elements])
    before = np.concatenate([planar(e.covariance, len(e.points)) for e in base.elements])
    chain = np.concatenate(
        [
            np.full(len(e.points), stations.chain[stations.of_line(k)[0]])
            for k, e in enumerate(base.elements)
        ]
    )
    move, after = solve_vertices(vertices, chain, before, stations, mean, least, 1.5)
    met = [some[stations.of_line(k)].any() for k in range(len(base.elements))]
    free = np.repeat(met, np.diff(start)) & np.repeat(stated, np.diff(start))
    move = at_nodes(vertices, move, free)
    after = _not_below(after, FusionModel().floor)
    for k, element in enumerate(base.elements):
        part = slice(start[k], start[k + 1])
        if not met[k] or not stated[k]:
            continue
        xy, cov = element.xy + move[part], after[part]
        if element.ring:
            xy[-1], cov[-1] = xy[0], cov[0]
        points = np.column_stack([xy, element.points[:, 2]])
        out[k] = points, columns(cov, element.covariance)
    return out


def _states(element: Element) -> bool:
    """True when a covariance is known at every vertex."""
    return element.covariance is not None and bool(np.isfinite(element.covariance[:, :3]).all())


def _not_below(covariance: Array, floor: float) -> Array:
    """Covariances (n, 2, 2) of which no sigma is below ``floor`` (m)."""
    size, axes = np.linalg.eigh(covariance)
    size = np.maximum(size, floor**2)
    return np.asarray((axes * size[:, None, :]) @ np.swapaxes(axes, -1, -2))


def _with_heights(element: Element, s: Array, height: Array) -> Element:
    """The element with heights (at ``s`` along it) where it has none."""
    known, missing = np.isfinite(height), np.isnan(element.points[:, 2])
    if not known.any() or not missing.any():
        return element
    order = np.argsort(s[known], kind="stable")
    s, height = s[known][order], height[known][order]
    at = arc_length(element.points)
    behind = np.clip(np.searchsorted(s, at), 0, len(s) - 1)
    gap = np.minimum(np.abs(s[behind] - at), np.abs(s[np.maximum(behind - 1, 0)] - at))
    points = element.points.copy()
    take = missing & (gap <= NEAR)
    points[take, 2] = np.interp(at[take], s, height)
    return replace(element, points=points)


def _confirmed(element: Element, source: Element, once: bool) -> Element:
    """The element with the evidence that the other map has of it; ``once``: it is the same."""
    firsts = [t for t in (element.first_seen_ns, source.first_seen_ns) if t is not None]
    lasts = [t for t in (element.last_seen_ns, source.last_seen_ns) if t is not None]
    pick = max if once else _added
    return replace(
        element,
        existence=float(np.clip(pick(element.existence, source.existence), -LIMIT, LIMIT)),
        seen=int(pick(element.seen, source.seen)),
        in_view=int(pick(element.in_view, source.in_view)),
        traversals=int(pick(element.traversals, source.traversals)),
        first_seen_ns=min(firsts, default=None),
        last_seen_ns=max(lasts, default=None),
        attributes=source.attributes | element.attributes,
        runs=tuple(sorted({*element.runs, *source.runs})),
        model_sha256=element.model_sha256 or source.model_sha256,
    )


def _added(a: float, b: float) -> float:
    return a + b


# ---- what only the other map has


@dataclass
class _Piece:
    """A stretch (n, 3 or 7) of line ``owner`` that only the other map has, and which of its ends
    lines of this map go on from."""

    owner: int
    table: Array
    goes_on: tuple[bool, bool]


def _new_lines(base: Lines, other: Lines, common: Common) -> list[Element]:
    """The lines of ``other`` without what they have in common; where they were cut, or met a line
    that is in common, they are put onto the ends of ``base``."""
    pieces: list[_Piece] = []
    met = _met_common(other, common)
    for k, element in enumerate(other.elements):
        same = common.same[other.stations.of_line(k)]
        if not same.any():
            pieces.append(_Piece(k, with_covariance(element), met[k]))
            continue
        for table, first, last in left_over(element, same):
            pieces.append(_Piece(k, table, (first or met[k][0], last or met[k][1])))
    ends = [e.points[at] for e in base.elements if not e.ring for at in (0, -1)]
    loose = [(k, at) for k, p in enumerate(pieces) for at in (0, -1) if p.goes_on[at]]
    for (k, at), end in own_ends(loose, [p.table for p in pieces], np.array(ends)):
        table = pieces[k].table
        pieces[k].table = put_onto(table, end) if at == 0 else put_onto(table[::-1], end)[::-1]
    _close(pieces, _ends_alone(base, common))
    by_line: list[list[Array]] = [[] for _ in other.elements]
    for p in pieces:
        if length(p.table) >= GAP or not common.same[other.stations.of_line(p.owner)].any():
            by_line[p.owner].append(p.table)
    return [e for k, e in enumerate(other.elements) for e in parts_of(e, by_line[k])]


def _ends_alone(base: Lines, common: Common) -> Array:
    """(n, 3) ends of this map's lines where the other map does not have the line that ends."""
    out = [np.zeros((0, 3))]
    for k, element in enumerate(base.elements):
        own = base.stations.of_line(k)
        # A line that goes on from the end has a foot or two there.
        reach = min(REACH, len(own))
        for at, last in ((0, own[:reach]), (-1, own[-reach:])):
            if not element.ring and common.known[last].mean() < MOSTLY:
                out.append(element.points[at][None])
    return np.concatenate(out)


def _close(pieces: list[_Piece], ends: Array) -> None:
    """Ends of pieces that meet nothing are put onto one of the ``ends`` (n, 3) that meets nothing,
    in place: the maps may have known one side of the vertex each."""
    from scipy.spatial import cKDTree

    mine = [(k, at) for k, p in enumerate(pieces) for at in (0, -1) if not is_ring(p.table)]
    if not mine or not len(ends):
        return
    here = np.array([pieces[k].table[at, :2] for k, at in mine])
    every = cKDTree(np.concatenate([here, ends[:, :2]]))
    single = np.array([len(near) == 1 for near in every.query_ball_point(every.data, MET)])
    a, b = np.flatnonzero(single[: len(mine)]), np.flatnonzero(single[len(mine) :])
    if not len(a) or not len(b):
        return
    far, at = cKDTree(ends[b, :2]).query(here[a], distance_upper_bound=SAME)
    used: set[int] = set()
    for row in np.argsort(far, kind="stable"):
        target = int(at[row])
        if np.isfinite(far[row]) and target not in used:
            used.add(target)
            k, end = mine[int(a[row])]
            table = pieces[k].table.copy()
            table[end, :3] = ends[b[target]]
            pieces[k].table = table


def _met_common(other: Lines, common: Common) -> list[tuple[bool, bool]]:
    """Of every line whether its start and its end meet a line that this map has, too."""
    first = [int(other.stations.of_line(k)[0]) for k in range(len(other.elements))]
    last = [int(other.stations.of_line(k)[-1]) for k in range(len(other.elements))]
    shared: set[tuple[int, int]] = set()
    ends = []
    for element, *stations in zip(other.elements, first, last, strict=True):
        keys = [_place(element.xy[at]) for at in (0, -1)]
        ends.append(keys)
        if not element.ring:
            shared |= {key for key, at in zip(keys, stations, strict=True) if common.same[at]}
    return [
        (a in shared, b in shared) if not element.ring else (False, False)
        for element, (a, b) in zip(other.elements, ends, strict=True)
    ]


def _place(xy: Array) -> tuple[int, int]:
    """A vertex to the centimetre."""
    x, y = np.round(xy * 100).astype(np.int64).tolist()
    return x, y


def _rings(
    base: Lines, elements: list[Element], once: bool, out: Merged
) -> tuple[list[Element], list[Element]]:
    """Closed elements: those of this map that the other one has, too, and the new ones."""
    import shapely

    shapes = [polygon(e.xy) for e in base.elements]
    tree = shapely.STRtree(shapes)
    changed: dict[int, Element] = {}
    new = []
    for element in elements:
        shape = polygon(element.xy)
        rivals = [int(k) for k in tree.query(shape)]
        share = [max(inside(shape, shapes[k]), inside(shapes[k], shape)) for k in rivals]
        if max(share, default=0.0) < OVERLAP:
            new.append(element)
            continue
        k = rivals[int(np.argmax(share))]
        # Halves of one crossing confirm it once.
        if k not in changed:
            changed[k] = _confirmed(base.elements[k], element, once)
            out.confirmed.append(base.elements[k].element_id)
    return list(changed.values()), new
