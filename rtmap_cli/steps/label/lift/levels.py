"""Which level a vertex is on: the heights at which the vehicle drove nearby.

Under a bridge the road has two heights. Every stretch of the trajectory near a vertex offers one;
along an element the offers are chosen so that it goes the way that the vehicle drove and climbs no
steeper than roads do (Viterbi).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

REACH = 20.0
"""The ground is known to the trajectory so far beside it (m)."""
APART = 2.5
"""Heights so far apart (m) are two levels."""
OFFERS = 3
ASKED = 48
"""Trajectory samples that are looked at around a vertex."""
CROSSING = 12.0
"""Driving across an element costs as much as so many metres beside it."""
GRADE, JUMP = 0.15, 20.0
"""Steepest way along an element (m per m); cost of a metre above it."""


def samples(position: Array, ground_z: Array, step: float = 1.0) -> tuple[Array, Array]:
    """Places (n, 3) along a trajectory every ``step`` m, and its headings (n,) there."""
    known = np.isfinite(ground_z)
    xyz = np.column_stack([position[known, :2], ground_z[known]])
    if len(xyz) < 2:
        return xyz, np.zeros(len(xyz))
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xyz[:, :2], axis=0).T))])
    keep = np.concatenate([[True], np.diff(along) > 1e-6])
    along, xyz = along[keep], xyz[keep]
    if len(xyz) < 2:
        return xyz, np.zeros(len(xyz))
    at = np.arange(0.0, along[-1] + 1e-9, step)
    out = np.stack([np.interp(at, along, xyz[:, k]) for k in range(3)], axis=-1)
    if len(out) < 2:
        return out, np.zeros(len(out))
    return out, np.arctan2(*np.gradient(out[:, :2], axis=0).T[::-1])


def offers(
    xy: Array, heading: Array, path: Array, headings: Array
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Heights (n, OFFERS) that the trajectory offers each vertex, NaN where fewer, what each
    costs (metres away, more when driven across the element) and its sample of the path."""
    from scipy.spatial import cKDTree

    if not len(path):
        none = np.full((len(xy), OFFERS), np.nan)
        return none, np.full(none.shape, np.inf), np.zeros(none.shape, np.int64)
    count = min(ASKED, len(path))
    away, at = cKDTree(path[:, :2]).query(xy, count, distance_upper_bound=REACH)
    away, at = away.reshape(len(xy), count), at.reshape(len(xy), count)
    found = np.isfinite(away)
    at = np.where(found, at, 0)
    z = np.where(found, path[at, 2], np.nan)
    turn = np.where(np.isfinite(heading)[:, None], heading[:, None] - headings[at], 0.0)
    cost = np.where(found, away + CROSSING * np.abs(np.sin(turn)), np.inf)
    heights = np.full((len(xy), OFFERS), np.nan)
    costs = np.full((len(xy), OFFERS), np.inf)
    source = np.zeros((len(xy), OFFERS), np.int64)
    rows = np.arange(len(xy))
    for k in range(OFFERS):
        best = cost.argmin(axis=1)
        here = np.arange(len(rows))
        costs[rows, k], source[rows, k] = cost[here, best], at[here, best]
        first = np.where(np.isfinite(costs[rows, k]), z[here, best], np.nan)
        heights[rows, k] = first
        with np.errstate(invalid="ignore"):
            other = np.abs(z - first[:, None]) >= APART
        # Most vertices have one level: only the others are looked at again.
        more = other.any(axis=1)
        rows, z, at = rows[more], z[more], at[more]
        cost = np.where(other[more], cost[more], np.inf)
        if not len(rows):
            break
    return heights, costs, source


def chosen(xy: Array, heights: Array, costs: Array) -> NDArray[np.int64]:
    """(n,) which offer counts at each vertex of one element (n, 2)."""
    n = len(xy)
    single = ~np.isfinite(costs[:, 1])
    if single.all():
        return np.zeros(n, np.int64)
    step = np.concatenate([[0.0], np.hypot(*np.diff(xy, axis=0).T)])
    total = np.where(np.isfinite(costs), costs, 1e6)
    filled = np.where(np.isfinite(heights), heights, 0.0)
    back = np.zeros((n, OFFERS), np.int64)
    for k in range(1, n):
        climb = np.abs(filled[k][None, :] - filled[k - 1][:, None]) - GRADE * step[k]
        through = total[k - 1][:, None] + JUMP * np.maximum(climb, 0.0)
        back[k] = through.argmin(axis=0)
        total[k] = total[k] + through.min(axis=0)
    out = np.zeros(n, np.int64)
    state = int(total[-1].argmin())
    for k in range(n - 1, -1, -1):
        out[k] = state
        state = int(back[k, state])
    return out
