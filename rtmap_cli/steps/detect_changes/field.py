"""The density field of what the prior does not explain: where many drives saw a line.

Per drive Σ score · N(distance across the line; σ) over its detections, divided by the number of
frames that could see the cell; then the mean over the drives that looked: one vote per drive.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.visibility import views

Array = NDArray[np.float64]
Int = NDArray[np.int64]

CELL = 0.2
"""Size of a cell, metres."""
BLOCK = 640
"""Cells of a block's side: memory is bounded by a block, not by the map."""
MARGIN = 24
"""Cells around a block that are computed but not used, wider than any kernel."""
COARSE = 10
"""Cells per side of a square whose views are counted once."""


@dataclass(frozen=True)
class Marks:
    """Line samples of one drive: ``xy`` (n, 2), unit ``tangent`` (n, 2), ``spacing`` (n,) metres of
    line that each stands for, ``sigma`` (n,) across the line (m), ``score`` (n,)."""

    xy: Array
    tangent: Array
    spacing: Array
    sigma: Array
    score: Array

    def select(self, index: Any) -> Marks:
        """Some of the samples."""
        return Marks(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


BELL = np.linspace(-2.4, 2.4, 17)
"""Where the bell across a line is laid down, in sigmas."""
WIDEST = 1.2
"""Larger sigmas (m) are taken as that: wider bells say nothing and cost most."""
PAD = 34
"""Cells around a field that bells of samples in it, or just beside it, may reach."""
PART = 8192
"""Samples that are laid down together: what they need stays in the processor's cache."""


def deposits(marks: Marks, start: Int, width: int, height: int) -> Array:
    """Line samples, each N(0, sigma²) across its line, summed by cell: (rows y, columns x).

    Samples farther apart than a cell are repeated along their tangents.
    """
    spacing, tangent = marks.spacing, marks.tangent / CELL
    repeat = np.maximum(np.ceil(spacing / CELL), 1).astype(np.int64)
    row = np.repeat(np.arange(len(spacing)), repeat)
    k = np.arange(len(row)) - np.repeat(np.cumsum(repeat) - repeat, repeat)
    shift = ((k + 0.5) / repeat[row] - 0.5) * spacing[row]
    x = marks.xy[row, 0] / CELL + shift * tangent[row, 0] - start[0]
    y = marks.xy[row, 1] / CELL + shift * tangent[row, 1] - start[1]
    side = PAD / 2
    near = (x > -side) & (y > -side) & (x < width + side) & (y < height + side)
    row, x, y = row[near], x[near] + PAD, y[near] + PAD
    sigma = np.clip(marks.sigma, CELL, WIDEST)
    # Single precision places a sample to a thousandth of a cell, in half the memory.
    x, y = x.astype(np.float32), y.astype(np.float32)
    ax = (-sigma * tangent[:, 1])[row].astype(np.float32)
    ay = (sigma * tangent[:, 0])[row].astype(np.float32)
    bell = np.exp(-0.5 * BELL**2)
    share = (marks.score * spacing / repeat)[row]
    columns, rows = width + 2 * PAD, height + 2 * PAD
    index, mass = np.empty((len(BELL), len(row)), np.int64), np.empty((len(BELL), len(row)))
    for first in range(0, len(row), PART):
        z = slice(first, first + PART)
        for j, u in enumerate(BELL.astype(np.float32)):
            # What is not negative is cut off as floor does.
            cx, cy = (x[z] + u * ax[z]).astype(np.int32), (y[z] + u * ay[z]).astype(np.int32)
            index[j, z] = cy * np.int32(columns) + cx
            np.multiply(share[z], bell[j] / bell.sum() / CELL**2, out=mass[j, z])
    out = np.bincount(index.ravel(), mass.ravel(), rows * columns).astype(np.float64, copy=False)
    return out.reshape(rows, columns)[PAD : PAD + height, PAD : PAD + width]


def _coarse_views(coarse: Int, traversal: Traversal) -> Array:
    """(n,) frames of a drive that could see the middles of coarse squares (n, 2)."""
    middle = np.asarray((coarse + 0.5) * COARSE * CELL, np.float64)
    seen = views(middle, traversal.pose, traversal.range_m, traversal.occluders, margin=1.0)
    return np.bincount(seen.point, minlength=len(coarse)).astype(np.float64)


def blocks(
    drives: Sequence[Marks], traversals: Sequence[Traversal]
) -> Iterator[tuple[Int, Int, Array]]:
    """Yield block, first cell and field of every block near samples; the field has a margin.

    The field is in hits per view and metre: a line that every frame sees with score 1 and
    negligible σ would be infinitely high, with σ it is 1 / (√(2π) σ).
    """
    side, room = BLOCK * CELL, MARGIN * CELL
    where = np.concatenate([d.xy for d in drives]) if drives else np.zeros((0, 2))
    used = np.unique(np.floor(where / side).astype(np.int64) @ np.array([1 << 32, 1]))
    for key in used:
        # The low half of the key is signed.
        y = int((key + (1 << 31)) % (1 << 32)) - (1 << 31)
        block = np.array([(int(key) - y) >> 32, y])
        low, high = block * side - room, (block + 1) * side + room
        near = [d.select(((d.xy >= low) & (d.xy < high)).all(axis=1)) for d in drives]
        places = np.concatenate([d.xy for d in near])
        # Only the part of the block that holds anything, with room for the kernels.
        first = np.maximum(places.min(axis=0) - room, low)
        last = np.minimum(places.max(axis=0) + room, high)
        start = np.floor(first / CELL).astype(np.int64)
        shape = np.ceil(last / CELL).astype(np.int64) - start
        yield block, start, _mean_field(near, traversals, start, shape)


def _mean_field(
    drives: list[Marks], traversals: Sequence[Traversal], start: Int, shape: Int
) -> Array:
    """Mean over the drives of deposits per view, (rows y, columns x)."""
    width, height = int(shape[0]), int(shape[1])
    fields = [
        deposits(marks, start, width, height) if len(marks.score) else None for marks in drives
    ]
    coarse_shape = (height // COARSE + 2, width // COARSE + 2)
    base = start // COARSE
    # The squares of the grid need not start with the field: what is left over is cut.
    cut = start - base * COARSE
    # Views matter where anything was found only.
    some = np.zeros((coarse_shape[0] * COARSE, coarse_shape[1] * COARSE), bool)
    inner = some[cut[1] : cut[1] + height, cut[0] : cut[0] + width]
    for field in fields:
        if field is not None:
            inner |= field > 0
    used = np.argwhere(some.reshape(coarse_shape[0], COARSE, coarse_shape[1], COARSE).any((1, 3)))
    total = np.zeros((height, width))
    weight = np.zeros(coarse_shape)
    for field, traversal in zip(fields, traversals, strict=True):
        looked = np.zeros(coarse_shape)
        looked[used[:, 0], used[:, 1]] = _coarse_views(used[:, ::-1] + base, traversal)
        trust = np.clip((looked - 1) / 3, 0, 1)
        weight += trust
        if field is not None:
            total += field * _fine(trust / np.maximum(looked, 2.0), cut, height, width)
    return total / np.maximum(_fine(weight, cut, height, width), 0.5)


def _fine(coarse: Array, cut: Int, height: int, width: int) -> Array:
    """A coarse grid repeated to cells, without the ``cut`` cells before the field."""
    fine = np.repeat(np.repeat(coarse, COARSE, axis=0), COARSE, axis=1)
    return fine[cut[1] : cut[1] + height, cut[0] : cut[0] + width]
