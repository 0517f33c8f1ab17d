"""Lanelet2 in and out, through the command line: what becomes of what, dialects, round trips."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_lanelet2 import CRS, EAST, LANE, NORTH, Osm, assert_same, parse, street

from rtmap_cli.formats.lanelet2.osm import OsmFile, Relation, read_osm, write_osm
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import read_map

Rtmap = Callable[..., Any]


def imported(rtmap: Rtmap, osm: Osm, folder: Path, *more: object, **how: Any) -> VectorMap:
    path = osm.write(folder / "in.osm", **how)
    rtmap("import", "lanelet2", path, "-o", folder / "map", *more)
    return read_map(folder / "map")


def test_what_becomes_of_what(rtmap: Rtmap, tmp_path: Path) -> None:
    vector_map = imported(rtmap, street(), tmp_path)
    by_id = vector_map.by_id()
    assert vector_map.crs == CRS
    assert {name: e.class_name for name, e in by_id.items()} == {
        "way-101": "boundary",
        "way-103": "divider",
        "way-105": "divider",
        "way-120": "stop_line",
        "way-121": "traffic_light",
        "way-130": "boundary",
        "lanelet-201": "lanelet",
        "lanelet-202": "lanelet",
        "lanelet-203": "lanelet",
        "lanelet-204": "lanelet",
        "lanelet-210": "ped_crossing",
        "area-230": "area",
        "regulatory_element-220": "regulatory_element",
    }
    dashed = by_id["way-103"]
    # Joined with way 104, in the direction of way 103, which is stored backwards.
    np.testing.assert_allclose(dashed.xy[:, 0] - EAST, [0, 30, 60][::-1], atol=1e-4)
    np.testing.assert_allclose(dashed.points[:, 2], [112, 111, 110])
    assert dashed.attributes["mark"] == "DASHED_WHITE"
    assert by_id["way-105"].attributes["mark"] == "SOLID_YELLOW"
    assert np.isnan(by_id["way-105"].points[:, 2]).all(), "no ele is no height, not 0"
    crossing = by_id["lanelet-210"]
    assert crossing.ring and len(crossing.points) == 6
    assert by_id["lanelet-204"].attributes["location"] == "urban"
    np.testing.assert_allclose(
        by_id["lanelet-203"].xy - [EAST, NORTH],
        [[0, 3.5], [30, 3.5], [30, 0], [0, 0], [0, 3.5]],
        atol=1e-4,
    )
    assert by_id["area-230"].ring


def test_without_joining_each_way_is_an_element(rtmap: Rtmap, tmp_path: Path) -> None:
    vector_map = imported(rtmap, street(), tmp_path, "--no-join")
    ways = {e.element_id for e in vector_map if e.element_id.startswith("way-")}
    assert ways == {f"way-{k}" for k in (101, 102, 103, 104, 105, 106, 120, 121, 130, 131)}


@pytest.mark.parametrize("join", ["--join", "--no-join"])
def test_round_trip(rtmap: Rtmap, tmp_path: Path, join: str) -> None:
    imported(rtmap, street(), tmp_path, join)
    said = rtmap("export", "lanelet2", tmp_path / "map", "-o", tmp_path / "out.osm", "--json")
    assert json.loads(said.out)["notes"] == {}
    assert_same(street(), parse(tmp_path / "out.osm"))
    assert "local_x" not in (tmp_path / "out.osm").read_text(encoding="utf-8")
    rtmap("map", "validate", tmp_path / "map", "--fail-on", "error")


def test_same_map_same_bytes(rtmap: Rtmap, tmp_path: Path) -> None:
    imported(rtmap, street(), tmp_path)
    for name in ("a.osm", "b.osm"):
        rtmap("export", "lanelet2", tmp_path / "map", "-o", tmp_path / name)
    assert (tmp_path / "a.osm").read_bytes() == (tmp_path / "b.osm").read_bytes()


@pytest.mark.parametrize(
    ("degrees", "more"),
    [
        ("full", []),
        ("coarse", []),
        ("empty", ["--crs", CRS, "--origin", 400000, 5400000]),
        ("zero", ["--crs", CRS, "--origin", 400000, 5400000]),
    ],
)
def test_autoware_dialect(rtmap: Rtmap, tmp_path: Path, degrees: str, more: list[Any]) -> None:
    """Local coordinates count, wherever latitude and longitude are rounded, empty or 0."""
    origin = (400_000.0, 5_400_000.0)
    vector_map = imported(rtmap, street(), tmp_path, *more, degrees=degrees, local=origin)
    curb = vector_map.by_id()["way-101"]
    np.testing.assert_allclose(curb.xy[0] - [EAST, NORTH], [0, 7], atol=1e-4)
    rtmap("export", "lanelet2", tmp_path / "map", "-o", tmp_path / "out.osm")
    assert_same(street(), parse(tmp_path / "out.osm", origin))
    assert_same(street(), parse(tmp_path / "out.osm"))
    assert '<MetaInfo format_version="1" map_version="4"/>' in (tmp_path / "out.osm").read_text()


def test_an_origin_that_no_grid_knows(rtmap: Rtmap, tmp_path: Path) -> None:
    origin = (456_321.5, 5_427_654.25)
    imported(rtmap, street(), tmp_path, local=origin)
    rtmap("export", "lanelet2", tmp_path / "map", "-o", tmp_path / "out.osm")
    assert_same(street(), parse(tmp_path / "out.osm", origin))


def test_local_coordinates_of_another_frame_do_not_count(rtmap: Rtmap, tmp_path: Path) -> None:
    path = street().write(tmp_path / "in.osm", local=(400_000.0, 5_400_000.0))
    text = path.read_text(encoding="utf-8").replace("local_x", "local_z")
    text = text.replace("local_y", "local_x").replace("local_z", "local_y")
    path.write_text(text, encoding="utf-8")
    said = rtmap("import", "lanelet2", path, "-o", tmp_path / "map")
    assert "another frame" in said.err
    curb = read_map(tmp_path / "map").by_id()["way-101"]
    np.testing.assert_allclose(curb.xy[0] - [EAST, NORTH], [0, 7], atol=1e-4)


def test_export_for_autoware(rtmap: Rtmap, tmp_path: Path) -> None:
    imported(rtmap, street(), tmp_path)
    out = tmp_path / "out.osm"
    rtmap("export", "lanelet2", tmp_path / "map", "-o", out, "--dialect", "autoware")
    assert_same(street(), parse(out, (400_000.0, 5_400_000.0)))  # the MGRS square
    rtmap("export", "lanelet2", tmp_path / "map", "-o", out, "--origin", EAST, 0, "--overwrite")
    assert_same(street(), parse(out, (EAST, 0.0)))


@pytest.mark.parametrize(
    ("how", "left", "middle", "right"),
    [
        ("keep", "untyped", "untyped", "untyped"),
        ("boundary", "boundary", "boundary", "boundary"),
        ("divider", "divider", "divider", "divider"),
        ("by-place", "boundary", "divider", "boundary"),
    ],
)
def test_ways_without_a_type(
    rtmap: Rtmap, tmp_path: Path, how: str, left: str, middle: str, right: str
) -> None:
    osm = street()
    for number in range(101, 107):
        osm.ways[number] = (osm.ways[number][0], {})
    vector_map = imported(rtmap, osm, tmp_path, "--untyped", how, "--no-join")
    by_id = vector_map.by_id()
    found = [by_id[f"way-{k}"].class_name for k in (101, 103, 106)]
    assert found == [left, middle, right]
    rtmap("export", "lanelet2", tmp_path / "map", "-o", tmp_path / "out.osm")
    assert_same(osm, parse(tmp_path / "out.osm"))  # and nothing is invented


def test_neighbours_drawn_twice_and_lanes_that_cross(rtmap: Rtmap, tmp_path: Path) -> None:
    """Of the bounds that each lane drew for itself one is a divider; what crosses lanes is none."""
    osm = Osm()
    lines = {
        101: [(0, 7), (60, 7)],
        102: [(0, 3.5), (60, 3.5)],
        103: [(0, 3.45), (60, 3.45)],
        104: [(0, 0), (60, 0)],
        105: [(28, -30), (28, 40)],
        106: [(32, -30), (32, 40)],
    }
    for number, ends in lines.items():
        for k, (x, y) in enumerate(ends):
            osm.nodes[10 * number + k] = (x, y, None)
        osm.ways[number] = ([10 * number, 10 * number + 1], {})
    for k, (left, right) in enumerate(((101, 102), (103, 104), (105, 106))):
        osm.relations[201 + k] = ([("way", left, "left"), ("way", right, "right")], dict(LANE))
    by_id = imported(rtmap, osm, tmp_path, "--untyped", "by-place").by_id()
    found = {k: by_id[f"way-{k}"].class_name for k in lines}
    assert found[101] == found[104] == found[105] == found[106] == "boundary"
    assert (found[102], found[103]) == ("divider", "untyped")


def test_simulated_town_there_and_back(rtmap: Rtmap, tmp_path: Path) -> None:
    """A map that knows nothing of Lanelet2: ids, classes and vertices come back, ids stay."""
    town, back, out = tmp_path / "town", tmp_path / "back", tmp_path / "out.osm"
    rtmap("simulate", "town", "--seed", 3, "--size", 200, "-o", town)
    rtmap("export", "lanelet2", town, "-o", out)
    crs = read_map(town).crs
    rtmap("import", "lanelet2", out, "--crs", crs, "-o", back)
    first, second = read_map(town).by_id(), read_map(back).by_id()
    assert first.keys() == second.keys()
    classes = {e.class_name for e in first.values()}
    assert classes == {"ped_crossing", "divider", "boundary"}
    for name, element in first.items():
        assert second[name].class_name == element.class_name
        np.testing.assert_allclose(second[name].points, element.points, atol=1e-3)
        assert second[name].attributes.get("mark") == element.attributes.get("mark")
    rtmap("export", "lanelet2", back, "-o", tmp_path / "again.osm")
    assert_same(parse(out), parse(tmp_path / "again.osm"))


def test_a_crossing_turning_either_way_comes_back(rtmap: Rtmap, tmp_path: Path) -> None:
    corner = np.array([8.415, 49.0])
    ring = np.array([[0, 0], [5, 0], [5, 1], [5.2, 3], [0.1, 3], [0, 0]]) * [1.4e-5, 9e-6]
    rings = {"left": ring, "right": ring[::-1], "three": ring[[0, 1, 3, 0]]}
    rings["from the middle"] = np.concatenate([ring[2:-1], ring[:3]])
    features = [
        {
            "type": "Feature",
            "properties": {"id": name, "class": "ped_crossing"},
            # As a line: GeoJSON would turn a polygon round.
            "geometry": {"type": "LineString", "coordinates": (corner + r).tolist()},
        }
        for name, r in rings.items()
    ]
    path = tmp_path / "in.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    rtmap("import", "geojson", path, "--crs", CRS, "-o", tmp_path / "map")
    rtmap("export", "lanelet2", tmp_path / "map", "-o", tmp_path / "out.osm")
    rtmap("import", "lanelet2", tmp_path / "out.osm", "--crs", CRS, "-o", tmp_path / "back")
    first, second = read_map(tmp_path / "map").by_id(), read_map(tmp_path / "back").by_id()
    assert first.keys() == second.keys() == rings.keys()
    for name, element in first.items():
        np.testing.assert_allclose(second[name].points, element.points, atol=1e-3)


def test_any_text_in_tags_comes_back(tmp_path: Path) -> None:
    """Quotes, markup, line ends and letters of all kinds; what XML cannot hold is replaced."""
    odd = {"name": "Große \"Straße\" & 'Weg' <1>", "note": "two\nlines\tand\r", "字": "道路"}
    osm = OsmFile(relations={1: Relation([], odd), 2: Relation([], {"a": "\x00\x1b\ufffe\ud800"})})
    write_osm(osm, tmp_path / "out.osm")
    back = read_osm(tmp_path / "out.osm").relations
    assert back[1].tags == odd
    assert back[2].tags == {"a": "\ufffd" * 4}
