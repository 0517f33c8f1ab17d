"""What differs between two maps, element by element."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.maps.element import Element, VectorMap

Array = NDArray[np.float64]

KINDS = ("added", "removed", "modified", "updated")
"""``modified``: other geometry, class or attributes; ``updated``: only other evidence."""

TOLERANCE = 1e-3
"""Metres below which geometry counts as the same."""


@dataclass(frozen=True)
class Difference:
    """One element that differs. ``displacement`` is in metres, NaN where one side is missing."""

    kind: str
    element_id: str
    class_name: str
    displacement: float
    fields: tuple[str, ...]
    before: Element | None
    after: Element | None

    @property
    def shown(self) -> Element:
        """The element as it is, or as it was when it is gone."""
        found = self.after or self.before
        assert found is not None
        return found


def displacement(before: Array, after: Array) -> float:
    """How far the vertices of a line moved at most, metres, planar.

    Vertex by vertex where both have as many; else the largest distance of a vertex of one to the
    line of the other, both ways.
    """
    if len(before) == len(after):
        return float(np.hypot(*(after[:, :2] - before[:, :2]).T).max())
    import shapely

    lines = [shapely.linestrings(p[:, :2]) for p in (before, after)]
    points = [shapely.points(p[:, :2]) for p in (before, after)]
    there = shapely.distance(points[0], lines[1]).max()
    return float(max(there, shapely.distance(points[1], lines[0]).max()))


def _same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.shape == b.shape and bool(np.array_equal(a, b, equal_nan=True))
    return type(a) is type(b) and bool(a == b)


def _compare(old: Element, new: Element, tolerance: float) -> Difference | None:
    moved = displacement(old.points, new.points)
    fields = [n for n in old.__dataclass_fields__ if not _same(getattr(old, n), getattr(new, n))]
    heights = len(old.points) != len(new.points) or not np.allclose(
        old.points[:, 2], new.points[:, 2], rtol=0, atol=tolerance, equal_nan=True
    )
    if "points" in fields and moved <= tolerance and not heights:
        fields.remove("points")
    if not fields:
        return None
    kind = "modified" if {"points", "class_name", "attributes"} & set(fields) else "updated"
    return Difference(kind, new.element_id, new.class_name, moved, tuple(fields), old, new)


def compare_maps(
    before: VectorMap, after: VectorMap, tolerance: float = TOLERANCE
) -> list[Difference]:
    """Elements that differ, by kind, then id. Both maps must share their CRS."""
    old, new = before.by_id(), after.by_id()
    out = []
    for element_id in sorted(old.keys() | new.keys()):
        a, b = old.get(element_id), new.get(element_id)
        if a is None and b is not None:
            out.append(Difference("added", element_id, b.class_name, np.nan, (), None, b))
        elif b is None and a is not None:
            out.append(Difference("removed", element_id, a.class_name, np.nan, (), a, None))
        elif a is not None and b is not None and (found := _compare(a, b, tolerance)):
            out.append(found)
    return sorted(out, key=lambda d: (KINDS.index(d.kind), d.element_id))


def count_kinds(differences: list[Difference]) -> dict[str, int]:
    """How many elements of each kind."""
    counts = Counter(d.kind for d in differences)
    return {kind: counts[kind] for kind in KINDS}
