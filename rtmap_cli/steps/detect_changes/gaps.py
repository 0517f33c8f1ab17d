"""Lines that end and go on: told by frames in which one detection ends where the next begins.

A field of detections that are off by a metre or two along the line fills a gap of some metres, and
ends that look at each other are joined. But a network reports a line in one piece where it sees
one: where frame after frame has two detections behind each other, and none across, there are two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.keys import numbered
from rtmap_cli.geometry.polylines import is_ring
from rtmap_cli.maps.existence import runs_of
from rtmap_cli.maps.stations import MIN_STRETCH, Samples, Stations, assign, stations_of

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

LEAST = 2.0
"""So many frames (weighted with their scores) must have two detections behind each other."""
ACROSS = 0.5
"""For each of them so many may have one across."""
NARROWEST, WIDEST = 1.5, 10.0
"""Between the two detections lie so many metres: less is no gap, more is another reason."""
GAP = 3.0
"""Shorter gaps (m) are not told from lines that meet: detections are cut short on both sides."""
INSIDE = 1.5
"""A detection runs across a place when it reaches so far (m) beyond it on both sides."""
QUANTILE = 0.7
"""Detections are cut short: the line ends where that share of them has ended."""


@dataclass(frozen=True)
class _Pieces:
    """Detections of one drive on lines: number ``detection`` (k,), ``line`` and ``frame``, from
    ``low`` to ``high`` (m) along the line, ``score``; in order of frame, line and ``low``."""

    detection: Int
    line: Int
    frame: Int
    low: Array
    high: Array
    score: Array


def part_at_gaps(
    lines: list[Array], others: list[Array], samples: Sequence[Samples]
) -> list[Array]:
    """The lines without the gaps that detections leave; ``others`` are known and compete for
    detections. The two sides of a gap are lines of their own."""
    if not lines:
        return []
    stations = stations_of([*others, *lines])
    drives = [_pieces(stations, s) for s in samples]
    across, apart, seen = _counted(stations, drives)
    need = 2 if sum(len(d.line) > 0 for d in drives) > 1 else 1
    gap = (apart >= LEAST) & (apart * ACROSS >= across) & (seen >= need)
    out: list[Array] = []
    for k, line in enumerate(lines):
        index = stations.of_line(len(others) + k)
        if not gap[index].any() or is_ring(line):
            out.append(line)
            continue
        ends = [_ends(stations, len(others) + k, run, index, drives) for run in runs_of(gap[index])]
        out += _cut(stations.xy[index], stations.s[index], [e for e in ends if e is not None])
    return out


def _pieces(stations: Stations, samples: Samples) -> _Pieces:
    """What each detection covers of each line."""
    feet, _ = assign(stations, samples)
    count = len(stations.lines)
    keys, row = numbered(samples.detection[feet.sample] * count + stations.line[feet.station])
    s = stations.s[feet.station] + feet.along
    low, high = np.full(len(keys), np.inf), np.full(len(keys), -np.inf)
    np.minimum.at(low, row, s)
    np.maximum.at(high, row, s)
    first = np.zeros(len(keys), np.int64)
    first[row] = feet.sample
    frame, line = samples.frame[first], keys % max(count, 1)
    order = np.lexsort((low, line, frame))
    order = order[(high - low)[order] >= MIN_STRETCH]
    number, score = samples.detection[first], samples.score[first]
    return _Pieces(*(v[order] for v in (number, line, frame, low, high, score)))


def _behind(p: _Pieces) -> tuple[Int, Array]:
    """Which detections are followed by another one on their line in their frame, with a gap between
    the two, and where (m) that one begins."""
    same = (p.line[1:] == p.line[:-1]) & (p.frame[1:] == p.frame[:-1])
    # The two sides of a hairpin have two numbers, but were seen in one piece.
    same &= (np.abs(np.diff(p.detection)) > 1) | (p.score[1:] != p.score[:-1])
    gap = p.low[1:] - p.high[:-1]
    first = np.flatnonzero(same & (gap >= NARROWEST) & (gap <= WIDEST))
    return first, p.low[first + 1]


def _counted(stations: Stations, drives: Sequence[_Pieces]) -> tuple[Array, Array, Array]:
    """At every station the detections that run across it, the gaps around it (both weighted with
    scores), and the drives that have such gaps."""
    n = len(stations)
    across, apart, seen = np.zeros((3, n))
    for p in drives:
        across += _spread(stations, p.line, p.low + INSIDE, p.high - INSIDE, p.score)
        first, begin = _behind(p)
        score = np.minimum(p.score[first], p.score[first + 1])
        here = _spread(stations, p.line[first], p.high[first], begin, score)
        apart += here
        seen += here > 0
    return across, apart, seen


def _spread(stations: Stations, line: Int, low: Array, high: Array, weight: Array) -> Array:
    """(n,) the summed ``weight`` of stretches from ``low`` to ``high`` (m) of lines."""
    # Stations are in order of their lines and places: one number says both.
    far = float(stations.s.max(initial=0.0)) + 100.0
    place = stations.line * far + stations.s
    begin = np.searchsorted(place, line * far + np.maximum(low, 0.0))
    end = np.searchsorted(place, line * far + np.minimum(high, far - 1.0), side="right")
    ok = end > begin
    out = np.zeros(len(stations) + 1)
    np.add.at(out, begin[ok], weight[ok])
    np.add.at(out, end[ok], -weight[ok])
    return np.asarray(np.cumsum(out)[:-1])


def _ends(
    stations: Stations, line: int, run: Int, index: Int, drives: Sequence[_Pieces]
) -> tuple[float, float] | None:
    """Where (m) a line ends and goes on around the stations ``index[run]``; None: nowhere."""
    a, b = stations.s[index[run[0]]], stations.s[index[run[-1]]]
    ends, begins = [], []
    for p in drives:
        first, begin = _behind(p)
        mine = (p.line[first] == line) & (p.high[first] <= b) & (begin >= a)
        ends.append(p.high[first][mine])
        begins.append(begin[mine])
    low = float(np.quantile(np.concatenate(ends), QUANTILE))
    high = float(np.quantile(np.concatenate(begins), 1 - QUANTILE))
    return (low, high) if high - low >= GAP else None


def _cut(xy: Array, s: Array, gaps: list[tuple[float, float]]) -> list[Array]:
    """A line (n, 2) with places ``s`` (n,) of its vertices, without the gaps."""
    starts = [0.0, *(g[1] for g in gaps)]
    stops = [*(g[0] for g in gaps), float(s[-1])]
    out = []
    for a, b in zip(starts, stops, strict=True):
        if b - a < MIN_STRETCH:
            continue
        inner = s[(s > a) & (s < b)]
        at = np.concatenate([[a], inner, [b]])
        out.append(np.stack([np.interp(at, s, xy[:, k]) for k in (0, 1)], axis=-1))
    return out
