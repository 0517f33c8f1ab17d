"""Lines that are one: told by detections that run from the one to the other.

Where a boundary turns into a niche and out again within some metres, the field of detections that
are off by as much has no ridge, and what is found are two lines that end beside each other. But a
network reports a line in one piece where it sees one: detections that run from the end of one line
to that of another say that the two belong together, and where the way between them lies.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import is_ring, length, resample
from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.outlook import Outlook
from rtmap_cli.maps.stations import MIN_COS, Samples, Stations, assign, stations_of

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Links = dict[tuple[int, int], "list[_Link]"]

TO_END = 6.0
"""A detection leaves and reaches a line not farther (m) from its end than that."""
LONGEST = 20.0
"""Longest way (m) between two lines."""
SHORTEST = 4.0
"""What a detection has of each of the two (m) at least, or a quarter of a short one."""
BESIDE, ALONGSIDE = 1.3, 4.0
"""An end lies beside a line when its last metres (``ALONGSIDE``) are so near (m) to it."""
MARGIN = 1.0
"""Nearer (m) to the border of the range detections may be cut."""
LEAST = 2.0
"""So many detections (weighted with their scores) must run over both, …"""
APART = 1.0
"""… and for each frame that has one on either side, none over both, so many."""


@dataclass(frozen=True)
class _Runs:
    """Stretches of detections on lines in the order of the samples of a drive: ``line``, ``frame``
    and ``score`` (k,), ``whole`` number of the detection that it is part of; ``first``, ``last``
    sample; ``begin``, ``end`` places (m) of these along the line."""

    line: Int
    frame: Int
    score: Array
    whole: Int
    first: Int
    last: Int
    begin: Array
    end: Array


@dataclass(frozen=True)
class _Link:
    """One detection that runs from an end to another: its ``score``, where (m) it leaves the one
    line and reaches the other, and its ``way`` (n, 2) between the two."""

    score: float
    leave: float
    reach: float
    way: Array


def bridged(
    lines: list[Array],
    others: list[Array],
    traversals: Sequence[Traversal],
    samples: Sequence[Samples],
) -> list[Array]:
    """The lines, those made one that detections run over; ``others`` are known and compete for
    detections."""
    if not lines:
        return []
    stations = stations_of([*others, *lines])
    total = np.bincount(stations.line, stations.spacing).astype(np.float64)
    links: Links = defaultdict(list)
    runs = [_runs(stations, s) for s in samples]
    for r, s in zip(runs, samples, strict=True):
        _find_links(links, r, s, total, len(others))
    found = []
    for (a, b), some in links.items():
        weight = sum(x.score for x in some)
        between = max(some, key=lambda x: x.score).way
        apart = float(
            sum(
                _apart(r, a, b, total, t.outlook, between)
                for r, t in zip(runs, traversals, strict=True)
            )
        )
        if weight >= LEAST and weight >= APART * apart:
            found.append((-weight, a, b))
    taken: set[int] = set()
    chosen = {}
    for _, a, b in sorted(found):
        if a not in taken and b not in taken:
            taken |= {a, b}
            chosen[a, b] = links[a, b]
    return _joined(lines, stations, len(others), chosen)


def _runs(stations: Stations, samples: Samples) -> _Runs:
    """The stretches of all detections of a drive."""
    feet, _ = assign(stations, samples)
    order = np.argsort(feet.sample, kind="stable")
    sample, station = feet.sample[order], feet.station[order]
    s = stations.s[station] + feet.along[order]
    line = stations.line[station]
    # The two sides of a hairpin have two numbers, but were seen in one piece.
    frame, score = samples.frame[sample], samples.score[sample]
    other = np.ones(len(sample), bool)
    other[1:] = (frame[1:] != frame[:-1]) | (score[1:] != score[:-1])
    other[1:] |= np.diff(samples.detection[sample]) > 1
    new = other.copy()
    # From the one end of a line to its other one there is a jump, too: it is closed.
    new[1:] |= (line[1:] != line[:-1]) | (np.abs(np.diff(s)) > TO_END)
    start = np.flatnonzero(new)
    stop = np.append(start[1:], len(sample)) - 1 if len(start) else start
    whole = np.cumsum(other)[start]
    return _Runs(
        line[start], frame[start], score[start], whole, sample[start], sample[stop],
        s[start], s[stop],
    )  # fmt: skip


def _find_links(links: Links, runs: _Runs, samples: Samples, total: Array, old: int) -> None:
    """Add the links of a drive under the ends that they join: 2 · line, + 1 for the far end."""
    size = np.abs(runs.end - runs.begin)
    long = np.flatnonzero((size >= _enough(total)[runs.line]) & (runs.line >= old))
    for i, j in zip(long[:-1].tolist(), long[1:].tolist(), strict=True):
        if runs.whole[i] != runs.whole[j]:
            continue
        a, b = int(runs.line[i]), int(runs.line[j])
        far, near = runs.end[i] > runs.begin[i], runs.end[j] < runs.begin[j]
        leave, reach = float(runs.end[i]), float(runs.begin[j])
        if (total[a] - leave if far else leave) > TO_END:
            continue
        if (total[b] - reach if near else reach) > TO_END:
            continue
        way = samples.xy[runs.last[i] : runs.first[j] + 1]
        if length(way) > LONGEST:
            continue
        one, two = 2 * a + int(far), 2 * b + int(near)
        if one == two:
            continue
        score = float(runs.score[i])
        if one < two:
            links[one, two].append(_Link(score, leave, reach, way))
        else:
            links[two, one].append(_Link(score, reach, leave, way[::-1]))


def _enough(total: Array) -> Array:
    """What a detection has of lines of the lengths ``total`` (n,), metres, at least."""
    return np.minimum(SHORTEST, total / 4)


def _apart(runs: _Runs, a: int, b: int, total: Array, outlook: Outlook, between: Array) -> float:
    """The frames (weighted with scores) with a detection at either of two ends, none over both,
    that had all of the way ``between`` them in view: else the range may have cut one in two."""
    at, enough = [], _enough(total)
    for end in (a, b):
        low, high = np.minimum(runs.begin, runs.end), np.maximum(runs.begin, runs.end)
        near = total[end // 2] - high if end % 2 else low
        mine = (runs.line == end // 2) & (near <= TO_END) & (high - low >= enough[end // 2])
        at.append(np.flatnonzero(mine))
    whole = {int(runs.whole[k]) for k in at[0]} & {int(runs.whole[k]) for k in at[1]}
    together = {int(runs.frame[k]) for k in at[0] if int(runs.whole[k]) in whole}
    first = {int(runs.frame[k]): float(runs.score[k]) for k in at[0]}
    second = {int(runs.frame[k]): float(runs.score[k]) for k in at[1]}
    both = (first.keys() & second.keys()) - together
    frames = np.array(sorted(both), np.int64)
    seen = (outlook.clear(frames[:, None], between[None], MARGIN) >= 0).all(axis=1)
    return sum(min(first[f], second[f]) for f in frames[seen].tolist())


def _joined(
    lines: list[Array], stations: Stations, old: int, links: dict[tuple[int, int], list[_Link]]
) -> list[Array]:
    """The lines cut where the links leave them, and put together with the mean ways between."""
    if not links:
        return list(lines)
    low = np.zeros(len(lines))
    high = np.array([stations.s[stations.of_line(old + k)[-1]] for k in range(len(lines))])
    after: dict[int, tuple[int, Array]] = {}
    for (a, b), some in links.items():
        places = [np.median([x.leave for x in some]), np.median([x.reach for x in some])]
        for end, place in zip((a, b), places, strict=True):
            k = end // 2 - old
            if end % 2:
                high[k] = max(place, low[k] + 0.5)
            else:
                low[k] = min(place, high[k] - 0.5)
        count = max(2, round(float(np.median([length(x.way) for x in some]))) + 1)
        weight = np.array([x.score for x in some])
        ways = np.array([resample(x.way, count) for x in some])
        way = (ways * weight[:, None, None]).sum(axis=0) / weight.sum()
        after[a], after[b] = (b, way), (a, way[::-1])
    parts = []
    for k in range(len(lines)):
        index = stations.of_line(old + k)
        s, xy = stations.s[index], stations.xy[index]
        at = np.concatenate([[low[k]], s[(s > low[k]) & (s < high[k])], [high[k]]])
        parts.append(np.stack([np.interp(at, s, xy[:, i]) for i in (0, 1)], axis=-1))
    out, done = [], set[int]()
    # Chains begin at an end that is free; what is left are circles, which begin anywhere.
    ends = [2 * (k + old) + e for k in range(len(lines)) for e in (0, 1)]
    for start in [*(e for e in ends if e not in after), *ends]:
        if start // 2 in done:
            continue
        chain, here = [], start
        while here // 2 not in done:
            k = here // 2
            done.add(k)
            chain.append(parts[k - old][::-1] if here % 2 else parts[k - old])
            if here ^ 1 not in after:
                break
            here, way = after[here ^ 1]
            chain.append(way[1:-1])
            if here == start:
                chain.append(chain[0][:1])
        out.append(np.concatenate(chain))
    return out


def cut_beside(lines: list[Array]) -> list[Array]:
    """The lines cut where an end lies beside them, after having run beside them for a while.

    Of two lines a foot apart, the sides of a thin wall, the ridge may go on as the wrong one. With
    the cut, `bridged` can tell which of the two it is that goes on.
    """
    if not lines:
        return []
    stations = stations_of(lines)
    cuts: dict[int, list[float]] = defaultdict(list)
    for k, line in enumerate(lines):
        if is_ring(line):
            continue
        own = stations.of_line(k)
        for index in (own, own[::-1]):
            behind = np.abs(stations.s[index] - stations.s[index[0]])
            if behind[-1] < 2 * ALONGSIDE:
                continue
            other = _neighbour(stations, index[behind <= ALONGSIDE])
            if other is not None:
                cuts[int(stations.line[other])].append(float(stations.s[other]))
    out = []
    for k, line in enumerate(lines):
        s, xy = stations.s[stations.of_line(k)], stations.xy[stations.of_line(k)]
        # Near an end there is nothing to tell.
        places = [c for c in sorted(cuts[k]) if ALONGSIDE < c < s[-1] - ALONGSIDE]
        if not places or is_ring(line):
            out.append(line)
            continue
        for low, high in itertools.pairwise([s[0], *places, s[-1]]):
            at = np.concatenate([[low], s[(s > low) & (s < high)], [high]])
            if high - low > SHORTEST:
                out.append(np.stack([np.interp(at, s, xy[:, i]) for i in (0, 1)], axis=-1))
    return out


def _neighbour(stations: Stations, side: Int) -> int | None:
    """The station beside the first of some in a row, of a line that runs beside all of them."""
    near = stations.tree.query_ball_point(stations.xy[side], BESIDE)
    strand, first = stations.strand, None
    for i, some in zip(side.tolist(), near, strict=True):
        others = [
            j
            for j in some
            if strand[j] != strand[i]
            and abs(float(stations.tangent[i] @ stations.tangent[j])) > MIN_COS
        ]
        if not others:
            return None
        if first is None:
            first = min(others, key=lambda j: float(np.hypot(*(stations.xy[j] - stations.xy[i]))))
    return first
