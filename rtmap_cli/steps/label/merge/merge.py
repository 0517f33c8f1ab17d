"""Three-way merge of labels: base, edits of it, and labels that were generated anew.

Lines are merged by displacement: what the edit moved a place of the base line, the new line moves
there too. So it keeps its vertices, nodes and lanelets, and both changes count. A conflict is where
both sides changed the same thing in different ways.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.formats.lanelet2.source import source_of
from rtmap_cli.formats.lanelet2.tags import LENGTH, NODES, PREFIX, RELATION, WAYS
from rtmap_cli.geometry.polylines import length, resample_step
from rtmap_cli.maps.difference import displacement
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.steps.label.merge.edits import OUTLINES, Edit

Array = NDArray[np.float64]

REACH = 2.0
"""A new line within this (m) of the base line is the same line: labels of another drive are."""
SAME_SHARE = 0.6
"""… if this share of the shorter one lies there."""


@dataclass(frozen=True)
class Conflict:
    """What could not be brought together: the edit, why, and the new element if there is one."""

    edit: Edit
    why: str
    new: Element | None = None


@dataclass
class Merged:
    """The merged map, conflicts, and how many edits went in by kind."""

    vector_map: VectorMap
    conflicts: list[Conflict] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)


def merge_edits(
    base: VectorMap,
    edits: Sequence[Edit],
    new: VectorMap,
    tolerance: float,
    drift: float,
    prefer: str,
) -> Merged:
    """``new`` with the edits of ``base``; a conflict takes the side ``prefer`` (edited, new).

    All maps share one CRS. ``tolerance`` (m): smaller edits are none. ``drift`` (m): new lines
    that differ from the base by less are the same line seen again, and conflict with no edit.
    """
    merger = _Merger(base, new, tolerance, drift, prefer == "edited")
    for edit in _agreed(edits, merger.out.conflicts, tolerance):
        merger.take(edit)
    return merger.result()


def _agreed(edits: Sequence[Edit], conflicts: list[Conflict], tolerance: float) -> list[Edit]:
    """One edit per element: of several files that say the same the first, else a conflict."""
    first: dict[str, Edit] = {}
    for edit in edits:
        other = first.setdefault(edit.element_id, edit)
        if other is edit or _same_outcome(other, edit, tolerance):
            continue
        why = f"edited differently in {other.source} and {edit.source}; the first one counts"
        conflicts.append(Conflict(edit, why))
    return list(first.values())


def _same_outcome(a: Edit, b: Edit, tolerance: float) -> bool:
    if a.after is None or b.after is None:
        return a.after is b.after
    same = a.after.class_name == b.after.class_name and (a.tags or {}) == (b.tags or {})
    return same and displacement(a.after.points, b.after.points) <= tolerance


class _Merger:
    """The new elements by id, edited one by one."""

    def __init__(
        self, base: VectorMap, new: VectorMap, tolerance: float, drift: float, edited: bool
    ) -> None:
        self.base, self.tolerance, self.drift = base.by_id(), tolerance, drift
        self.edited = edited
        self.elements = new.by_id()
        self.out = Merged(new)
        self.placed: dict[int, list[Array]] = defaultdict(list)
        self.touched: set[str] = set()

    def take(self, edit: Edit) -> None:
        """Bring one edit into the new labels, or note why not."""
        if edit.before is None:
            self.insert(edit)
        elif edit.after is None:
            self.delete(edit)
        else:
            found = self.counterparts(edit.before)
            if not found:
                if edit.before.class_name in OUTLINES and not edit.tags:
                    return
                self.conflict(edit, "edited, but nothing like it is in the new labels")
                if self.edited and edit.before.class_name not in OUTLINES:
                    self.put(edit.after)
                return
            if edit.redrawn:
                self.redraw(edit, found)
            elif edit.moved is not None:
                self.move(edit, found)
            if edit.tags or edit.after.class_name != edit.before.class_name:
                self.tag(edit, found)

    def counterparts(self, before: Element) -> list[str]:
        """Ids of the new elements that are a base element: of its id, else where it lies."""
        same = self.elements.get(before.element_id)
        if same is not None and same.class_name == before.class_name:
            return [before.element_id]
        return [
            name
            for name, e in self.elements.items()
            if e.class_name == before.class_name
            and name not in self.base
            and _along(before, e) >= SAME_SHARE
        ]

    def conflict(self, edit: Edit, why: str, new: str | None = None) -> None:
        """Note what does not go together."""
        self.out.conflicts.append(Conflict(edit, why, self.elements.get(new or "")))

    def move(self, edit: Edit, found: Sequence[str]) -> None:
        """Move the vertices of the new lines as the edit moved the base line."""
        assert edit.moved is not None
        hit = False
        for name in found:
            element = self.elements[name]
            feet, shift, beside = edit.moved.at(element.xy, REACH if len(found) > 1 else np.inf)
            drawn = beside & (np.hypot(*shift.T) > self.tolerance)
            if not drawn.any():
                continue
            hit = True
            off = np.hypot(*(element.xy - feet).T)
            left = np.hypot(*(element.xy - feet - shift).T)
            if (left[drawn] <= self.tolerance).all():
                self.out.counts["already there"] += 1
                continue
            points = element.points.copy()
            if (off[drawn] > self.drift).any():
                far = float(off[drawn].max())
                why = f"moved by hand, and {far:.2f} m away from the base in the new labels"
                self.conflict(edit, why, name)
                if not self.edited:
                    continue
                # The hand's word: the line that was drawn, not a sum of both moves.
                points[drawn, :2] = (feet + shift)[drawn]
            else:
                points[drawn, :2] += shift[drawn]
            self.place(element, points, drawn)
            self.out.counts["moved"] += 1
        if not hit:
            self.heights(edit, found)

    def heights(self, edit: Edit, found: Sequence[str]) -> None:
        """An edit of heights alone: vertex by vertex where both have the same ones."""
        assert edit.before is not None and edit.after is not None
        for name in found:
            element = self.elements[name]
            if len(element.points) != len(edit.after.points):
                self.conflict(edit, "its heights were edited, its vertices are others now", name)
                continue
            points = element.points.copy()
            points[:, 2] = edit.after.points[:, 2]
            self.place(element, points, np.zeros(len(points), bool))
            self.out.counts["moved"] += 1

    def place(self, element: Element, points: Array, drawn: NDArray[np.bool_]) -> None:
        """Other places for the vertices of a new element; its nodes take other lines along."""
        covariance = element.covariance
        if covariance is not None:
            covariance = covariance.copy()
            covariance[drawn, :3] = np.nan
        nodes = source_of(element).nodes
        if len(nodes) == len(points):
            for k in np.flatnonzero((points != element.points).any(axis=1)).tolist():
                self.placed[nodes[k]].append(points[k])
        self.elements[element.element_id] = element.with_points(points, covariance)
        self.touched.add(element.element_id)

    def redraw(self, edit: Edit, found: Sequence[str]) -> None:
        """A line drawn anew replaces the new one."""
        assert edit.before is not None and edit.after is not None
        if len(found) > 1:
            self.conflict(edit, f"drawn anew, but {len(found)} new elements lie there", found[0])
            return
        element = self.elements[found[0]]
        if displacement(edit.after.points, element.points) <= self.tolerance:
            self.out.counts["already there"] += 1
            return
        if displacement(edit.before.points, element.points) > self.drift:
            self.conflict(edit, "drawn anew by hand, and another line in the new labels", found[0])
            if not self.edited:
                return
        self.elements[found[0]] = element.with_points(edit.after.points)
        self.out.counts["redrawn"] += 1

    def tag(self, edit: Edit, found: Sequence[str]) -> None:
        """Attributes and class, key by key."""
        assert edit.before is not None and edit.after is not None
        for name in found:
            element = self.elements[name]
            own = dict(element.attributes)
            for key, (was, now) in (edit.tags or {}).items():
                here = own.get(key)
                if here == now:
                    continue
                if here != was:
                    told = f"{key} is {now!r} by hand and {here!r} in the new labels"
                    self.conflict(edit, f"{told}, {was!r} before", name)
                    if not self.edited or key.startswith(PREFIX):
                        continue
                if now is None:
                    own.pop(key, None)
                else:
                    own[key] = now
            kind = element.class_name
            if edit.after.class_name != edit.before.class_name:
                kind = edit.after.class_name
            self.elements[name] = replace(element, attributes=own, class_name=kind)
            self.out.counts["tagged"] += 1

    def delete(self, edit: Edit) -> None:
        """Take an element out, unless it is another one by now."""
        assert edit.before is not None
        found = self.counterparts(edit.before)
        if not found:
            self.out.counts["already there"] += 1
        for name in found:
            element = self.elements[name]
            inner = _along(edit.before, element) < 1 and len(found) > 1
            apart = displacement(edit.before.points, element.points)
            if inner or (apart > self.drift and edit.before.class_name not in OUTLINES):
                self.conflict(edit, "deleted by hand, and another line in the new labels", name)
                if not self.edited or inner:
                    continue
            del self.elements[name]
            self.out.counts["deleted"] += 1

    def insert(self, edit: Edit) -> None:
        """Add an element, unless the new labels have it."""
        assert edit.after is not None
        for element in self.elements.values():
            alike = element.class_name == edit.after.class_name
            if not alike or element.element_id in self.base:
                continue
            if displacement(edit.after.points, element.points) <= self.drift:
                self.out.counts["already there"] += 1
                return
        taken = self.elements.get(edit.element_id)
        if taken is not None and taken.element_id not in self.base:
            self.conflict(
                edit, "added by hand under an id that the new labels use", taken.element_id
            )
            if not self.edited:
                return
        self.put(edit.after)
        self.out.counts["inserted"] += 1

    def put(self, element: Element) -> None:
        """Add an element under a free id; ids of ways and relations that are taken are dropped."""
        name = element.element_id
        while name in self.elements:
            name += "-edited"
        own = dict(element.attributes)
        used = {(k, e.attributes[k]) for e in self.elements.values() for k in (RELATION, WAYS)
                if k in e.attributes}  # fmt: skip
        if any((k, own.get(k)) in used for k in (RELATION, WAYS)):
            own = {k: v for k, v in own.items() if not k.startswith(PREFIX)}
        self.elements[name] = replace(element, element_id=name, attributes=own)

    def result(self) -> Merged:
        """Nodes that moved take along whatever else uses them."""
        moved = {n: np.mean(rows, axis=0) for n, rows in self.placed.items()}
        for name, element in self.elements.items():
            if moved and NODES in element.attributes:
                self.elements[name] = self.follow(element, moved)
        self.out.vector_map = VectorMap(
            self.elements.values(), self.out.vector_map.crs, self.out.vector_map.version
        )
        return self.out

    def follow(self, element: Element, moved: dict[int, Array]) -> Element:
        """An element with its nodes where they lie now."""
        source = source_of(element)
        rows = [k for k, n in enumerate(source.nodes) if n in moved]
        if not rows or len(source.nodes) != len(element.points):
            return element
        fitted = source.fits or element.element_id in self.touched
        points = source.points.copy()
        turned = not np.array_equal(points, element.points, equal_nan=True)
        for k in rows:
            points[k] = moved[source.nodes[k]]
        own = dict(element.attributes)
        if fitted:
            own[LENGTH] = f"{length(points):.3f}"
        if turned:
            points = points[::-1]
        return replace(element, points=points, attributes=own)


def _along(a: Element, b: Element) -> float:
    """Which share of the shorter line lies within ``REACH`` of the other one."""
    first, second = sorted((a.xy, b.xy), key=length)
    samples = resample_step(first, 1.0)
    near = shapely.distance(shapely.points(samples), shapely.linestrings(second)) <= REACH
    return float(np.mean(near))
