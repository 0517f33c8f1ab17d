"""Drives that were not localized put onto each other: smooth, shift, pull, and the common place.

Each drive's poses are the MAP estimate of odometry, of GNSS with a bias that walks, and of the
offsets of what it saw to what all drives saw there; drives and crests of the common field are
solved in turn. All drives together may still be moved at will: their common place is where the
mean of GNSS over the drives has it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs.motion import Motion, motion_terms
from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.steps.crowdsource.align.cloud import cloud_of
from rtmap_cli.steps.crowdsource.align.pull import company, pulls, solved
from rtmap_cli.steps.crowdsource.align.shift import best_shifts, stretches_of, surfaces

Array = NDArray[np.float64]
Int = NDArray[np.int64]

COARSE = (0.8, 0.6)
"""Blur (m) of the fields of the rounds that search for shifts."""
REACHES = (1.0, 0.8, 0.6, 0.5, 0.4, 0.4)
"""Reach (m) of the rounds that pull points onto crests."""
SMOOTHING = 5
"""Solves of a drive without a map: odometry turns with the poses."""
COMMON = 150.0
"""Distance (m) over which the drives' GNSS is averaged for the common place."""
NODE = 30.0
"""Cells (m) in which the sums for that are kept."""
WINDOW = 15.0
"""Travel (m) on either side from which a pose is known."""


@dataclass(frozen=True)
class Aligned:
    """The drives at their new poses; ``common`` (m²) is the variance per axis of the place that all
    of them share, which no averaging over the drives takes away."""

    traversals: list[Traversal]
    common: float


def align(traversals: Sequence[Traversal]) -> Aligned:
    """Align drives that state motion; the others are returned as they are.

    The result does not depend on the order of the drives.
    """
    free = sorted((t for t in traversals if _usable(t)), key=lambda t: t.run_id)
    if not free:
        return Aligned(list(traversals), 0.0)
    motions = [t.motion for t in free if t.motion is not None]
    first = np.concatenate([[0], np.cumsum([len(t.pose) for t in free])]).astype(np.int64)
    pose, bias = (np.concatenate(a) for a in zip(*map(_smooth, motions), strict=True))
    information = np.zeros((len(pose), 3, 3))
    gnss = np.concatenate([m.gnss for m in motions])
    slow = np.concatenate([m.slow for m in motions])
    cloud = cloud_of(free, first)
    if len(cloud) and len(free) > 1:
        spans = [slice(a, b) for a, b in pairwise(first.tolist())]
        stretch = stretches_of(pose, first)
        for blur in COARSE:
            surface = surfaces(cloud, pose, stretch, blur)
            # All move at once, each towards the others: only by their share, else two would swap.
            part = stretch[cloud.frame]
            met = cloud.weight * company(cloud, cloud.at(pose)[0], 5.0)
            total = np.bincount(part, cloud.weight, len(surface))
            share = np.bincount(part, met, len(surface)) / np.maximum(total, 1e-9)
            for span, motion in zip(spans, motions, strict=True):
                shift = _shifted(surface, stretch[span], motion, pose[span])
                pose[span, :2] += shift * share[stretch[span], None]
        for k, reach in enumerate(REACHES):
            if k in (0, len(REACHES) - 2):
                pose[:, :2] += _to_common(pose, gnss, slow)
                bias = gnss - pose
            pull = pulls(cloud, pose, reach)
            for span, motion in zip(spans, motions, strict=True):
                pose[span], bias[span], information[span] = solved(
                    cloud, pull, motion, span, pose[span], bias[span]
                )
    return _result(traversals, free, first, pose, information, slow)


def _usable(traversal: Traversal) -> bool:
    m = traversal.motion
    return (
        m is not None
        and len(traversal.pose) > 1
        and bool(np.isfinite(m.white).all() and np.isfinite(m.slow).all())
        and bool((m.white > 0).all() and (m.slow > 0).all())
    )


def _smooth(motion: Motion) -> tuple[Array, Array]:
    """Poses and biases (T, 3) from GNSS and odometry alone."""
    pose, bias = motion.gnss.copy(), np.zeros((len(motion.gnss), 3))
    for _ in range(SMOOTHING):
        step = motion_terms(motion, pose, bias).solve()
        pose, bias = pose + step[:, :3], bias + step[:, 3:]
    return pose, bias


def _shifted(surface: Array, stretch: Int, motion: Motion, pose: Array) -> Array:
    """(T, 2) shift of every frame, linear between the middles of its stretches."""
    numbers = np.unique(stretch)
    travel = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(pose[:, :2], axis=0).T))])
    middle = np.array([travel[stretch == k].mean() for k in numbers])
    before = np.array([(pose - motion.gnss)[stretch == k, :2].mean(axis=0) for k in numbers])
    shift = best_shifts(surface[numbers], motion.slow[0, :2], before)
    return np.stack([np.interp(travel, middle, shift[:, i]) for i in (0, 1)], axis=-1)


def _to_common(pose: Array, gnss: Array, slow: Array) -> Array:
    """(F, 2) by how much the drives around each frame lie off the mean of their GNSS."""
    from scipy.spatial import cKDTree

    key = np.floor(pose[:, :2] / NODE).astype(np.int64)
    nodes, inverse = np.unique(key, axis=0, return_inverse=True)
    weight = 1.0 / (slow[:, :2] ** 2).mean(axis=1)
    total = np.bincount(inverse.ravel(), weight)
    off = np.stack(
        [np.bincount(inverse.ravel(), weight * (gnss - pose)[:, i]) for i in (0, 1)], axis=-1
    )
    places = (nodes + 0.5) * NODE
    near = cKDTree(places).sparse_distance_matrix(
        cKDTree(places), 2.5 * COMMON, output_type="coo_matrix"
    )
    kernel = np.exp(-0.5 * (near.data / COMMON) ** 2)
    n = len(nodes)
    mean = (
        np.stack([np.bincount(near.row, kernel * off[near.col, i], n) for i in (0, 1)], axis=-1)
        / np.bincount(near.row, kernel * total[near.col], n)[:, None]
    )
    # Between nodes the mean varies smoothly: the kernel again, at the frames.
    d = cKDTree(pose[:, :2]).sparse_distance_matrix(
        cKDTree(places), 2.5 * NODE, output_type="coo_matrix"
    )
    share = np.exp(-0.5 * (d.data / NODE) ** 2)
    out = np.stack([np.bincount(d.row, share * mean[d.col, i], len(pose)) for i in (0, 1)], -1)
    return np.asarray(out / np.bincount(d.row, share, len(pose))[:, None], np.float64)


def _result(
    traversals: Sequence[Traversal],
    free: list[Traversal],
    first: Int,
    pose: Array,
    information: Array,
    slow: Array,
) -> Aligned:
    """The drives at their poses, with what the frames around say of each pose."""
    moved = {}
    for k, t in enumerate(free):
        span = slice(int(first[k]), int(first[k + 1]))
        covariance = _covariance(pose[span], information[span])
        moved[t.run_id] = t.moved(pose[span], covariance)
    common = float((slow[:, :2] ** 2).mean()) / len(free)
    return Aligned([moved.get(t.run_id, t) for t in traversals], common)


def _covariance(pose: Array, information: Array) -> Array:
    """(T, 3, 3) from the information of the frames within ``WINDOW`` of travel."""
    travel = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(pose[:, :2], axis=0).T))])
    low = np.searchsorted(travel, travel - WINDOW, side="left")
    high = np.searchsorted(travel, travel + WINDOW, side="right")
    total = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(information, axis=0)])
    # Nobody else there: a decimetre and a fifth of a degree are left of odometry and GNSS.
    least = np.diag(1 / np.array([0.15, 0.15, 0.004]) ** 2)
    return np.asarray(np.linalg.inv(total[high] - total[low] + least), np.float64)
