"""What drives saw as points with directions, and density fields of them on a grid.

A field of a class has three channels, Σ w (1, cos 2θ, sin 2θ) with θ the direction of the line, so
that f₀ + f₁ cos 2φ + f₂ sin 2φ = Σ 2 w cos²(θ - φ) counts lines along φ and none across it. The
map is passed in square blocks with a margin: memory is bounded by a block.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.keys import packed
from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.stations import samples_of

Array = NDArray[np.float64]
Int = NDArray[np.int64]

SIDE = 64.0
"""Side of a block, metres."""
MIN_SCORE = 0.1
"""Detections of a lower score do not speak for where a drive was."""


@dataclass(frozen=True)
class Cloud:
    """Points along detections: ``drive``, ``frame`` (n,) numbered over all drives, ``kind`` of
    their class, ``local`` (n, 2) in the ego frame, ``angle`` (n,) of the line in the ego frame,
    ``weight`` (n,) and ``variance`` (n,) across the line (m²)."""

    drive: Int
    frame: Int
    kind: Int
    local: Array
    angle: Array
    weight: Array
    variance: Array

    def __len__(self) -> int:
        return len(self.drive)

    def at(self, pose: Array) -> tuple[Array, Array]:
        """Map points (n, 2) and angles (n,) when the frames have ``pose`` (F, 3)."""
        p = pose[self.frame]
        c, s = np.cos(p[:, 2]), np.sin(p[:, 2])
        x, y = self.local.T
        xy = np.stack([p[:, 0] + c * x - s * y, p[:, 1] + s * x + c * y], axis=-1)
        return xy, self.angle + p[:, 2]


def cloud_of(traversals: Sequence[Traversal], first: Int) -> Cloud:
    """The detections of all drives; ``first`` (drives + 1,) frame of each drive.

    A vertex weighs by the length it stands for, its score, how sharp it is, and the travel of its
    frame: a vehicle that waits says no more than one that passes.
    """
    names = sorted({str(c) for t in traversals for c in np.unique(t.class_name)})
    parts: list[tuple[Array, ...]] = []
    for k, t in enumerate(traversals):
        index = np.flatnonzero(t.score >= MIN_SCORE)
        s = samples_of(t.points[index], t.covariance[index], t.score[index], t.frame[index])
        p = t.pose[s.frame]
        variance = np.maximum(s.across_sigma**2, 0.01)
        step = np.hypot(*np.diff(t.pose[:, :2], axis=0, append=t.pose[-1:, :2]).T)
        each = 2 * t.points.shape[1] - 1
        kind = np.repeat(np.searchsorted(names, t.class_name[index].astype(str)), each)
        c, n, d = np.cos(p[:, 2]), np.sin(p[:, 2]), s.xy - p[:, :2]
        local = np.stack([c * d[:, 0] + n * d[:, 1], c * d[:, 1] - n * d[:, 0]], axis=-1)
        angle = np.arctan2(s.tangent[:, 1], s.tangent[:, 0]) - p[:, 2]
        travel = np.clip(step, 0.05, 5.0)[s.frame]
        weight = s.spacing * s.score * travel / np.sqrt(variance)
        # Vertices alone: the points between them say nothing of their own.
        keep = (weight > 0) & (np.arange(len(s)) % each % 2 == 0)
        own = (np.full(len(s), k), s.frame + first[k], kind, local, angle, weight, variance)
        parts.append(tuple(a[keep] for a in own))
    return Cloud(*(np.concatenate(a) for a in zip(*parts, strict=True)))


def blocks_of(xy: Array, margin: float) -> Iterator[tuple[Array, Int, Int]]:
    """Yield the low corner of each block, the points in it and those within ``margin`` (m) of it,
    its own included (indices into ``xy``)."""
    key = np.floor(xy / SIDE).astype(np.int64)
    _, first, inverse = np.unique(packed(*key.T), return_index=True, return_inverse=True)
    values = key[first]
    order = np.argsort(inverse, kind="stable")
    ends = np.cumsum(np.bincount(inverse, minlength=len(values)))
    rows = {tuple(v): order[e - n : e] for v, e, n in _spans(values, ends)}
    for (i, j), own in rows.items():
        near = [rows[k] for a in (-1, 0, 1) for b in (-1, 0, 1) if (k := (i + a, j + b)) in rows]
        around = np.concatenate(near)
        low = np.array([i, j]) * SIDE
        x, y = xy[around, 0] - low[0], xy[around, 1] - low[1]
        far = SIDE + margin
        inside = (x >= -margin) & (x < far) & (y >= -margin) & (y < far)
        yield low, own, around[inside]


def _spans(values: Int, ends: Int) -> Iterator[tuple[tuple[int, int], int, int]]:
    starts = np.concatenate([[0], ends[:-1]])
    for v, a, b in zip(values.tolist(), starts.tolist(), ends.tolist(), strict=True):
        yield (v[0], v[1]), b, b - a


@dataclass(frozen=True)
class Grid:
    """A block's grid: ``low`` corner with the margin (m), ``cell`` (m), ``size`` cells a side."""

    low: Array
    cell: float
    size: int

    def cells(self, xy: Array) -> Int:
        """(n, 2) row and column of points."""
        at = np.floor((xy - self.low) / self.cell).astype(np.int64)
        return np.clip(at[:, ::-1], 0, self.size - 1)

    def field(self, cells: Int, kind: Int, angle: Array, weight: Array, kinds: int) -> Array:
        """(kinds, 3, size, size) sums of the channels, not blurred."""
        plane = self.size * self.size
        flat = kind * plane + cells[:, 0] * self.size + cells[:, 1]
        out = np.empty((kinds, 3, plane))
        for c, along in enumerate((np.ones_like(angle), np.cos(2 * angle), np.sin(2 * angle))):
            out[:, c] = np.bincount(flat, weight * along, kinds * plane).reshape(kinds, plane)
        return out.reshape(kinds, 3, self.size, self.size)


def blurred(field: Array, sigma: float) -> Array:
    """Gaussian blur of the last two axes, ``sigma`` in cells."""
    from scipy.ndimage import gaussian_filter

    out: Array = gaussian_filter(field, (0,) * (field.ndim - 2) + (sigma, sigma), mode="constant")
    return out
