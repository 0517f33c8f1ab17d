"""What somebody did to a map: elements moved, redrawn, tagged, added and deleted since its base."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.formats.lanelet2.tags import BOUNDS, LENGTH, NODE_TAGS, NODES, WAYS
from rtmap_cli.geometry.polylines import arc_length, is_ring, length, resample_step
from rtmap_cli.maps.element import Element, VectorMap

Array = NDArray[np.float64]

SHAPE_KEYS = frozenset({WAYS, NODES, LENGTH, NODE_TAGS, BOUNDS})
"""Attributes that say which nodes a line has: they follow from the lines, nobody edits them."""
OUTLINES = frozenset({"lanelet", "area"})
"""Classes that are the outline of other elements: they move with those."""
REDRAWN = (2.0, 0.1)
"""A line whose length changed by more than this (m, and this share) was redrawn, not moved."""
STEP = 1.0


@dataclass(frozen=True)
class Moved:
    """A line before and after, sample by sample: ``before``, ``after`` (n, 2 or 3)."""

    before: Array
    after: Array

    @property
    def shift(self) -> Array:
        """(n, 2) how far each sample moved, metres."""
        return np.asarray(self.after[:, :2] - self.before[:, :2])

    def at(self, points: Array, reach: float) -> tuple[Array, Array, NDArray[np.bool_]]:
        """For (m, 2) points: place on the old line, shift (m, 2), and which of them lie beside the
        old line (within ``reach`` metres, not beyond its ends)."""
        line = shapely.linestrings(self.before[:, :2])
        spot = shapely.points(points)
        s = np.asarray(shapely.line_locate_point(line, spot))
        feet = shapely.get_coordinates(shapely.line_interpolate_point(line, s))
        along = arc_length(self.before)
        shift = np.stack([np.interp(s, along, v) for v in self.shift.T], axis=1)
        off = points - feet
        beside = np.hypot(*off.T) <= reach
        for end, outward in ((0, self.before[0] - self.before[1]),
                             (-1, self.before[-1] - self.before[-2])):  # fmt: skip
            past = (points - self.before[end, :2]) @ outward[:2]
            at_end = s <= 1e-9 if end == 0 else s >= along[-1] - 1e-9
            size = max(float(np.hypot(*outward[:2])), 1e-9)
            beside &= ~(at_end & (past / size > reach / 2))
        return feet, shift, beside


@dataclass(frozen=True)
class Edit:
    """One element that was edited: ``before`` (None: added) and ``after`` (None: deleted), from
    file ``source``. ``moved``: its line, where it changed; None with ``redrawn`` for another one.
    ``tags``: attributes by name, before and after (None: absent)."""

    source: str
    element_id: str
    before: Element | None
    after: Element | None
    moved: Moved | None = None
    redrawn: bool = False
    tags: Mapping[str, tuple[str | None, str | None]] | None = None

    @property
    def shown(self) -> Element:
        """The element as it was edited, or as it was when it is gone."""
        found = self.after or self.before
        assert found is not None
        return found


def edits_between(
    base: VectorMap, edited: VectorMap, source: str, tolerance: float, partial: bool = False
) -> list[Edit]:
    """Edits from ``base`` to ``edited``, by element id; moves up to ``tolerance`` (m) are none.

    ``partial``: ``edited`` holds a part of the map, what it lacks was not deleted.
    """
    old, new = base.by_id(), edited.by_id()
    out = []
    for name in sorted(old.keys() | new.keys()):
        a, b = old.get(name), new.get(name)
        if a is None or b is None:
            if a is None or not partial:
                out.append(Edit(source, name, a, b))
        elif edit := _edit(source, a, b, tolerance):
            out.append(edit)
    return out


def _edit(source: str, a: Element, b: Element, tolerance: float) -> Edit | None:
    tags = {
        k: (a.attributes.get(k), b.attributes.get(k))
        for k in sorted(a.attributes.keys() | b.attributes.keys())
        if k not in SHAPE_KEYS and a.attributes.get(k) != b.attributes.get(k)
    }
    moved, redrawn = None, False
    if a.class_name not in OUTLINES:
        moved, redrawn = _shape(a, b, tolerance)
    if not tags and moved is None and not redrawn and a.class_name == b.class_name:
        return None
    return Edit(source, a.element_id, a, b, moved, redrawn, tags)


def _shape(a: Element, b: Element, tolerance: float) -> tuple[Moved | None, bool]:
    """How a line changed: (moved, redrawn); heights count where both are known."""
    p, q = a.points, b.points
    if len(p) == len(q) and a.ring == b.ring:
        pairs = [(p, q), (p, q[::-1])] if not a.ring else [(p, q)]
        if a.ring:
            pairs += [(p, _rolled(q, k, turn)) for turn in (1, -1) for k in range(len(q) - 1)]
        before, after = min(pairs, key=lambda x: float(_apart(*x).sum()))
    else:
        before, after = resample_step(p[:, :2], STEP), np.zeros(0)
        line = shapely.linestrings(q[:, :2])
        s = shapely.line_locate_point(line, shapely.points(before))
        after = shapely.get_coordinates(shapely.line_interpolate_point(line, s))
    change = abs(length(q) - length(p))
    if change > max(REDRAWN[0], REDRAWN[1] * length(p)) or is_ring(p) != is_ring(q):
        return None, True
    far = _apart(before, after).max() > tolerance
    if before.shape[1] == 3 and not far:
        rise = np.abs(after[:, 2] - before[:, 2])
        far = bool(np.nanmax(rise, initial=0.0) > tolerance)
    return (Moved(before, after), False) if far else (None, False)


def _rolled(ring: Array, k: int, turn: int) -> Array:
    """A ring that begins at vertex ``k``, forwards or backwards."""
    rows = np.roll(ring[:-1][::turn], -k, axis=0)
    return np.concatenate([rows, rows[:1]])


def _apart(a: Array, b: Array) -> Array:
    return np.asarray(np.hypot(*(a[:, :2] - b[:, :2]).T))
