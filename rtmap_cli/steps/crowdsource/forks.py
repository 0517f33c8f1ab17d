"""Forks as nodes: where a line ends on another one, that one is cut, and three ends meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import arc_length, is_ring, project

Array = NDArray[np.float64]

BESIDE = 1.2
"""An end so near (m) to the inside of a line is a fork …"""
AHEAD = 10.0
"""… when it goes on to meet that line within this distance (m) …"""
NEARS = 0.4
"""… and comes nearer by this (m) at least …"""
BASE = 10.0
"""… over its last metres."""
FROM_END = 3.0
"""Nearer (m) to the end of a line there is no fork: ends meet there."""


@dataclass
class Branch:
    """A line as vertices ``points`` (n, 3) with ``covariance`` (n, 4) or None; ``source`` is the
    number of the line that it is, or is a part of."""

    points: Array
    covariance: Array | None
    source: int


def forked(lines: Sequence[Branch], may: Sequence[bool]) -> list[Branch]:
    """The lines cut at their forks, parts in order; only lines that ``may`` change are moved or
    cut. Each end is looked at once, in the order of the lines."""
    out = [[line] for line in lines]
    for k, allowed in enumerate(may):
        for side in (0, -1):
            if not allowed or is_ring(out[k][0].points):
                continue
            piece = out[k][0] if side == 0 else out[k][-1]
            node = _node(piece.points, side, out, may, k)
            if node is None:
                continue
            line, part, at = node
            target = out[line][part]
            first, second = _cut(target, at)
            out[line][part : part + 1] = [first, second]
            _end_at(piece, side, second.points[0])
    return [part for parts in out for part in parts]


def _node(
    points: Array, side: int, lines: list[list[Branch]], may: Sequence[bool], own: int
) -> tuple[int, int, float] | None:
    """Line, its part and arc length (m) at which an end runs into another line, if it does."""
    end, before = points[side, :2], _before(points, side)
    best: tuple[float, int, int, float] | None = None
    for j, parts in enumerate(lines):
        if j == own or not may[j]:
            continue
        for part, branch in enumerate(parts):
            found = _meeting(end, before, branch.points)
            if found is not None and (best is None or found[0] < best[0]):
                best = (found[0], j, part, found[1])
    return None if best is None else best[1:]


def _before(points: Array, side: int) -> Array:
    """The point ``BASE`` metres before an end, or the other end of a shorter line."""
    p = points[:, :2] if side else points[::-1, :2]
    at = arc_length(p)
    return np.array([np.interp(max(at[-1] - BASE, 0.0), at, p[:, i]) for i in (0, 1)])


def _meeting(end: Array, before: Array, line: Array) -> tuple[float, float] | None:
    """Distance of an end to a line, and where on the line (arc length, m) it runs into it.

    ``before`` is a point of the ending line some metres back: it must lie on the same side and
    clearly farther away.
    """
    low, high = line[:, :2].min(axis=0) - BESIDE, line[:, :2].max(axis=0) + BESIDE
    if (end < low).any() or (end > high).any():
        return None
    feet, distance, segment = project(np.stack([end, before]), line)
    if distance[0] > BESIDE or distance[1] < distance[0] + NEARS:
        return None
    at = arc_length(line)
    s = at[segment] + np.hypot(*(feet - line[segment, :2]).T)
    along = float(s[0] - s[1])
    if abs(along) < 0.8 * float(np.hypot(*(end - before))):
        return None
    sides = ((np.stack([end, before]) - feet) * (before - feet[1])).sum(axis=1)
    # Past the line already, or on its way to it.
    nears = float(distance[1] - distance[0] if sides[0] > 0 else distance[1] + distance[0])
    ahead = float(distance[0]) * along / nears if sides[0] > 0 else 0.0
    if abs(ahead) > AHEAD:
        return None
    place = float(s[0]) + ahead
    if not FROM_END <= place <= at[-1] - FROM_END:
        return None
    return float(distance[0]), place


def _cut(branch: Branch, at: float) -> tuple[Branch, Branch]:
    """The two parts of a line before and after an arc length; both hold the vertex there."""
    s = arc_length(branch.points)
    k = int(np.searchsorted(s, at))
    both = branch.points if branch.covariance is None else np.hstack(
        [branch.points, branch.covariance]
    )  # fmt: skip
    new = np.array([np.interp(at, s, both[:, i]) for i in range(both.shape[1])])
    parts = [np.vstack([both[:k], new]), np.vstack([new, both[k:]])]
    width = branch.points.shape[1]
    first, second = (
        Branch(p[:, :width], None if branch.covariance is None else p[:, width:], branch.source)
        for p in parts
    )
    return first, second


def _end_at(branch: Branch, side: int, node: Array) -> None:
    """Let a line end at a node, in place."""
    points, covariance = branch.points, branch.covariance
    at = 0 if side == 0 else len(points)
    branch.points = np.insert(points, at, node, axis=0)
    if covariance is not None:
        branch.covariance = np.insert(covariance, at, covariance[side], axis=0)
