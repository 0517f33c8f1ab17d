"""The height of the ground between the lines of a map, and how a vehicle stands on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import xyyaw_of
from rtmap_cli.maps.element import VectorMap

Array = NDArray[np.float64]

STEP = 3.0
"""Spacing of the grid of heights, metres."""
LEVEL = 0.05
"""A map whose heights differ by less (m) is flat."""
WHEELS = np.array([[2.8, 0.8], [2.8, -0.8], [0.0, 0.8], [0.0, -0.8]])
"""Where the wheels touch the ground, ego frame, metres (the origin is under the rear axle)."""


@dataclass(frozen=True)
class Ground:
    """Heights on a grid: ``z[j, i]`` (m, above ``base``) at ``zero + step · (i, j)``, map frame."""

    zero: Array
    step: float
    z: NDArray[np.float32]
    base: float

    def at(self, xy: Array) -> Array:
        """Heights (...) at places (..., 2) in the map frame, bilinear; the border's beyond it."""
        rows, columns = self.z.shape
        p = (np.asarray(xy, dtype=np.float64) - self.zero) / self.step
        p = np.clip(p, 0.0, np.array([columns - 1.001, rows - 1.001]))
        i, j = np.floor(p[..., 0]).astype(np.int64), np.floor(p[..., 1]).astype(np.int64)
        u, v = p[..., 0] - i, p[..., 1] - j
        low = (1 - u) * self.z[j, i] + u * self.z[j, i + 1]
        high = (1 - u) * self.z[j + 1, i] + u * self.z[j + 1, i + 1]
        out: Array = self.base + (1 - v) * low + v * high
        return out


def ground_of(vector_map: VectorMap, margin: float = 40.0) -> Ground | None:
    """The ground through the vertices of a map, linear between them, level beyond (``margin`` m).

    None for maps without heights and for flat ones. Roads above each other are mixed.
    """
    from scipy.interpolate import LinearNDInterpolator
    from scipy.ndimage import gaussian_filter
    from scipy.spatial import Delaunay, QhullError, cKDTree

    points = [e.points for e in vector_map if e.points.shape[1] == 3]
    known = np.concatenate([*points, np.zeros((0, 3))])
    known = known[np.isfinite(known).all(axis=1)]
    if len(known) < 4 or np.ptp(known[:, 2]) < LEVEL:
        return None
    # One point per square metre is enough, and triangles stay few.
    _, first = np.unique(np.floor(known[:, :2]), axis=0, return_index=True)
    known = known[first]
    zero = known[:, :2].min(axis=0) - margin
    columns, rows = np.ceil((known[:, :2].max(axis=0) + margin - zero) / STEP).astype(int) + 1
    base = float(known[:, 2].mean())
    xy, z = known[:, :2] - zero, known[:, 2] - base
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2) * STEP
    try:
        heights = LinearNDInterpolator(Delaunay(xy), z)(grid)
    except QhullError:  # all on one line
        heights = np.full(len(grid), np.nan)
    outside = np.isnan(heights)
    away, nearest = cKDTree(xy).query(grid)
    heights[outside] = z[nearest[outside]]
    heights = heights.reshape(rows, columns)
    # Nearest heights make steps far from the map; they are smoothed away there.
    far = np.where(outside, np.clip(away / 12.0 - 0.5, 0.0, 1.0), 0.0).reshape(rows, columns)
    heights = heights + far * (gaussian_filter(heights, 4.0) - heights)
    smooth = gaussian_filter(heights, 0.7)
    return Ground(zero, STEP, smooth.astype(np.float32), base)


def stand_on(ground: Ground | None, map_SE3_ego: Array) -> Array:
    """Poses (..., 4, 4) put on the ground: x, y and yaw stay, the rest follows from four wheels."""
    if ground is None:
        return map_SE3_ego
    place = xyyaw_of(map_SE3_ego)
    c, s = np.cos(place[..., 2]), np.sin(place[..., 2])
    turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    wheels = place[..., None, :2] + WHEELS @ np.swapaxes(turn, -1, -2)
    z = ground.at(wheels)
    front, rear = z[..., :2].mean(axis=-1), z[..., 2:].mean(axis=-1)
    left, right = z[..., ::2].mean(axis=-1), z[..., 1::2].mean(axis=-1)
    climb = (front - rear) / (WHEELS[0, 0] - WHEELS[2, 0])
    lean = (left - right) / (WHEELS[0, 1] - WHEELS[1, 1])
    # Columns of the rotation: forward and left lie in the plane of the wheels.
    ahead = np.stack([c, s, climb], -1)
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    up = np.cross(ahead, np.stack([-s, c, lean], -1))
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    out = np.array(map_SE3_ego, dtype=np.float64)
    out[..., :3, 0], out[..., :3, 1], out[..., :3, 2] = ahead, np.cross(up, ahead), up
    out[..., 2, 3] = rear
    return out


def level(map_SE3_ego: Array) -> Array:
    """The pose (4, 4) with the same place and yaw, upright."""
    x, y, yaw = xyyaw_of(map_SE3_ego)
    out = np.eye(4)
    out[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    out[:3, 3] = x, y, map_SE3_ego[2, 3]
    return out
