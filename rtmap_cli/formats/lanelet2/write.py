"""A map as a Lanelet2 file: what came from one keeps its ids, what is new gets stable ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli import __version__
from rtmap_cli.errors import BadInput
from rtmap_cli.formats.lanelet2.chains import apart
from rtmap_cli.formats.lanelet2.frame import MGRS_SQUARE, Frame, placed_nodes
from rtmap_cli.formats.lanelet2.nodes import Nodes
from rtmap_cli.formats.lanelet2.numbers import Numbers
from rtmap_cli.formats.lanelet2.osm import Member, OsmFile, Relation, Tags, Way
from rtmap_cli.formats.lanelet2.outline import sides_of, turn_tag
from rtmap_cli.formats.lanelet2.pieces import Piece, pieces_of
from rtmap_cli.formats.lanelet2.source import Bound, Source, source_of
from rtmap_cli.formats.lanelet2.tags import (
    AREA,
    CLASS_TAG,
    ID_TAG,
    NODES,
    RING_TAG,
    WAYS,
    own_tags,
    relation_class,
    tags_of_new,
    way_class,
)
from rtmap_cli.geometry.polylines import is_ring
from rtmap_cli.maps.element import RING_CLASSES, Element, VectorMap

Array = NDArray[np.float64]

DIALECTS = ("lanelet2", "autoware")


def to_osm(
    vector_map: VectorMap, info: Mapping[str, Any] | None = None, dialect: str | None = None
) -> tuple[OsmFile, Counter[str]]:
    """The OSM content of a map, and how often something had to give.

    ``info`` is what the import left in the map's history (frame, header, what has no line).
    ``dialect``: with ``autoware`` nodes have local_x, local_y and the file has MetaInfo; default:
    as the file that was imported, else ``lanelet2``. BadInput for attributes that were broken.
    """
    info = dict(info or {})
    dialect = dialect or DIALECTS[bool(info.get("local"))]
    sources = [source_of(e) for e in sorted(vector_map, key=lambda e: e.element_id)]
    writer = _Writer(sources, info.get("rest") or {})
    writer.run()
    frame = _frame(vector_map, info)
    used = {n for w in writer.out.ways.values() for n in w.nodes} | writer.loose
    points = {n: p for n, p in writer.nodes.points.items() if n in used}
    writer.out.nodes = placed_nodes(points, writer.node_tags, frame, dialect == "autoware")
    writer.out.attributes = dict(info.get("attributes") or {"version": "0.6"})
    writer.out.attributes["generator"] = f"rtmap {__version__}"
    writer.out.meta = info.get("meta")
    if writer.out.meta is None and dialect == "autoware":
        writer.out.meta = {"format_version": "1", "map_version": "1"}
    return writer.out, +writer.notes


def _frame(vector_map: VectorMap, info: Mapping[str, Any]) -> Frame:
    """The frame of the file's local coordinates; without one: those of the MGRS square."""
    origin = info.get("origin")
    if origin is None and len(vector_map):
        corner = np.floor(np.array(vector_map.bounds()[:2]) / MGRS_SQUARE) * MGRS_SQUARE
        origin = corner.tolist()
    return Frame(vector_map.crs, None if origin is None else (origin[0], origin[1]))


class _Writer:
    """Fills an ``OsmFile`` from the elements of a map."""

    def __init__(self, sources: Sequence[Source], rest: Mapping[str, Any]) -> None:
        self.sources, self.rest = sources, rest
        self.notes: Counter[str] = Counter()
        self.out = OsmFile()
        self.loose: set[int] = set()
        self.node_tags: dict[int, Tags] = {}
        ways = {int(w[0]) for s in sources for w in s.ways or []}
        bounds = {k for s in sources for k in s.bounds}
        nodes = {n for s in sources for n in s.nodes} | {int(k) for k in rest.get("node", {})}
        relations = {s.relation for s in sources if s.relation is not None}
        self.bounds_of_lanelets = bounds
        self.way_numbers = Numbers(ways | bounds | {int(k) for k in rest.get("way", {})})
        self.relation_numbers = Numbers(relations | {int(k) for k in rest.get("relation", {})})
        self.nodes = Nodes(nodes, self.notes)

    def run(self) -> None:
        """Nodes, then lines, then what refers to them."""
        cut = self.place_nodes()
        self.add_rest_of_lines()
        for s in self.sources:
            if s.ways is not None:
                self.add_ways(s, s.ways, cut[s.name])
        for s in self.sources:
            if s.ways is None and s.relation is None:
                self.add_new(s.element)
        for s in self.sources:
            if s.relation is not None:
                self.add_relation(s, s.relation)
        for key, (members, tags) in self.rest.get("relation", {}).items():
            kept = Relation([Member(*m) for m in members], dict(tags))
            self.out.relations.setdefault(int(key), kept)
        self.prune()

    def place_nodes(self) -> dict[str, list[Piece]]:
        """Settle where all nodes lie; the pieces of each element that came from ways."""
        lines = [s for s in self.sources if s.ways is not None]
        for s in self.sources:
            self.node_tags |= s.node_tags
            if s.ways is None and s.nodes and s.fits:
                self.nodes.tell(s.rank, s.name, s.nodes, s.points)
        self.nodes.settle()
        lines = [self.forwards(s) for s in lines]
        self.sources = [*lines, *(s for s in self.sources if s.ways is None)]
        for s in lines:
            if s.fits:
                self.nodes.tell(s.rank, s.name, s.nodes, s.points)
        self.nodes.settle()
        cut = {s.name: self.whole_ways(s) for s in lines}
        for s in lines:
            for piece in cut[s.name] if not s.fits else ():
                points = s.element.points[piece.start : piece.stop + 1]
                self.nodes.tell(s.rank, s.name, piece.nodes, points[: len(piece.nodes)])
        self.nodes.settle()
        return cut

    def forwards(self, s: Source) -> Source:
        """The element in the direction of its nodes: somebody may have drawn it the other way
        round. The outlines of lanelets tell where both ends were."""
        if not s.nodes or s.nodes[0] == s.nodes[-1]:
            return s
        ends = [self.nodes.points.get(n) for n in (s.nodes[0], s.nodes[-1])]
        if ends[0] is None or ends[1] is None:
            return s
        before = np.stack([ends[0], ends[1]])[:, :2]
        now = s.element.xy[[0, -1]]
        if np.hypot(*(now - before).T).sum() <= np.hypot(*(now[::-1] - before).T).sum():
            return s
        return replace(s, element=s.element.with_points(s.element.points[::-1]))

    def add_rest_of_lines(self) -> None:
        """What the import found without any length."""
        for key, (x, y, z, tags) in self.rest.get("node", {}).items():
            self.loose.add(int(key))
            self.node_tags.setdefault(int(key), tags)
            point = np.array([x, y, np.nan if z is None else z], np.float64)
            self.nodes.points.setdefault(int(key), point)
        for key, (nodes, tags) in self.rest.get("way", {}).items():
            if all(n in self.nodes.points for n in nodes):
                self.out.ways[int(key)] = Way(list(nodes), dict(tags))

    def whole_ways(self, s: Source) -> list[Piece]:
        """The line of an element that came from ways, as these ways and what was added or cut."""
        try:
            ways = apart(s.ways or [], s.nodes)
        except (ValueError, TypeError):
            raise BadInput(f"element {s.name}", f"{WAYS} and {NODES} do not agree") from None
        if not s.fits:
            known = [(number, nodes) for number, nodes, _ in ways]
            return pieces_of(s.element.points, known, self.nodes.points)
        out, at = [], 0
        for number, nodes, _ in ways:
            out.append(Piece(at, at + len(nodes) - 1, number, tuple(nodes)))
            at += len(nodes) - 1
        return out

    def add_ways(self, s: Source, ways: list[list[Any]], pieces: Sequence[Piece]) -> None:
        """The ways of an element that came from some: those that are whole, then the others."""
        own = _way_tags(s.element)
        first = min(int(w[0]) for w in ways)
        backwards = {int(w[0]): bool(w[2]) for w in ways}
        # An id that rtmap gave goes with the longest piece; one that is a way's with that way.
        given = s.name != f"way-{first}"
        longest = max(range(len(pieces)), key=lambda k: pieces[k].stop - pieces[k].start)
        whole = {
            k: p.way
            for k, p in enumerate(pieces)
            if p.way is not None and p.way not in self.out.ways
        }
        ends: dict[int, int] = {}
        for k, way in whole.items():
            piece = pieces[k]
            nodes = self.nodes.of(s.name, piece.nodes)
            ends |= {piece.start: nodes[0], piece.stop: nodes[-1]}
            tags = own | ({ID_TAG: s.name} if given and k == longest else {})
            self.out.ways[way] = Way(nodes[::-1] if backwards[way] else nodes, tags)
        for k, piece in enumerate(pieces):
            if k in whole:
                continue
            name = s.name if given and k == longest else f"{s.name}/{k}"
            number, tags = first, own | ({ID_TAG: s.name} if given else {})
            alone = len(ways) == len(pieces) == 1 and first not in self.bounds_of_lanelets
            if not alone or first in self.out.ways:
                # The bounds of lanelets stay where they were; the line stands beside them.
                number, tags = self.way_numbers.of(name), own | {ID_TAG: name}
                self.notes["lines cut, added to or drawn anew, written as ways of their own"] += 1
            points = s.element.points[piece.start : piece.stop + 1]
            nodes = self.nodes.line(name, points, is_ring(points))
            nodes[0], nodes[-1] = ends.get(piece.start, nodes[0]), ends.get(piece.stop, nodes[-1])
            self.out.ways[number] = Way(nodes, tags)

    def add_new(self, element: Element) -> None:
        """An element that Lanelet2 does not know yet."""
        name = element.element_id
        tags = tags_of_new(element.class_name, element.attributes) | {ID_TAG: name}
        if element.class_name in RING_CLASSES and element.ring:
            tags |= {"type": "lanelet", "subtype": "crosswalk"}
            tags.setdefault("participant:pedestrian", "yes")
            tags[RING_TAG] = turn_tag(element.points)
            members = self.add_sides(element, {})
            self.out.relations[self.relation_numbers.of(name)] = Relation(members, tags)
            return
        if way_class(tags) != element.class_name:
            tags[CLASS_TAG] = element.class_name
        nodes = self.nodes.line(name, element.points, element.ring)
        self.out.ways[self.way_numbers.of(name)] = Way(nodes, tags)

    def add_sides(self, element: Element, ways: Mapping[str, tuple[int, Tags]]) -> list[Member]:
        """The bounds of a crosswalk from its ring; ``ways``: ids and tags that they have."""
        name = element.element_id
        out = []
        nodes = self.nodes.line(name, element.points, True)
        for role, side in zip(("left", "right"), sides_of(element.points), strict=True):
            number, tags = ways.get(role) or (
                self.way_numbers.of(f"{name}/{role}"),
                {"type": "pedestrian_marking"},
            )
            self.out.ways[number] = Way([nodes[k] for k in side], dict(tags))
            out.append(Member("way", number, role))
        return out

    def add_relation(self, s: Source, number: int) -> None:
        """A lanelet, area or other relation, with those of its bounds that are gone by now."""
        tags = own_tags(s.element.attributes)
        kind = tags.get("type") or "relation"
        if number in self.out.relations:
            number = self.relation_numbers.of(s.name)
        if s.name != f"{AREA if kind == 'multipolygon' else kind}-{number}":
            tags[ID_TAG] = s.name
        if s.element.class_name not in (relation_class(tags), kind, "relation"):
            tags[CLASS_TAG] = s.element.class_name
        members = list(s.members)
        if s.bounds and s.element.class_name in RING_CLASSES and not s.fits:
            members = self.reshaped(s, members)
            tags[RING_TAG] = turn_tag(s.element.points)
        for way, bound in s.bounds.items():
            self.add_bound(way, bound)
        self.out.relations[number] = Relation(members, tags)

    def reshaped(self, s: Source, members: list[Member]) -> list[Member]:
        """The members of a crosswalk whose ring has other vertices than its bounds had."""
        ways = {m.role: m.ref for m in members if m.role in ("left", "right")}
        own = {r: (k, t) for r, k in ways.items() if (t := s.bounds[k].tags) is not None}
        fresh = {m.role: m for m in self.add_sides(s.element, own)}
        return [fresh.get(m.role, m) for m in members]

    def add_bound(self, way: int, bound: Bound) -> None:
        """A bound that no element tells of any more; paint that is gone leaves a virtual line."""
        if way in self.out.ways or not all(n in self.nodes.points for n in bound.nodes):
            return
        if bound.tags is None:
            self.notes["bounds of lanelets whose line is gone made virtual"] += 1
        tags = {"type": "virtual"} if bound.tags is None else dict(bound.tags)
        self.out.ways[way] = Way(list(bound.nodes), tags)

    def prune(self) -> None:
        """Take away members that are not there, and the relations that mean nothing without."""
        there: dict[str, Any] = {
            "node": self.nodes.points,
            "way": self.out.ways,
            "relation": self.out.relations,
        }
        again = True
        while again:
            again = False
            for number, relation in list(self.out.relations.items()):
                kept = [m for m in relation.members if m.ref in there[m.kind]]
                if len(kept) == len(relation.members):
                    continue
                again = True
                lost = len(relation.members) - len(kept)
                self.notes["members of relations whose element is gone left out"] += lost
                if _means_something(relation.members, kept):
                    relation.members = kept
                else:
                    del self.out.relations[number]
                    self.notes["relations left out with them"] += 1
        for relation in self.out.relations.values():
            self.loose |= {m.ref for m in relation.members if m.kind == "node"}


def _means_something(before: Sequence[Member], after: Sequence[Member]) -> bool:
    """True for a relation that can be without the members it lost: it has all its bounds, and
    something that it refers to if it had."""
    a, b = Counter(m.role for m in before), Counter(m.role for m in after)
    bounds = all(a[role] == b[role] for role in ("left", "right", "outer"))
    return bounds and bool(b["refers"]) == bool(a["refers"])


def _way_tags(element: Element) -> Tags:
    """The tags of a way, in agreement with the class that its element has by now."""
    tags = own_tags(element.attributes)
    if not tags.get("type"):
        return tags
    if element.class_name in (way_class(tags), way_class(tags, True)):
        return tags
    kept = {k: v for k, v in tags.items() if k not in ("type", "subtype")}
    tags = tags_of_new(element.class_name, kept)
    return tags if way_class(tags) == element.class_name else tags | {CLASS_TAG: element.class_name}


def info_of(history: Sequence[Any], version: int | None) -> dict[str, Any]:
    """What the newest import up to ``version`` left in a map's history; {} where there was none."""
    for entry in reversed(history):
        found = entry.info.get("lanelet2")
        if found and (version is None or entry.version <= version):
            return dict(found)
    return {}
