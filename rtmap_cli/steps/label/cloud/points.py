"""Sweeps made ready: bad returns dropped, motion within the turn taken out, thinned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry import lie

Array = NDArray[np.float64]

MAX_RANGE = 120.0
OWN_BODY = 1.5
"""Returns nearer than this to the ego origin in x and y are the vehicle itself (m)."""


@dataclass(frozen=True)
class Sweep:
    """One turn of a LiDAR: ``xyz`` (n, 3) m in the ego frame, ``intensity`` (n,) in [0, 1], and
    ``time`` (n,) seconds from the frame's time where the points are not motion compensated."""

    xyz: Array
    intensity: Array
    time: Array | None = None

    def __len__(self) -> int:
        return len(self.xyz)

    def kept(self, rows: NDArray[np.bool_]) -> Sweep:
        """Some of the points."""
        time = None if self.time is None else self.time[rows]
        return Sweep(self.xyz[rows], self.intensity[rows], time)


def cleaned(sweep: Sweep, reach: float = MAX_RANGE) -> Sweep:
    """Without NaN, zero returns, the vehicle's own body and what lies beyond ``reach`` (m)."""
    with np.errstate(invalid="ignore"):
        far = np.abs(sweep.xyz).max(axis=1, initial=0.0)
        body = np.abs(sweep.xyz[:, :2]).max(axis=1, initial=0.0)
        good = np.isfinite(sweep.xyz).all(axis=1) & (far < reach) & (body > OWN_BODY)
    if sweep.time is not None:
        good &= np.isfinite(sweep.time)
    return sweep if good.all() else sweep.kept(good)


def deskewed(sweep: Sweep, twist: Array) -> Array:
    """(n, 3) points where they would have been at the frame's time, the vehicle moving with a
    constant ``twist`` (6,) per second (rotation, translation; ego frame).

    A point measured t seconds after the frame's time moves by exp(t ξ). The rotation vector of a
    part of a turn is small, so exp is taken to second order in the angle.
    """
    if sweep.time is None or not len(sweep):
        return sweep.xyz
    # Turns have few distinct times: motions are computed on a grid and looked up.
    low, high = float(sweep.time.min()), float(sweep.time.max())
    if high - low < 1e-6:
        moves = lie.exp(low * twist)
        return np.asarray(sweep.xyz @ moves[:3, :3].T + moves[:3, 3])
    grid = 256
    slot = np.round((sweep.time - low) / (high - low) * (grid - 1)).astype(np.int64)
    moves = lie.exp(np.linspace(low, high, grid)[:, None] * twist)
    r, t = moves[slot, :3, :3], moves[slot, :3, 3]
    return np.asarray(np.einsum("nij,nj->ni", r, sweep.xyz) + t)


def cell_keys(xyz: Array, cell: float) -> NDArray[np.int64]:
    """(n,) one number per cubic cell of side ``cell`` (m), 21 bits an axis."""
    k = np.floor(xyz / cell).astype(np.int64) + (1 << 20)
    return np.asarray((k[:, 0] << 42) | (k[:, 1] << 21) | k[:, 2])


def thinned(xyz: Array, cell: float) -> Array:
    """(m, 3) the mean of the points in every cell of side ``cell`` (m)."""
    if not len(xyz):
        return xyz
    _, group, count = np.unique(cell_keys(xyz, cell), return_inverse=True, return_counts=True)
    sums = [np.bincount(group, xyz[:, k], len(count)) for k in range(3)]
    return np.stack(sums, axis=-1) / count[:, None]


LEAVES = (0.6, 0.7, 0.8, 1.0, 1.25)
"""Cells that sweeps may be thinned to (m): in smaller ones the neighbours of a point lie on its own
ring, and its surface is not seen."""


def leaf_of(xyz: Array, wanted: int = 10_000) -> float:
    """The cell side (m) of `LEAVES` that thins a sweep to ``wanted`` points or fewer."""
    for leaf in LEAVES[:-1]:
        if len(np.unique(cell_keys(xyz, leaf))) <= wanted:
            return leaf
    return LEAVES[-1]
