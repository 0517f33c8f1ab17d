"""Where the nodes of an export lie: elements that share a node may have moved apart."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.formats.lanelet2.numbers import Numbers

Array = NDArray[np.float64]

TOGETHER = 1.0
"""Metres within which elements that share a node still meet there: they do so in their middle."""
SAME = 1e-6
MIDDLE = "nodes where lines had moved apart a little set to their middle"
SPLIT = "nodes split because their lines had moved apart"


class Nodes:
    """Positions of nodes by id, told by the elements that use them.

    ``rank`` 0 counts first: lines and crossings that rtmap keeps, then other lines, then outlines,
    which are the borders of something else. Among equals the mean counts, or, farther apart than
    ``TOGETHER``, the first one; the others then get nodes of their own.
    """

    def __init__(self, taken: set[int], notes: Counter[str]) -> None:
        self.numbers, self.notes = Numbers(taken), notes
        self.points: dict[int, Array] = {}
        self._told: dict[int, list[tuple[int, str, Array]]] = defaultdict(list)
        self._apart: dict[tuple[str, int], int] = {}

    def tell(self, rank: int, element_id: str, nodes: Sequence[int], points: Array) -> None:
        """``points`` (n, 3) of an element at its ``nodes``."""
        for node, point in dict(zip(nodes, points, strict=True)).items():
            self._told[node].append((rank, element_id, point))

    def settle(self) -> None:
        """Decide where every node lies, by all that was told so far."""
        self._apart.clear()
        self.notes.pop(MIDDLE, None)
        self.notes.pop(SPLIT, None)
        for node, told in self._told.items():
            best = min(rank for rank, _, _ in told)
            rows = sorted((name, i) for i, (rank, name, _) in enumerate(told) if rank == best)
            points = np.stack([told[i][2] for _, i in rows])
            off = np.hypot(*(points[:, :2] - points[0, :2]).T)
            together = points[off <= TOGETHER]
            if off.max() <= SAME:
                self.points[node] = points[0]
                continue
            known = np.isfinite(together[:, 2])
            height = together[known, 2].mean() if known.any() else np.nan
            self.points[node] = np.array([*together[:, :2].mean(axis=0), height])
            self.notes[MIDDLE] += 1
            for (name, i), far in zip(rows, off > TOGETHER, strict=True):
                if far:
                    self._apart[name, node] = self.new(f"{name}/{node}", told[i][2])
                    self.notes[SPLIT] += 1

    def of(self, element_id: str, nodes: Sequence[int]) -> list[int]:
        """The nodes of an element, with those that it has for itself by now."""
        return [self._apart.get((element_id, n), n) for n in nodes]

    def new(self, name: str, point: Array) -> int:
        """A node for a point that had none."""
        node = self.numbers.of(f"node {name}")
        self.points[node] = np.asarray(point, np.float64)
        return node

    def line(self, element_id: str, points: Array, ring: bool) -> list[int]:
        """New nodes for a line; a ring ends in its first one."""
        rows = points[:-1] if ring else points
        nodes = [self.new(f"{element_id}/{k}", p) for k, p in enumerate(rows)]
        return nodes + nodes[:1] if ring else nodes
