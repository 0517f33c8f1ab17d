"""Which stations lie near points: a grid that knows for its cells the nearest station of each line.

Many points of many drives are compared with the same lines. A cell of the grid lists one station
for each line, or stretch of a line that does not turn by much, in reach of the cell; for a point in
it the foot on that stretch is a step or two along the line away.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Int = NDArray[np.int64]

CELL = 1.0
"""Side (m) of the cells, about the distance of stations."""
TURN = np.pi / 4
"""A stretch turns by this at most, all its wriggles added up."""
MOST = 1 << 22
"""Grids of more cells are searched, not looked up: memory stays bounded."""


@dataclass(frozen=True)
class Nearby:
    """Entries in order of their cells: ``cell`` (k,) used cells, the entries of each from ``first``
    (k + 1,) on in ``station``; ``low`` (2,) first cell and ``shape`` of the grid; ``row`` of every
    cell in ``cell``, or -1 (None: too many). Of every station (n, 2) ``xy`` and ``tangent``, the
    ``gap`` (m) to the next one and the ends of its line as ``start``, ``stop`` (n,)."""

    low: Int
    shape: tuple[int, int]
    cell: Int
    first: Int
    station: Int
    row: NDArray[np.int32] | None
    xy: Array
    tangent: Array
    gap: Array
    start: Int
    stop: Int

    def feet(self, points: Array) -> tuple[Int, Int, Array, Array]:
        """Pairs of a point (index into (m, 2), ascending) and the station of a stretch near it that
        is nearest along the line (a station may come twice), and how far (m) the point lies along
        and to the left of the tangent of the station."""
        px, py = np.ascontiguousarray(points.T)
        column = np.floor(px / CELL).astype(np.int64) - self.low[0]
        row = np.floor(py / CELL).astype(np.int64) - self.low[1]
        inside = (column >= 0) & (row >= 0) & (column < self.shape[0]) & (row < self.shape[1])
        row = self._rows(np.where(inside, column * self.shape[1] + row, -1))
        i = np.flatnonzero(row >= 0)
        row = row[i]
        entry = self.first[row]
        count = self.first[row + 1] - entry
        if len(count) and count.max() > 1:
            i = np.repeat(i, count)
            entry = np.repeat(entry - (np.cumsum(count) - count), count) + np.arange(len(i))
        j = self.station[entry]
        sx, sy, tx, ty = self._columns
        px, py = px[i], py[i]
        step = (px - sx[j]) * tx[j] + (py - sy[j]) * ty[j]
        moved = j + np.rint(step / self.gap[j]).astype(np.int64)
        j = np.minimum(np.maximum(moved, self.start[j]), self.stop[j])
        px -= sx[j]
        py -= sy[j]
        x, y = tx[j], ty[j]
        return i, j, px * x + py * y, x * py - y * px

    @cached_property
    def _columns(self) -> Array:
        """(4, n) places and tangents of the stations, each number in a row of its own."""
        return np.ascontiguousarray(np.column_stack([self.xy, self.tangent]).T)

    def _rows(self, cell: Int) -> Int:
        if self.row is not None:
            return np.where(cell >= 0, self.row[cell], -1)
        at = np.minimum(np.searchsorted(self.cell, cell), len(self.cell) - 1)
        return np.where(self.cell[at] == cell, at, -1)


def nearby(xy: Array, tangent: Array, s: Array, line: Int, reach: float) -> Nearby:
    """The grid of stations ``xy`` (n, 2) with unit ``tangent`` (n, 2), at ``s`` (n,) metres of
    their ``line`` (n,), in whose order they are; n > 0. Points within ``reach`` (m) of a stretch
    find it."""
    n = len(xy)
    ends = np.flatnonzero(np.append(line[1:] != line[:-1], True))
    number = np.diff(ends, prepend=-1)
    stop = np.repeat(ends, number)
    start = stop - np.repeat(number, number) + 1
    gap = np.maximum(s[stop] / np.maximum(stop - start, 1), 1e-6)
    home = np.floor(xy / CELL).astype(np.int64)
    far = reach + CELL * np.sqrt(0.5)
    side = int(np.ceil(far / CELL))
    low = home.min(axis=0) - side
    shape = (home.max(axis=0) + side + 1 - low).tolist()
    around = np.mgrid[-side : side + 1, -side : side + 1].reshape(2, -1).T
    middle = (home + 0.5) * CELL - xy
    apart = ((middle[:, None] + around * CELL) ** 2).sum(axis=-1)
    k, o = np.nonzero(apart <= far**2)
    cells = ((home - low)[k] + around[o]) @ np.array([shape[1], 1])
    key = np.sort(cells * n + k)
    cells, k = np.divmod(key, n)
    stretch = _stretches(tangent, line)[k]
    new = np.ones(len(key), bool)
    new[1:] = (cells[1:] != cells[:-1]) | (stretch[1:] != stretch[:-1])
    begin = np.flatnonzero(new)
    where = np.stack(np.divmod(cells, shape[1]), axis=-1) + low + 0.5
    distance = ((where * CELL - xy[k]) ** 2).sum(axis=1)
    nearest = distance == np.repeat(
        np.minimum.reduceat(distance, begin), np.diff(begin, append=len(key))
    )
    station = np.minimum.reduceat(np.where(nearest, k, n), begin)
    used, first = np.unique(cells[begin], return_index=True)
    row = None
    if shape[0] * shape[1] <= MOST:
        row = np.full(shape[0] * shape[1], -1, np.int32)
        row[used] = np.arange(len(used))
    grid = low, (shape[0], shape[1]), used, np.append(first, len(begin)), station, row
    return Nearby(*grid, xy, tangent, gap, start, stop)


def _stretches(tangent: Array, line: Int) -> Int:
    """(n,) number of the stretch of each station: ascending, cut at ends of lines and turns."""
    before, after = tangent[:-1], tangent[1:]
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    turn = np.abs(np.arctan2(cross, (before * after).sum(axis=1)))
    part = np.floor(np.cumsum(turn) / TURN).astype(np.int64)
    change = (np.diff(part, prepend=0) > 0) | (line[1:] != line[:-1])
    return np.concatenate([[0], np.cumsum(change)])
