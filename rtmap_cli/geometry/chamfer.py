"""Chamfer distances between polylines, for many pairs at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def chamfer(a: Array, b: Array) -> float:
    """Symmetric Chamfer distance of two point sets (n, 2) and (m, 2).

    Half the sum of the mean over ``a`` of the distance to the nearest point of ``b`` and the mean
    over ``b`` of the distance to the nearest point of ``a``; point to point, not to segment.
    """
    from scipy.spatial.distance import cdist

    # Differences are squared and summed, never expanded to a² + b² - 2ab: lines exactly one
    # threshold apart must come out exactly there.
    squares = cdist(a, b, "sqeuclidean")
    to_b, to_a = np.sqrt(squares.min(axis=1)), np.sqrt(squares.min(axis=0))
    return float(to_b.mean() + to_a.mean()) / 2


def chamfer_pairs(a: Array, b: Array, i: Index, j: Index, limit: float = np.inf) -> Array:
    """(k,) distances of the pairs (a[i], b[j]); ``a`` (n, s, 2) and ``b`` (m, s, 2).

    Pairs that cannot be within ``limit`` are infinitely far: their points' distances to the
    other's bounding box, which are cheap, already say so.
    """
    out = np.full(len(i), np.inf)
    for k in np.flatnonzero(_lower_bound(a, b, i, j, limit) <= limit + 1e-9):
        out[k] = chamfer(a[i[k]], b[j[k]])
    out[out > limit] = np.inf
    return out


def _lower_bound(a: Array, b: Array, i: Index, j: Index, limit: float) -> Array:
    """(k,) values that the Chamfer distances cannot be below; sharp only below ``limit``."""
    if not len(i):
        return np.zeros(0)
    low_a, high_a = a.min(axis=1), a.max(axis=1)
    low_b, high_b = b.min(axis=1), b.max(axis=1)
    gap = np.maximum(np.maximum(low_a[i] - high_b[j], low_b[j] - high_a[i]), 0)
    out: Array = np.hypot(gap[:, 0], gap[:, 1])
    # Boxes that overlap can still hold distant lines: these need the points.
    near = np.flatnonzero(out <= limit)
    for part in np.array_split(near, max(1, len(near) // 4096)):
        to_b = _box_distance(a[i[part]], low_b[j[part]], high_b[j[part]])
        to_a = _box_distance(b[j[part]], low_a[i[part]], high_a[i[part]])
        out[part] = (to_b.mean(axis=1) + to_a.mean(axis=1)) / 2
    return out


def _box_distance(points: Array, low: Array, high: Array) -> Array:
    gap = np.maximum(np.maximum(low[:, None] - points, points - high[:, None]), 0)
    return np.hypot(gap[..., 0], gap[..., 1])


def bands(lines: Array, half_width: float) -> NDArray[Any]:
    """(n,) polygons: the lines (n, s, 2) widened to both sides, flat ends, mitred corners.

    A line of zero length has an empty band.
    """
    import shapely

    return shapely.buffer(
        shapely.linestrings(lines), half_width, cap_style="flat", join_style="mitre"
    )
