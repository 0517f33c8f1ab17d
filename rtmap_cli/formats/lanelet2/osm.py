"""OSM XML as Lanelet2 uses it: nodes, ways and relations with tags, read and written.

Reading streams through expat and refuses every document type: where no entity can be declared, none
can grow or fetch anything. Nothing is resolved, opened or downloaded.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, TypeVar
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from rtmap_cli.errors import BadInput
from rtmap_cli.tables import whole_file

T = TypeVar("T")
Tags = dict[str, str]

LARGEST_ID = 2**63 - 1
DEGREE_DIGITS = 11
"""Decimals of latitude and longitude: a micrometre."""

_NO_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass
class Node:
    """A point: degrees (NaN where the file has none) and tags."""

    latitude: float
    longitude: float
    tags: Tags = field(default_factory=dict)


@dataclass
class Way:
    """A line: ids of its nodes, and tags."""

    nodes: list[int] = field(default_factory=list)
    tags: Tags = field(default_factory=dict)


@dataclass(frozen=True)
class Member:
    """What a relation refers to: ``kind`` is node, way or relation."""

    kind: str
    ref: int
    role: str


@dataclass
class Relation:
    """Members in order, and tags."""

    members: list[Member] = field(default_factory=list)
    tags: Tags = field(default_factory=dict)


@dataclass
class OsmFile:
    """The content of one file by id. ``attributes`` are those of ``<osm>``, ``meta`` those of
    Autoware's ``<MetaInfo>`` (None where there is none)."""

    nodes: dict[int, Node] = field(default_factory=dict)
    ways: dict[int, Way] = field(default_factory=dict)
    relations: dict[int, Relation] = field(default_factory=dict)
    attributes: Tags = field(default_factory=dict)
    meta: Tags | None = None


def read_osm(path: str | Path) -> OsmFile:
    """The nodes, ways and relations of an OSM XML file; what is marked deleted is left out.

    BadInput when it is missing, truncated, not XML or not OSM, declares a document type (entities),
    or uses an id twice. References are left to ``check_references``.
    """
    path = Path(path)
    if not path.is_file():
        raise BadInput(path, "no such file")
    reader = _Reader(path)
    with path.open("rb") as file:
        reader.parse(file)
    return reader.out


class _Reader:
    """Handlers of expat that fill an ``OsmFile``."""

    def __init__(self, path: Path) -> None:
        self.path, self.out = path, OsmFile()
        self.depth = 0
        self.current: Node | Way | Relation | None = None
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self.start
        self.parser.EndElementHandler = self.end
        self.parser.StartDoctypeDeclHandler = self.doctype

    def parse(self, file: BinaryIO) -> None:
        """Read the whole file."""
        try:
            self.parser.ParseFile(file)
        except expat.ExpatError as error:
            what = expat.ErrorString(error.code)
            raise BadInput(
                self.path,
                f"cannot be read as XML (line {error.lineno}: {what})",
                "it may be truncated; copy it again",
            ) from None
        except (LookupError, ValueError) as error:
            raise BadInput(self.path, f"cannot be read as XML ({error})") from None

    def doctype(self, *_: object) -> None:
        """No OSM file has a document type; entities come with one."""
        raise self.bad("declares a document type (entities), which no map needs", "remove it")

    def start(self, name: str, attributes: Tags) -> None:
        """A start tag."""
        self.depth += 1
        if self.depth == 1:
            if name != "osm":
                raise self.bad(f"not an OSM file (it begins with <{name}>)")
            self.out.attributes = attributes
        elif self.depth == 2:
            self.primitive(name, attributes)
        elif self.depth == 3 and self.current is not None:
            self.part(name, attributes)

    def end(self, _: str) -> None:
        """An end tag."""
        self.depth -= 1
        if self.depth == 1:
            self.current = None

    def primitive(self, name: str, attributes: Tags) -> None:
        """A node, way or relation, or what stands beside them."""
        if name == "MetaInfo":
            self.out.meta = attributes
        if name not in ("node", "way", "relation"):
            return
        number = self.number(attributes, "id", name)
        if attributes.get("action") == "delete":
            # Kept apart from the map, so that its tags go nowhere.
            self.current = Way()
        elif name == "node":
            latitude = self.degrees(attributes, "lat", number)
            longitude = self.degrees(attributes, "lon", number)
            self.current = self.add(self.out.nodes, name, number, Node(latitude, longitude))
        elif name == "way":
            self.current = self.add(self.out.ways, name, number, Way())
        else:
            self.current = self.add(self.out.relations, name, number, Relation())

    def part(self, name: str, attributes: Tags) -> None:
        """A tag, a node of a way or a member of a relation."""
        if name == "tag" and self.current is not None:
            self.current.tags[attributes.get("k", "")] = attributes.get("v", "")
        elif name == "nd" and isinstance(self.current, Way):
            self.current.nodes.append(self.number(attributes, "ref", name))
        elif name == "member" and isinstance(self.current, Relation):
            ref = self.number(attributes, "ref", name)
            kind = attributes.get("type", "")
            if kind not in ("node", "way", "relation"):
                raise self.bad(f"a member's type is {kind!r}", "it is node, way or relation")
            self.current.members.append(Member(kind, ref, attributes.get("role", "")))

    def add(self, into: dict[int, T], name: str, number: int, item: T) -> T:
        """``item``, filed under its id."""
        if number in into:
            raise self.bad(f"{name} {number} is there twice", "ids are unique")
        into[number] = item
        return item

    def number(self, attributes: Tags, key: str, name: str) -> int:
        """An id: a whole number of 64 bits."""
        text = attributes.get(key, "")
        if not re.fullmatch(r"-?[0-9]{1,19}", text) or abs(int(text)) > LARGEST_ID:
            raise self.bad(f"<{name}>: {key} is {text[:40]!r}, not an id")
        return int(text)

    def degrees(self, attributes: Tags, key: str, number: int) -> float:
        """Latitude or longitude; NaN where it is absent or empty."""
        text = attributes.get(key, "").strip()
        if not text:
            return math.nan
        limit = 90.0 if key == "lat" else 180.0
        try:
            value = float(text)
        except ValueError:
            value = math.inf
        if not abs(value) <= limit:
            raise self.bad(f"node {number}: {key} is {text[:40]!r}, not degrees within ±{limit:g}")
        return value

    def bad(self, what: str, todo: str = "") -> BadInput:
        """The error, with the line."""
        return BadInput(self.path, f"line {self.parser.CurrentLineNumber}: {what}", todo)


def check_references(osm: OsmFile, path: Path) -> None:
    """BadInput for the first reference that leads nowhere."""
    todo = "load the whole map in the editor and save it again"
    for number, way in osm.ways.items():
        for ref in way.nodes:
            if ref not in osm.nodes:
                raise BadInput(path, f"way {number} refers to node {ref}, which is missing", todo)
    there: dict[str, Iterable[int]] = {
        "node": osm.nodes.keys(),
        "way": osm.ways.keys(),
        "relation": osm.relations.keys(),
    }
    for number, relation in osm.relations.items():
        for m in relation.members:
            if m.ref not in there[m.kind]:
                raise BadInput(
                    path, f"relation {number} refers to {m.kind} {m.ref}, which is missing", todo
                )


def write_osm(osm: OsmFile, path: str | Path) -> None:
    """Write a file sorted by kind and id, whole or not at all. The same content, the same bytes."""
    with whole_file(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(osm_lines(osm))


def osm_lines(osm: OsmFile) -> Iterator[str]:
    """The file as text, line by line. JOSM asks for ``version`` wherever an id is positive."""
    yield '<?xml version="1.0" encoding="UTF-8"?>\n'
    yield f"<osm{_attributes(osm.attributes)}>\n"
    if osm.meta is not None:
        yield f"  <MetaInfo{_attributes(osm.meta)}/>\n"
    for number, node in sorted(osm.nodes.items()):
        place = f'lat="{_degrees(node.latitude)}" lon="{_degrees(node.longitude)}"'
        head = f'  <node id="{number}" visible="true" version="1" {place}'
        if not node.tags:
            yield head + "/>\n"
            continue
        yield head + ">\n"
        yield from _tags(node.tags)
        yield "  </node>\n"
    for number, way in sorted(osm.ways.items()):
        yield f'  <way id="{number}" visible="true" version="1">\n'
        yield from (f'    <nd ref="{ref}"/>\n' for ref in way.nodes)
        yield from _tags(way.tags)
        yield "  </way>\n"
    for number, relation in sorted(osm.relations.items()):
        yield f'  <relation id="{number}" visible="true" version="1">\n'
        for m in relation.members:
            yield f'    <member type="{m.kind}" ref="{m.ref}" role={_quoted(m.role)}/>\n'
        yield from _tags(relation.tags)
        yield "  </relation>\n"
    yield "</osm>\n"


def _degrees(value: float) -> str:
    return f"{value:.{DEGREE_DIGITS}f}"


def _quoted(text: str) -> str:
    """An attribute's value; characters that XML cannot hold become U+FFFD."""
    return quoteattr(_NO_XML.sub("\ufffd", text), {"\n": "&#10;", "\r": "&#13;", "\t": "&#9;"})


def _attributes(values: Tags) -> str:
    named = {k: v for k, v in values.items() if re.fullmatch(r"[A-Za-z_][\w.-]*", k)}
    return "".join(f" {key}={_quoted(value)}" for key, value in named.items())


def _tags(tags: Tags) -> Iterator[str]:
    for key, value in tags.items():
        yield f"    <tag k={_quoted(key)} v={_quoted(value)}/>\n"
