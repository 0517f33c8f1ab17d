"""The systematic error of detections at a place: a smooth unit field over the map, per class.

f(q) = Σ_j b_j(q) w_j with w_j ~ N(0, I) and covariance close to exp(-d²/2l²). Within one frame the
b_j come from a few inducing points in the ego frame (Nyström); along a drive they are Gaussian
bumps on a square grid of the map, which keeps the normal equations sparse.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def frame_basis(points: Array, length_m: float) -> Array:
    """(..., m) basis at (..., 2) ego points; inducing points at most 0.9 l apart cover them all."""
    axes = []
    for axis in (0, 1):
        x = points[..., axis]
        low, high = float(x.min()), float(x.max())
        knots = np.linspace(low, high, max(2, int(np.ceil((high - low) / (0.9 * length_m))) + 1))
        prior = np.exp(-0.5 * ((knots[:, None] - knots) / length_m) ** 2)
        root = np.linalg.cholesky(prior + 1e-6 * np.eye(len(knots)))
        value = np.exp(-0.5 * ((x[..., None] - knots) / length_m) ** 2)
        axes.append(value @ np.linalg.inv(root).T)
    both = (axes[0][..., :, None] * axes[1][..., None, :]).reshape(*points.shape[:-1], -1)
    return both / np.sqrt((both * both).sum(-1, keepdims=True))


class GridField:
    """Bumps on a grid; a point sees the ``SIDE`` × ``SIDE`` nearest ones."""

    SIDE = 4

    def __init__(self, length_m: float) -> None:
        # Bumps of width l/√2 convolve to a covariance of length l.
        self.width = length_m / np.sqrt(2.0)
        self.spacing = 1.25 * self.width

    def axes(self, points: Array) -> tuple[Index, Array]:
        """First cells (n, 2) that (n, 2) map points see per axis, and values (n, SIDE, 2) of the
        `SIDE` from there: a bump's value is the product of both axes'."""
        first = np.floor(points / self.spacing).astype(np.int64) - self.SIDE // 2 + 1
        away = points[:, None] - (first[:, None] + np.arange(self.SIDE)[:, None]) * self.spacing
        value = np.exp(-0.5 * (away / self.width) ** 2)
        return first, value / np.sqrt((value * value).sum(1, keepdims=True))

    def basis(self, points: Array) -> tuple[Index, Array]:
        """Cells (n, 16, 2) of the bumps that (n, 2) map points see and their values (n, 16)."""
        first, value = self.axes(points)
        offset = np.arange(self.SIDE)
        grid = np.stack(np.meshgrid(offset, offset, indexing="ij"), -1).reshape(-1, 2)
        both = value[:, :, None, 0] * value[:, None, :, 1]
        return first[:, None] + grid, both.reshape(len(points), -1)
