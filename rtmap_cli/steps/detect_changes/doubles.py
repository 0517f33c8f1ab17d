"""Two lines where the field shows one: told by frames in which two detections lie side by side.

Lines a foot or two apart leave one ridge in a field whose detections are half a metre off. But a
network reports each line once a frame: where a frame holds two detections beside each other there
are two lines, and how often it does tells them from false ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.keys import numbered
from rtmap_cli.geometry.polylines import is_ring
from rtmap_cli.maps.existence import runs_of
from rtmap_cli.maps.stations import Samples, Stations, assign, stations_of

Array = NDArray[np.float64]
Int = NDArray[np.int64]

CELL = 3.0
"""Two detections of a frame that meet a line within such a stretch (m) of it lie side by side."""
OFTEN, STILL = 0.12, 0.05
"""Share of the frames with any detection that must hold two somewhere in a stretch, and all along
it: a false one is rarer."""
WIDTH = 6.0
"""Sigma (m) of the smoothing along the line."""
SHORTEST = 7.0
"""Shorter stretches (m) are not told apart."""
NARROWEST = 0.25
"""Lines nearer to each other (m) are one."""
TO_END = 5.0
"""A stretch that comes so near (m) to the end of its line goes on to it."""


@dataclass(frozen=True)
class _Beside:
    """At n places along lines: ``frames`` with any detection, ``pairs`` of them with two side by
    side in ``drives`` drives, and the mean offsets ``low``, ``high`` (m) of the two."""

    frames: Array
    pairs: Array
    drives: Array
    low: Array
    high: Array


def split_doubles(
    lines: list[Array], others: list[Array], samples: Sequence[Samples]
) -> list[Array]:
    """The lines, with a second one where the detections of single frames show two; ``others`` are
    known and compete for detections.

    Of two lines the one that goes on most smoothly continues the old one, the other one starts
    where they part.
    """
    if not lines:
        return []
    stations = stations_of([*others, *lines])
    place = cells_of(stations)
    first = np.searchsorted(place, np.arange(int(place[-1]) + 1))
    beside = _smoothed(_counted(stations, place, samples), stations, place, first)
    need = 2 if sum(len(s) > 0 for s in samples) > 1 else 1
    apart = (beside.drives >= 0.5 * need) & (beside.high - beside.low > NARROWEST)
    sure = apart & (beside.pairs > OFTEN * beside.frames)
    double = apart & (beside.pairs > STILL * beside.frames)
    out: list[Array] = []
    for k, line in enumerate(lines):
        index = stations.of_line(len(others) + k)
        flags = double[place[index]]
        runs = [
            run
            for run in runs_of(_to_the_ends(flags, stations.s[index]))
            if stations.s[index[run[-1]]] - stations.s[index[run[0]]] >= SHORTEST
            and sure[place[index[run]]].any()
        ]
        if not runs or is_ring(line):
            out.append(line)
            continue
        middle = (stations.s[first] + stations.s[_last(first, len(stations))]) / 2
        own = np.unique(place[index])
        s = stations.s[index]
        sides = [np.interp(s, middle[own], v[own]) for v in (beside.low, beside.high)]
        out += _parted(stations.xy[index], stations.normal[index], runs, sides)
    return out


def cells_of(stations: Stations) -> Int:
    """(n,) number of the stretch of ``CELL`` metres of its line that each station lies in."""
    along = np.floor(stations.s / CELL).astype(np.int64)
    change = np.ones(len(stations), bool)
    change[1:] = (np.diff(stations.line) != 0) | (np.diff(along) != 0)
    return np.asarray(np.cumsum(change) - 1)


def _last(first: Int, count: int) -> Int:
    return np.append(first[1:], count) - 1


def _counted(stations: Stations, place: Int, samples: Sequence[Samples]) -> _Beside:
    """Sums over all drives: ``low`` and ``high`` are sums over the pairs."""
    n = int(place[-1]) + 1
    total = np.zeros((5, n))
    for s in samples:
        feet, _ = assign(stations, s)
        if not len(feet):
            continue
        cell = s.frame[feet.sample] * n + place[feet.station]
        count = int(s.detection.max()) + 1
        keys, row = numbered(cell * count + s.detection[feet.sample])
        offset = np.bincount(row, feet.offset) / np.bincount(row)
        # In order of frame and place; of each the first and the last in order of offset.
        cells = keys // count
        order = np.lexsort((offset, cells))
        cells, offset = cells[order], offset[order]
        start = np.flatnonzero(np.concatenate([[True], np.diff(cells) != 0]))
        end = np.append(start[1:], len(cells)) - 1
        where = cells[start] % n
        pair = end > start
        found = np.bincount(where[pair], minlength=n)
        total[0] += np.bincount(where, minlength=n)
        total[1] += found
        total[2] += found > 0
        total[3] += np.bincount(where[pair], offset[start[pair]], n)
        total[4] += np.bincount(where[pair], offset[end[pair]], n)
    return _Beside(*total)


def _smoothed(beside: _Beside, stations: Stations, place: Int, first: Int) -> _Beside:
    """Sums become means over the places around; counts stay comparable to each other."""
    from scipy.ndimage import gaussian_filter1d

    line = stations.line[first]
    raw = np.stack([getattr(beside, name) for name in beside.__dataclass_fields__])
    out = np.zeros_like(raw)
    for k in np.unique(line):
        own = line == k
        out[:, own] = gaussian_filter1d(raw[:, own], WIDTH / CELL, axis=1, mode="nearest")
    pairs = np.maximum(out[1], 1e-9)
    return _Beside(out[0], out[1], out[2], out[3] / pairs, out[4] / pairs)


def _to_the_ends(flags: NDArray[np.bool_], s: Array) -> NDArray[np.bool_]:
    """Flags of the stations of a line, with what is left before an end added to a stretch."""
    out = flags.copy()
    found = np.flatnonzero(flags)
    if len(found):
        if s[found[0]] - s[0] <= TO_END:
            out[: found[0]] = True
        if s[-1] - s[found[-1]] <= TO_END:
            out[found[-1] :] = True
    return out


def _parted(xy: Array, normal: Array, runs: list[Int], sides: list[Array]) -> list[Array]:
    """The line moved to one side along ``runs``, and for each run the other side as a line."""
    main = xy.copy()
    others = []
    for run in runs:
        low, high = (xy[run] + side[run, None] * normal[run] for side in sides)
        inner = [e for e, station in ((0, run[0]), (-1, run[-1])) if 0 < station < len(xy) - 1]
        # At an inner end the line is one again: the side nearer to it there is the line itself.
        away = [sum(abs(float(side[run[e]])) for e in inner) for side in sides]
        near, far = (low, high) if away[0] <= away[1] else (high, low)
        main[run] = near
        head = [main[run[0] - 1][None]] if 0 in inner else []
        tail = [main[run[-1] + 1][None]] if -1 in inner else []
        others.append(np.concatenate([*head, far, *tail]))
    return [main, *others]
