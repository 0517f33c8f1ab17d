"""NDT: points against normal distributions in cells, without any package.

Biber and Straßer 2003, Magnusson 2009 (section 6.3). A cell holds the mean μ and covariance C of
the points in it; a point q of the sweep at m² = (q − μ)ᵀ C⁻¹ (q − μ) from its cell scores
exp(−m²/2), which Gauss–Newton maximises with weights exp(−m²/2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry import lie
from rtmap_cli.geometry.poses import transform
from rtmap_cli.steps.label.cloud.matcher import ITERATIONS, Match, judged
from rtmap_cli.steps.label.cloud.points import cell_keys, thinned

Array = NDArray[np.float64]
Int = NDArray[np.int64]

FEWEST = 5
"""Points that make a distribution."""
FLATTEST = 1e-3
"""Smallest share of the largest variance that a cell's variances may have."""
SIGMA = 0.03
"""Smallest standard deviation of a cell (m): noise of ranges."""
REACH = 120.0
"""Cells farther than this from the vehicle are forgotten (m)."""


@dataclass
class Cells:
    """Sums of the points per cell, sorted by key, and the distributions made of them."""

    size: float
    keys: Int
    sums: Array
    """(n, 10): count, x, y, z, xx, xy, xz, yy, yz, zz, about ``origin``."""
    origin: Array

    @staticmethod
    def empty(size: float) -> Cells:
        """No cells."""
        return Cells(size, np.zeros(0, np.int64), np.zeros((0, 10)), np.zeros(3))

    def add(self, xyz: Array) -> None:
        """Add points (n, 3)."""
        p = xyz - self.origin
        x, y, z = p.T
        rows = np.stack([np.ones(len(p)), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z], -1)
        keys = np.concatenate([self.keys, cell_keys(xyz, self.size)])
        table = np.concatenate([self.sums, rows])
        self.keys, group = np.unique(keys, return_inverse=True)
        self.sums = np.stack(
            [np.bincount(group, table[:, k], len(self.keys)) for k in range(10)], axis=-1
        )

    def forget(self, centre: Array) -> None:
        """Drop cells far from ``centre`` (3,), and take sums about it from now on."""
        n = self.sums[:, 0]
        mean = self.sums[:, 1:4] / n[:, None]
        near = np.linalg.norm(mean + self.origin - centre, axis=1) < REACH
        self.keys, self.sums, mean, n = self.keys[near], self.sums[near], mean[near], n[near]
        shift = centre - self.origin
        i, j = np.triu_indices(3)
        second = self.sums[:, 4:] / n[:, None] - mean[:, i] * mean[:, j]
        moved = mean - shift
        self.sums[:, 1:4] = moved * n[:, None]
        self.sums[:, 4:] = (second + moved[:, i] * moved[:, j]) * n[:, None]
        self.origin = centre.copy()

    def distributions(self) -> tuple[Int, Array, Array]:
        """Keys (m,), means (m, 3) and inverse covariances (m, 3, 3) of cells with points enough."""
        full = self.sums[:, 0] >= FEWEST
        s = self.sums[full]
        n = s[:, 0]
        mean = s[:, 1:4] / n[:, None]
        i, j = np.triu_indices(3)
        c = np.zeros((len(s), 3, 3))
        c[:, i, j] = (s[:, 4:] / n[:, None] - mean[:, i] * mean[:, j]) * (n / (n - 1))[:, None]
        c[:, j, i] = c[:, i, j]
        value, vector = np.linalg.eigh(c)
        floor = np.maximum(FLATTEST * value[:, 2:], SIGMA**2)
        inverse = (vector / np.maximum(value, floor)[:, None, :]) @ np.swapaxes(vector, 1, 2)
        return self.keys[full], mean + self.origin, inverse


class Ndt:
    """Satisfies ``Matcher``: a coarse and a fine grid of distributions."""

    def __init__(self, leaf: float) -> None:
        self.leaf = leaf
        self._levels = [Cells.empty(size) for size in (6 * leaf, 3 * leaf)]
        self._ready: list[tuple[Int, Array, Array]] | None = None

    def prepare(self, xyz: Array) -> tuple[Array, Array]:
        """The sweep as it goes into the map, and thinned for matching."""
        return thinned(xyz, self.leaf / 3), thinned(xyz, self.leaf)

    def insert(self, prepared: tuple[Array, Array], pose: Array) -> None:
        """Add a sweep to the cells; those that are out of reach are forgotten."""
        for level in self._levels:
            if np.linalg.norm(pose[:3, 3] - level.origin) > REACH / 4:
                level.forget(pose[:3, 3])
            level.add(transform(pose, prepared[0]))
        self._ready = None

    def match(self, prepared: tuple[Array, Array], guess: Array) -> Match:
        """Coarse cells first, then fine ones."""
        if self._ready is None:
            self._ready = [level.distributions() for level in self._levels]
        pose = guess
        for level, ready in zip(self._levels, self._ready, strict=True):
            out = _newton(ready, level.size, prepared[1], pose)
            pose = out.pose
        return out

    def local_points(self) -> Array:
        """The means of the fine cells."""
        return self._levels[-1].distributions()[1]


def _newton(ready: tuple[Int, Array, Array], size: float, points: Array, pose: Array) -> Match:
    """Gauss–Newton of points (n, 3) against distributions from a pose on."""
    keys, mean, inverse = ready
    for _ in range(ITERATIONS):
        q = transform(pose, points)
        wanted = cell_keys(q, size)
        at = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
        met = np.flatnonzero(keys[at] == wanted) if len(keys) else np.zeros(0, np.int64)
        e = q[met] - mean[at[met]]
        c = inverse[at[met]]
        ce = np.einsum("nij,nj->ni", c, e)
        m2 = (ce * e).sum(axis=1)
        weight = np.exp(-0.5 * m2)
        r = pose[:3, :3]
        j = np.concatenate([-r @ lie.skew(points[met]), np.broadcast_to(r, c.shape)], axis=2)
        wj = weight[:, None, None] * (c @ j)
        h = np.einsum("nij,nik->jk", j, wj)
        g = np.einsum("nij,ni->j", wj, e)
        step = -np.linalg.solve(h + 1e-6 * np.eye(6), g)
        pose = pose @ lie.exp(step)
        if np.linalg.norm(step[:3]) < 2e-4 and np.linalg.norm(step[3:]) < 1e-3:
            break
    cost = float(np.minimum(m2 / 2, 5.0).sum())
    return judged(pose, h, len(met), cost, len(points))
