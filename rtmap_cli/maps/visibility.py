"""Which part of the map was in view of a frame and not hidden.

"Not seen" is evidence only where the sensor looked: inside the range, not behind an occluder and,
where the cameras are known, inside one of their frusta. Never looked ≠ looked and absent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Int = NDArray[np.int64]

Range = tuple[float, float, float, float]
Sectors = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Views:
    """Pairs of a frame and a map point that it could see: rows ``frame``, ``point`` and the
    ``distance`` (m) between them, sorted by frame, then point."""

    frame: Int
    point: Int
    distance: Array

    def __len__(self) -> int:
        return len(self.frame)


def hidden(points: Array, boxes: Array) -> NDArray[np.bool_]:
    """(n,) True where the line of sight from the ego origin meets a box before the point or in it.

    ``points`` (n, 2) and ``boxes`` (k, 5: x, y, yaw, length, width) in the ego frame, metres.
    A box around the origin (the vehicle itself) hides nothing.
    """
    return hidden_in_frames(points, np.zeros(len(points), np.int64), [boxes])


def hidden_in_frames(points: Array, frame: Int, boxes: Sequence[Array]) -> NDArray[np.bool_]:
    """``hidden`` for points of several frames, each with its own boxes: (n,) ``frame`` says whose.

    Slab test of the segment origin → point in each box's own frame, for the segments that meet the
    circle around the box.
    """
    out = np.zeros(len(points), bool)
    most = max((len(b) for b in boxes), default=0)
    if not most or not len(points):
        return out
    # Missing boxes are NaN, which is near nothing.
    table = np.full((len(boxes), most, 5), np.nan)
    for row, own in zip(table, boxes, strict=True):
        row[: len(own)] = own
    px, py = points[:, :1], points[:, 1:]
    square = px * px + py * py
    radius = np.hypot(table[..., 3], table[..., 4]) / 2 + 1e-6
    nearest = np.maximum(np.hypot(table[..., 0], table[..., 1]) - radius, 0.0) ** 2
    # Boxes beyond all points hide none of them: often most of the traffic.
    order = np.argsort(nearest, axis=1)
    count = int((nearest <= square.max()).sum(axis=1).max(initial=0))
    order = order[:, :count]
    row = np.arange(len(boxes))[:, None]
    table, radius, nearest = table[row, order], radius[row, order], nearest[row, order]
    cx, cy = table[..., 0][frame], table[..., 1][frame]
    near = (px * cy - py * cx) ** 2 <= square * (radius**2)[frame]
    near &= (square >= nearest[frame]) & (px * cx + py * cy > -radius[frame] * np.sqrt(square))
    n, k = np.nonzero(near)
    blocked = _meets(points[n], table[frame[n], k])
    out[n[blocked]] = True
    return out


def _meets(points: Array, boxes: Array) -> NDArray[np.bool_]:
    """(n,) whether the segment from the origin to each point meets its box (n, 5)."""
    x, y = boxes[:, 0], boxes[:, 1]
    c, s, half = np.cos(boxes[:, 2]), np.sin(boxes[:, 2]), boxes[:, 3:5] / 2
    px, py = points[:, 0], points[:, 1]
    enter, leave = np.zeros(len(points)), np.ones(len(points))
    around = np.ones(len(points), bool)
    for origin, step, size in (
        (-(c * x + s * y), c * px + s * py, half[:, 0]),
        (s * x - c * y, c * py - s * px, half[:, 1]),
    ):
        step = np.where(np.abs(step) < 1e-12, 1e-12, step)
        one, other = (-size - origin) / step, (size - origin) / step
        enter = np.maximum(enter, np.minimum(one, other))
        leave = np.minimum(leave, np.maximum(one, other))
        around &= np.abs(origin) <= size
    return np.asarray((enter <= leave) & ~around, np.bool_)


def in_sectors(points: Array, sectors: Sectors) -> NDArray[np.bool_]:
    """(n,) True where the bearing of an ego-frame point lies in one of the horizontal fields of
    view: pairs (centre, half width) in radians, counter-clockwise from straight ahead."""
    bearing = np.arctan2(points[:, 1], points[:, 0])
    out = np.zeros(len(points), bool)
    for centre, half_width in sectors:
        turn = (bearing - centre + np.pi) % (2 * np.pi) - np.pi
        out |= np.abs(turn) <= half_width
    return out


def views(
    points: Array,
    pose: Array,
    range_m: Range,
    occluders: Sequence[Array] | None = None,
    margin: float = 0.0,
    sectors: Sectors | None = None,
) -> Views:
    """Which of the map points (n, 2) each of m frames could see.

    ``pose`` (m, 3) x, y, yaw of map_SE3_ego; ``range_m`` the ego-frame box, shrunk by ``margin``
    (m) on all sides; ``occluders`` per frame (k, 5) ego-frame boxes; ``sectors`` the cameras'
    fields of view (None: all around).
    """
    from scipy.spatial import cKDTree

    x0, y0, x1, y1 = range_m
    low = np.array([x0 + margin, y0 + margin])
    high = np.array([x1 - margin, y1 - margin])
    if not len(points) or not len(pose) or (low >= high).any():
        return Views(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    centre, reach = (low + high) / 2, float(np.hypot(*(high - low)) / 2)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    middles = pose[:, :2] + np.stack(
        [c * centre[0] - s * centre[1], s * centre[0] + c * centre[1]], axis=-1
    )
    tree = cKDTree(points)
    room = reach + 1e-6
    close = (middles >= points.min(axis=0) - room) & (middles <= points.max(axis=0) + room)
    frames, which, distances = [], [], []
    for group in _groups(middles, close.all(axis=1)):
        first = middles[group.start]
        room = reach + float(np.hypot(*(middles[group] - first).T).max())
        index = np.sort(np.asarray(tree.query_ball_point(first, room), np.int64))
        if not len(index):
            continue
        dx = points[index, 0] - pose[group, 0, None]
        dy = points[index, 1] - pose[group, 1, None]
        cg, sg = c[group, None], s[group, None]
        x, y = cg * dx + sg * dy, cg * dy - sg * dx
        i, k = np.nonzero((x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1]))
        local = np.stack([x[i, k], y[i, k]], axis=-1)
        seen = np.ones(len(i), bool) if sectors is None else in_sectors(local, sectors)
        if occluders is not None:
            seen &= ~hidden_in_frames(local, i, occluders[group])
        frames.append(i[seen] + group.start)
        which.append(index[k[seen]])
        distances.append(np.hypot(local[seen, 0], local[seen, 1]))
    if not frames:
        return Views(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    return Views(np.concatenate(frames), np.concatenate(which), np.concatenate(distances))


TOGETHER, APART = 16, 12.0
"""At most so many frames, not farther apart (m), look for points together."""


def _groups(middles: Array, wanted: NDArray[np.bool_]) -> list[slice]:
    """Frames one after the other that stand near each other, without those not wanted."""
    out, start = [], 0
    while start < len(middles):
        if not wanted[start]:
            start += 1
            continue
        part = middles[start : start + TOGETHER]
        end = (np.hypot(*(part - part[0]).T) > APART) | ~wanted[start : start + TOGETHER]
        stop = start + (int(end.argmax()) if end.any() else len(part))
        out.append(slice(start, stop))
        start = stop
    return out
