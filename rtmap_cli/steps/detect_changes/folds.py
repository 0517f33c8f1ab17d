"""Lines that fold back beside themselves: the two sides of a thin thing are seen as one.

The kerb around a finger between two parking bays runs out and back half a metre beside itself. A
frame has one detection there, which goes to one of the two sides; the other one would look as if
it had gone. But there is no such thing with one side: what finds either finds both.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.maps.stations import MIN_COS, STEP, Stations
from rtmap_cli.steps.detect_changes.votes import DriveCounts, detection_value

Int = NDArray[np.int64]

THIN = 1.0
"""The two sides of what is thinner than this (m) exist together."""


def folds(stations: Stations, before: int) -> Int:
    """(k, 2) stations of the first ``before`` with those across from them, on the other side of a
    fold of their own line; each station once in the first column."""
    from scipy.spatial import cKDTree

    reach = float(np.hypot(THIN, STEP))
    pairs = cKDTree(stations.xy[:before]).query_pairs(reach, output_type="ndarray")
    a, b = pairs[:, 0], pairs[:, 1]
    back = (stations.tangent[a] * stations.tangent[b]).sum(axis=1) < -MIN_COS
    own = stations.line[a] == stations.line[b]
    both = np.concatenate([pairs[own & back], pairs[own & back][:, ::-1]]).astype(np.int64)
    step = stations.xy[both[:, 1]] - stations.xy[both[:, 0]]
    across = np.abs((step * stations.normal[both[:, 0]]).sum(axis=1))
    both, step = both[across < THIN], step[across < THIN]
    order = np.lexsort((both[:, 1], np.hypot(*step.T), both[:, 0]))
    both = both[order]
    first = np.diff(both[:, 0], prepend=-1) != 0
    out: Int = both[first]
    return out


def shared(counts: DriveCounts, pairs: Int) -> DriveCounts:
    """The counts of a drive, what it found on the other side of a fold (``pairs`` of `folds`)
    counted on this side, too, in frames that found nothing here. Places that the network was asked
    about keep their own answers."""
    index = pairs[:, 1]
    order = np.argsort(counts.hit_place, kind="stable")
    low, high = (
        np.searchsorted(counts.hit_place[order], index, side) for side in ("left", "right")
    )
    number = high - low
    to = np.repeat(pairs[:, 0], number)
    row = order[np.repeat(low - (np.cumsum(number) - number), number) + np.arange(len(to))]
    time = int(counts.hit_frame.max(initial=-1)) + 1
    known = np.isin(to * time + counts.hit_frame[row], counts.hit_place * time + counts.hit_frame)
    new = ~known & ~counts.prompted[to]
    hits = counts.hits.copy()
    np.add.at(hits, to[new], detection_value(counts.hit_score[row[new]]))
    return replace(counts, hits=hits)
