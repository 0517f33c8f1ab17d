"""Strands: chains cut where they fold, so that a detection cannot hop between their two sides.

The outline of a lane is often one chain with both its sides, joined at the end of a bay or around
an island. As a line it is one thing; for a detection beside it the two sides are two lines.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Int = NDArray[np.int64]

BESIDE = 3.0
"""Two parts of a chain nearer than this (m) are two sides of it …"""
AWAY = 10.0
"""… when the way along the chain is longer than this (m)."""


def strands_of(xy: Array, tangent: Array, s: Array, line: Int, chain: Int) -> Int:
    """(n,) number of the strand of each station: a line, or the part of it before it folds back,
    joined with the next lines of its chain as long as they do not run beside it.

    Of every station ``xy``, ``tangent`` (n, 2) metres, ``s`` (n,) metres along its ``line`` (n,),
    and the ``chain`` (n,) of that."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(xy).query_pairs(BESIDE, output_type="ndarray").astype(np.int64)
    same = chain[pairs[:, 0]] == chain[pairs[:, 1]]
    pairs = np.sort(pairs[same], axis=1)
    part = _parts(tangent, s, line, pairs)
    group = np.arange(int(part.max(initial=-1)) + 1)
    near = np.flatnonzero(part[pairs[:, 0]] != part[pairs[:, 1]])
    a, b = pairs[near].T
    touching = np.hypot(*(xy[a] - xy[b]).T) < 0.05
    # Parts of one line were cut because they fold: they stay apart.
    touching &= line[a] != line[b]
    for k in np.flatnonzero(touching):
        one, other = group[part[a[k]]], group[part[b[k]]]
        if one == other:
            continue
        joint = xy[a[k]]
        across = (group[part[a]] == one) & (group[part[b]] == other)
        across |= (group[part[a]] == other) & (group[part[b]] == one)
        far = [np.hypot(*(xy[i] - joint).T) > AWAY / 2 for i in (a, b)]
        if not (across & far[0] & far[1]).any():
            group[group == other] = one
    return np.asarray(group[part], np.int64)


def _parts(tangent: Array, s: Array, line: Int, pairs: Int) -> Int:
    """(n,) number of the part of each station: lines, cut where they come back to themselves."""
    own = pairs[line[pairs[:, 0]] == line[pairs[:, 1]]]
    a, b = own.T
    turned = (tangent[a] * tangent[b]).sum(axis=1) < 0
    back = turned & (s[b] - s[a] > AWAY)
    # Of every station the last one before it that it comes back to.
    last = np.full(len(line), -1)
    np.maximum.at(last, b[back], a[back])
    part = np.zeros(len(line), np.int64)
    number, start, row = -1, 0, 0
    for k in range(len(line)):
        first = k == 0 or line[k] != line[k - 1]
        if first:
            number, start, row = number + 1, k, k
        elif last[k] >= start:
            # The tip lies halfway between the two stations.
            middle = (s[last[k]] + s[k]) / 2
            start = row + int(np.searchsorted(s[row:k], middle))
            number += 1
            part[start:k] = number
        part[k] = number
    return part
