"""Chamfer distances between polylines, for many pairs at once."""

from __future__ import annotations

from collections.abc import Sequence
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


def sample_lines(lines: Sequence[Array], count: int) -> Array:
    """(n, count, 2) points at equal arc length of n polylines (any number of vertices ≥ 2 each).

    Like ``polylines.resample`` line by line, in one pass over all of them.
    """
    if not len(lines):
        return np.zeros((0, count, 2))
    points = np.concatenate([line[:, :2] for line in lines]).astype(np.float64)
    size = np.array([len(line) for line in lines])
    last = np.cumsum(size) - 1
    first = last - size + 1
    way = np.diff(points, axis=0, append=points[-1:])
    step = np.hypot(way[:, 0], way[:, 1])
    step[last] = 0.0
    # Each line's own arc length in a row; sums over all lines only serve to find the segment.
    line_of = np.repeat(np.arange(len(lines)), size)
    place = np.arange(len(points)) - first[line_of]
    rows = np.zeros((len(lines), int(size.max()) + 1))
    rows[line_of, place + 1] = step
    s = np.cumsum(rows, axis=1)[line_of, place]
    total = s[last]
    at = np.linspace(0.0, total, count, axis=1)
    offset = np.concatenate([[0.0], np.cumsum(total + 1.0)[:-1]])
    k = np.searchsorted(s + offset[line_of], at + offset[:, None], side="right") - 1
    k = np.clip(k, first[:, None], np.maximum(last - 1, first)[:, None])
    share = np.clip((at - s[k]) / np.where(step[k] > 0, step[k], 1.0), 0.0, 1.0)
    out: Array = points[k] + share[..., None] * way[k]
    out[:, -1] = points[last]
    out[total <= 0] = points[first[total <= 0]][:, None]
    return out


def chamfer_pairs(a: Array, b: Array, i: Index, j: Index, limit: float = np.inf) -> Array:
    """(k,) distances of the pairs (a[i], b[j]); ``a`` (n, s, 2) and ``b`` (m, s, 2).

    Pairs that cannot be within ``limit`` are infinitely far: their points' distances to the
    other's bounding box, which are cheap, already say so.
    """
    out = np.full(len(i), np.inf)
    which, distance, _ = close_pairs(a, b, i, j, limit)
    out[which] = distance
    return out


def close_pairs(
    a: Array, b: Array, i: Index, j: Index, limit: float, probes: Index | None = None
) -> tuple[Index, Array, Index]:
    """The pairs (a[i], b[j]) within ``limit``: which they are (c,), their distances (c,), and for
    points number ``probes`` (p,) of a[i] the numbers (c, p) of the nearest points of b[j]."""
    from scipy.spatial.distance import cdist

    picks = np.zeros(0, np.intp) if probes is None else probes
    which = np.flatnonzero(_lower_bound(a, b, i, j, limit) <= limit + 1e-9)
    squares = np.empty((a.shape[1], b.shape[1]))
    to_b, to_a = np.empty((len(which), a.shape[1])), np.empty((len(which), b.shape[1]))
    feet = np.empty((len(which), len(picks)), np.intp)
    for n, k in enumerate(which.tolist()):
        # As ``chamfer``, in the same memory for all pairs.
        cdist(a[i[k]], b[j[k]], "sqeuclidean", out=squares)
        squares.min(axis=1, out=to_b[n])
        squares.min(axis=0, out=to_a[n])
        squares[picks].argmin(axis=1, out=feet[n])
    distance = (np.sqrt(to_b).mean(axis=1) + np.sqrt(to_a).mean(axis=1)) / 2
    kept = distance <= limit
    return which[kept], distance[kept], feet[kept]


def _lower_bound(a: Array, b: Array, i: Index, j: Index, limit: float) -> Array:
    """(k,) values that the Chamfer distances cannot be below; sharp only below ``limit``."""
    if not len(i):
        return np.zeros(0)
    low_a, high_a = a.min(axis=1), a.max(axis=1)
    low_b, high_b = b.min(axis=1), b.max(axis=1)
    gap = np.maximum(np.maximum(low_a[i] - high_b[j], low_b[j] - high_a[i]), 0)
    out: Array = np.hypot(gap[:, 0], gap[:, 1])
    # Boxes that overlap can still hold distant lines: these need the points. The distance to a box
    # is convex, so that it is no larger at the mean of ten points than on average over them.
    near = np.flatnonzero(out <= limit)
    a, b = _means(a), _means(b)
    for part in np.array_split(near, max(1, len(near) // 4096)):
        to_b = _box_distance(a[i[part]], low_b[j[part]], high_b[j[part]])
        to_a = _box_distance(b[j[part]], low_a[i[part]], high_a[i[part]])
        out[part] = (to_b.mean(axis=1) + to_a.mean(axis=1)) / 2
    return out


def _means(lines: Array, count: int = 10) -> Array:
    """(n, s / count, 2) means of ``count`` consecutive points; the points if they do not divide."""
    n, s = lines.shape[:2]
    return lines if s % count else lines.reshape(n, s // count, count, 2).mean(axis=2)


def _box_distance(points: Array, low: Array, high: Array) -> Array:
    gap = np.maximum(np.maximum(low[:, None] - points, points - high[:, None]), 0)
    return np.sqrt(gap[..., 0] ** 2 + gap[..., 1] ** 2)


def beside(a: Array, b: Array, nearest: Index, within: float) -> NDArray[np.bool_]:
    """(k,) True where some point of a line surely lies beside another line, within a distance.

    ``a`` (k, p, 2) are points of one line each, ``b`` (k, s, 2) the other lines, ``nearest``
    (k, p) the points of b nearest to those of a. A point that has its foot inside a segment of b
    lies in b's flat band. False says nothing: a point that was not asked may lie there.
    """
    out = np.zeros(len(a), dtype=bool)
    middle = np.minimum(nearest, b.shape[1] - 2)
    for before in (0, 1):
        k = np.maximum(middle - before, 0)[..., None]
        start = np.take_along_axis(b, k, axis=1)
        way = np.take_along_axis(b, k + 1, axis=1) - start
        square = (way**2).sum(axis=-1)
        offset = a - start
        along = (offset * way).sum(axis=-1)
        across = np.abs(offset[..., 0] * way[..., 1] - offset[..., 1] * way[..., 0])
        inside = (along > 0) & (along < square) & (across < within * np.sqrt(square))
        out |= inside.any(axis=1)
    return out


def bands(lines: Array, half_width: float) -> NDArray[Any]:
    """(n,) polygons: the lines (n, s, 2) widened to both sides, flat ends, mitred corners.

    A line of zero length has an empty band.
    """
    import shapely

    return shapely.buffer(
        shapely.linestrings(lines), half_width, cap_style="flat", join_style="mitre"
    )
