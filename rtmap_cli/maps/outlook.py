"""What the frames of a drive could see, worked out once: for the field and for all votes.

Occluders leave in each frame a depth by bearing, beyond which nothing is seen. Places are judged by
the middle of their cell of a fixed grid, so that all questions about a drive (how often was a place
in view, by which frames, does this detection count) have one answer that fits together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.maps.sight import SightModel

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

CELL = 2.0
"""Side (m) of the cells in which views are counted."""
BINS = 720
"""Bearings at which the depth is known, about half a degree apart."""
TOGETHER = 64
"""Frames that are worked out together: what they need stays in the processor's cache."""
FINE = 4
"""Steps per metre of the tables of a sight model."""


def _bins(x: Any, y: Any) -> NDArray[np.int32]:
    """The bin of each bearing, counted from straight back, counter-clockwise: by y / (|x| + |y|),
    which grows with the angle as well as the arc tangent does, for a tenth of its cost."""
    part = y / np.maximum(np.abs(x) + np.abs(y), np.float32(1e-9))
    turn = np.where(x >= 0, part, np.where(y >= 0, 2 - part, -2 - part)) + 2
    # Straight back is 0 and 4 at once.
    return np.minimum((turn * (BINS / 4)).astype(np.int32), BINS - 1)


def _bin_rays() -> tuple[Array, Array]:
    """Unit vectors (2, BINS) of the middles of the bins."""
    turn = (np.arange(BINS) + 0.5) * 4 / BINS - 2
    x = 1 - np.abs(turn)
    y = np.where(np.abs(turn) <= 1, turn, np.sign(turn) * (2 - np.abs(turn)))
    size = np.hypot(x, y)
    return x / size, y / size


def depths(boxes: Sequence[Array], reach: float) -> Single:
    """(m, BINS) distance (m) of the nearest box by bearing in each frame, inf where none is.

    ``boxes`` per frame (k, 5: x, y, yaw, length, width) in the ego frame. A box around the origin
    (the vehicle itself), or beyond ``reach`` (m), hides nothing.
    """
    out = np.full((len(boxes), BINS), np.inf, np.float32)
    frame = np.repeat(np.arange(len(boxes)), [len(b) for b in boxes])
    if not len(frame):
        return out
    x, y, yaw, length, width = np.concatenate(boxes).T
    far, radius = np.hypot(x, y), np.hypot(length, width) / 2 + 1e-6
    c, s = np.cos(yaw), np.sin(yaw)
    one, two = -(c * x + s * y), s * x - c * y
    around = (np.abs(one) <= length / 2) & (np.abs(two) <= width / 2)
    near = np.flatnonzero((far - radius < reach) & ~around)
    # The bins that a circle around the box fills, all of them for one that reaches the vehicle.
    half = np.where(far > radius, np.arcsin(np.minimum(radius / np.maximum(far, 1e-9), 1.0)), np.pi)
    bearing = np.arctan2(y, x)
    first, last = (
        _bins(np.cos(a), np.sin(a)).astype(np.int64)[near] for a in (bearing - half, bearing + half)
    )
    count = np.where(half[near] >= np.pi / 2, BINS, (last - first) % BINS + 1)
    k = np.repeat(near, count)
    step = np.arange(len(k)) - np.repeat(np.cumsum(count) - count, count)
    bin_ = (np.repeat(first, count) + step) % BINS
    ray_x, ray_y = _bin_rays()
    rx, ry = ray_x[bin_], ray_y[bin_]
    enter, leave = np.zeros(len(k)), np.full(len(k), np.inf)
    for origin, along, size in (
        (one[k], c[k] * rx + s[k] * ry, length[k] / 2),
        (two[k], c[k] * ry - s[k] * rx, width[k] / 2),
    ):
        along = np.where(np.abs(along) < 1e-12, 1e-12, along)
        a, b = (-size - origin) / along, (size - origin) / along
        enter, leave = np.maximum(enter, np.minimum(a, b)), np.minimum(leave, np.maximum(a, b))
    meets = enter <= leave
    np.minimum.at(out, (frame[k[meets]], bin_[meets]), enter[meets].astype(np.float32))
    return out


@dataclass(frozen=True)
class Outlook:
    """Pairs of a frame and a cell of the grid that it could see, in order of the frames: ``frame``,
    ``cell`` (row · columns + column of the drive's grid), ``distance`` and ``border`` (m): from the
    vehicle, and to the border of its range. ``low`` (2,) is the number of the grid's first cell,
    ``shape`` its rows (y) and columns (x)."""

    pose: Array
    range_m: tuple[float, float, float, float]
    depth: Single
    low: Int
    shape: tuple[int, int]
    frame: NDArray[np.int32]
    cell: NDArray[np.int32]
    distance: Single
    border: Single
    sums: dict[Any, Array] = field(default_factory=dict, repr=False, compare=False)

    def cells(self, xy: Array) -> Int:
        """(n,) the drive's cell of places (n, 2), -1 outside its grid."""
        column, row = (np.floor(xy / CELL).astype(np.int64) - self.low).T
        inside = (column >= 0) & (row >= 0) & (row < self.shape[0]) & (column < self.shape[1])
        return np.where(inside, row * self.shape[1] + column, -1)

    def _middles(self, cell: Int) -> Array:
        row, column = np.divmod(cell, self.shape[1])
        return np.asarray((np.stack([column, row], axis=-1) + self.low + 0.5) * CELL, np.float64)

    def sees(self, frame: Int, cell: Int, margin: float) -> Mask:
        """(n,) whether a frame could see a cell, ``margin`` (m) of its range left out."""
        return (cell >= 0) & (self.clear(frame, self._middles(cell), margin) >= 0)

    def sees_in_turn(self, frame: Int, cell: Int, margin: float) -> Mask:
        """``sees`` for places in a row, which often lie in the cell of the one before."""
        new = np.ones(len(cell), bool)
        new[1:] = (cell[1:] != cell[:-1]) | (frame[1:] != frame[:-1])
        first = np.flatnonzero(new)
        seen = self.sees(frame[first], cell[first], margin)
        return np.repeat(seen, np.diff(first, append=len(cell)))

    def clear(self, frame: Int, xy: Array, margin: float) -> Array:
        """(...) distance (m) of places (..., 2) from a ``frame`` (of a shape that broadcasts), -1
        where it could not see them."""
        c, s = np.cos(self.pose[:, 2])[frame], np.sin(self.pose[:, 2])[frame]
        dx, dy = (xy[..., k] - self.pose[:, k][frame] for k in (0, 1))
        x, y = c * dx + s * dy, c * dy - s * dx
        x0, y0, x1, y1 = self.range_m
        inside = (x >= x0 + margin) & (x <= x1 - margin) & (y >= y0 + margin) & (y <= y1 - margin)
        distance = np.sqrt(x * x + y * y)
        seen = inside & (distance < self.depth[frame, _bins(x, y)])
        return np.where(seen, distance, -1.0)

    def counted(self, margin: float, sight: SightModel | None = None) -> Array:
        """(cells + 1,) frames that could see each cell, or their summed detection probabilities by
        distance and border; 0 last, for places outside the grid."""
        if (margin, sight) not in self.sums:
            self.sums[margin, sight] = self._counted(margin, sight)
        return self.sums[margin, sight]

    def _counted(self, margin: float, sight: SightModel | None) -> Array:
        inside = self.border >= margin
        weight = None
        if sight is not None:
            at = (np.arange(200 * FINE) + 0.5) / FINE
            by_distance, by_border = (sight.curve(name, at) for name in ("distance", "to_border"))
            weight = by_distance[(self.distance[inside] * FINE).astype(np.int32)]
            weight = weight * by_border[(self.border[inside] * FINE).astype(np.int32)]
        size = self.shape[0] * self.shape[1] + 1
        return np.bincount(self.cell[inside], weight, size).astype(np.float64)

    @cached_property
    def _by_cell(self) -> Any:
        """Sparse (cells, frames), by rows: the distances to the border."""
        from scipy.sparse import coo_matrix

        shape = (self.shape[0] * self.shape[1], len(self.pose))
        return coo_matrix((self.border, (self.cell, self.frame)), shape=shape).tocsr()

    def frames(self, cell: Int, margin: float) -> Int:
        """The frames that could see places in the cells, once for each place."""
        table, rows = self._by_cell, cell[cell >= 0]
        first = table.indptr[rows].astype(np.int64)
        count = table.indptr[rows + 1] - first
        at = np.repeat(first - (np.cumsum(count) - count), count) + np.arange(count.sum())
        out: Int = table.indices[at[table.data[at] >= margin]].astype(np.int64)
        return out


def outlook(
    pose: Array, range_m: tuple[float, float, float, float], occluders: Sequence[Array]
) -> Outlook:
    """The outlook of a drive: ``pose`` (m, 3) x, y, yaw of map_SE3_ego, the ego-frame box
    ``range_m`` and ``occluders`` per frame (k, 5) as ``depths`` takes them."""
    x0, y0, x1, y1 = range_m
    middle, reach = np.array([x0 + x1, y0 + y1]) / 2, float(np.hypot(x1 - x0, y1 - y0) / 2)
    farthest = float(np.hypot(max(abs(x0), abs(x1)), max(abs(y0), abs(y1))))
    depth = depths(occluders, farthest)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    turned = np.stack([c * middle[0] - s * middle[1], s * middle[0] + c * middle[1]], axis=-1)
    home = np.floor((pose[:, :2] + turned) / CELL).astype(np.int64)
    side = int(np.ceil(reach / CELL)) + 1
    grid = np.mgrid[-side : side + 1, -side : side + 1].reshape(2, -1)
    around = grid[:, np.hypot(*grid) * CELL <= reach + CELL]
    low = home.min(axis=0) - side
    rows, columns = (home.max(axis=0) + side + 1 - low)[::-1].tolist()
    first = ((home - low) @ np.array([1, columns])).astype(np.int32)
    offset = (around.T @ np.array([1, columns])).astype(np.int32)
    ax, ay = (around * CELL).astype(np.float32)
    # From the vehicle to the middle of its home cell: small numbers, for which single is enough.
    bx, by = ((home + 0.5) * CELL - pose[:, :2]).astype(np.float32).T[..., None]
    c, s = c.astype(np.float32)[:, None], s.astype(np.float32)[:, None]
    parts = []
    for k in range(0, len(pose), TOGETHER):
        z = slice(k, k + TOGETHER)
        dx, dy = ax + bx[z], ay + by[z]
        x, y = c[z] * dx + s[z] * dy, c[z] * dy - s[z] * dx
        border = np.minimum(np.minimum(x - x0, x1 - x), np.minimum(y - y0, y1 - y))
        i, j = np.nonzero(border >= 0)
        x, y = x[i, j], y[i, j]
        distance = np.sqrt(x * x + y * y)
        clear = distance < depth[i + k, _bins(x, y)]
        i, j = i[clear], j[clear]
        parts.append((i + k, first[i + k] + offset[j], distance[clear], border[i, j]))
    frame, cell, distance, border = (
        np.concatenate([p[n] for p in parts]) if parts else np.zeros(0) for n in range(4)
    )
    return Outlook(
        pose,
        range_m,
        depth,
        low,
        (rows, columns),
        frame.astype(np.int32),
        cell.astype(np.int32),
        distance.astype(np.float32),
        border.astype(np.float32),
    )
