"""Polylines as (n, 2) or (n, 3) float arrays; a ring repeats its first vertex at the end."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def is_ring(points: Array, tolerance: float = 1e-6) -> bool:
    """True when the last vertex repeats the first one (planar, metres)."""
    return len(points) > 3 and bool(np.abs(points[0, :2] - points[-1, :2]).max() <= tolerance)


def arc_length(points: Array) -> Array:
    """(n,) planar distance travelled from the first vertex, in the unit of the points."""
    steps = np.hypot(*np.diff(points[:, :2], axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps)])


def length(points: Array) -> float:
    """Planar length of a polyline."""
    return float(np.hypot(*np.diff(points[:, :2], axis=0).T).sum())


def resample(points: Array, count: int) -> Array:
    """``count`` points at equal planar arc length, first and last vertex included.

    Heights are interpolated; where an end of a segment has no height (NaN) neither have its
    points. A line of zero length becomes ``count`` copies of its first vertex.
    """
    s = arc_length(points)
    if s[-1] <= 0:
        return np.repeat(np.asarray(points[:1], dtype=np.float64), count, axis=0)
    at = np.linspace(0.0, s[-1], count)
    return np.stack([np.interp(at, s, points[:, k]) for k in range(points.shape[1])], axis=-1)


def resample_step(points: Array, step: float) -> Array:
    """Points at equal arc length at most ``step`` apart, both ends kept."""
    return resample(points, max(2, int(np.ceil(length(points) / step - 1e-9)) + 1))


def tangents(points: Array) -> Array:
    """(n, 2) unit tangents by central differences (one-sided at the ends; wrapped on rings)."""
    p = np.asarray(points[:, :2], dtype=np.float64)
    if is_ring(points):
        d = np.roll(p[:-1], -1, axis=0) - np.roll(p[:-1], 1, axis=0)
        d = np.concatenate([d, d[:1]])
    else:
        d = np.gradient(p, axis=0)
    return d / np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-12)[:, None]


def normals(points: Array) -> Array:
    """(n, 2) unit normals to the left of the tangents."""
    t = tangents(points)
    return np.stack([-t[:, 1], t[:, 0]], axis=-1)


def clip_to_box(points: Array, box: tuple[float, float, float, float]) -> list[Array]:
    """The stretches of a polyline inside ``box`` = (x_min, y_min, x_max, y_max).

    Order and direction are kept; heights are interpolated at the cuts (Liang–Barsky, per
    segment). Stretches of zero length are dropped. A ring that starts inside is joined over its
    start so that it is not cut where nothing cuts it.
    """
    x0, y0, x1, y1 = box
    p = np.asarray(points, dtype=np.float64)
    a, b = p[:-1], p[1:]
    d = b - a
    low, high = np.zeros(len(d)), np.ones(len(d))
    outside = np.zeros(len(d), dtype=bool)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for axis, (lo, hi) in enumerate(((x0, x1), (y0, y1))):
            flat = d[:, axis] == 0
            outside |= flat & ((a[:, axis] < lo) | (a[:, axis] > hi))
            t0, t1 = (lo - a[:, axis]) / d[:, axis], (hi - a[:, axis]) / d[:, axis]
            t0, t1 = np.minimum(t0, t1), np.maximum(t0, t1)
            low = np.where(flat, low, np.maximum(low, t0))
            high = np.where(flat, high, np.minimum(high, t1))
    keep = ~outside & (low < high)
    pieces: list[list[Array]] = []
    for i in np.flatnonzero(keep):
        start = a[i] if low[i] <= 0 else _mix(a[i], b[i], low[i])
        end = b[i] if high[i] >= 1 else _mix(a[i], b[i], high[i])
        if pieces and low[i] <= 0 and i > 0 and keep[i - 1] and high[i - 1] >= 1:
            pieces[-1].append(end)
        else:
            pieces.append([start, end])
    joined = is_ring(p) and len(pieces) > 1 and keep[0] and keep[-1]
    if joined and low[0] <= 0 and high[-1] >= 1:
        pieces[0] = pieces.pop() + pieces[0][1:]
    return [np.array(piece) for piece in pieces]


def _mix(a: Array, b: Array, t: float) -> Array:
    return a + t * (b - a)


def join_lines(lines: list[Array], tolerance: float = 0.01) -> list[Array]:
    """Join polylines end to end where exactly two ends meet within ``tolerance`` metres.

    Lines may be reversed; where three or more ends meet nothing is joined (a fork stays a fork).
    A chain that comes back to its start becomes a ring. Planar ends decide; heights travel along.
    """
    from scipy.spatial import cKDTree

    lines = [np.asarray(line, dtype=np.float64) for line in lines if len(line) > 1]
    open_ids = [i for i, line in enumerate(lines) if not is_ring(line)]
    if not open_ids:
        return lines
    ends = np.array([lines[i][k, :2] for i in open_ids for k in (0, -1)])
    groups: dict[int, list[int]] = {}
    partner: dict[int, int] = {}
    for k, near in enumerate(cKDTree(ends).query_ball_point(ends, tolerance)):
        groups[k] = sorted(near)
    for k, near in groups.items():
        if len(near) == 2 and groups[near[0]] == groups[near[1]] == near:
            partner[k] = near[0] if near[1] == k else near[1]
    out = [line for i, line in enumerate(lines) if is_ring(line)]
    used: set[int] = set()
    starts = [k for k in range(len(ends)) if k not in partner] + list(range(len(ends)))
    for start in starts:
        if start // 2 in used:
            continue
        chain: list[Array] = []
        end = start
        while True:
            index = end // 2
            used.add(index)
            piece = lines[open_ids[index]]
            chain.append(piece if end % 2 == 0 else piece[::-1])
            other = partner.get(end ^ 1)
            if other is None or other // 2 in used:
                break
            end = other
        points = np.concatenate([chain[0]] + [c[1:] for c in chain[1:]])
        if partner.get(end ^ 1) == start and len(points) > 3:
            points[-1] = points[0]
        out.append(points)
    return out


def project(points: Array, line: Array) -> tuple[Array, Array, NDArray[np.int64]]:
    """Nearest points of a polyline to (n, 2) points.

    Returns the planar feet (n, 2), the distances (n,) and the segment indices (n,).
    """
    a, b = line[:-1, :2], line[1:, :2]
    d = b - a
    norm = np.maximum((d * d).sum(-1), 1e-18)
    t = np.clip(((points[:, None, :2] - a) * d).sum(-1) / norm, 0.0, 1.0)
    feet = a + t[..., None] * d
    distance = np.hypot(*np.moveaxis(points[:, None, :2] - feet, -1, 0))
    best = distance.argmin(axis=1)
    rows = np.arange(len(points))
    return feet[rows, best], distance[rows, best], best
