"""A small Lanelet2 map for the tests, and a reader of OSM files that is not rtmap's."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rtmap_cli.maps.crs import lonlat_to, to_lonlat

CRS = "EPSG:32632"
EAST, NORTH = 457_000.0, 5_428_000.0
"""A corner in Karlsruhe; the small map lies within 100 m of it."""

Point = tuple[float, float, float | None]


@dataclass
class Osm:
    """Content of an OSM file: coordinates of nodes (x, y, z or None; metres in CRS), node tags,
    ways and relations as (refs or members, tags)."""

    nodes: dict[int, Point] = field(default_factory=dict)
    node_tags: dict[int, dict[str, str]] = field(default_factory=dict)
    ways: dict[int, tuple[list[int], dict[str, str]]] = field(default_factory=dict)
    relations: dict[int, tuple[list[tuple[str, int, str]], dict[str, str]]] = field(
        default_factory=dict
    )

    def write(self, path: Path, degrees: str = "full", local: Any = None) -> Path:
        """``degrees``: full, empty, zero or coarse (rounded to 1e-5°, a metre); ``local``: origin
        of local_x, local_y in CRS."""
        xy = np.array([p[:2] for p in self.nodes.values()]) + [EAST, NORTH]
        lonlat = to_lonlat(CRS, xy)
        lines = ['<?xml version="1.0"?>', '<osm version="0.6" generator="by hand">']
        if local is not None:
            lines.append('<MetaInfo format_version="1" map_version="4"/>')
        for (number, point), (lon, lat), at in zip(self.nodes.items(), lonlat, xy, strict=True):
            shown = {
                "full": f'lat="{lat:.11f}" lon="{lon:.11f}"',
                "coarse": f'lat="{lat:.5f}" lon="{lon:.5f}"',
                "zero": 'lat="0.0" lon="0.0"',
                "empty": 'lat="" lon=""',
            }[degrees]
            tags = dict(self.node_tags.get(number, {}))
            if point[2] is not None:
                tags["ele"] = repr(point[2])
            if local is not None:
                tags |= {"local_x": f"{at[0] - local[0]:.4f}", "local_y": f"{at[1] - local[1]:.4f}"}
            lines += [f'<node id="{number}" {shown}>', *_tag_lines(tags), "</node>"]
        for number, (refs, tags) in self.ways.items():
            body = [f'<nd ref="{r}"/>' for r in refs]
            lines += [f'<way id="{number}">', *body, *_tag_lines(tags), "</way>"]
        for number, (members, tags) in self.relations.items():
            body = [f'<member type="{t}" ref="{r}" role="{o}"/>' for t, r, o in members]
            lines += [f'<relation id="{number}">', *body, *_tag_lines(tags), "</relation>"]
        path.write_text("\n".join([*lines, "</osm>"]), encoding="utf-8")
        return path


def _tag_lines(tags: dict[str, str]) -> list[str]:
    return [f'<tag k="{k}" v="{v}"/>' for k, v in tags.items()]


LANE = {"type": "lanelet", "subtype": "road", "location": "urban", "one_way": "yes"}


def street() -> Osm:
    """Two lanes over two stretches, a crosswalk, a stop line with its light, a traffic island.

    Nodes 1–3: left curb, 4–6: dashed line, 7–9: right edge line. The bound 103 of lanelet 203 is
    stored backwards; heights of 7–9 are unknown; node 40 is a sign of one place.
    """
    osm = Osm()
    for row, y in enumerate((7.0, 3.5, 0.0)):
        for k, x in enumerate((0.0, 30.0, 60.0)):
            osm.nodes[3 * row + k + 1] = (x, y, None if row == 2 else 110.0 + k)
    curb, dashed = {"type": "curbstone", "subtype": "high"}, {"type": "line_thin"}
    dashed["subtype"] = "dashed"
    solid = {"type": "line_thick", "subtype": "solid", "color": "yellow"}
    osm.ways |= {101: ([1, 2], curb), 102: ([2, 3], curb)}
    osm.ways |= {103: ([5, 4], dashed), 104: ([5, 6], dashed)}
    osm.ways |= {105: ([7, 8], solid), 106: ([8, 9], solid)}
    for number, left, right in ((201, 101, 103), (202, 102, 104), (203, 103, 105), (204, 104, 106)):
        osm.relations[number] = ([("way", left, "left"), ("way", right, "right")], dict(LANE))
    osm.nodes |= {20: (40.0, 8.0, 111.0), 21: (40.0, 3.0, 111.0), 22: (40.0, -1.0, 111.0)}
    osm.nodes |= {23: (44.0, 8.0, 111.0), 24: (44.0, -1.0, 111.0)}
    osm.ways |= {110: ([20, 21, 22], {"type": "pedestrian_marking"}), 111: ([24, 23], {})}
    walk = {"type": "lanelet", "subtype": "crosswalk", "participant:pedestrian": "yes"}
    osm.relations[210] = ([("way", 110, "left"), ("way", 111, "right")], walk)
    osm.nodes |= {30: (38.0, 3.5, 111.0), 31: (38.0, 0.0, 111.0)}
    osm.nodes |= {32: (50.0, -2.0, 116.0), 33: (50.4, -2.0, 116.0)}
    osm.node_tags[32] = {"color": "red"}
    osm.ways |= {120: ([30, 31], {"type": "stop_line"})}
    osm.ways |= {121: ([32, 33], {"type": "traffic_light", "subtype": "red_yellow_green"})}
    light = {"type": "regulatory_element", "subtype": "traffic_light"}
    osm.relations[220] = ([("way", 121, "refers"), ("way", 120, "ref_line")], light)
    osm.relations[204][0].append(("relation", 220, "regulatory_element"))
    osm.nodes |= {34: (70.0, 0.0, 110.0), 35: (75.0, 0.0, 110.0), 36: (72.0, 4.0, 110.0)}
    low = {"type": "curbstone", "subtype": "low"}
    osm.ways |= {130: ([34, 35, 36], low), 131: ([34, 36], low)}
    island = {"type": "multipolygon", "subtype": "traffic_island"}
    osm.relations[230] = ([("way", 130, "outer"), ("way", 131, "outer")], island)
    osm.nodes[40] = (10.0, 9.0, 112.0)
    osm.ways[140] = ([40], {"type": "traffic_sign", "subtype": "de205"})
    sign = {"type": "regulatory_element", "subtype": "speed_limit"}
    osm.relations[240] = ([("way", 140, "refers")], sign)
    return osm


def parse(path: Path, origin: Any = None) -> Osm:
    """A file read with ElementTree; nodes in metres east and north of the corner.

    With ``origin`` local_x and local_y count, else latitude and longitude.
    """
    root, osm = ET.parse(path).getroot(), Osm()
    rows = list(root.iter("node"))
    tags = {int(n.get("id", "")): _tags(n) for n in rows}
    if origin is None:
        lonlat = np.array([(float(n.get("lon", "")), float(n.get("lat", ""))) for n in rows])
        xy = lonlat_to(CRS, lonlat)
    else:
        places = [(float(t["local_x"]), float(t["local_y"])) for t in tags.values()]
        xy = np.array(places) + origin
    for (number, own), (x, y) in zip(tags.items(), xy - [EAST, NORTH], strict=True):
        osm.nodes[number] = (x, y, float(own["ele"]) if "ele" in own else None)
        rest = {k: v for k, v in own.items() if k not in ("ele", "local_x", "local_y") and v}
        if rest:
            osm.node_tags[number] = rest
    for way in root.iter("way"):
        refs = [int(n.get("ref", "")) for n in way.iter("nd")]
        osm.ways[int(way.get("id", ""))] = (refs, _tags(way))
    for relation in root.iter("relation"):
        members = [
            (m.get("type", ""), int(m.get("ref", "")), m.get("role", ""))
            for m in relation.iter("member")
        ]
        osm.relations[int(relation.get("id", ""))] = (members, _tags(relation))
    return osm


def _tags(item: Any) -> dict[str, str]:
    return {t.get("k"): t.get("v") for t in item.iter("tag")}


def assert_same(a: Osm, b: Osm, atol: float = 1e-3) -> None:
    """Both hold the same ways, relations and tags; nodes of ways within ``atol`` metres."""
    assert a.ways == b.ways
    assert a.relations == b.relations
    used = {n for refs, _ in a.ways.values() for n in refs}
    assert used <= b.nodes.keys()
    for number in used:
        first, second = a.nodes[number], b.nodes[number]
        assert (first[2] is None) == (second[2] is None), f"height of node {number}"
        apart = [abs(p - q) for p, q in zip(first, second, strict=True) if p is not None]
        assert max(apart) <= atol, f"node {number}: {apart}"
        assert a.node_tags.get(number, {}) == b.node_tags.get(number, {})
