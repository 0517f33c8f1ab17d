"""A Lanelet2 file as a map: ways, lanelets, areas and regulatory elements become elements."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.lanelet2.chains import Chain, joined
from rtmap_cli.formats.lanelet2.frame import PLACE_TAGS, Frame, node_points
from rtmap_cli.formats.lanelet2.osm import (
    OsmFile,
    Relation,
    Tags,
    Way,
    check_references,
    read_osm,
)
from rtmap_cli.formats.lanelet2.outline import aligned, border_of, ring_of, turned
from rtmap_cli.formats.lanelet2.tags import (
    AREA,
    BOUNDS,
    CLASS_TAG,
    CROSSWALK_OWN,
    ID_TAG,
    LANELET2_TYPES,
    LENGTH,
    MEMBERS,
    NODE_TAGS,
    NODES,
    NOT_FOR_VEHICLES,
    RELATION,
    RING_TAG,
    UNTYPED,
    WAYS,
    relation_class,
    way_attributes,
    way_class,
)
from rtmap_cli.formats.lanelet2.untyped import classes_by_place
from rtmap_cli.geometry.polylines import is_ring, length
from rtmap_cli.geometry.rings import signed_area
from rtmap_cli.maps.element import RING_CLASSES, Element, VectorMap

Array = NDArray[np.float64]

MIN_AREA = 0.1
"""m² below which a crossing is none."""
UNTYPED_CHOICES = ("keep", "divider", "boundary", "by-place")


@dataclass
class Lanelet2Map:
    """A file read: its map, the frame of its coordinates, what belongs to no element (``rest``, for
    the map's history), and how often something was odd (``notes``)."""

    vector_map: VectorMap
    frame: Frame
    info: dict[str, Any]
    notes: Counter[str] = field(default_factory=Counter)


def read_lanelet2(
    path: str | Path,
    crs: str | None = None,
    origin: tuple[float, float] | None = None,
    untyped: str = "keep",
    join: bool = True,
) -> Lanelet2Map:
    """A map from a Lanelet2 file, in the projected metric ``crs`` (default: UTM zone of the data).

    ``origin``: see ``node_points``. ``untyped``: the class of ways without a type (``keep``:
    "untyped"; ``by-place``: see ``classes_by_place``). ``join``: dividers and boundaries of the
    same tags are joined where exactly two ends share a node. BadInput for a file that is none.
    """
    path = Path(path)
    osm = read_osm(path)
    _check_lanelet2(osm, path)
    check_references(osm, path)
    notes: Counter[str] = Counter()
    points, frame = node_points(osm, path, crs, origin, notes)
    elements = _Elements(osm, points, notes)
    found = [*elements.of_ways(untyped, join), *elements.of_relations()]
    for name, count in Counter(e.element_id for e in found).items():
        if count > 1:
            raise BadInput(path, f"{count} elements are called {name} ({ID_TAG})", "ids are unique")
    info = {
        "origin": frame.origin,
        "local": any("local_x" in n.tags for n in osm.nodes.values()),
        "attributes": osm.attributes,
        "meta": osm.meta,
        "rest": elements.rest(),
    }
    return Lanelet2Map(VectorMap(found, frame.crs), frame, info, +notes)


def _check_lanelet2(osm: OsmFile, path: Path) -> None:
    if not osm.ways:
        raise BadInput(path, "holds no ways, so there is nothing to import")
    if any(r.tags.get("type") == "lanelet" for r in osm.relations.values()):
        return
    typed = [w for w in osm.ways.values() if w.tags.get("type") in LANELET2_TYPES]
    if not typed:
        raise BadInput(
            path,
            "no Lanelet2 map: it holds neither a lanelet nor a line of a Lanelet2 type",
            "an extract of OpenStreetMap has no lane markings",
        )


class _Elements:
    """Makes elements of one file; ``left_over`` collects what no element can hold."""

    def __init__(self, osm: OsmFile, points: dict[int, Array], notes: Counter[str]) -> None:
        self.osm, self.points, self.notes = osm, points, notes
        self.left_over: dict[str, list[int]] = {"node": [], "way": [], "relation": []}
        self.users: dict[tuple[str, int], list[int]] = defaultdict(list)
        for number, relation in osm.relations.items():
            for m in relation.members:
                self.users[m.kind, m.ref].append(number)
        self.bounds = {k: b for k, r in osm.relations.items() if (b := self._bounds(r))}
        self.lines = {k: w for k, w in osm.ways.items() if self._extent(w)}
        self.left_over["way"] = sorted(osm.ways.keys() - self.lines.keys())
        self.inner = self._bounds_of_crosswalks()

    def of_ways(self, untyped: str, join: bool) -> list[Element]:
        """One element a way, or a chain of ways with ``join``."""
        classes = self._classes(untyped)
        chains = [Chain.of(k, tuple(self.lines[k].nodes)) for k in classes]
        if join:
            kinds = {
                k: (name, tuple(sorted(self.lines[k].tags.items())))
                for k, name in classes.items()
                if name in ("divider", "boundary") and ID_TAG not in self.lines[k].tags
            }
            chains = joined(chains, kinds)
        return [self._way_element(c, classes[c.first]) for c in chains]

    def of_relations(self) -> Iterator[Element]:
        """Lanelets, crosswalks, areas, and relations that stand where their members are."""
        for number, relation in sorted(self.osm.relations.items()):
            element = self._relation_element(number, relation)
            if element is None:
                self.left_over["relation"].append(number)
            else:
                yield element

    def rest(self) -> dict[str, Any]:
        """What has no line: ways of one place, loose nodes with tags, relations without a place.

        By kind and id: nodes as [x, y, z or None, tags] in the map frame, ways as [nodes, tags],
        relations as [members, tags].
        """
        used = {n for w in self.lines.values() for n in w.nodes}
        ways = {k: self.osm.ways[k] for k in self.left_over["way"]}
        wanted = {n for w in ways.values() for n in w.nodes}
        for number in self.osm.nodes.keys() - used:
            if self._node_tags(number) or ("node", number) in self.users:
                wanted.add(number)
            elif number not in wanted:
                self.notes["nodes without tags that no way uses left out"] += 1
        self.notes["ways without any length kept aside"] += len(ways)
        self.notes["relations without a place kept aside"] += len(self.left_over["relation"])
        relations = {k: self.osm.relations[k] for k in self.left_over["relation"]}
        return {
            "node": {str(k): [*self._place(k), self._node_tags(k)] for k in sorted(wanted)},
            "way": {str(k): [w.nodes, w.tags] for k, w in ways.items()},
            "relation": {str(k): [_members(r), r.tags] for k, r in relations.items()},
        }

    def _place(self, node: int) -> list[float | None]:
        return [float(v) if np.isfinite(v) else None for v in self.points[node]]

    def _extent(self, way: Way) -> bool:
        """True for a way that leads somewhere."""
        return len(way.nodes) > 1 and length(self._line(way.nodes)) > 0

    def _line(self, nodes: Sequence[int]) -> Array:
        return np.stack([self.points[n] for n in nodes])

    def _bounds(self, relation: Relation) -> tuple[int, int] | None:
        """Left and right way of a lanelet; None for what is no lanelet or lacks one."""
        if relation.tags.get("type") != "lanelet":
            return None
        sides = [[m.ref for m in relation.members if m.role == r] for r in ("left", "right")]
        ways = [side[0] for side in sides if len(side) == 1]
        if len(ways) != 2 or not all(k in self.osm.ways for k in ways):
            self.notes["lanelets without one left and one right way"] += 1
            return None
        if not all(self._extent(self.osm.ways[k]) for k in ways):
            self.notes["lanelets with a bound without length"] += 1
            return None
        return ways[0], ways[1]

    def _bounds_of_crosswalks(self) -> set[int]:
        """Ways that only bound one crosswalk: they are part of its element."""
        return {
            way
            for number, ways in self.bounds.items()
            if self.osm.relations[number].tags.get("subtype") == "crosswalk"
            for way in ways
            if self.users["way", way] == [number]
            and self.osm.ways[way].tags.get("type", "") in CROSSWALK_OWN
        }

    def _classes(self, untyped: str) -> dict[int, str]:
        """The class of every way that becomes an element, in order of the ids."""
        roads = {
            way
            for number, ways in self.bounds.items()
            if self.osm.relations[number].tags.get("subtype") not in NOT_FOR_VEHICLES
            for way in ways
        }
        out = {}
        for number in sorted(self.lines.keys() - self.inner):
            tags = self.lines[number].tags
            name = tags.get(CLASS_TAG) or way_class(tags, number in roads)
            ring = is_ring(self._line(self.lines[number].nodes))
            out[number] = UNTYPED if name in RING_CLASSES and not ring else name
        unknown = [k for k, name in out.items() if name == UNTYPED]
        if untyped == "by-place":
            lines = {k: self._line(self.lines[k].nodes)[:, :2] for k in unknown}
            areas = {k: self._outline(k)[1] for k in self.bounds}
            sides = {k: [n for n, b in self.bounds.items() if k in b] for k in unknown}
            out |= classes_by_place(lines, areas, sides)
        elif untyped != "keep":
            out |= dict.fromkeys([k for k in unknown if k in roads], untyped)
        self.notes["ways without a type"] += len(unknown)
        return out

    def _way_element(self, chain: Chain, class_name: str) -> Element:
        tags = dict(self.lines[chain.first].tags)
        tags.pop(CLASS_TAG, None)
        name = tags.pop(ID_TAG, None) or f"way-{chain.first}"
        own = way_attributes(tags) | {WAYS: chain.as_json()} | self._nodes(chain.nodes)
        return Element(name, class_name, self._line(chain.nodes), attributes=own)

    def _outline(self, number: int) -> tuple[list[int], Array]:
        """Nodes and points around a lanelet."""
        left, right = (self.osm.ways[k].nodes for k in self.bounds[number])
        ring = ring_of(*aligned(left, right, self.points))
        ring = turned(ring, self.osm.relations[number].tags.get(RING_TAG, ""))
        return ring, self._line(ring)

    def _relation_element(self, number: int, relation: Relation) -> Element | None:
        class_name = relation.tags.get(CLASS_TAG) or relation_class(relation.tags)
        own = dict(relation.tags)
        own.pop(CLASS_TAG, None)
        kind = AREA if class_name == AREA else own.get("type") or "relation"
        name = own.pop(ID_TAG, None) or f"{kind}-{number}"
        own |= {RELATION: str(number), MEMBERS: json.dumps(_members(relation))}
        nodes = None
        if number in self.bounds:
            nodes, points = self._outline(number)
            crossing = class_name in RING_CLASSES
            turned = crossing and signed_area(points) < 0
            own |= self._bounds_kept(list(self.bounds[number]), nodes[::-1] if turned else nodes)
            if crossing and not _is_crossing(points):
                self.notes["crosswalks whose outline crosses itself kept as lanelets"] += 1
                class_name = "lanelet"
        elif class_name == AREA:
            outer = [m.ref for m in relation.members if m.role == "outer" and m.kind == "way"]
            nodes = border_of([self.osm.ways[k].nodes for k in outer if k in self.lines])
            if nodes is not None:
                own |= self._bounds_kept(outer, nodes)
                points = self._line(nodes)
            else:
                self.notes["areas whose border does not close"] += 1
        if nodes is None:
            way = self._place_of(number)
            if way is None:
                return None
            points = self._line(self.lines[way].nodes)
            class_name = "relation" if class_name in RING_CLASSES else class_name
        return Element(name, class_name, points, attributes=own)

    def _bounds_kept(self, ways: list[int], ring: list[int]) -> Tags:
        """Attributes that make the bounds of a lanelet or area again where their own elements are
        gone, with the tags of those that have none."""
        kept = {
            str(k): {"nodes": self.osm.ways[k].nodes}
            | ({"tags": self.osm.ways[k].tags} if k in self.inner else {})
            for k in ways
        }
        return {BOUNDS: json.dumps(kept)} | self._nodes(ring)

    def _place_of(self, number: int) -> int | None:
        """The way at which a relation without an outline stands: of its members, else of theirs,
        else of the relations that refer to it."""
        roles = {"ref_line": 0, "refers": 1}
        seen, waiting = {number}, [number]
        while waiting:
            current = waiting.pop()
            members = self.osm.relations[current].members
            for m in sorted(members, key=lambda m: roles.get(m.role, 2)):
                if m.kind == "way" and m.ref in self.lines:
                    return m.ref
            others = [m.ref for m in members if m.kind == "relation"]
            others += self.users["relation", current]
            fresh = [k for k in dict.fromkeys(others) if k not in seen]
            seen.update(fresh)
            waiting += reversed(fresh)
        return None

    def _node_tags(self, node: int) -> Tags:
        """The tags of a node that say something else than where it is."""
        return {k: v for k, v in self.osm.nodes[node].tags.items() if k not in PLACE_TAGS and v}

    def _nodes(self, nodes: Sequence[int]) -> Tags:
        """Attributes that say which node each vertex is."""
        out = {NODES: " ".join(map(str, nodes)), LENGTH: f"{length(self._line(nodes)):.3f}"}
        found = {str(n): t for n in dict.fromkeys(nodes) if (t := self._node_tags(n))}
        return out | ({NODE_TAGS: json.dumps(found, ensure_ascii=False)} if found else {})


def _members(relation: Relation) -> list[list[Any]]:
    return [[m.kind, m.ref, m.role] for m in relation.members]


def _is_crossing(ring: Array) -> bool:
    """True for a ring that bounds an area."""
    if len(ring) < 4:
        return False
    shape = shapely.Polygon(ring[:, :2])
    return bool(shape.is_valid and shape.area >= MIN_AREA)
