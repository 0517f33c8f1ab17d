"""Edits: decided changes, and what a map is with them. What no edit names stays as it is.

A delete takes a whole element or a stretch of it, an insert adds one, a modify puts an element or
a stretch of it elsewhere. Edits of one element are made together on its old geometry, so that their
order does not matter; vertices outside the stretches keep their bits.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.polylines import arc_length, is_ring, length, project, resample_step
from rtmap_cli.maps.element import RING_CLASSES, Element, VectorMap

Array = NDArray[np.float64]

OFF = 2.0
"""A stretch to delete, on average farther (m) from its element, is not one of it …"""
ASIDE = 6.0
"""… nor is one to modify, whose new place may be this far (m) from the old one."""
REST = 1.0
"""Shorter pieces (m) that a stretch would leave at an end go with it."""
JOIN = 0.6
"""A modified stretch that ends farther (m) beside the rest of its line is a line of its own."""


@dataclass(frozen=True)
class Edit:
    """One change to make. ``points`` (n, 3) in the map frame, z NaN where unknown: the element to
    insert, the element or stretch to delete, or where a modified one lies now. The evidence of an
    insert becomes that of its element."""

    change_id: str
    kind: str
    class_name: str
    element_id: str | None
    points: Array
    log_odds: float = 0.0
    seen: int = 0
    in_view: int = 0
    traversals: int = 0
    first_seen_ns: int | None = None
    last_seen_ns: int | None = None
    runs: tuple[str, ...] = ()
    attributes: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Edited:
    """A map with edits, and the ids that it lost, gained or holds with other content."""

    vector_map: VectorMap
    deleted: tuple[str, ...]
    inserted: tuple[str, ...]
    modified: tuple[str, ...]


def apply_edits(vector_map: VectorMap, edits: Sequence[Edit], where: str | Path) -> Edited:
    """All edits made, or BadInput: an unknown element, another class, a stretch that is none of its
    element, two edits of one place, an id that is taken. ``where`` names the file in errors."""
    old = vector_map.by_id()
    by_element: dict[str, list[Edit]] = {}
    for edit in edits:
        if edit.kind == "insert":
            continue
        known = old.get(edit.element_id or "")
        if known is None:
            what = f"change {edit.change_id}: the map has no element {edit.element_id}"
            raise BadInput(where, what, "was it deleted, or is this another map?")
        if known.class_name != edit.class_name:
            what = f"change {edit.change_id}: {known.element_id} is a {known.class_name}"
            raise BadInput(where, f"{what}, not a {edit.class_name}")
        by_element.setdefault(known.element_id, []).append(edit)
    taken = set(old)
    out: list[Element] = []
    for element in vector_map:
        mine = by_element.get(element.element_id)
        if mine is None:
            out.append(element)
            continue
        parts = _edited(element, mine, where)
        for rank, part in enumerate(parts):
            name = _free(element.element_id, taken, rank) if rank else element.element_id
            out.append(replace(part, element_id=name))
    for edit in sorted((e for e in edits if e.kind == "insert"), key=lambda e: e.change_id):
        element = inserted_element(edit)
        if element.element_id in taken:
            what = f"change {edit.change_id}: the map has an element {element.element_id} already"
            raise BadInput(where, what, "was it applied before?")
        taken.add(element.element_id)
        out.append(element)
    out.sort(key=lambda e: e.element_id)
    new = VectorMap(out, vector_map.crs, vector_map.version)
    now = new.by_id()
    changed = [k for k in by_element if k in now]
    return Edited(
        new,
        tuple(sorted(k for k in old if k not in now)),
        tuple(sorted(k for k in now if k not in old)),
        tuple(sorted(changed)),
    )


def together(element: Element, edits: Sequence[Edit]) -> list[Edit]:
    """Of some edits of an element those that can be made together: each unless it overlaps one
    before it."""
    if element.class_name in RING_CLASSES:
        return list(edits[:1])
    line = _turned(element, edits) if is_ring(element.points) else element
    kept: list[_Cut] = []
    for cut in (_cut(line, edit) for edit in edits):
        if not any(_overlap(cut, k) for k in kept):
            kept.append(cut)
    return [cut.edit for cut in kept]


def inserted_element(edit: Edit) -> Element:
    """The element of an insert; its id comes from the change, so that it is the same every time."""
    name = edit.element_id
    if not name:
        digest = hashlib.sha256(edit.change_id.encode()).hexdigest()[:10]
        name = f"{edit.class_name}-{digest}"
    points = edit.points
    if edit.class_name in RING_CLASSES and not is_ring(points):
        points = np.concatenate([points, points[:1]])
    return Element(
        name,
        edit.class_name,
        points,
        None,
        edit.log_odds,
        edit.seen,
        edit.in_view,
        edit.traversals,
        edit.first_seen_ns,
        edit.last_seen_ns,
        dict(edit.attributes),
        edit.runs,
    )


def _free(stem: str, taken: set[str], rank: int) -> str:
    """``stem.rank``, or the next number that is free."""
    while f"{stem}.{rank}" in taken:
        rank += 1
    taken.add(f"{stem}.{rank}")
    return f"{stem}.{rank}"


# ---- one element


@dataclass(frozen=True)
class _Cut:
    """A stretch from ``start`` to ``stop`` (m along the element) and what comes in its place."""

    start: float
    stop: float
    edit: Edit


def _edited(element: Element, edits: Sequence[Edit], where: str | Path) -> list[Element]:
    """What remains of an element, its largest part first; empty when it goes."""
    if element.class_name in RING_CLASSES:
        if len(edits) > 1:
            what = f"changes {edits[0].change_id} and {edits[1].change_id} are both about"
            raise BadInput(where, f"{what} {element.element_id}", "accept one of them")
        _check_off(element, edits[0], where)
        return [] if edits[0].kind == "delete" else [element.with_points(_closed(edits[0].points))]
    line, cuts = _cuts(element, edits, where)
    table = _table(line)
    at = arc_length(table)
    pieces: list[Array] = []
    open_piece: Array | None = None
    here = 0.0
    for cut in [*cuts, None]:
        stop = at[-1] if cut is None else cut.start
        rest = _part(table, at, here, stop) if stop - here >= REST else None
        open_piece = _joined(open_piece, rest, pieces)
        if cut is not None:
            here = cut.stop
            if cut.edit.kind == "modify":
                new = np.full((len(cut.edit.points), table.shape[1]), np.nan)
                new[:, :3] = _like_old(cut.edit.points, table, at, cut)
                open_piece = _joined(open_piece, new, pieces)
            elif open_piece is not None:
                pieces.append(open_piece)
                open_piece = None
    if open_piece is not None:
        pieces.append(open_piece)
    pieces = _closed_again(element, pieces)
    pieces.sort(key=lambda p: -length(p))
    keep = element.covariance is not None
    return [line.with_points(p[:, :3], p[:, 3:] if keep else None) for p in pieces]


def _joined(piece: Array | None, onward: Array | None, pieces: list[Array]) -> Array | None:
    """The open piece with what follows it, if they meet; else it is put among ``pieces``."""
    if onward is None or piece is None:
        return onward if piece is None else piece
    gap = float(np.hypot(*(piece[-1, :2] - onward[0, :2])))
    if gap <= JOIN:
        return np.concatenate([piece, onward[1:] if gap < 1e-3 else onward])
    pieces.append(piece)
    return onward


def _closed_again(element: Element, pieces: list[Array]) -> list[Array]:
    """Pieces of a closed line joined over its start, which lies in none of the stretches."""
    if not is_ring(element.points) or not pieces:
        return pieces
    gap = float(np.hypot(*(pieces[-1][-1, :2] - pieces[0][0, :2])))
    if gap > JOIN:
        return pieces
    if len(pieces) == 1:
        return [pieces[0] if gap < 1e-6 else np.concatenate([pieces[0], pieces[0][:1]])]
    return [np.concatenate([pieces[-1], pieces[0][1:]]), *pieces[1:-1]]


def _table(element: Element) -> Array:
    """(n, 3 or 7) points and covariances side by side, to be interpolated together."""
    if element.covariance is None:
        return element.points
    return np.column_stack([element.points, element.covariance])


def _part(table: Array, at: Array, start: float, stop: float) -> Array:
    """The rows between two places, with interpolated ones at the cuts."""
    inside = (at > start + 1e-6) & (at < stop - 1e-6)
    ends = [
        table[k] if abs(at[k] - s) <= 1e-6 else _row(table, at, s)
        for s, k in ((s, int(np.abs(at - s).argmin())) for s in (start, stop))
    ]
    return np.concatenate([ends[0][None], table[inside], ends[1][None]])


def _row(table: Array, at: Array, s: float) -> Array:
    return np.array([np.interp(s, at, table[:, k]) for k in range(table.shape[1])])


def _like_old(points: Array, table: Array, at: Array, cut: _Cut) -> Array:
    """New points in the direction of the old line."""
    a, b = (_row(table[:, :2], at, s) for s in (cut.start, cut.stop))
    same = np.hypot(*(points[0, :2] - a)) + np.hypot(*(points[-1, :2] - b))
    other = np.hypot(*(points[-1, :2] - a)) + np.hypot(*(points[0, :2] - b))
    return points if same <= other else points[::-1]


def _closed(points: Array) -> Array:
    return points if is_ring(points) else np.concatenate([points, points[:1]])


def _check_off(element: Element, edit: Edit, where: str | Path) -> None:
    """BadInput when the geometry of an edit lies elsewhere than its element."""
    limit = OFF if edit.kind == "delete" else ASIDE
    off = float(project(resample_step(edit.points[:, :2], 0.5), element.xy)[1].mean())
    if off > limit:
        what = f"change {edit.change_id}: lies {off:.1f} m from its element {element.element_id}"
        raise BadInput(where, what, "is this the right map and version?")


def _cuts(element: Element, edits: Sequence[Edit], where: str | Path) -> tuple[Element, list[_Cut]]:
    """The stretches of some edits in order; a closed line begins where the first of them does."""
    for edit in edits:
        _check_off(element, edit, where)
    line = element
    if is_ring(element.points):
        line = _turned(element, edits)
    cuts = sorted((_cut(line, edit) for edit in edits), key=lambda c: (c.start, c.stop))
    for one, other in itertools.pairwise(cuts):
        if _overlap(one, other):
            what = f"changes {one.edit.change_id} and {other.edit.change_id} overlap on"
            raise BadInput(where, f"{what} {element.element_id}", "accept one of them")
    return line, cuts


def _overlap(one: _Cut, other: _Cut) -> bool:
    """Whether two stretches have more in common than is left over at ends."""
    first, second = sorted((one, other), key=lambda c: (c.start, c.stop))
    return second.start < first.stop - REST


def _turned(element: Element, edits: Sequence[Edit]) -> Element:
    """A closed line that begins at the vertex which is farthest from all the edits."""
    off = np.min([project(element.xy[:-1], _planar(e.points))[1] for e in edits], axis=0)
    start = int(off.argmax())
    order = np.r_[start : len(element.points) - 1, 0 : start + 1]
    covariance = None if element.covariance is None else element.covariance[order]
    return element.with_points(element.points[order], covariance)


def _planar(points: Array) -> Array:
    return np.asarray(points[:, :2], np.float64)


def _cut(line: Element, edit: Edit) -> _Cut:
    """Where the stretch of an edit lies on its line; ends nearer than ``REST`` are the line's."""
    points = resample_step(_planar(edit.points), 0.5)
    feet, _, segment = project(points, line.xy)
    at = arc_length(line.points)
    s = at[segment] + np.hypot(*(feet - line.xy[segment]).T)
    total = float(at[-1])
    if is_ring(edit.points):
        return _Cut(0.0, total, edit)
    start, stop = sorted((float(s[0]), float(s[-1])))
    return _Cut(0.0 if start < REST else start, total if stop > total - REST else stop, edit)
