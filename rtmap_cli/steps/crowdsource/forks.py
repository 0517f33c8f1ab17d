"""Forks as nodes: where a line ends on another one, that one is cut, and three ends meet.

So they do where two lines run on top of each other from their ends before they part: the stretch
that they have in common is kept once.
"""

from __future__ import annotations

import itertools
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

TOGETHER = 0.2
"""Lines so near (m) to each other from their ends on are one there …"""
STEM = 4.0
"""… when that goes on for so far (m) …"""
PARTED = 0.6
"""… and they come so far apart (m) …"""
SOON = 10.0
"""… within this way (m)."""
STEP = 0.5


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
    _share_stems(out, may)
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


def _share_stems(lines: list[list[Branch]], may: Sequence[bool]) -> None:
    """What two lines have in common from their ends on is kept by the longer one, which is cut
    where they part, in place; each line takes part once."""
    free = [k for k, ok in enumerate(may) if ok and not is_ring(lines[k][0].points)]
    order = sorted(free, key=lambda k: (-float(arc_length(lines[k][0].points)[-1]), k))
    done: set[int] = set()
    for row, k in enumerate(order):
        for j in order[row + 1 :]:
            if {k, j} & done:
                continue
            for side, other in itertools.product((0, -1), (0, -1)):
                stem = _stem(lines[k][0].points, side, lines[j][0].points, other)
                if stem is None:
                    continue
                kept, cut = lines[k][0], lines[j][0]
                along = arc_length(kept.points)[-1]
                parts = _cut(kept, stem if side == 0 else along - stem)
                node = parts[0].points[-1]
                _, _, segment = project(node[None], cut.points)
                s = arc_length(cut.points)
                at = s[segment[0]] + np.hypot(*(node[:2] - cut.points[segment[0], :2]))
                rest = _cut(cut, float(np.clip(at, 1e-6, s[-1] - 1e-6)))[1 if other == 0 else 0]
                rest.points[0 if other == 0 else -1] = node
                lines[k], lines[j] = list(parts), [rest]
                done |= {k, j}
                break


def _stem(a: Array, side: int, b: Array, other: int) -> float | None:
    """How far (m) from their ends on two lines are one, before they part; None: they are not."""
    if np.hypot(*(a[side, :2] - b[other, :2])) > PARTED:
        return None
    a, b = (x[:, :2] if at == 0 else x[::-1, :2] for x, at in ((a, side), (b, other)))
    at = arc_length(a)
    s = np.arange(0.0, min(float(at[-1]), 100.0), STEP)
    places = np.stack([np.interp(s, at, a[:, i]) for i in (0, 1)], axis=-1)
    _, apart, _ = project(places, b)
    near = np.flatnonzero(apart > TOGETHER)
    # The very ends are what detections are cut at.
    near = near[s[near] > 1.0]
    if not len(near) or s[near[0]] < STEM:
        return None
    first = int(near[0])
    wide = np.flatnonzero(apart[first:] > PARTED)
    if not len(wide) or s[first + wide[0]] - s[first] > SOON:
        return None
    last = first + int(wide[0])
    # Back to where they would be one, as straight as they part.
    back = apart[first] * (s[last] - s[first]) / max(float(apart[last] - apart[first]), 1e-6)
    return float(max(s[first] - back, STEM / 2))


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
