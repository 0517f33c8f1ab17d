"""Whether predictions have the shape of the truth: smoothness and topology. No part of mAP.

Smoothness compares the turning of matched lines: the total absolute curvature ∫|dθ| per metre,
which is as large as the truth's for a faithful line and larger for one that wiggles. Topology
compares joints, the places where an end of a line meets another line of its class, one to one and
by place as the junction metric of RoadTracer does (Bastani et al., CVPR 2018).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import is_ring, length, resample_step

Array = NDArray[np.float64]

STEP = 1.0
"""Lines are taken at points this far apart along them (m): less is noise of surveying."""
ZIGZAG = np.radians(5.0)
"""Turns of at least this, one after the other and to opposite sides, are a zigzag …"""
ZIGZAG_LENGTH = 12.0
"""… when they are at most this far apart (m)."""
MEET = 0.5
"""An end meets a line within this distance (m) …"""
REACH = 1.5
"""… and a joint of the truth is found by one of the prediction within this (m)."""

MEASURES = 12
"""Numbers per frame and class: turning (rad), length (m), zigzags of matched predictions and of
their truth; joints, then forks: true, predicted, found."""


def measure(pred: Sequence[Array], truth: Sequence[Array], matched: NDArray[np.intp]) -> Array:
    """(``MEASURES``,) sums over one class of one frame, which add up over frames.

    Lines (n, 2 or more) in metres; ``matched`` (len(pred),) is the true line that each prediction
    hit, -1 for none. Only hits count for smoothness, all lines for topology.
    """
    out = np.zeros(MEASURES)
    for k in np.flatnonzero(matched >= 0).tolist():
        out[:3] += turning(pred[k])
        out[3:6] += turning(truth[matched[k]])
    (places, arms), (there, their_arms) = joints(truth), joints(pred)
    for start, least in ((6, 2), (9, 3)):
        true, predicted = places[arms >= least], there[their_arms >= least]
        out[start : start + 3] = len(true), len(predicted), _matches(true, predicted)
    return out


def turning(line: Array) -> Array:
    """(3,) total absolute turn (rad), length (m) and number of zigzags of a line, at ``STEP``.

    The start of a closed ring counts as any other vertex.
    """
    total = length(line)
    if total <= 0:
        return np.zeros(3)
    way = np.diff(resample_step(line[:, :2], STEP), axis=0)
    if is_ring(line):
        way = np.concatenate([way, way[:1]])
    ahead, behind = way[1:], way[:-1]
    cross = behind[:, 0] * ahead[:, 1] - behind[:, 1] * ahead[:, 0]
    turn = np.arctan2(cross, (behind * ahead).sum(axis=1))
    sharp = np.flatnonzero(np.abs(turn) >= ZIGZAG)
    back = np.diff(np.sign(turn[sharp])) != 0
    near = np.diff(sharp) * np.hypot(*way[0]) <= ZIGZAG_LENGTH
    return np.array([np.abs(turn).sum(), total, (back & near).sum()])


def joints(lines: Sequence[Array]) -> tuple[Array, NDArray[np.int64]]:
    """Places (k, 2) where an end of an open line meets another line, and how many arms meet there.

    Ends within ``MEET`` of each other are one joint. Every end there is an arm; a line that passes
    has two.
    """
    import shapely

    nothing = np.zeros((0, 2)), np.zeros(0, np.int64)
    lines = [line[:, :2] for line in lines if length(line) > 0]
    ends = [(k, p) for k, x in enumerate(lines) if not is_ring(x) for p in (x[0], x[-1])]
    if len(lines) < 2 or not ends:
        return nothing
    owner = np.array([k for k, _ in ends])
    points = np.array([p for _, p in ends])
    shapes = np.array([shapely.LineString(line) for line in lines])
    near = shapely.distance(shapely.points(points)[:, None], shapes[None]) <= MEET
    near[np.arange(len(owner)), owner] = False
    meeting = near.any(axis=1)
    if not meeting.any():
        return nothing
    owner, points, near = owner[meeting], points[meeting], near[meeting]
    label = _clusters(points)
    places, arms = [], []
    for k in range(label.max() + 1):
        here = label == k
        passing = near[here].any(axis=0)
        passing[owner[here]] = False
        places.append(points[here].mean(axis=0))
        arms.append(int(here.sum() + 2 * passing.sum()))
    return np.array(places), np.array(arms, np.int64)


def _clusters(points: Array) -> NDArray[np.int64]:
    """(n,) labels 0, 1, … of points that hang together by distances of at most ``MEET``."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    gap = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
    i, j = np.nonzero(gap <= MEET)
    graph = coo_array((np.ones(len(i)), (i, j)), shape=gap.shape)
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def _matches(true: Array, predicted: Array) -> int:
    """How many pairs within ``REACH`` can be made, nearest first, each place used once."""
    if not len(true) or not len(predicted):
        return 0
    gap = np.hypot(*(true[:, None] - predicted[None]).transpose(2, 0, 1))
    free_i, free_j, count = np.ones(len(true), bool), np.ones(len(predicted), bool), 0
    for flat in np.argsort(gap, axis=None, kind="stable"):
        i, j = divmod(int(flat), gap.shape[1])
        if free_i[i] and free_j[j] and gap[i, j] <= REACH:
            free_i[i] = free_j[j] = False
            count += 1
    return count


@dataclass(frozen=True)
class Shape:
    """Smoothness and topology of one class, from the sum of its measures (``MEASURES``,)."""

    sums: Array

    def smoothness(self) -> dict[str, float | None]:
        """Turning (degrees per metre) and zigzags (per 100 m) of hits and of the truth they hit;
        ``excess_deg_per_m`` is the difference of the turnings. None without hits."""
        turn, way, zigzags, true_turn, true_way, true_zigzags = self.sums[:6].tolist()
        if not way or not true_way:
            names = ("deg_per_m", "true_deg_per_m", "excess_deg_per_m")
            return dict.fromkeys((*names, "zigzags_per_100_m", "true_zigzags_per_100_m"))
        mine, theirs = np.degrees(turn / way), np.degrees(true_turn / true_way)
        return {
            "deg_per_m": float(mine),
            "true_deg_per_m": float(theirs),
            "excess_deg_per_m": float(mine - theirs),
            "zigzags_per_100_m": 100 * zigzags / way,
            "true_zigzags_per_100_m": 100 * true_zigzags / true_way,
        }

    def topology(self) -> dict[str, dict[str, Any]]:
        """Joints and, of them, forks (three arms or more): counts, precision, recall, F1."""
        return {
            "joints": _shares(*self.sums[6:9].astype(int).tolist()),
            "forks": _shares(*self.sums[9:12].astype(int).tolist()),
        }


def _shares(true: int, predicted: int, found: int) -> dict[str, Any]:
    return {
        "true": true,
        "predicted": predicted,
        "found": found,
        "precision": found / predicted if predicted else None,
        "recall": found / true if true else None,
        "f1": 2 * found / (true + predicted) if true + predicted else None,
    }
