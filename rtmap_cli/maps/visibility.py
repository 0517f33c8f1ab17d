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
    Slab test of the segment origin → point in each box's own frame; a box around the origin (the
    vehicle itself) hides nothing.
    """
    if not len(boxes) or not len(points):
        return np.zeros(len(points), bool)
    c, s = np.cos(boxes[:, 2]), np.sin(boxes[:, 2])
    half = boxes[:, 3:5] / 2
    # Origin and directions in the frames of the boxes: (k, 2) and (k, n, 2).
    ox = -(c * boxes[:, 0] + s * boxes[:, 1])
    oy = -(-s * boxes[:, 0] + c * boxes[:, 1])
    dx = c[:, None] * points[:, 0] + s[:, None] * points[:, 1]
    dy = -s[:, None] * points[:, 0] + c[:, None] * points[:, 1]
    enter, leave = np.zeros(dx.shape), np.ones(dx.shape)
    for origin, step, size in ((ox, dx, half[:, 0]), (oy, dy, half[:, 1])):
        step = np.where(np.abs(step) < 1e-12, 1e-12, step)
        a = (-size - origin)[:, None] / step
        b = (size - origin)[:, None] / step
        enter = np.maximum(enter, np.minimum(a, b))
        leave = np.minimum(leave, np.maximum(a, b))
    around = (np.abs(ox) <= half[:, 0]) & (np.abs(oy) <= half[:, 1])
    return np.asarray(((enter <= leave) & ~around[:, None]).any(axis=0), np.bool_)


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
    near = cKDTree(points).query_ball_point(middles, reach, return_sorted=True)
    frames, which, distances = [], [], []
    for i, candidates in enumerate(near):
        index = np.asarray(candidates, np.int64)
        d = points[index] - pose[i, :2]
        local = np.stack([c[i] * d[:, 0] + s[i] * d[:, 1], c[i] * d[:, 1] - s[i] * d[:, 0]], -1)
        ok = ((local >= low) & (local <= high)).all(axis=1)
        if sectors is not None:
            ok &= in_sectors(local, sectors)
        index, local = index[ok], local[ok]
        if occluders is not None and len(occluders[i]) and len(index):
            clear = ~hidden(local, occluders[i])
            index, local = index[clear], local[clear]
        frames.append(np.full(len(index), i, np.int64))
        which.append(index)
        distances.append(np.hypot(local[:, 0], local[:, 1]))
    return Views(np.concatenate(frames), np.concatenate(which), np.concatenate(distances))
