"""Which points of a sweep lie on the ground, and which stand on it and hide what is behind."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]

CELL, REACH = 1.0, 100.0
"""Size of a cell in which the lowest point is looked for, and how far around the vehicle (m)."""
STEP = 0.3
"""Points up to this far above the lowest one of their cell are ground (kerbs are): m."""
AROUND, LIFT = 7, 0.5
"""A cell whose lowest point is `LIFT` (m) above the lowest of `AROUND`² cells is on top of
something: 0.5 m in 3 m is a slope of 17 %."""
BELOW, FALL = 0.5, 0.15
"""Points more than 0.5 m + 15 % of their distance under the road are reflections."""
OVERHEAD = 3.0
"""What hangs higher above the ground than this hides none of it near: branches, signs (m)."""


def split(xyz: Floats, ground_z: float) -> tuple[Bools, Bools]:
    """(n,) on the ground, and (n,) standing on it, of points (n, 3) in the ego frame (m).

    ``ground_z`` is the height of the road under the vehicle. What hangs high over the ground, lies
    far under it or beyond `REACH` is neither.
    """
    x, y, z = xyz[:, 0], xyz[:, 1], xyz[:, 2]
    rise = z - np.float32(ground_z)
    far = np.abs(x) + np.abs(y)
    valid = (np.maximum(np.abs(x), np.abs(y)) < REACH) & (rise > -BELOW - FALL * far)
    side = int(2 * REACH / CELL)
    column = ((x + np.float32(REACH)) * np.float32(1 / CELL)).astype(np.int32)
    row = ((y + np.float32(REACH)) * np.float32(1 / CELL)).astype(np.int32)
    at = np.where(valid, row * side + column, 0)
    lowest = np.full(side * side, np.inf, np.float32)
    np.minimum.at(lowest, at[valid], rise[valid])
    around = minimum_filter(lowest.reshape(side, side), AROUND, mode="nearest").ravel()
    base = np.where(lowest > around + LIFT, around, lowest)
    height = rise - base[at]
    ground = valid & (height <= STEP)
    return ground, valid & ~ground & (height < OVERHEAD)
