"""The fine part: how far each point lies from the line that all drives together see there.

The mean of the field across a point's line, weighted by a bell around the point: a step of mean
shift, whose fixed points are the crests of the field. Then one solve per drive: odometry, GNSS
with its bias, and these offsets, of which all frames of a drive at one place are one vote.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.keys import packed
from rtmap_cli.logs.motion import Motion, motion_terms
from rtmap_cli.steps.crowdsource.align.cloud import SIDE, Cloud, Grid, blocks_of, blurred

Array = NDArray[np.float64]
Int = NDArray[np.int64]

CELL = 0.25
PLACE = 10.0
"""Side (m) of a place: what a drive sees of a class and direction in it is one vote."""
DRIVE_SHARE = 0.55
"""Share of a detection's variance that all frames of a drive have in common at a place."""
FLOOR = 0.05
"""No vote is sharper (m)."""
HUBER = 1.5
PASSES = 2
"""Solves of a drive with the same offsets."""


@dataclass(frozen=True)
class Pull:
    """``offset`` (n,) of the crest to the left of each point's line (m) and its ``weight`` (n,), an
    information (1/m²); 0 where no other drive saw anything."""

    offset: Array
    weight: Array


def pulls(cloud: Cloud, pose: Array, reach: float) -> Pull:
    """Offsets of all points at ``pose`` (F, 3); ``reach`` (m) is the sigma of the bell."""
    xy, angle = cloud.at(pose)
    kinds = int(cloud.kind.max()) + 1
    blur = max(0.4 * reach, CELL)
    margin = 2.5 * reach + 3 * blur
    size = int(np.ceil((SIDE + 2 * margin) / CELL)) + 1
    u = np.linspace(-2.0, 2.0, 13) * reach
    bell = np.exp(-0.5 * (u / reach) ** 2)
    offset, seen = np.zeros(len(cloud)), np.zeros(len(cloud), bool)
    for low, own, around in blocks_of(xy, margin):
        grid = Grid(low - margin, CELL, size)
        field = blurred(
            grid.field(
                grid.cells(xy[around]),
                cloud.kind[around],
                angle[around],
                cloud.weight[around],
                kinds,
            ),
            blur / CELL,
        )
        a = angle[own]
        c2, s2 = np.cos(2 * a), np.sin(2 * a)
        x, y = ((xy[own, k] - grid.low[k]) / CELL for k in (0, 1))
        across, up = -np.sin(a) / CELL, np.cos(a) / CELL
        flat, plane = field.ravel(), size * size
        base = cloud.kind[own] * (3 * plane)
        total, moment = np.zeros(len(own)), np.zeros(len(own))
        for step, share in zip(u, bell, strict=True):
            # The margin is wider than the bell: no step leaves the grid.
            row, column = (y + step * up).astype(np.int64), (x + step * across).astype(np.int64)
            at = base + row * size + column
            f = flat[at] + c2 * flat[at + plane] + s2 * flat[at + 2 * plane]
            f = np.maximum(f, 0.0) * share
            total += f
            moment += step * f
        seen[own] = total > 0
        # The bell pulls the mean towards the point: a crest at d moves it by d / (1 + r) only.
        offset[own] = moment / np.where(total > 0, total, 1.0)
    share = company(cloud, xy)
    return Pull(offset, np.where(seen, share, 0.0) * _votes(cloud, xy, angle))


def company(cloud: Cloud, xy: Array, cell: float = 2.0) -> Array:
    """(n,) share of the other drives in what was seen of a class around each point."""
    place = np.floor(xy / cell).astype(np.int64)
    name = packed(*place.T, cloud.kind)
    _, key = np.unique(name, return_inverse=True)
    _, own = np.unique(packed(name, cloud.drive), return_inverse=True)
    total = np.bincount(key, cloud.weight)[key]
    mine = np.bincount(own, cloud.weight)[own]
    out: Array = 1.0 - mine / total
    return out


def _votes(cloud: Cloud, xy: Array, angle: Array) -> Array:
    """(n,) information (1/m²) of each point: those of a drive at a place are one vote."""
    place = np.floor(xy / PLACE).astype(np.int64)
    turn = np.floor((angle % np.pi) / (np.pi / 4) + 0.5).astype(np.int64) % 4
    _, key = np.unique(packed(cloud.drive, cloud.kind, turn, *place.T), return_inverse=True)
    weight = cloud.weight / cloud.variance
    total = np.bincount(key, weight)
    variance = DRIVE_SHARE * np.bincount(key, weight * cloud.variance) / total + FLOOR**2
    # A place of which little was seen is less than one vote.
    length = np.bincount(key, cloud.weight)
    amount = np.minimum(1.0, length / np.maximum(np.median(length), 1e-9))
    return weight * (amount / (total * variance))[key]


def solved(
    cloud: Cloud, pull: Pull, motion: Motion, frames: slice, pose: Array, bias: Array
) -> tuple[Array, Array, Array]:
    """Pose (T, 3), bias and information (T, 3, 3) of one drive with frames ``frames`` of all."""
    first, last = frames.start, frames.stop
    mine = np.flatnonzero((cloud.frame >= first) & (cloud.frame < last) & (pull.weight > 0))
    frame = cloud.frame[mine] - first
    local, start = cloud.local[mine], pose[frame]
    heading = cloud.angle[mine] + start[:, 2]
    normal = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
    c, s = np.cos(start[:, 2]), np.sin(start[:, 2])
    arm = np.stack([-s * local[:, 0] - c * local[:, 1], c * local[:, 0] - s * local[:, 1]], -1)
    jacobian = np.column_stack([normal, (normal * arm).sum(axis=1)])
    target, weight = pull.offset[mine], pull.weight[mine]
    scale = np.sqrt(np.median(target**2) / 0.455) if len(target) else 1.0
    weight = weight * np.minimum(1.0, HUBER * scale / np.maximum(np.abs(target), 1e-9))
    count = last - first
    information = np.zeros((count, 3, 3))
    for i in range(3):
        for j in range(3):
            information[:, i, j] = np.bincount(
                frame, weight * jacobian[:, i] * jacobian[:, j], count
            )
    wanted = np.stack([np.bincount(frame, weight * jacobian[:, i] * target, count)
                       for i in range(3)], axis=-1)  # fmt: skip
    begin = pose.copy()
    for _ in range(PASSES):
        terms = motion_terms(motion, pose, bias)
        terms.add(information, np.einsum("tij,tj->ti", information, pose - begin) - wanted)
        step = terms.solve()
        pose, bias = pose + step[:, :3], bias + step[:, 3:]
    return pose, bias, information
