"""Borders of lanes: a width to each side of the centre line, meeting at the nodes of the graph."""

from __future__ import annotations

import csv
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.polylines import normals
from rtmap_cli.steps.label.lanes.graph import Edge, LaneGraph, drawn

Array = NDArray[np.float64]
Bool = NDArray[np.bool_]

CALTRANS = 3.048
"""Metres from the centre line to each side: 10 ft, lanes of the Highway Design Manual with room."""
COLUMNS = ("x", "y", "radius", "left", "right")
EVERY = 2
"""Samples of the centre line per vertex of a border."""
SAME = 0.3
"""Metres by which places of one line differ at most."""
MOVED = 0.1
"""Metres by which a node may draw a border aside that still counts as seen there."""
KINDS = ("width", "paint", "curb")
"""What a border's place was taken from."""


@dataclass
class Sides:
    """Metres to the left and right (n, 2) of the samples of an edge, and KINDS codes (n, 2)."""

    metres: Array
    kind: NDArray[np.int8]


@dataclass(frozen=True)
class Borders:
    """Left and right border of an edge: lines (m, 2), and KINDS codes of their vertices (m,)."""

    lines: tuple[Array, Array]
    kinds: tuple[NDArray[np.int8], NDArray[np.int8]]


@dataclass(frozen=True)
class Widths:
    """Metres to each side: ``both`` everywhere but near ``places`` (k, 2), within ``radius`` (k,)
    of which ``sides`` (k, 2) hold, left and right; the nearest place counts."""

    both: float = CALTRANS
    places: Array | None = None
    radius: Array | None = None
    sides: Array | None = None

    def at(self, xy: Array) -> Array:
        """(n, 2) metres to the left and right of places (n, 2)."""
        out = np.full((len(xy), 2), self.both)
        if self.places is None or self.radius is None or self.sides is None:
            return out
        d = np.hypot(*np.moveaxis(xy[:, None] - self.places, -1, 0))
        d[d > self.radius] = np.inf
        best = d.argmin(axis=1)
        near = np.isfinite(d[np.arange(len(xy)), best])
        out[near] = self.sides[best[near]]
        return out


def read_widths(path: Path, both: float) -> Widths:
    """Widths of stretches from a CSV with columns x, y, radius, left, right (map frame, metres)."""
    if not path.is_file():
        raise BadInput(path, "no such file")
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    try:
        values = np.array([[float(r[c]) for c in COLUMNS] for r in rows], np.float64)
    except (KeyError, TypeError, ValueError):
        raise BadInput(path, f"is no table of numbers {','.join(COLUMNS)}") from None
    values = values.reshape(-1, len(COLUMNS))
    if not np.isfinite(values).all() or (values[:, 2:] <= 0).any():
        raise BadInput(path, "radius, left and right are metres above 0")
    return Widths(both, values[:, :2], values[:, 2], values[:, 3:])


def sides_of(graph: LaneGraph, widths: Widths) -> list[Sides]:
    """The widths at every sample of every edge."""
    return [
        Sides(widths.at(e.xy), np.zeros((len(e.xy), 2), np.int8)) for e in graph.edges
    ]  # fmt: skip


def borders_of(graph: LaneGraph, sides: list[Sides]) -> list[Borders]:
    """The borders of every edge; edges that share a node share the vertices there."""
    shared = _at_nodes(graph, sides)
    return [_borders(e, s, shared) for e, s in zip(graph.edges, sides, strict=True)]


def _at_nodes(graph: LaneGraph, sides: list[Sides]) -> dict[int, Array]:
    """(2, 2) left and right vertex at every node: square to the mean direction.

    What was seen counts before what was assumed; where edges saw different lines, the nearest one.
    """
    found: dict[int, list[tuple[Array, NDArray[np.int8]]]] = defaultdict(list)
    place: dict[int, Array] = {}
    for e, s in zip(graph.edges, sides, strict=True):
        for node, k in ((e.start, 0), (e.end, -1)):
            found[node].append((s.metres[k], s.kind[k]))
            place[node] = e.xy[k]
    out = {}
    for node, parts in found.items():
        heading = graph.heading(node)
        left = np.array([-heading[1], heading[0]])
        metres, kind = (np.array(x) for x in zip(*parts, strict=True))
        known = np.where((kind > 0).any(axis=0), kind > 0, True)
        known &= metres <= np.where(known, metres, np.inf).min(axis=0) + SAME
        mean = (metres * known).sum(axis=0) / known.sum(axis=0)
        out[node] = np.stack([place[node] + mean[0] * left, place[node] - mean[1] * left])
    return out


def _borders(e: Edge, s: Sides, shared: dict[int, Array]) -> Borders:
    normal = normals(e.xy)
    lines, kinds = [], []
    for side, sign in enumerate((1.0, -1.0)):
        line = e.xy + sign * s.metres[:, side, None] * normal
        first, last = shared[e.start][side] - line[0], shared[e.end][side] - line[-1]
        there = line
        line = drawn(line, first, last)
        aside = np.abs(((line - there) * normal).sum(axis=1))
        keep = _thinned(_forwards(line, e.xy))
        lines.append(line[keep])
        kinds.append(np.where(aside > MOVED, 0, s.kind[:, side])[keep].astype(np.int8))
        lines[-1][0], lines[-1][-1] = shared[e.start][side], shared[e.end][side]
    return Borders((lines[0], lines[1]), (kinds[0], kinds[1]))


def _forwards(line: Array, centre: Array) -> NDArray[np.int64]:
    """Vertices that go forwards: inside of a tight curve an offset turns back over itself."""
    direction = np.gradient(centre, axis=0)
    keep = [0]
    for k in range(1, len(line) - 1):
        if (line[k] - line[keep[-1]]) @ direction[k] > 0.05 * float(np.hypot(*direction[k])):
            keep.append(k)
    while len(keep) > 1 and (line[-1] - line[keep[-1]]) @ direction[-1] <= 0:
        keep.pop()
    return np.array([*keep, len(line) - 1], np.int64)


def _thinned(keep: NDArray[np.int64]) -> NDArray[np.int64]:
    """Every second vertex, both ends kept."""
    return np.unique(np.concatenate([keep[::EVERY], keep[-1:]]))
