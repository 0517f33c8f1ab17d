"""The raster of the map frame: summed weights per cell and observed class, in sparse tiles."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import xyyaw_of
from rtmap_cli.logs.semantic import CLASSES, Window
from rtmap_cli.steps.semantic.evidence import Weighting

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

TILE = 256
"""Cells along a side of a tile."""
K = len(CLASSES)
HEIGHT, FRAMES = K, K + 1
"""Layers of a tile after the K classes: summed weight times height, frames that saw the cell."""


class Raster:
    """Evidence of cells of ``cell`` metres; cell (i, j) is [i, i + 1) × [j, j + 1) cells of the map
    frame. ``per_frame``: most weight that one frame may give to a cell, however many points fell
    there: points of one frame share their errors."""

    def __init__(self, cell: float, per_frame: float = 2.0) -> None:
        self.cell, self.per_frame = cell, per_frame
        self.tiles: dict[tuple[int, int], Floats] = {}

    def add(self, xyz: Array, classes: NDArray[np.uint8], weight: Floats) -> None:
        """Add the points of one frame: (n, 3) in the map frame (m), classes (n,), weights (n,)."""
        if not len(xyz):
            return
        ij = np.floor(xyz[:, :2] / self.cell).astype(np.int64)
        low = ij.min(axis=0)
        columns, rows = (ij.max(axis=0) - low + 1).tolist()
        at = (ij[:, 1] - low[1]) * columns + (ij[:, 0] - low[0])
        size = rows * columns
        counts = np.bincount(at * K + classes, weight, size * K).reshape(size, K)
        total = counts.sum(axis=1)
        seen = np.flatnonzero(total)
        values = np.empty((len(seen), K + 2), np.float32)
        scale = np.minimum(1.0, self.per_frame / total[seen])
        values[:, :K] = counts[seen] * scale[:, None]
        values[:, HEIGHT] = np.bincount(at, weight * xyz[:, 2], size)[seen] * scale
        values[:, FRAMES] = 1
        self._lay_down(low[0] + seen % columns, low[1] + seen // columns, values)

    def _lay_down(self, i: NDArray[np.int64], j: NDArray[np.int64], values: Floats) -> None:
        """Add values (n, K + 2) to distinct cells."""
        ti, tj = i // TILE, j // TILE
        key = (tj - tj.min()) * (int(ti.max() - ti.min()) + 1) + (ti - ti.min())
        for k in np.unique(key):
            rows = key == k
            tile = (int(ti[rows][0]), int(tj[rows][0]))
            if tile not in self.tiles:
                self.tiles[tile] = np.zeros((TILE, TILE, K + 2), np.float32)
            self.tiles[tile][j[rows] - tile[1] * TILE, i[rows] - tile[0] * TILE] += values[rows]

    def counts(self, i0: int, j0: int, columns: int, rows: int) -> Floats:
        """(rows, columns, K) summed weights of a block of cells."""
        out = np.zeros((rows, columns, K), np.float32)
        for tj in range(j0 // TILE, (j0 + rows - 1) // TILE + 1):
            for ti in range(i0 // TILE, (i0 + columns - 1) // TILE + 1):
                tile = self.tiles.get((ti, tj))
                if tile is None:
                    continue
                a0, a1 = max(i0, ti * TILE), min(i0 + columns, (ti + 1) * TILE)
                b0, b1 = max(j0, tj * TILE), min(j0 + rows, (tj + 1) * TILE)
                out[b0 - j0 : b1 - j0, a0 - i0 : a1 - i0] = tile[
                    b0 - tj * TILE : b1 - tj * TILE, a0 - ti * TILE : a1 - ti * TILE, :K
                ]
        return out

    def window(self, window: Window, map_SE3_ego: Array, weighting: Weighting) -> NDArray[np.uint8]:
        """(K + 1, rows, columns) the ego window at a pose (x, y and yaw count): probabilities
        times 255 and the plane of evidence. Weights are interpolated between the four cells around
        a centre."""
        x, y, yaw = xyyaw_of(map_SE3_ego)
        c, s = np.cos(yaw), np.sin(yaw)
        reach = np.hypot(window.half_x, window.half_y) + 2 * self.cell
        i0, j0 = (int(np.floor((v - reach) / self.cell)) for v in (x, y))
        side = int(np.ceil(2 * reach / self.cell)) + 3
        block = self.counts(i0, j0, side, side)
        ego = window.centres()
        u = ((x + c * ego[..., 0] - s * ego[..., 1]) / self.cell - i0 - 0.5).astype(np.float32)
        v = ((y + s * ego[..., 0] + c * ego[..., 1]) / self.cell - j0 - 0.5).astype(np.float32)
        at = v.astype(np.int32) * side + u.astype(np.int32)
        seen = np.asarray(block.any(axis=-1))
        near = seen[:-1, :-1] | seen[1:, :-1] | seen[:-1, 1:] | seen[1:, 1:]
        used = np.zeros((side, side), bool)
        used[:-1, :-1] = near
        wanted = np.flatnonzero(used.take(at))
        at, du, dv = at.ravel()[wanted], (u % 1).ravel()[wanted], (v % 1).ravel()[wanted]
        flat = block.reshape(-1, K)
        found = flat[at] * ((1 - du) * (1 - dv))[:, None]
        for step, share in ((1, du * (1 - dv)), (side, (1 - du) * dv), (side + 1, du * dv)):
            found += flat[at + step] * share[:, None]
        out = np.zeros((window.rows * window.columns, K + 1), np.uint8)
        out[wanted, :K] = np.round(255 * weighting.probabilities(found))
        out[wanted, K] = np.round(255 * (1 - np.exp(-found.sum(axis=1))))
        return np.ascontiguousarray(out.T).reshape(K + 1, window.rows, window.columns)

    def __iter__(self) -> Iterator[tuple[tuple[int, int], Floats]]:
        """Tiles in the order of their numbers."""
        return iter(sorted(self.tiles.items()))
