"""Two new lines where frames see one: the one that is seen less goes.

Ridges of the field and the ways between them may run twice along one line, some decimetres apart.
Detections then go to whichever is nearer, and both look like lines that are hard to see. But of
two lines that are there a network sees both in many frames; of one line it sees one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import is_ring
from rtmap_cli.maps.assignment import assign_once
from rtmap_cli.maps.existence import runs_of
from rtmap_cli.maps.stations import MIN_COS, Samples, Stations, stations_of

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

BESIDE = 1.0
"""Lines nearer to each other than this (m) may be one."""
REACH = 2
"""A detection is seen at a station when it has a foot so many stations from it, or nearer."""
LEAST = 8
"""Frames that saw either of the two, at least, …"""
SELDOM = 0.1
"""… of which this share saw both: less is one line."""
SHORTEST = 8.0
"""Shorter stretches (m) are not told."""
GAP = 2
"""Stations between two that are told are told, too."""
LEFT = 3.0
"""Shorter pieces (m) of what is left go, too."""


def without_twins(
    lines: list[Array], others: list[Array], samples: Sequence[Samples]
) -> list[Array]:
    """The lines without the stretches where another new one, which is seen more often, is all that
    frames see; ``others`` are known and compete for detections."""
    if len(lines) < 2:
        return lines
    stations = stations_of([*others, *lines])
    a, b = _neighbours(stations, len(others))
    if not len(a):
        return lines
    here, there, both = _seen(stations, a, b, samples)
    either = here + there - both
    twin = (either >= LEAST) & (both <= SELDOM * either)
    # Of two as often seen the first one stays.
    less = twin & ((here < there) | ((here == there) & (a > b)))
    told = np.zeros(len(stations), bool)
    told[a[less]] = True
    out = []
    for k, line in enumerate(lines):
        index = stations.of_line(len(others) + k)
        gone = _long_enough(told[index], stations.s[index])
        if not gone.any() or is_ring(line):
            out.append(line)
            continue
        for run in runs_of(~gone):
            piece = index[run]
            if stations.s[piece[-1]] - stations.s[piece[0]] >= LEFT:
                out.append(stations.xy[piece])
    return out


def _neighbours(stations: Stations, old: int) -> tuple[Int, Int]:
    """Stations of new lines, and the nearest one beside each of them on every other new strand."""
    pairs = stations.tree.query_pairs(BESIDE, output_type="ndarray")
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    a, b = pairs.T
    ok = (stations.line[a] >= old) & (stations.line[b] >= old)
    ok &= stations.strand[a] != stations.strand[b]
    ok &= stations.line[a] != stations.line[b]
    ok &= np.abs((stations.tangent[a] * stations.tangent[b]).sum(axis=1)) > MIN_COS
    a, b = a[ok], b[ok]
    far = np.hypot(*(stations.xy[a] - stations.xy[b]).T)
    order = np.lexsort((far, stations.line[b], a))
    a, b = a[order], b[order]
    first = np.ones(len(a), bool)
    first[1:] = (a[1:] != a[:-1]) | (stations.line[b[1:]] != stations.line[b[:-1]])
    return a[first], b[first]


def _seen(
    stations: Stations, a: Int, b: Int, samples: Sequence[Samples]
) -> tuple[Array, Array, Array]:
    """Of every pair of stations the frames that saw the one, the other, and both."""
    total: list[Any] = [np.zeros(len(a)) for _ in range(3)]
    for s in samples:
        feet, _ = assign_once(stations, s, wide=False)
        if not len(feet):
            continue
        hit = _hits(stations, feet.station, s.frame[feet.sample])
        one, two = hit[a], hit[b]
        for k, part in enumerate((one, two, one.multiply(two))):
            total[k] += np.asarray(part.sum(axis=1)).ravel()
    return total[0], total[1], total[2]


def _hits(stations: Stations, station: Int, frame: Int) -> Any:
    """Sparse (stations, frames): 1 where a frame has a foot within ``REACH`` stations."""
    from scipy.sparse import csr_matrix

    n = len(stations)
    places, frames = [], []
    for step in range(-REACH, REACH + 1):
        at = np.clip(station + step, 0, n - 1)
        same = stations.line[at] == stations.line[station]
        places.append(at[same])
        frames.append(frame[same])
    place, time = np.concatenate(places), np.concatenate(frames)
    shape = (n, int(time.max()) + 1)
    hit = csr_matrix((np.ones(len(place), np.int32), (place, time)), shape=shape)
    hit.data[:] = 1
    return hit


def _long_enough(told: Mask, s: Array) -> Mask:
    """Short interruptions closed, short stretches dropped."""
    out = told.copy()
    for run in runs_of(~told):
        inner = run[0] > 0 and run[-1] < len(told) - 1
        if inner and len(run) <= GAP:
            out[run] = True
    for run in runs_of(out.copy()):
        if s[run[-1]] - s[run[0]] < SHORTEST:
            out[run] = False
    return out
