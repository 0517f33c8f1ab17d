"""Changes of the world: elements deleted, inserted or moved, with what is true about them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rtmap_cli.errors import NoAnswer, UsageError
from rtmap_cli.geometry.polylines import arc_length, is_ring, length, normals, resample, tangents
from rtmap_cli.geometry.rings import polygon
from rtmap_cli.maps.crs import to_lonlat
from rtmap_cli.maps.element import CLASSES, RING_CLASSES, Element, VectorMap
from rtmap_cli.steps.simulate.worlds.world import even_odd_surface

Array = NDArray[np.float64]

KINDS = ("delete", "insert", "move")
SEEN_FROM = 14.0
"""A change near a path has its middle within this distance of it, metres."""
APART = 12.0
"""Distance between the middles of two changes, metres."""
MIN_REST = 3.0
"""What is left of a line on either side of a deleted stretch, if it is longer than this (m)."""


@dataclass(frozen=True)
class ChangeSpec:
    """``count`` changes of one kind and class."""

    kind: str
    class_name: str
    count: int = 1

    def inverse(self) -> ChangeSpec:
        """The change that undoes it (a move stays a move)."""
        opposite = {"delete": "insert", "insert": "delete", "move": "move"}
        return replace(self, kind=opposite[self.kind])


@dataclass(frozen=True)
class Change:
    """One true change, prior → world: ``kind`` delete or insert; ``points`` (n, 2) map frame.

    ``element_id`` is the id in the map that holds the element; the two halves of a move share
    ``moved``.
    """

    element_id: str
    kind: str
    class_name: str
    points: Array
    moved: str | None = None

    def flipped(self) -> Change:
        """The same change seen from the other map."""
        return replace(self, kind="insert" if self.kind == "delete" else "delete")

    def as_json(self, crs: str) -> dict[str, Any]:
        """The change as truth files hold it; geometry in WGS84, ``length_m`` along the line."""
        lonlat = np.round(to_lonlat(crs, self.points), 8).tolist()
        ring = self.class_name in RING_CLASSES
        geometry = {
            "type": "Polygon" if ring else "LineString",
            "coordinates": [lonlat] if ring else lonlat,
        }
        out: dict[str, Any] = {
            "element_id": self.element_id,
            "kind": self.kind,
            "class": self.class_name,
            "geometry": geometry,
            "length_m": round(float(arc_length(self.points)[-1]), 3),
        }
        if self.moved is not None:
            out["moved"] = self.moved
        return out


def truth_json(
    changes: Sequence[Change], crs: str, delineators: Sequence[Array] = ()
) -> dict[str, Any]:
    """The truth file: ``{"crs", "changes": […]}``, kinds seen from the outdated map; of works also
    the rows of ``delineators`` (n, 2)."""
    told: dict[str, Any] = {"crs": crs, "changes": [c.as_json(crs) for c in changes]}
    if delineators:
        told["delineators"] = [np.round(to_lonlat(crs, row), 8).tolist() for row in delineators]
    return told


def parse_spec(text: str) -> ChangeSpec:
    """``delete:ped_crossing``, ``insert:divider*2``, ``move:divider``; UsageError otherwise."""
    found = re.fullmatch(r"(\w+):(\w+)(?:\*(\d+))?", text.strip())
    if not found:
        raise UsageError(f"--change {text}: write KIND:CLASS or KIND:CLASS*COUNT")
    kind, name, count = found[1], found[2], int(found[3] or 1)
    if kind not in KINDS:
        raise UsageError(f"--change {text}: {kind} is no change, known are {', '.join(KINDS)}")
    if name not in CLASSES:
        raise UsageError(f"--change {text}: {name} is no class, known are {', '.join(CLASSES)}")
    if kind == "move" and name != "divider":
        raise UsageError(f"--change {text}: only a divider can be moved")
    if not 1 <= count <= 1000:
        raise UsageError(f"--change {text}: the count must lie in 1 … 1000")
    return ChangeSpec(kind, name, count)


def change_world(
    vector_map: VectorMap,
    specs: Sequence[ChangeSpec],
    rng: np.random.Generator,
    near: Array | None = None,
) -> tuple[VectorMap, list[Change]]:
    """A changed copy of a map, and the changes from the old map to the new one.

    ``near`` (n, 2) is a path in the map frame: changes then lie within 14 m of it. They lie
    12 m apart from each other. A crossing is deleted whole, of a line a stretch of 14 to 24 m; an
    inserted crossing is 3.0 to 4.4 m deep and spans the road, inserted lines are 12 to 20 m long,
    on asphalt and 1.1 m or more from every line. A move takes a stretch of a divider 0.9 to 1.6 m
    to the side: a delete and an insert. NoAnswer when no place is left for a change.
    """
    work = _Work(vector_map, rng, near)
    for spec in specs:
        for _ in range(spec.count):
            made = getattr(work, f"_{spec.kind}_{_shape(spec)}")(spec.class_name)
            if not made:
                where = " near the drive" if near is not None else " in the map"
                raise NoAnswer(f"no place for {spec.kind}:{spec.class_name}{where}")
    return VectorMap(work.elements.values(), vector_map.crs), work.changes


def common_path(paths: Sequence[Array]) -> Array:
    """The points (n, 2) of the first path that every other one passes within 14 m, not at an end.

    NoAnswer when the paths share nothing.
    """
    path = paths[0]
    if len(paths) == 1:
        return path
    shared = np.ones(len(path), bool)
    for other in paths[1:]:
        distance, nearest = cKDTree(other).query(path)
        inside = (nearest > 2) & (nearest < len(other) - 3)
        shared &= (distance <= SEEN_FROM) & inside
    shared[:3] = shared[-3:] = False
    if not shared.any():
        raise NoAnswer("the drives share no stretch of road")
    return path[shared]


def _shape(spec: ChangeSpec) -> str:
    return "ring" if spec.class_name in RING_CLASSES else "line"


class _Work:
    """A map while it is being changed."""

    def __init__(self, vector_map: VectorMap, rng: np.random.Generator, near: Array | None):
        self.elements = vector_map.by_id()
        self.rng = rng
        self.path = near
        self.surface = even_odd_surface(vector_map)
        self.changes: list[Change] = []
        self.middles: list[Array] = []

    def _free(self, points: Array) -> bool:
        """True when a change may lie here: near the path, apart from the others."""
        middle = points[len(points) // 2] if not is_ring(points) else points[:-1].mean(axis=0)
        if any(np.hypot(*(middle - m)) < APART for m in self.middles):
            return False
        if self.path is None:
            return True
        return bool(np.hypot(*(self.path - middle).T).min() <= SEEN_FROM)

    def _record(self, change: Change) -> None:
        self.changes.append(change)
        p = change.points
        self.middles.append(p[:-1].mean(axis=0) if is_ring(p) else p[len(p) // 2])

    def _fresh(self, class_name: str) -> str:
        while (name := f"{class_name}-{self.rng.integers(16**6):06x}") in self.elements:
            pass
        return name

    def _ordered(self, class_name: str) -> list[Element]:
        """The elements of a class in a random order that does not hang on the map's order."""
        found = [e for e in self.elements.values() if e.class_name == class_name]
        found.sort(key=lambda e: e.element_id)
        return [found[i] for i in self.rng.permutation(len(found))]

    def _delete_ring(self, class_name: str) -> bool:
        for element in self._ordered(class_name):
            if self._free(element.xy):
                del self.elements[element.element_id]
                self._record(Change(element.element_id, "delete", class_name, element.xy))
                return True
        return False

    def _stretch(self, element: Element) -> tuple[float, float] | None:
        """A random free stretch of a line, stations in metres."""
        s = arc_length(element.points)
        wanted = float(self.rng.uniform(14.0, 24.0))
        if s[-1] < 8.0:
            return None
        if s[-1] < wanted + MIN_REST:
            whole = (0.0, float(s[-1]))
            return whole if self._free(part_of(element.points, *whole)[:, :2]) else None
        for _ in range(12):
            start = float(self.rng.uniform(0.0, s[-1] - wanted))
            if self.path is not None and s[-1] > 60:
                start = self._near_start(element, s, wanted)
            piece = part_of(element.points, start, start + wanted)[:, :2]
            if self._free(piece) and self._compact(piece):
                return start, start + wanted
        return None

    def _near_start(self, element: Element, s: Array, wanted: float) -> float:
        """A start station such that the stretch lies near a random place of the path."""
        assert self.path is not None
        place = self.path[int(self.rng.integers(len(self.path)))]
        line = part_of(element.points, 0.0, float(s[-1]), 1.0)
        nearest = int(np.hypot(*(line[:, :2] - place).T).argmin())
        middle = float(arc_length(line)[nearest]) + self.rng.normal(0, 3.0)
        return float(np.clip(middle - wanted / 2, 0.0, s[-1] - wanted))

    def _compact(self, piece: Array) -> bool:
        """True for a stretch without sharp bends: not the end of a side street."""
        return float(np.hypot(*(piece[-1] - piece[0]))) > 0.75 * float(arc_length(piece)[-1])

    def _delete_line(self, class_name: str, moved: str | None = None) -> bool:
        for element in self._ordered(class_name):
            stretch = self._stretch(element)
            if stretch is None:
                continue
            cut_out(self.elements, element, *stretch)
            gone = part_of(element.points, *stretch)[:, :2]
            self._record(Change(element.element_id, "delete", class_name, gone, moved))
            return True
        return False

    def _insert_ring(self, class_name: str) -> bool:
        """A crossing straight across the road, at a right angle to the way."""
        old = [e.xy for e in self.elements.values() if e.class_name == class_name]
        taken = shapely.union_all([polygon(p) for p in old]) if old else None
        for place, heading in self._places(200):
            along = np.array([np.cos(heading), np.sin(heading)])
            depth = self.rng.uniform(3.0, 4.4)
            ring = self._across(place, along, float(depth))
            if ring is None or not self._free(ring):
                continue
            if taken is not None and shapely.distance(taken, shapely.polygons(ring)) < APART:
                continue
            self._add(class_name, ring, {"pattern": "zebra"})
            return True
        return False

    def _across(self, place: Array, along: Array, depth: float) -> Array | None:
        """The ring (5, 2) from curb to curb at a place, None where the road is no strip."""
        across = np.array([-along[1], along[0]])
        ends = []
        for shift in (0.0, depth):
            p = place + shift * along
            line = shapely.linestrings([p - 25 * across, p + 25 * across])
            parts = shapely.get_parts(shapely.intersection(line, self.surface))
            own = [g for g in parts if shapely.distance(g, shapely.points(p)) < 0.1]
            if not own or not 5.0 < own[0].length < 26.0:
                return None
            ends.append(np.asarray(own[0].coords)[[0, -1]])
        (a, b), (d, c) = ends
        if max(np.hypot(*(a - d)), np.hypot(*(b - c))) > 1.5 * depth:
            return None
        ring = np.array([a, b, c, d, a])
        # Beside a driveway the ends would run over the curb.
        line = shapely.linestrings(ring)
        road = shapely.intersection(self.surface, line.envelope.buffer(1.0)).buffer(0.04)
        return ring if shapely.contains(road, line) else None

    def _insert_line(self, class_name: str) -> bool:
        """A line on asphalt beside the way, clear of every other line and crossing."""
        lines = [shapely.linestrings(e.xy) for e in self.elements.values()]
        tree = shapely.STRtree(lines)
        for place, heading in self._places(400):
            along = np.array([np.cos(heading), np.sin(heading)])
            offset = self.rng.choice([-1.0, 1.0]) * self.rng.uniform(0.0, 8.0)
            t = np.arange(0.0, self.rng.uniform(12.0, 20.0), 2.0)
            points = place + offset * np.array([-along[1], along[0]]) + t[:, None] * along
            line = shapely.linestrings(points)
            if not self._free(points) or not shapely.contains(self.surface, line.buffer(1.0)):
                continue
            if len(tree.query(line, "dwithin", 1.1)):
                continue
            mark = {"mark": "SOLID_WHITE"} if class_name == "divider" else {}
            self._add(class_name, points, mark)
            return True
        return False

    def _move_line(self, class_name: str) -> bool:
        """A stretch of a line to the side: a delete and an insert with one name."""
        for _ in range(20):
            saved = dict(self.elements), list(self.changes), list(self.middles)
            moved = f"move-{len(self.changes)}"
            if not self._delete_line(class_name, moved):
                return False
            gone = self.changes[-1]
            side = self.rng.choice([-1.0, 1.0]) * self.rng.uniform(0.9, 1.6)
            points = gone.points + side * normals(gone.points)
            inside = shapely.contains(self.surface, shapely.linestrings(points).buffer(0.3))
            others = [shapely.linestrings(e.xy) for e in self.elements.values()]
            inner = points[1:-1] if len(points) > 3 else resample(points, 5)[1:-1]
            clear = shapely.distance(shapely.linestrings(inner), others).min() > 0.6
            if inside and clear:
                source = saved[0][gone.element_id]
                self._add(class_name, points, dict(source.attributes), moved)
                return True
            self.elements, self.changes, self.middles = saved
        return False

    def _add(
        self, class_name: str, points: Array, attributes: dict[str, str], moved: str | None = None
    ) -> None:
        name = self._fresh(class_name)
        self.elements[name] = Element(name, class_name, points, attributes=attributes)
        self._record(Change(name, "insert", class_name, points, moved))

    def _places(self, count: int) -> list[tuple[Array, float]]:
        """Random places on the way with its heading: on the path, else along dividers."""
        if self.path is not None and len(self.path) > 1:
            way = [self.path]
        else:
            way = [e.xy for e in self.elements.values() if e.class_name == "divider"]
        out = []
        for _ in range(count if way else 0):
            line = way[int(self.rng.integers(len(way)))]
            k = int(self.rng.integers(len(line)))
            t = tangents(line)[k]
            out.append((line[k], float(np.arctan2(t[1], t[0]))))
        return out


def cut_out(elements: dict[str, Element], element: Element, start: float, end: float) -> None:
    """Take a stretch (m) out of one of the elements; the rests keep the id with #a and #b behind
    it, unless they are short."""
    points = element.points
    total = float(arc_length(points)[-1])
    del elements[element.element_id]
    if is_ring(points):
        rests = [np.concatenate([part_of(points, end, total), part_of(points, 0.0, start)[1:]])]
    else:
        rests = [part_of(points, 0.0, start), part_of(points, end, total)]
    for suffix, rest in zip("ab", rests, strict=False):
        if is_ring(points) or length(rest) > MIN_REST:
            name = f"{element.element_id}#{suffix}"
            elements[name] = replace(element, element_id=name, points=rest, covariance=None)


def part_of(points: Array, start: float, end: float, step: float | None = None) -> Array:
    """The stretch of a line between two stations, its vertices kept (or every ``step`` m)."""
    s = arc_length(points)
    inner = s[(s > start + 1e-6) & (s < end - 1e-6)]
    if step is not None:
        inner = np.arange(start + step, end, step)
    at = np.concatenate([[start], inner, [end]])
    return np.stack([np.interp(at, s, points[:, k]) for k in range(points.shape[1])], axis=-1)
