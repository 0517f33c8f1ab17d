"""Sparse rasters: blocks of cells where something lies, nothing elsewhere, so that a city fits.

A layout says which blocks of ``SIDE`` × ``SIDE`` cells are there; a raster is an array
(blocks, SIDE, SIDE), rows y, columns x. Cell (i, j) covers [i, i + 1) × [j, j + 1) cells of the map
frame; blocks are sorted by their keys.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Float = NDArray[np.float32]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

SIDE = 64
"""Cells of a block's side."""
_BITS = 6
_LOW = SIDE - 1
_HALF = 1 << 30
_SHIFT = 31
AROUND = np.array([[-1, 1], [0, 1], [1, 1], [1, 0], [1, -1], [0, -1], [-1, -1], [-1, 0]])
"""The eight neighbours of a cell (x, y), clockwise from the upper left."""


def pack(cells: Int) -> Int:
    """(n,) one sortable number for each integer cell (n, 2): x, y."""
    return ((cells[:, 0] + _HALF) << _SHIFT) | (cells[:, 1] + _HALF)


def unpack(keys: Int) -> Int:
    """(n, 2) the cells of ``pack``."""
    return np.stack([(keys >> _SHIFT) - _HALF, (keys & ((1 << _SHIFT) - 1)) - _HALF], axis=-1)


def find(keys: Int, wanted: Int) -> Int:
    """(n,) places of ``wanted`` in the sorted ``keys``, −1 where they are not."""
    if not len(keys):
        return np.full(len(wanted), -1)
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[at] == wanted, at, -1)


@dataclass(frozen=True)
class Layout:
    """Which blocks are there: sorted packed ``keys`` (b,), and the size of a ``cell`` (m)."""

    keys: Int
    cell: float

    def __len__(self) -> int:
        return len(self.keys)

    @staticmethod
    def around(xy: Array, reach: float, cell: float) -> Layout:
        """The blocks that lie within ``reach`` metres (per axis) of some of the points (n, 2)."""
        size = SIDE * cell
        low = np.floor((xy - reach) / size).astype(np.int64)
        high = np.floor((xy + reach) / size).astype(np.int64)
        most = (high - low).max(axis=0, initial=0) + 1
        step = np.stack(np.meshgrid(np.arange(most[0]), np.arange(most[1])), -1).reshape(-1, 2)
        all_ = low[:, None] + step
        return Layout(np.unique(pack(all_[(all_ <= high[:, None]).all(axis=-1)])), cell)

    @staticmethod
    def union(layouts: list[Layout], cell: float) -> Layout:
        """The blocks of all."""
        parts = [x.keys for x in layouts] or [np.zeros(0, np.int64)]
        return Layout(np.unique(np.concatenate(parts)), cell)

    def places(self, cells: Int) -> Int:
        """(n,) flat places in a raster of integer cells (n, 2), −1 where no block is."""
        block = find(self.keys, pack(cells >> _BITS))
        flat = (((block << _BITS) | (cells[:, 1] & _LOW)) << _BITS) | (cells[:, 0] & _LOW)
        return np.where(block >= 0, flat, -1)

    def cells(self, flat: Int) -> Int:
        """(n, 2) integer cells of flat places."""
        block, rest = np.divmod(flat, SIDE * SIDE)
        return unpack(self.keys[block]) * SIDE + np.stack([rest % SIDE, rest // SIDE], axis=-1)

    def centres(self, flat: Int) -> Array:
        """(n, 2) centres of flat places in the map frame."""
        return np.asarray((self.cells(flat) + 0.5) * self.cell, np.float64)

    def zeros(self) -> Float:
        """An empty raster."""
        return np.zeros((len(self), SIDE, SIDE), np.float32)

    def deposit(self, xy: Array, weight: Array) -> Float:
        """A raster with each weight (n,) spread over the four cells around its point (n, 2), by
        bilinear shares: their mean place is the point. What has no block is dropped."""
        place, share = (np.concatenate(part) for part in zip(*self._corners(xy), strict=True))
        size = len(self) * SIDE * SIDE
        out = np.bincount(place + 1, share * np.tile(weight, 4), size + 1)[1:]
        return out.reshape(-1, SIDE, SIDE).astype(np.float32)

    def count(self, cells: Int, weight: Array) -> Float:
        """A raster of the weights (n,) summed by integer cell (n, 2)."""
        size = len(self) * SIDE * SIDE
        out = np.bincount(self.places(cells) + 1, weight, size + 1)[1:]
        return out.reshape(-1, SIDE, SIDE).astype(np.float32)

    def halo(self, raster: Float, width: int) -> Float:
        """(blocks, SIDE + 2 width, SIDE + 2 width): each block with its neighbours' borders."""
        n, w = len(self), width
        out = np.zeros((n, SIDE + 2 * w, SIDE + 2 * w), np.float32)
        out[:, w : w + SIDE, w : w + SIDE] = raster
        here = unpack(self.keys)
        span = {
            -1: (slice(0, w), slice(SIDE - w, SIDE)),
            0: (slice(w, w + SIDE), slice(0, SIDE)),
            1: (slice(w + SIDE, None), slice(0, w)),
        }
        for dx, dy in AROUND.tolist():
            other = find(self.keys, pack(here + [dx, dy]))
            k = np.flatnonzero(other >= 0)
            (to_y, from_y), (to_x, from_x) = span[dy], span[dx]
            out[k, to_y, to_x] = raster[other[k], from_y, from_x]
        return out

    def blur(self, raster: Float, sigma: float) -> Float:
        """The raster under a Gaussian of ``sigma`` cells; weights sum to one."""
        kernel = gaussian(sigma)
        width = len(kernel) // 2
        wide = self.halo(raster, width)
        rows = sum(k * wide[:, i : i + SIDE] for i, k in enumerate(kernel))
        return np.asarray(
            sum(k * rows[:, :, i : i + SIDE] for i, k in enumerate(kernel)), np.float32
        )

    def value(self, raster: Float, xy: Array) -> Array:
        """(n,) the raster at points (n, 2), bilinear between centres; 0 where no block is."""
        flat = np.append(raster.ravel(), np.float32(0))
        out = np.zeros(len(xy))
        for place, share in self._corners(xy):
            out += share * flat[place]
        return out

    def _corners(self, xy: Array) -> Iterator[tuple[Int, Array]]:
        """The four cells around points (n, 2), with the share that each has in them."""
        at = xy / self.cell - 0.5
        low = np.floor(at).astype(np.int64)
        part = at - low
        left, below = 1.0 - part[:, 0], 1.0 - part[:, 1]
        flat = self.places(low)
        # Nearly all have their four cells in one block.
        last = low & _LOW == _LOW
        edge = np.flatnonzero(last[:, 0] | last[:, 1] | (flat < 0))
        for dx in (0, 1):
            for dy in (0, 1):
                place = flat + (dx + dy * SIDE)
                place[edge] = self.places(low[edge] + np.array([dx, dy]))
                x, y = (part[:, 0] if dx else left), (part[:, 1] if dy else below)
                yield place, x * y

    def add(self, total: Float, part: Float, layout: Layout) -> None:
        """Add a raster of another ``layout``, whose blocks are all here, to ``total``."""
        total[find(self.keys, layout.keys)] += part


def gaussian(sigma: float) -> Float:
    """(2k + 1,) Gaussian weights out to three sigmas (cells), their sum one."""
    k = np.arange(-int(np.ceil(3 * sigma)), int(np.ceil(3 * sigma)) + 1)
    out = np.exp(-0.5 * (k / sigma) ** 2)
    return np.asarray(out / out.sum(), np.float32)


def points_along(lines: Array, step: float) -> tuple[Int, Array, Array]:
    """Points about ``step`` apart along polylines (n, v, 2): of each the number of its line (k,),
    place (k, 2) and the length (k,) of line that it stands for."""
    way = np.diff(lines, axis=1)
    size = np.hypot(way[..., 0], way[..., 1]).ravel()
    repeat = np.maximum(np.ceil(size / step), 1).astype(np.int64)
    repeat[size <= 0] = 0
    segment = np.repeat(np.arange(len(size)), repeat)
    first = np.cumsum(repeat) - repeat
    share = (np.arange(len(segment)) - first[segment] + 0.5) / repeat[segment]
    start = lines[:, :-1].reshape(-1, 2)[segment]
    xy = start + share[:, None] * way.reshape(-1, 2)[segment]
    return segment // max(way.shape[1], 1), xy, size[segment] / repeat[segment]


def cells_inside(rings: Array, cell: float) -> tuple[Int, Int]:
    """The cells whose centres lie inside rings (n, v, 2), by the even-odd rule: the ring (k,) and
    the integer cell (k, 2) of each. All rings at once: where edges cross the rows of centres, the
    crossings of a row are sorted and the cells between every two of them filled."""
    closed = np.concatenate([rings, rings[:, :1]], axis=1) / cell - 0.5
    a, b = closed[:, :-1].reshape(-1, 2), closed[:, 1:].reshape(-1, 2)
    owner = np.repeat(np.arange(len(rings)), closed.shape[1] - 1)
    low, high = np.minimum(a[:, 1], b[:, 1]), np.maximum(a[:, 1], b[:, 1])
    first, stop = np.ceil(low).astype(np.int64), np.ceil(high).astype(np.int64)
    count = np.maximum(stop - first, 0)
    edge = np.repeat(np.arange(len(a)), count)
    row = first[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    x = a[edge, 0] + (row - a[edge, 1]) / (b[edge, 1] - a[edge, 1]) * (b[edge, 0] - a[edge, 0])
    order = np.lexsort((x, row, owner[edge]))
    x, row, ring = x[order], row[order], owner[edge][order]
    # A row crosses a closed ring an even number of times.
    left, right = np.ceil(x[::2]).astype(np.int64), np.ceil(x[1::2]).astype(np.int64)
    size = np.maximum(right - left, 0)
    span = np.repeat(np.arange(len(left)), size)
    column = left[span] + np.arange(len(span)) - np.repeat(np.cumsum(size) - size, size)
    return ring[::2][span], np.stack([column, row[::2][span]], axis=-1)
