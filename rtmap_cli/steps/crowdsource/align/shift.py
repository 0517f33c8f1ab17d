"""The coarse part: by how much stretches of each drive are shifted against all the others.

Every stretch of a drive (some 60 m) is compared with the field of the other drives at all shifts on
a grid; along the drive the best sequence of shifts is found by dynamic programming, with GNSS as
the prior and slow changes from stretch to stretch.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.keys import packed
from rtmap_cli.steps.crowdsource.align.cloud import SIDE, Cloud, Grid, blocks_of, blurred

Array = NDArray[np.float64]
Int = NDArray[np.int64]

CELL = 0.4
LAGS = 8
"""Shifts are tried up to LAGS cells each way: 3.2 m, four sigmas of a usual GNSS bias."""
STRETCH = 60.0
"""Travel (m) that shares one shift."""
GAIN = 30.0
"""Log-likelihood that a stretch loses when nothing of it meets the others."""
CHANGE = 0.5
"""Sigma (m) of the change of the shift from one stretch to the next."""


def stretches_of(pose: Array, first: Int) -> Int:
    """(F,) number of the stretch of every frame, over all drives."""
    out = np.zeros(len(pose), np.int64)
    count = 0
    for a, b in pairwise(first.tolist()):
        step = np.hypot(*np.diff(pose[a:b, :2], axis=0).T)
        travel = np.concatenate([[0.0], np.cumsum(step)])
        parts = max(1, round(float(travel[-1]) / STRETCH))
        own = np.minimum((travel / max(travel[-1], 1e-9) * parts).astype(np.int64), parts - 1)
        out[a:b] = own + count
        count += parts
    return out


def surfaces(cloud: Cloud, pose: Array, stretch: Int, blur: float) -> Array:
    """(stretches, 2 LAGS + 1, 2 LAGS + 1) agreement with the other drives by shift in y and x."""
    xy, angle = cloud.at(pose)
    kinds = int(cloud.kind.max()) + 1
    margin = (LAGS + 1) * CELL + 3 * blur
    size = int(np.ceil((SIDE + 2 * margin) / CELL)) + 1
    lags = np.arange(-LAGS, LAGS + 1)
    out = np.zeros((int(stretch.max()) + 1, len(lags), len(lags)))
    for low, own, around in blocks_of(xy, margin):
        grid = Grid(low - margin, CELL, size)
        cells = grid.cells(xy[around])
        drive = cloud.drive[around]
        fields = {
            int(d): grid.field(
                cells[drive == d],
                cloud.kind[around][drive == d],
                angle[around][drive == d],
                cloud.weight[around][drive == d],
                kinds,
            )
            for d in np.unique(drive)
        }
        if len(fields) < 2:
            continue
        total = sum(fields.values(), np.zeros((kinds, 3, size, size)))
        for d, field in fields.items():
            index = own[cloud.drive[own] == d]
            if not len(index):
                continue
            others = blurred(total - field, blur / CELL)
            place = grid.cells(xy[index]), cloud.kind[index]
            _add_agreement(
                out, others, place, stretch[cloud.frame[index]], angle[index], cloud.weight[index]
            )
    return out


def _add_agreement(
    out: Array, field: Array, place: tuple[Int, Int], stretch: Int, angle: Array, weight: Array
) -> None:
    """Add to ``out`` (stretches, lags, lags) how much of ``field`` lies along points at all lags.

    ``place``: cell (n, 2) and kind (n,) of each point. What a stretch has in a cell is summed up
    first: frames one after the other see the same.
    """
    (cell, kind), size = place, field.shape[-1]
    name = packed(stretch, kind, cell[:, 0], cell[:, 1])
    _, first, owner = np.unique(name, return_index=True, return_inverse=True)
    windows = np.lib.stride_tricks.sliding_window_view(field, (2 * LAGS + 1,) * 2, axis=(2, 3))
    row, column = (np.clip(cell[first, k] - LAGS, 0, size - 2 * LAGS - 1) for k in (0, 1))
    which = stretch[first]
    ends = np.flatnonzero(np.append(which[1:] != which[:-1], True)) + 1
    for c, along in enumerate((np.ones_like(angle), np.cos(2 * angle), np.sin(2 * angle))):
        mass = np.bincount(owner, weight * along, len(first))
        for a, b in pairwise([0, *ends.tolist()]):
            part = windows[kind[first[a:b]], c, row[a:b], column[a:b]].reshape(b - a, -1)
            out[which[a]] += (mass[a:b] @ part).reshape(out.shape[1:])


def best_shifts(surface: Array, sigma: Array, before: Array) -> Array:
    """(stretches, 2) shifts in x, y of one drive's stretches in a row.

    ``surface`` (stretches, lags, lags), ``sigma`` (2,) of GNSS, ``before`` (stretches, 2) shifts
    that were applied already. The most probable sequence (Viterbi) under Gaussian changes.
    """
    lags = (np.arange(surface.shape[1]) - LAGS) * CELL
    y, x = (g.ravel() for g in np.meshgrid(lags, lags, indexing="ij"))
    shift = np.stack([x, y], axis=-1)
    score = np.zeros(len(shift))
    back = np.zeros((len(surface), len(shift)), np.int64)
    for k, s in enumerate(surface):
        top = float(s.max())
        fit = GAIN * (s.ravel() / top - 1.0) if top > 0 else np.zeros(len(shift))
        gain = fit - (((shift + before[k]) / sigma) ** 2).sum(-1) / 2
        if k:
            # Changes of the shift itself, with what was applied before.
            jump = before[k] - before[k - 1]
            cost = ((shift[None] + jump - shift[:, None]) ** 2).sum(-1) / (2 * CHANGE**2)
            options = score[:, None] - cost
            back[k] = options.argmax(axis=0)
            score = options[back[k], np.arange(len(shift))] + gain
        else:
            score = gain
    path = [int(score.argmax())]
    for k in range(len(surface) - 1, 0, -1):
        path.append(int(back[k, path[-1]]))
    return shift[path[::-1]]
