"""Skeletons of sparse masks, and the polylines of their graphs.

Thinning after Zhang and Suen, "A fast parallel algorithm for thinning digital patterns" (1984), on
lists of cells in place of images. Cells of the skeleton become a graph; its branches become
polylines, short spurs go, and at a junction the two branches that go on straight are one line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.blocks import AROUND, find, pack, unpack
from rtmap_cli.geometry.polylines import length

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

REACH = 3.0
"""Metres over which the direction of a branch at a junction is measured."""


def neighbours(keys: Int) -> Int:
    """(n, 8) places of the eight neighbours (clockwise from the upper left) of the cells with
    sorted packed ``keys``; n where there is none."""
    cells = unpack(keys)
    out = np.stack([find(keys, pack(cells + step)) for step in AROUND], axis=-1)
    return np.where(out < 0, len(keys), out)


def _tables() -> tuple[Bool, Bool]:
    """(2, 256) by the code of the neighbours, whether each of the two passes takes a cell."""
    bits = ((np.arange(256)[:, None] >> np.arange(8)) & 1).astype(bool)
    # Zhang and Suen begin above the cell: p2 … p9.
    p = np.roll(bits, -1, axis=1)
    count = p.sum(axis=1)
    turns = (~p & np.roll(p, -1, axis=1)).sum(axis=1)
    both = (count >= 2) & (count <= 6) & (turns == 1)
    up, right, down, left = p[:, 0], p[:, 2], p[:, 4], p[:, 6]
    first = both & ~(up & right & down) & ~(right & down & left)
    second = both & ~(up & right & left) & ~(up & down & left)
    return first, second


def thin(cells: Int) -> Int:
    """The skeleton (k, 2) of a mask, given as its cells (n, 2): lines one cell wide that are
    connected as the mask is."""
    keys = np.unique(pack(cells))
    around = neighbours(keys)
    alive = np.append(np.ones(len(keys), bool), False)
    power = 1 << np.arange(8)
    tables = _tables()
    here = np.arange(len(keys))
    while True:
        gone = 0
        for table in tables:
            code = (alive[around[here]] * power).sum(axis=1)
            drop = here[table[code]]
            alive[drop] = False
            gone += len(drop)
            here = here[alive[here]]
        if not gone:
            return unpack(keys[here])


@dataclass
class _Branch:
    """A chain of cells between two nodes (−1: a free end); rings have neither."""

    path: list[int]
    start: int
    stop: int


def trace(cells: Int, cell: float, spur: float, angle: float) -> list[Array]:
    """Polylines (n, 2), metres, of a skeleton's cells (k, 2), rings closed.

    Spurs shorter than ``spur`` metres at a junction are dropped; there the branches that go on
    within ``angle`` (rad) are joined, the straightest first; others end on them.
    """
    keys = np.unique(pack(cells))
    if not len(keys):
        return []
    xy = np.asarray((unpack(keys) + 0.5) * cell, np.float64)
    links = _links(keys)
    degree = np.array([len(x) for x in links])
    node = _nodes(links, degree)
    branches = _branches(links, degree, node)
    for _ in range(3):
        kept = [b for b in branches if not _is_spur(b, xy, spur)]
        if len(kept) == len(branches):
            break
        branches = kept
    return _lines(branches, xy, node, angle)


def _links(keys: Int) -> list[list[int]]:
    """Neighbours of each cell; not over a corner where a cell beside it leads there too."""
    around = neighbours(keys)
    there = around < len(keys)
    # Even ones are diagonal; beside a diagonal lie the one before and the one after it.
    for k in (0, 2, 4, 6):
        there[:, k] &= ~(there[:, k - 1] | there[:, k + 1])
    return [row[ok].tolist() for row, ok in zip(around, there, strict=True)]


def _nodes(links: list[list[int]], degree: Int) -> Int:
    """(n,) number of the junction that a cell belongs to, −1 for others."""
    node = np.full(len(links), -1)
    count = 0
    for seed in np.flatnonzero(degree > 2).tolist():
        if node[seed] >= 0:
            continue
        stack = [seed]
        node[seed] = count
        while stack:
            for k in links[stack.pop()]:
                if degree[k] > 2 and node[k] < 0:
                    node[k] = count
                    stack.append(k)
        count += 1
    return node


def _branches(links: list[list[int]], degree: Int, node: Int) -> list[_Branch]:
    """All chains between nodes and free ends, then the rings without any."""
    used = np.zeros(len(links), bool)
    out = []

    def walk(start: int, onward: int) -> list[int]:
        path = [start, onward]
        while node[path[-1]] < 0 and degree[path[-1]] == 2:
            used[path[-1]] = True
            ahead = [k for k in links[path[-1]] if k != path[-2]]
            if not ahead or ahead[0] == start:
                return [*path, start] if ahead else path
            path.append(ahead[0])
        used[path[-1]] |= node[path[-1]] < 0
        return path

    for start in np.flatnonzero((node >= 0) | (degree == 1)).tolist():
        if node[start] < 0 and used[start]:
            continue
        used[start] |= node[start] < 0
        for onward in links[start]:
            inner = node[start] >= 0 and node[onward] == node[start]
            if inner or (node[onward] < 0 and used[onward]):
                continue
            if node[start] >= 0 and node[onward] >= 0 and onward < start:
                continue
            path = walk(start, onward)
            out.append(_Branch(path, int(node[path[0]]), int(node[path[-1]])))
    for start in np.flatnonzero(~used & (degree == 2) & (node < 0)).tolist():
        if not used[start]:
            used[start] = True
            path = walk(start, links[start][0])
            out.append(_Branch(path, -1, -1))
    return out


def _is_spur(branch: _Branch, xy: Array, spur: float) -> bool:
    """A short chain from a junction into nothing."""
    free = (branch.start < 0) != (branch.stop < 0)
    return free and length(xy[branch.path]) < spur


def _lines(branches: list[_Branch], xy: Array, node: Int, angle: float) -> list[Array]:
    """Branches as polylines, joined at their junctions."""
    middle = {int(k): xy[node == k].mean(axis=0) for k in np.unique(node[node >= 0])}
    lines: list[Array] = []
    ends: dict[int, list[tuple[int, int]]] = {}
    for b in branches:
        points = xy[b.path].copy()
        for at, name in ((0, b.start), (-1, b.stop)):
            if name >= 0:
                points[at] = middle[name]
                ends.setdefault(name, []).append((len(lines), at))
        lines.append(points)
    partner: dict[tuple[int, int], tuple[int, int]] = {}
    for group in ends.values():
        partner |= _pairs(group, lines, angle)
    return _chained(lines, partner)


def _pairs(
    group: list[tuple[int, int]], lines: list[Array], angle: float
) -> dict[tuple[int, int], tuple[int, int]]:
    """Which ends at a junction go on in each other."""
    way = {end: _outward(lines[end[0]], end[1]) for end in group}
    scored = sorted(
        (float(way[p] @ way[q]), p, q) for i, p in enumerate(group) for q in group[i + 1 :]
    )
    out: dict[tuple[int, int], tuple[int, int]] = {}
    for cosine, p, q in scored:
        # Two that are left of a junction are one line, whatever they do.
        if (cosine <= -np.cos(angle) or len(group) == 2) and p not in out and q not in out:
            out[p], out[q] = q, p
    return out


def _outward(line: Array, at: int) -> Array:
    """Unit vector from an end of a line into it, over ``REACH`` metres."""
    points = line if at == 0 else line[::-1]
    far = np.hypot(*(points - points[0]).T)
    k = int(np.argmax(far >= REACH)) if (far >= REACH).any() else len(points) - 1
    d = points[k] - points[0]
    return d / max(float(np.hypot(*d)), 1e-9)


def _chained(lines: list[Array], partner: dict[tuple[int, int], tuple[int, int]]) -> list[Array]:
    """Lines put together over the pairs of their ends."""
    used: set[int] = set()
    out = []
    starts = [(k, at) for k in range(len(lines)) for at in (0, -1) if (k, at) not in partner]
    starts += [(k, 0) for k in range(len(lines))]
    for end in starts:
        if end[0] in used:
            continue
        chain: list[Array] = []
        here: tuple[int, int] | None = end
        while here is not None and here[0] not in used:
            used.add(here[0])
            points = lines[here[0]] if here[1] == 0 else lines[here[0]][::-1]
            chain.append(points if not chain else points[1:])
            here = partner.get((here[0], -1 if here[1] == 0 else 0))
        out.append(np.concatenate(chain))
    return out
