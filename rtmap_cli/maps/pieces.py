"""Pieces of elements: cut where lines have a stretch in common with others, cut ends put onto the
ends of these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import arc_length, length, tangents
from rtmap_cli.maps.element import Element
from rtmap_cli.maps.existence import runs_of

Array = NDArray[np.float64]

GAP = 3.0
"""Shorter stretches (m) between two that are the same are the same, too; ends within that meet."""
SHORTEST = 1.0
"""Shorter pieces (m) that a cut would leave are dropped."""
STEP = 0.5
"""A vertex so near (m) to the end that its line is put onto is left out."""


def free_id(name: str, taken: set[str]) -> str:
    """The id, with a number behind it where it is taken."""
    free, k = name, 0
    while free in taken:
        k += 1
        free = f"{name}.{k}"
    return free


def with_covariance(element: Element) -> Array:
    """(n, 3 or 7) points and covariances side by side, to be cut and interpolated together."""
    if element.covariance is None:
        return element.points
    return np.column_stack([element.points, element.covariance])


def parts_of(element: Element, pieces: Sequence[Any]) -> list[Element]:
    """Elements of pieces (n, 3 or 7) of one; the longest keeps the id."""
    pieces = [p for p in pieces if len(p) > 1 and length(p) >= SHORTEST]
    rank = np.argsort([-length(p) for p in pieces], kind="stable")
    name = element.element_id
    out = []
    for k, p in enumerate(pieces):
        place = int(np.flatnonzero(rank == k)[0])
        out.append(
            replace(
                element,
                element_id=f"{name}.{place}" if place else name,
                points=p[:, :3],
                covariance=p[:, 3:] if p.shape[1] > 3 else None,
            )
        )
    return out


def left_over(element: Element, same: NDArray[np.bool_]) -> list[tuple[Array, bool, bool]]:
    """The stretches (n, 3 or 7) that are not in common, and whether each was cut at its start and
    at its end."""
    table = with_covariance(element)
    at = arc_length(table)
    places = np.linspace(0.0, at[-1], len(same))
    pieces = []
    for run in runs_of(~same):
        a, b = places[run[0]], places[run[-1]]
        if b - a < GAP:
            continue
        inside = (at > a + 1e-9) & (at < b - 1e-9)
        first, last = (
            np.array([np.interp(x, at, table[:, k]) for k in range(table.shape[1])]) for x in (a, b)
        )
        piece = np.concatenate([first[None], table[inside], last[None]])
        pieces.append((piece, bool(run[0] > 0), bool(run[-1] < len(same) - 1)))
    return pieces


def own_ends(
    cuts: Sequence[tuple[int, int]], pieces: Sequence[Array], ends: Array
) -> list[tuple[tuple[int, int], Array]]:
    """Of every cut (piece, 0 or -1) the end (3,) that it is put onto, if one is near: each an end
    of its own where there are as many, so that lines a foot apart keep their order."""
    if not len(ends) or not cuts:
        return []
    from scipy.optimize import linear_sum_assignment

    place = np.array([pieces[k][at, :2] for k, at in cuts])
    beside = np.array([tangents(pieces[k][:, :2])[at] for k, at in cuts])[:, ::-1] * [-1.0, 1.0]
    apart = ends[None, :, :2] - place[:, None]
    far = np.hypot(apart[..., 0], apart[..., 1])
    # Along the line a cut lies where stations happen to be: what counts is how far beside.
    cost = (apart * beside[:, None]).sum(axis=-1) ** 2 + 0.01 * far**2
    cost[far > GAP] = 1e6
    own = dict(zip(*linear_sum_assignment(cost), strict=True))
    out = []
    for k, cut in enumerate(cuts):
        j = own.get(k)
        j = int(far[k].argmin()) if j is None or far[k, j] > GAP else j
        if far[k, j] <= GAP:
            out.append((cut, ends[j]))
    return out


def put_onto(piece: Array, end: Array) -> Array:
    """The piece beginning exactly at an end (3,)."""
    along = arc_length(piece)
    ahead = np.array([np.interp(2 * GAP, along, piece[:, k]) for k in (0, 1)]) - piece[0, :2]
    # Vertices that lie behind that end would make the line turn back.
    step = piece[1:, :2] - end[:2]
    onward = (step @ ahead > 0) & (np.hypot(*step.T) > STEP) | (along[1:] > 2 * GAP)
    start = int(np.argmax(onward)) + 1 if onward.any() else len(piece) - 1
    head = piece[:1].copy()
    head[0, :3] = end
    return np.concatenate([head, piece[start:]])
