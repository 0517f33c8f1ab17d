"""The density field of what the prior does not explain: where many drives saw a line.

Per drive Σ score · N(distance across the line; σ) over its detections, divided by the number of
frames that could see the cell; then the mean over the drives that looked: one vote per drive.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.outlook import CELL as VIEW_CELL

Array = NDArray[np.float64]
Int = NDArray[np.int64]

CELL = 0.2
"""Size of a cell, metres."""
BLOCK = 640
"""Cells of a block's side: memory is bounded by a block, not by the map."""
MARGIN = 24
"""Cells around a block that are computed but not used, wider than any kernel."""
VIEW_MARGIN = 1.0
"""Border (m) of the range that does not count as looked at."""


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
"""Where the bell across a line is laid down, in sigmas: with steps below a sigma its sum is that
of the bell to a millionth."""
APART = 1
"""Samples are laid down about so many cells apart along their lines."""
WIDEST = 1.2
"""Larger sigmas (m) are taken as that: wider bells say nothing and cost most."""
PAD = 34
"""Cells around a field that bells of samples in it, or just beside it, may reach."""
PART = 4096
"""Samples that are laid down together: what they need stays in the processor's cache."""


def deposits(marks: Marks, start: Int, width: int, height: int) -> Array:
    """Line samples, each N(0, sigma²) across its line, summed by cell: (rows y, columns x).

    Samples farther apart than `APART` cells are repeated along their tangents.
    """
    spacing, tangent = marks.spacing, marks.tangent / CELL
    repeat = np.maximum(np.ceil(spacing / (APART * CELL)), 1).astype(np.int64)
    row = np.repeat(np.arange(len(spacing)), repeat)
    k = np.arange(len(row)) - np.repeat(np.cumsum(repeat) - repeat, repeat)
    shift = ((k + 0.5) / repeat[row] - 0.5) * spacing[row]
    x = marks.xy[row, 0] / CELL + shift * tangent[row, 0] - start[0]
    y = marks.xy[row, 1] / CELL + shift * tangent[row, 1] - start[1]
    side = PAD / 2
    near = (x > -side) & (y > -side) & (x < width + side) & (y < height + side)
    row = row[near]
    # Single precision places a sample to a thousandth of a cell, in half the memory.
    x, y = (x[near] + PAD).astype(np.float32), (y[near] + PAD).astype(np.float32)
    sigma = np.clip(marks.sigma, CELL, WIDEST)
    ax = (-sigma * tangent[:, 1]).astype(np.float32)[row]
    ay = (sigma * tangent[:, 0]).astype(np.float32)[row]
    share = (marks.score * spacing / repeat)[row]
    bell = np.exp(-0.5 * BELL**2)
    bell /= bell.sum() * CELL**2
    u = BELL.astype(np.float32)[:, None]
    columns, rows = width + 2 * PAD, height + 2 * PAD
    out = np.zeros(rows * columns)
    for first in range(0, len(row), PART):
        z = slice(first, first + PART)
        # What is not negative is cut off as floor does.
        cx, cy = (x[z] + u * ax[z]).astype(np.int32), (y[z] + u * ay[z]).astype(np.int32)
        index = (cy * np.int32(columns) + cx).astype(np.intp)
        np.add.at(out, index.ravel(), (bell[:, None] * share[z]).ravel())
    return out.reshape(rows, columns)[PAD : PAD + height, PAD : PAD + width]


def blocks(
    drives: Sequence[Marks], traversals: Sequence[Traversal]
) -> Iterator[tuple[Int, Int, Array]]:
    """Yield block, first cell and field of every block near samples; the field has a margin.

    The field is in hits per view and metre: a line that every frame sees with score 1 and
    negligible σ would be infinitely high, with σ it is 1 / (√(2π) σ).
    """
    side, room = BLOCK * CELL, MARGIN * CELL
    looked = [t.outlook.counted(VIEW_MARGIN) for t in traversals]
    marks = _per_view(drives, traversals, looked)
    if not len(marks.score):
        return
    px, py = np.ascontiguousarray(marks.xy.T)
    used = np.unique((np.floor(px / side).astype(np.int64) << 32) + np.floor(py / side).astype(int))
    for packed in used.tolist():
        # The low half of the key is signed.
        x = (packed + (1 << 31)) >> 32
        block = np.array([x, packed - (x << 32)])
        low = block * side - room
        high = low + side + 2 * room
        inside = (px >= low[0]) & (px < high[0]) & (py >= low[1]) & (py < high[1])
        near = marks.select(np.flatnonzero(inside))
        # Only the part of the block that holds anything, with room for the kernels.
        first = np.maximum(near.xy.min(axis=0) - room, low)
        last = np.minimum(near.xy.max(axis=0) + room, high)
        start = np.floor(first / CELL).astype(np.int64)
        width, height = (np.ceil(last / CELL).astype(np.int64) - start).tolist()
        field = deposits(near, start, width, height)
        yield block, start, field / _looks_at(traversals, looked, start, width, height)


def _trust(looked: Array) -> Array:
    """How much of a vote a drive has at cells that so many of its frames could see."""
    return np.clip((looked - 1) / 3, 0, 1)


def _per_view(
    drives: Sequence[Marks], traversals: Sequence[Traversal], looked: Sequence[Array]
) -> Marks:
    """The marks of all drives, their scores divided by the frames that could see them: what they
    sum up to is the mean over the frames of one drive, times its vote."""
    parts = []
    for marks, traversal, number in zip(drives, traversals, looked, strict=True):
        frames = number[traversal.outlook.cells(marks.xy)]
        score = marks.score * _trust(frames) / np.maximum(frames, 2.0)
        parts.append(replace(marks, score=score))
    names = Marks.__dataclass_fields__
    return Marks(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def _looks_at(
    traversals: Sequence[Traversal], looked: Sequence[Array], start: Int, width: int, height: int
) -> Array:
    """(rows y, columns x) votes of all drives at the cells of a field, at least half a one."""
    column, row = ((start[k] + np.arange(n) + 0.5) * CELL for k, n in ((0, width), (1, height)))
    # The cells of views are larger than those of the field: each is asked about once.
    x, x_of = np.unique(np.floor(column / VIEW_CELL), return_inverse=True)
    y, y_of = np.unique(np.floor(row / VIEW_CELL), return_inverse=True)
    places = (np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) + 0.5) * VIEW_CELL
    total = np.zeros(len(places))
    for traversal, number in zip(traversals, looked, strict=True):
        total += _trust(number[traversal.outlook.cells(places)])
    out: Array = np.maximum(total, 0.5).reshape(len(y), len(x))[y_of][:, x_of]
    return out
