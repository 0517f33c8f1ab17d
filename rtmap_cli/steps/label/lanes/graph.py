"""The graph of lanes: strands averaged, cut where others leave and join, as edges between nodes."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from rtmap_cli.geometry.polylines import (
    arc_length,
    length,
    normals,
    project,
    resample_step,
    tangents,
)
from rtmap_cli.steps.label.lanes.strands import WITHIN, Strands, strands_of, tolerance
from rtmap_cli.steps.label.lanes.traces import STEP, Trace

Array = NDArray[np.float64]
Node = tuple[int, int, int]

TOGETHER = 8.0
"""Metres within which forks (merges) of one strand are one: a lane forks at one place."""
SPUR = 12.0
"""Metres below which an edge that leads nowhere is the beginning or end of a drive, no lane."""
SMOOTH = 9.0
"""Metres of line to which a cubic is fitted, so that noise goes and curves stay."""
BLEND = 10.0
"""Metres over which an end is drawn to the node that it shares."""
CHANGE = (2.2, 4.6, 80.0)
"""Least and most metres between lanes, and longest metres of driving, of a change of lanes."""


@dataclass(frozen=True)
class Edge:
    """A lane between two nodes: centre line (n, 2), m/s and number of passes there."""

    start: int
    end: int
    xy: Array
    speed: float
    passes: int


@dataclass
class LaneGraph:
    """Edges and what the nodes are: ``heading`` (2,) unit direction by node."""

    edges: list[Edge]

    def ends(self) -> tuple[dict[int, list[int]], dict[int, list[int]]]:
        """Edges that leave and that enter every node."""
        leaves: dict[int, list[int]] = defaultdict(list)
        enters: dict[int, list[int]] = defaultdict(list)
        for k, e in enumerate(self.edges):
            leaves[e.start].append(k)
            enters[e.end].append(k)
        return leaves, enters

    def successors(self, k: int) -> list[int]:
        """Edges that go on where edge ``k`` ends."""
        return [j for j, e in enumerate(self.edges) if e.start == self.edges[k].end]

    def heading(self, node: int) -> Array:
        """(2,) the direction in which lanes go through a node."""
        parts = [tangents(e.xy)[0] for e in self.edges if e.start == node]
        parts += [tangents(e.xy)[-1] for e in self.edges if e.end == node]
        total = np.sum(parts, axis=0)
        out: Array = total / max(float(np.hypot(*total)), 1e-9)
        return out


def lane_graph(traces: list[Trace]) -> LaneGraph:
    """Lanes of traces as a graph: edges from fork to merge, rings in three pieces."""
    out = strands_of(traces)
    edges = joined(without_spurs(_Cutter(out, _averaged(out)).edges()))
    edges = joined(without_changes(edges))
    return LaneGraph(_meeting(_sampled(edges)))


@dataclass
class Line:
    """A strand averaged: (n, 2) centre, (n,) m/s and passes."""

    xy: Array
    speed: Array
    passes: Array


def _averaged(out: Strands) -> list[Line]:
    """The strands, each the mean of all that drove there; those under way to elsewhere excepted."""
    samples, bound = out.samples, tolerance(out) * 2
    total = [np.zeros(len(s.ids)) for s in out.strands]
    count = [np.ones(len(s.ids)) for s in out.strands]
    speed = [samples.speed[s.ids].copy() for s in out.strands]
    for m in (m for run in out.runs for m in run if abs(m.left) <= bound):
        at = round(m.at) + out.strands[m.strand].ahead
        if 0 <= at < len(total[m.strand]):
            total[m.strand][at] += m.left
            count[m.strand][at] += 1
            speed[m.strand][at] += samples.speed[m.sample]
    lines = []
    for s, left, n, fast in zip(out.strands, total, count, speed, strict=True):
        xy = samples.xy[s.ids]
        if len(xy) >= 4:
            xy = xy + _smooth(left / n)[:, None] * normals(xy)
            xy = np.stack([_smooth(xy[:, 0]), _smooth(xy[:, 1])], axis=-1)
        lines.append(Line(xy, fast / n, n))
    return lines


def _smooth(values: Array) -> Array:
    """Cubics fitted along a line (Savitzky and Golay)."""
    window = min(int(SMOOTH / STEP) // 2 * 2 + 1, (len(values) - 1) // 2 * 2 + 1)
    if window < 5:
        return values
    out: Array = savgol_filter(values, window, 3, mode="interp")
    return out


class _Cutter:
    """Cuts strands where others begin and end on them; nodes are names that may turn out one."""

    def __init__(self, out: Strands, lines: list[Line]) -> None:
        self.strands, self.lines = out.strands, lines
        self.same: dict[Node, Node] = {}
        self.before: dict[int, tuple[int, int, int]] = {}
        self.after: dict[int, tuple[int, int, int]] = {}
        self.cuts: dict[int, list[tuple[int, Node]]] = defaultdict(list)

    def node(self, name: Node) -> Node:
        """What a node is called by now."""
        while (other := self.same.get(name, name)) != name:
            name = other
        return name

    def unite(self, a: Node, b: Node) -> None:
        """Two names of one node."""
        a, b = self.node(a), self.node(b)
        if a != b:
            self.same[max(a, b)] = min(a, b)

    def edges(self) -> list[Edge]:
        """All pieces."""
        for k in range(len(self.strands)):
            self.place(k, True)
            self.place(k, False)
        numbers: dict[Node, int] = {}
        out = []
        for k in range(len(self.strands)):
            for a, b, xy, speed, passes in self.pieces(k):
                ends = [numbers.setdefault(self.node(n), len(numbers)) for n in (a, b)]
                if ends[0] != ends[1] or length(xy) > 2 * TOGETHER:
                    out.append(Edge(ends[0], ends[1], xy, speed, passes))
        return out

    def place(self, k: int, forks: bool) -> None:
        """The nodes at which others leave strand ``k`` (``forks``), or join it.

        Those that are near each other are one node, upstream for forks and downstream for merges:
        there all run together still (already).
        """
        n = len(self.lines[k].xy)
        found = []
        for j, s in enumerate(self.strands):
            spot = s.start if forks else s.end
            if spot is not None and spot[0] == k and len(s.ids) > 1:
                place = int(np.clip(round(spot[1]) + self.strands[k].ahead, 0, n - 1))
                found.append((place, j))
        found.sort(reverse=not forks)
        near = TOGETHER / STEP
        own = self.strands[k].start if forks else self.strands[k].end
        name: Node = (k, 0 if forks else 1, 0)
        at = None if own is None else (0 if forks else n - 1)
        for p, j in found:
            if at is None or abs(p - at) > near:
                at, name = p, (k, 2 if forks else 3, p)
                self.cuts[k].append((p, name))
            if forks:
                self.before[j] = (k, at, p)
                self.unite((j, 0, 0), name)
            else:
                self.after[j] = (k, p, at)
                self.unite((j, 1, 0), name)

    def pieces(self, k: int) -> list[tuple[Node, Node, Array, float, int]]:
        """The pieces of strand ``k`` with their nodes."""
        line = self.lines[k]
        if len(line.xy) < 2:
            if k in self.before and k in self.after:
                self.unite((k, 0, 0), (k, 1, 0))
            return []
        xy, first = line.xy, 0
        if k in self.before:
            other, a, b = self.before[k]
            first = b - a
            xy = drawn(xy, self.lines[other].xy[b] - xy[0], np.zeros(2))
            xy = np.concatenate([self.lines[other].xy[a:b], xy])
        if k in self.after:
            other, a, b = self.after[k]
            xy = drawn(xy, np.zeros(2), self.lines[other].xy[a] - xy[-1])
            xy = np.concatenate([xy, self.lines[other].xy[a + 1 : b + 1]])
        cuts = sorted((p + first, name) for p, name in self.cuts[k])
        cuts = [(0, (k, 0, 0)), *cuts, (len(xy) - 1, (k, 1, 0))]
        out = []
        for (p, a_name), (q, b_name) in pairwise(cuts):
            if q - p < 2:
                self.unite(a_name, b_name)
                continue
            own = slice(max(p - first, 0), max(q - first, 1))
            speed = float(np.median(line.speed[own])) if len(line.speed[own]) else 0.0
            passes = int(np.median(line.passes[own])) if len(line.passes[own]) else 1
            out.append((a_name, b_name, xy[p : q + 1], speed, passes))
        return out


def joined(edges: list[Edge]) -> list[Edge]:
    """Edges made one where exactly one ends and one begins."""
    pool = dict(enumerate(edges))
    leaves, enters = LaneGraph(edges).ends()
    for node in list(leaves):
        if len(leaves[node]) != 1 or len(enters[node]) != 1:
            continue
        a, b = enters[node][0], leaves[node][0]
        if a == b:
            continue
        first, second = pool[a], pool.pop(b)
        n, m = length(first.xy), length(second.xy)
        pool[a] = Edge(
            first.start, second.end, np.concatenate([first.xy, second.xy[1:]]),
            (first.speed * n + second.speed * m) / max(n + m, 1e-9),
            max(first.passes, second.passes),
        )  # fmt: skip
        enters[second.end] = [a if k == b else k for k in enters[second.end]]
    return list(pool.values())


def without_spurs(edges: list[Edge]) -> list[Edge]:
    """Without short ends that lead nowhere and doubles of the same way."""
    for _ in range(2):
        leaves, enters = LaneGraph(edges).ends()
        kept = []
        for k, e in enumerate(edges):
            free = not enters[e.start], not leaves[e.end]
            alone = all(free) or (free[0] and not free[1] and len(enters[e.end]) < 2)
            alone |= free[1] and not free[0] and len(leaves[e.start]) < 2
            if any(free) and length(e.xy) < SPUR and not alone:
                continue
            if not any(_double(e, edges[j], j, k) for j in leaves[e.start] if j != k):
                kept.append(e)
        edges = kept
    return edges


def _double(e: Edge, other: Edge, j: int, k: int) -> bool:
    """True for the less driven one of two edges that are the same lane."""
    if e.end != other.end or (e.passes, -k) > (other.passes, -j):
        return False
    return bool(project(e.xy, other.xy)[1].max() < WITHIN)


def without_changes(edges: list[Edge]) -> list[Edge]:
    """Without the ways of vehicles that changed to the lane beside: no lane leads there."""
    graph = LaneGraph(edges)
    leaves, enters = graph.ends()
    return [e for k, e in enumerate(edges) if not _is_change(edges, k, leaves, enters)]


def _is_change(
    edges: list[Edge], k: int, leaves: dict[int, list[int]], enters: dict[int, list[int]]
) -> bool:
    """True where the lane that was left goes on beside the one that was entered."""
    e = edges[k]
    reach = length(e.xy)
    if reach > CHANGE[2]:
        return False
    for f in (f for f in leaves[e.start] if f != k):
        for g in (g for g in enters[e.end] if g != k and g != f):
            kept = _onward(edges, f, leaves, reach, False)
            other = _onward(edges, g, enters, reach, True)
            _, gap, at = project(kept, other)
            inside = (at > 0) & (at < len(other) - 2)
            beside = inside & (gap > CHANGE[0]) & (gap < CHANGE[1])
            beside &= (tangents(kept) * tangents(other)[at]).sum(axis=1) > 0.95
            if beside.mean() > 0.6:
                return True
    return False


def _onward(
    edges: list[Edge], k: int, links: dict[int, list[int]], reach: float, back: bool
) -> Array:
    """(n, 2) the line from edge ``k`` on (``back``: up to it), about ``reach`` metres."""
    xy = edges[k].xy
    node = edges[k].start if back else edges[k].end
    seen = {k}
    while length(xy) < reach and len(found := [j for j in links[node] if j not in seen]) == 1:
        seen.add(found[0])
        e = edges[found[0]]
        xy = np.concatenate([e.xy, xy[1:]] if back else [xy, e.xy[1:]])
        node = e.start if back else e.end
    s = arc_length(xy)
    keep = s >= s[-1] - reach if back else s <= reach
    out: Array = xy[keep]
    return out


def _sampled(edges: list[Edge]) -> list[Edge]:
    """Edges with a vertex every STEP; rings in three pieces, since no lanelet follows itself."""
    free = 1 + max((max(e.start, e.end) for e in edges), default=0)
    out = []
    for e in edges:
        line = resample_step(e.xy, STEP)
        pieces = 3 if e.start == e.end else 1
        marks = np.linspace(0, len(line) - 1, pieces + 1).round().astype(int)
        nodes = [e.start, *range(free, free + pieces - 1), e.end]
        free += pieces - 1
        for (a, b), (p, q) in zip(pairwise(nodes), pairwise(marks), strict=True):
            out.append(replace(e, start=a, end=b, xy=line[p : q + 1]))
    return out


def _meeting(edges: list[Edge]) -> list[Edge]:
    """The ends of edges drawn to the place that they share, most where least was driven."""
    total: dict[int, Array] = defaultdict(lambda: np.zeros(3))
    for e in edges:
        for node, p in ((e.start, e.xy[0]), (e.end, e.xy[-1])):
            total[node] += (*(e.passes * p), e.passes)
    out = []
    for e in edges:
        first = (total[e.start][:2] / total[e.start][2]) - e.xy[0]
        last = (total[e.end][:2] / total[e.end][2]) - e.xy[-1]
        out.append(replace(e, xy=drawn(e.xy, first, last)))
    return out


def drawn(xy: Array, first: Array, last: Array) -> Array:
    """(n, 2) a line whose ends are moved, the more the nearer to them, over BLEND metres."""
    s = arc_length(xy)
    reach = max(min(BLEND, s[-1]), 1e-9)
    near, far = (np.clip(1 - d / reach, 0, 1) for d in (s, s[-1] - s))
    out: Array = xy + _eased(near)[:, None] * first + _eased(far)[:, None] * last
    return out


def _eased(share: Array) -> Array:
    """A step without corners."""
    out: Array = share**2 * (3 - 2 * share)
    return out
