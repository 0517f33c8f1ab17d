"""One frame: which predictions hit a true element, as a protocol has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.chamfer import bands, beside, close_pairs, sample_lines
from rtmap_cli.steps.evaluate.maps.protocols import Detection, Protocol

Array = NDArray[np.float64]
Index = NDArray[np.intp]

PROBES = 12
"""Points of a line that are looked at before its band is computed."""


@dataclass(frozen=True)
class Match:
    """Of one class: hits (n, thresholds) of the predictions, and the true element (n,) that each
    hit at the largest threshold, -1 for none."""

    hits: NDArray[np.bool_]
    taken: Index


def match(
    pred: Sequence[Sequence[Detection]],
    truth: Sequence[Sequence[Detection]],
    thresholds: Array,
    protocol: Protocol,
    where: str,
) -> list[Match]:
    """Match the predictions of each class with its true elements; both sides list the same classes.

    All classes go through one pass: numpy's calls cost more than the few lines of a frame.
    BadInput at ``where`` for lines that the protocol cannot compare.
    """
    n, m = (np.array([len(c) for c in side], np.intp) for side in (pred, truth))
    lines = _sampled([e[1] for c in pred for e in c], protocol, protocol.keep_sampled, where)
    targets = _sampled([e[1] for c in truth for e in c], protocol, False, where)
    i, j = _same_class(n, m)
    distance, nearest = _nearest(lines, targets, i, j, float(thresholds[-1]), protocol)
    hits = np.zeros((len(lines), len(thresholds)), dtype=bool)
    taken = np.zeros((len(targets), len(thresholds)), dtype=bool)
    within = distance[:, None] <= thresholds
    # By falling score each line may take only its nearest element: there is no second choice.
    scores = np.array([e[2] for c in pred for e in c], dtype=np.float64)
    order = np.argsort(-scores, kind="stable")
    for k in order[within[order, -1]].tolist():
        hits[k] = within[k] & ~taken[nearest[k]]
        taken[nearest[k]] |= hits[k]
    out, start, first = [], 0, 0
    for count, targets_here in zip(n.tolist(), m.tolist(), strict=True):
        mine = hits[start : start + count]
        matched = np.where(mine[:, -1], nearest[start : start + count] - first, -1)
        out.append(Match(mine, matched))
        start, first = start + count, first + targets_here
    return out


def _same_class(n: Index, m: Index) -> tuple[Index, Index]:
    """All pairs of lines of one class: numbers (k,) of both, over all classes."""
    each = np.repeat(m, n)
    i = np.repeat(np.arange(len(each)), each)
    first = np.repeat(np.cumsum(m) - m, n) - (np.cumsum(each) - each)
    return i, np.arange(len(i)) + np.repeat(first, each)


def _sampled(lines: Sequence[Array], protocol: Protocol, keep: bool, where: str) -> Array:
    """(n, samples, 2) points at equal arc length."""
    arrays = [np.asarray(line, dtype=np.float64) for line in lines]
    if any(points.ndim != 2 or len(points) < 2 for points in arrays):
        raise BadInput(
            where,
            "an element has fewer than 2 vertices",
            f"protocol {protocol.name} has no rule for it",
        )
    out = sample_lines(arrays, protocol.samples)
    if keep:
        for k, points in enumerate(arrays):
            if len(points) == protocol.samples:
                out[k] = points[:, :2]
    if not np.isfinite(out).all():
        raise BadInput(where, "a vertex is not finite")
    return out


def _nearest(
    lines: Array, targets: Array, i: Index, j: Index, limit: float, protocol: Protocol
) -> tuple[Array, Index]:
    """Chamfer distance (n,) of each line to its nearest element, and which it is; infinitely far
    beyond ``limit``. Of equally near ones the first."""
    distance, nearest = np.full(len(lines), np.inf), np.full(len(lines), -1, np.intp)
    picks = np.linspace(0, protocol.samples - 1, PROBES).round().astype(np.intp)
    which, found, feet = close_pairs(lines, targets, i, j, limit, picks)
    i, j = i[which], j[which]
    if protocol.band is not None and len(which):
        near = beside(lines[i][:, picks], targets[j], feet, 0.95 * protocol.band)
        touch = _bands_touch(lines, targets, i, j, near, protocol.band)
        i, j, found = i[touch], j[touch], found[touch]
    for a, b, d in zip(i.tolist(), j.tolist(), found.tolist(), strict=True):
        if d < distance[a]:
            distance[a], nearest[a] = d, b
    return distance, nearest


def _bands_touch(
    lines: Array, targets: Array, i: Index, j: Index, near: NDArray[np.bool_], half_width: float
) -> NDArray[np.bool_]:
    """(k,) whether the bands of lines[i] and targets[j] intersect; none of zero length does.

    A point of one line well inside the other's band, ``near``, settles it; polygons of bands cost
    ten times as much.
    """
    import shapely

    touch = near & (np.ptp(lines[i], axis=1).max(axis=1) > 0)
    rest = np.flatnonzero(~touch)
    if len(rest):
        left, left_of = np.unique(i[rest], return_inverse=True)
        right, right_of = np.unique(j[rest], return_inverse=True)
        a, b = bands(lines[left], half_width), bands(targets[right], half_width)
        touch[rest] = shapely.intersects(a[left_of], b[right_of])
    return np.asarray(touch, dtype=bool)
