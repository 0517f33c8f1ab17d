"""What is left of a chain of ways after a line was cut: the ways that are still whole in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.formats.lanelet2.nodes import TOGETHER

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Piece:
    """The vertices ``start`` … ``stop`` (both in it) of a line: way ``way`` with its ``nodes`` in
    the order of the line, or None for what was part of a way."""

    start: int
    stop: int
    way: int | None = None
    nodes: tuple[int, ...] = ()


def pieces_of(
    points: Array, ways: Sequence[tuple[int, Sequence[int]]], known: Mapping[int, Array]
) -> list[Piece]:
    """A line (n, 2 or 3) as whole ways and what lies between them.

    ``ways``: ids and nodes in the order of the line. A way is whole where vertex after vertex lies
    within ``TOGETHER`` metres of a node whose place is ``known``.
    """
    out: list[Piece] = []
    at = 0
    for number, nodes in ways:
        if not all(n in known for n in nodes):
            continue
        places = np.stack([known[n][:2] for n in nodes])
        start = int(np.hypot(*(points[:, :2] - places[0]).T).argmin())
        stop = start + len(nodes) - 1
        if start < at or stop >= len(points):
            continue
        if np.hypot(*(points[start : stop + 1, :2] - places).T).max() > TOGETHER:
            continue
        if start > at:
            out.append(Piece(at, start))
        out.append(Piece(start, stop, number, tuple(nodes)))
        at = stop
    if at < len(points) - 1:
        out.append(Piece(at, len(points) - 1))
    return out
