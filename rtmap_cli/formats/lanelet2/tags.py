"""What Lanelet2's types mean to rtmap, and the attributes that keep the rest of a Lanelet2 map.

Types: LinestringTagging.md, LaneletAndAreaTagging.md of Lanelet2. An element keeps all tags of its
way or relation as attributes under their own names. Attributes that begin with ``lanelet2:`` hold
what rtmap's elements have no place for, so that ``rtmap export lanelet2`` can write it again:

* ``lanelet2:ways``: JSON, one [id, number of nodes, reversed] per way that the element is made of;
* ``lanelet2:nodes``: the id of the node at each vertex (of crossings counter-clockwise);
* ``lanelet2:length``: metres from the first to the last of them, as imported;
* ``lanelet2:node_tags``: JSON, tags of these nodes by id;
* ``lanelet2:id``, ``lanelet2:members``: id of the relation; JSON, [kind, id, role] per member;
* ``lanelet2:bounds``: JSON, by way: the nodes of a bound as stored, and the tags of a bound that is
  no element of its own.
"""

from __future__ import annotations

from collections.abc import Mapping

from rtmap_cli.formats.lanelet2.osm import Tags

PREFIX = "lanelet2:"
WAYS, NODES, NODE_TAGS = f"{PREFIX}ways", f"{PREFIX}nodes", f"{PREFIX}node_tags"
LENGTH = f"{PREFIX}length"
RELATION, MEMBERS, BOUNDS = f"{PREFIX}id", f"{PREFIX}members", f"{PREFIX}bounds"

ID_TAG, CLASS_TAG = "rtmap:id", "rtmap:class"
"""Tags of what did not come from Lanelet2: id and class of the element."""
RING_TAG = "rtmap:ring"
"""Which vertex around the lanelet is the ring's first, and whether the ring runs to the left."""

PAINTED = frozenset({"line_thin", "line_thick"})
BORDERS = frozenset({"road_border", "curbstone", "guard_rail", "jersey_barrier"})
ROAD_EDGES = frozenset({"wall", "fence", "hedge", "house"})
"""Borders of the road where a lanelet for vehicles ends at them, else things beside it."""
CROSSWALK_OWN = frozenset({"pedestrian_marking", "zebra_marking", "virtual", ""})
"""Bounds that belong to their crosswalk alone, where nothing else refers to them."""
LANELET2_TYPES = PAINTED | BORDERS | {"stop_line", "pedestrian_marking", "virtual"}
"""Types by which a file without any lanelet is known as Lanelet2."""

UNTYPED = "untyped"
AREA = "area"
NOT_FOR_VEHICLES = frozenset({"crosswalk", "walkway", "stairs", "shared_walkway", "bicycle_lane"})


def way_class(tags: Mapping[str, str], bounds_road: bool = False) -> str:
    """The class of a way's element; ``bounds_road``: a lanelet for vehicles ends at it."""
    kind = tags.get("type", "")
    if kind in PAINTED:
        return "divider"
    if kind in BORDERS or (kind in ROAD_EDGES and bounds_road):
        return "boundary"
    return kind or UNTYPED


def relation_class(tags: Mapping[str, str]) -> str:
    """The class of a relation's element: lanelet, ped_crossing, area or the relation's type."""
    kind = tags.get("type", "")
    if kind == "lanelet" and tags.get("subtype") == "crosswalk":
        return "ped_crossing"
    return AREA if kind == "multipolygon" else kind or "relation"


MARKS = {
    "SOLID": "solid",
    "DASHED": "dashed",
    "DOUBLE_SOLID": "solid_solid",
    "SOLID_DASHED": "solid_dashed",
    "DASHED_SOLID": "dashed_solid",
    "SOLID_DASH": "solid_dashed",
    "DASH_SOLID": "dashed_solid",
    "DOUBLE_DASH": "dashed",
    "DOUBLE_DASHED": "dashed",
}
"""Subtypes of painted lines by mark (Argoverse's names too) without its colour."""
COLOURS = ("WHITE", "YELLOW", "BLUE")


def mark_of(tags: Mapping[str, str]) -> str | None:
    """The mark (``SOLID_WHITE``) of a painted way, None where its tags do not tell one.

    A line without a colour is white (LinestringTagging.md).
    """
    kinds = {subtype: mark for mark, subtype in reversed(MARKS.items())}
    kind, colour = kinds.get(tags.get("subtype", "")), tags.get("color", "white").upper()
    if tags.get("type") not in PAINTED or kind is None or colour not in COLOURS:
        return None
    return f"{kind}_{colour}"


def way_attributes(tags: Mapping[str, str]) -> Tags:
    """The attributes of a way's element: its tags, with the mark of a painted line."""
    mark = mark_of(tags)
    return {**({"mark": mark} if mark else {}), **tags}


def own_tags(attributes: Mapping[str, str]) -> Tags:
    """The tags among an element's attributes, without a mark that they tell themselves."""
    own = {k: v for k, v in attributes.items() if not k.startswith(PREFIX)}
    if "mark" in own and own["mark"] == mark_of(own):
        del own["mark"]
    return own


def tags_of_new(class_name: str, attributes: Mapping[str, str]) -> Tags:
    """Tags for an element that did not come from Lanelet2; its attributes stay tags."""
    own = {k: v for k, v in attributes.items() if not k.startswith(PREFIX)}
    if class_name == "divider":
        return own_tags({"type": "line_thin"} | _paint(own.get("mark", "")) | own)
    if class_name == "boundary":
        return {"type": "road_border"} | own
    return own if class_name == UNTYPED else {"type": class_name} | own


def _paint(mark: str) -> Tags:
    """Subtype and colour of a mark such as DOUBLE_SOLID_YELLOW."""
    kind, _, colour = mark.rpartition("_")
    if kind not in MARKS or colour not in COLOURS:
        return {}
    return {"subtype": MARKS[kind], "color": colour.lower()}
