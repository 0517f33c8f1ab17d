"""Edges of the graph cut into lanelets: where a border changes, and where they are too long.

A way has one type (Lanelet2), so a lanelet ends where a border changes for long from paint to curb,
or from what was seen to what was not.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import length
from rtmap_cli.steps.label.lanes.borders import Sides
from rtmap_cli.steps.label.lanes.graph import LaneGraph
from rtmap_cli.steps.label.lanes.traces import STEP

Kinds = NDArray[np.int8]

LEAST = 10.0
"""Metres of a lanelet at least, and of what a border must be to be told apart."""


def cut_in_lanelets(
    graph: LaneGraph, sides: list[Sides], longest: float
) -> tuple[LaneGraph, list[Sides]]:
    """The graph with its edges cut where one of their borders is of another kind for ``LEAST``, and
    into pieces of at most ``longest`` metres."""
    free = 1 + max((max(e.start, e.end) for e in graph.edges), default=0)
    edges, pieces = [], []
    for e, s in zip(graph.edges, sides, strict=True):
        step = length(e.xy) / max(len(e.xy) - 1, 1)
        marks = [0]
        for a, b in pairwise([0, *_places(s.kind), len(e.xy) - 1]):
            count = max(int(np.ceil((b - a) * step / longest)), 1)
            marks += np.linspace(a, b, count + 1).round().astype(int).tolist()[1:]
        nodes = [e.start, *range(free, free + len(marks) - 2), e.end]
        free += len(marks) - 2
        for (a, b), (p, q) in zip(pairwise(nodes), pairwise(marks), strict=True):
            edges.append(replace(e, start=a, end=b, xy=e.xy[p : q + 1]))
            pieces.append(Sides(s.metres[p : q + 1], s.kind[p : q + 1]))
    return LaneGraph(edges), pieces


def _places(kind: Kinds) -> list[int]:
    """Samples at which one of the two borders (n, 2) changes, LEAST apart and from the ends."""
    least = int(LEAST / STEP)
    found = sorted({k for side in (0, 1) for k in _changes(kind[:, side], least)})
    out: list[int] = []
    for k in found:
        if k - (out[-1] if out else 0) >= least and len(kind) - 1 - k >= least:
            out.append(k)
    return out


def _changes(kind: Kinds, least: int) -> list[int]:
    """Where a border (n,) changes from one kind to another, each ``least`` samples long."""
    ends = np.flatnonzero(np.diff(kind)) + 1
    runs = [(a, b, int(kind[a])) for a, b in pairwise([0, *ends.tolist(), len(kind)])]
    while len(runs) > 1:
        k = min(range(len(runs)), key=lambda i: runs[i][1] - runs[i][0])
        a, b, _ = runs[k]
        if b - a >= least:
            break
        # The shortest run goes to its longer neighbour, and those of one kind become one.
        near = [i for i in (k - 1, k + 1) if 0 <= i < len(runs)]
        other = max(near, key=lambda i: runs[i][1] - runs[i][0])
        runs[k] = (a, b, runs[other][2])
        runs = _joined(runs)
    return [a for a, _, _ in runs[1:]]


def _joined(runs: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
    """Runs without neighbours of the same kind."""
    out = runs[:1]
    for a, b, kind in runs[1:]:
        if kind == out[-1][2]:
            out[-1] = (out[-1][0], b, kind)
        else:
            out.append((a, b, kind))
    return out
