"""The dense map: voxels hashed into tiles; tiles that the vehicle left go to disk."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs.cloud import Voxels

Array = NDArray[np.float64]
Int = NDArray[np.int64]

TILE = 50.0
"""Side of a tile (m)."""
PENDING = 400_000
"""Rows that wait to be summed in a tile."""
SUMS = 7
"""count, sweeps, x, y, z, z², intensity: about the tile's corner."""

_BITS = 20


class VoxelMap:
    """Sums of points per voxel, tile by tile; ``finish`` gives the tiles to ``write``.

    Tiles farther than ``keep`` metres from the vehicle are parked in ``folder`` and come back when
    it does: memory is that of the neighbourhood.
    """

    def __init__(self, voxel: float, folder: Path, keep: float) -> None:
        self.voxel, self.folder, self.keep = voxel, folder, keep
        self._side = round(TILE / voxel)
        self._tiles: dict[tuple[int, int], list[tuple[Int, Array]]] = {}
        self._parked: set[tuple[int, int]] = set()
        self.points = 0

    def add(self, xyz: Array, intensity: Array) -> None:
        """Add the points (n, 3) of one sweep, map frame."""
        if not len(xyz):
            return
        self.points += len(xyz)
        cell = np.floor(xyz / self.voxel).astype(np.int64)
        tile = np.floor_divide(cell[:, :2], self._side)
        low = tile.min(axis=0)
        wide = int(np.ptp(tile[:, 1])) + 1
        group = (tile[:, 0] - low[0]) * wide + tile[:, 1] - low[1]
        inner = cell[:, :2] - tile * self._side
        key = ((cell[:, 2] + (1 << (_BITS - 1))) << (2 * _BITS)) | (inner[:, 0] << _BITS)
        key |= inner[:, 1]
        order = np.argsort(group, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
            at = (int(tile[rows[0], 0]), int(tile[rows[0], 1]))
            local = xyz[rows] - (at[0] * TILE, at[1] * TILE, 0.0)
            self._put(at, key[rows], local, intensity[rows])

    def _put(self, at: tuple[int, int], key: Int, local: Array, intensity: Array) -> None:
        one = np.ones(len(key))
        table = np.stack([one, one, *local.T, local[:, 2] ** 2, intensity], axis=-1)
        keys, sums = _summed(key, table)
        sums[:, 1] = 1.0
        if at not in self._tiles:
            self._tiles[at] = [self._load(at)] if at in self._parked else []
            self._parked.discard(at)
        parts = self._tiles[at]
        parts.append((keys, sums))
        if sum(len(k) for k, _ in parts[1:]) > PENDING:
            self._tiles[at] = [_merged(parts)]

    def leave(self, place: Array) -> None:
        """Park the tiles that lie farther than ``keep`` from a place (2,)."""
        for at in list(self._tiles):
            middle = (np.array(at) + 0.5) * TILE
            if np.abs(middle - place).max() > self.keep + TILE / 2:
                keys, sums = _merged(self._tiles.pop(at))
                self.folder.mkdir(exist_ok=True)
                np.savez(self._file(at), keys=keys, sums=sums)
                self._parked.add(at)

    def finish(self, write: Callable[[tuple[int, int], Voxels], None]) -> int:
        """Give every tile's voxels to ``write``; returns how many voxels there are."""
        total = 0
        for at in sorted(self._parked | set(self._tiles)):
            keys, sums = _merged(self._tiles[at]) if at in self._tiles else self._load(at)
            voxels = _voxels(sums, at)
            write(at, voxels)
            total += len(keys)
        return total

    def _file(self, at: tuple[int, int]) -> Path:
        return self.folder / f"{at[0]}_{at[1]}.npz"

    def _load(self, at: tuple[int, int]) -> tuple[Int, Array]:
        with np.load(self._file(at), allow_pickle=False) as found:
            return found["keys"], found["sums"]


def _summed(key: Int, table: Array) -> tuple[Int, Array]:
    """Rows of equal keys added up, sorted by key."""
    order = np.argsort(key, kind="stable")
    key = key[order]
    first = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    return key[first], np.add.reduceat(table[order], first, axis=0)


def _merged(parts: list[tuple[Int, Array]]) -> tuple[Int, Array]:
    if len(parts) == 1:
        return parts[0]
    return _summed(np.concatenate([k for k, _ in parts]), np.concatenate([s for _, s in parts]))


def _voxels(sums: Array, at: tuple[int, int]) -> Voxels:
    n = sums[:, 0]
    mean = sums[:, 2:5] / n[:, None]
    variance = np.maximum(sums[:, 5] / n - mean[:, 2] ** 2, 0.0)
    xyz = mean + (at[0] * TILE, at[1] * TILE, 0.0)
    return Voxels(xyz, sums[:, 6] / n, n, sums[:, 1], np.sqrt(variance))
