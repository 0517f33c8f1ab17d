"""Lanelet2 maps whose elements were moved, cut, deleted or added, written again."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sample_lanelet2 import CRS, EAST, NORTH, Osm, assert_same, parse, street

from rtmap_cli.maps.crs import to_lonlat
from rtmap_cli.maps.store import read_map

Rtmap = Callable[..., Any]
Features = dict[str, Any]


@pytest.fixture
def edited(rtmap: Rtmap, tmp_path: Path) -> Callable[..., tuple[Osm, dict[str, int]]]:
    """``edited(change, *options)``: the small street after ``change(features by id)``, exported;
    with what the export told."""

    def call(change: Callable[[Features], None], *options: str) -> tuple[Osm, dict[str, int]]:
        path = street().write(tmp_path / "in.osm")
        rtmap("import", "lanelet2", path, "-o", tmp_path / "map", *options)
        rtmap("export", "geojson", tmp_path / "map", "-o", tmp_path / "map.geojson")
        collection = json.loads((tmp_path / "map.geojson").read_text(encoding="utf-8"))
        features = {f["id"]: f for f in collection["features"]}
        change(features)
        collection["features"] = list(features.values())
        (tmp_path / "edited.geojson").write_text(json.dumps(collection), encoding="utf-8")
        rtmap("import", "geojson", tmp_path / "edited.geojson", "-o", tmp_path / "edited")
        out = tmp_path / "out.osm"
        said = rtmap("export", "lanelet2", tmp_path / "edited", "-o", out, "--json")
        again = tmp_path / "again.osm"
        rtmap("export", "lanelet2", tmp_path / "edited", "-o", again)
        assert again.read_bytes() == out.read_bytes()
        crs = read_map(tmp_path / "edited").crs
        rtmap("import", "lanelet2", out, "--crs", crs, "-o", tmp_path / "back", *options)
        rtmap("export", "lanelet2", tmp_path / "back", "-o", tmp_path / "last.osm")
        assert_same(parse(out), parse(tmp_path / "last.osm"))
        return parse(out), json.loads(said.out)["notes"]

    return call


def line(name: str, class_name: str, *xy: tuple[float, float], **more: str) -> dict[str, Any]:
    places = [(EAST + x, NORTH + y) for x, y in xy]
    lonlat = to_lonlat(CRS, places).tolist()  # type: ignore[arg-type]
    geometry = {"type": "LineString", "coordinates": lonlat}
    properties = {"id": name, "class": class_name, **more}
    return {"type": "Feature", "id": name, "properties": properties, "geometry": geometry}


def reshape(feature: dict[str, Any], *xy: tuple[float, float]) -> None:
    feature["geometry"] = line("", "", *xy)["geometry"]


def without_rest(osm: Osm) -> Osm:
    """The street without what only the history of its own map folder keeps."""
    del osm.ways[140], osm.relations[240]
    return osm


def test_nothing_changed(edited: Any) -> None:
    out, notes = edited(lambda features: None)
    assert_same(without_rest(street()), out)
    assert notes == {}


def test_paint_that_is_gone_leaves_a_virtual_bound(edited: Any) -> None:
    out, notes = edited(lambda features: features.pop("way-103"))
    wanted = without_rest(street())
    for number in (103, 104):
        wanted.ways[number] = (wanted.ways[number][0], {"type": "virtual"})
    assert_same(wanted, out)
    assert list(notes.values()) == [2]


def test_a_line_that_moved_takes_the_lanelets_along(edited: Any) -> None:
    def change(features: Features) -> None:
        reshape(features["way-103"], (60, 3.8), (30, 3.8), (0, 3.8))

    out, notes = edited(change)
    assert out.ways == without_rest(street()).ways and notes == {}
    assert [round(out.nodes[n][1], 3) for n in (4, 5, 6)] == [3.8, 3.8, 3.8]
    assert out.relations == without_rest(street()).relations


def test_a_line_drawn_the_other_way_round_turns_no_lanelet(edited: Any) -> None:
    def change(features: Features) -> None:
        reshape(features["way-105"], (30, 0.1), (0, 0.1))

    out, notes = edited(change, "--no-join")
    assert out.ways == without_rest(street()).ways
    assert out.nodes[7][:2] == pytest.approx((0, 0.1), abs=1e-3)
    assert list(notes.values()) == [1], "its neighbour did not move along"


def test_a_line_that_was_cut_keeps_its_whole_ways(edited: Any) -> None:
    def change(features: Features) -> None:
        reshape(features["way-101"], (0, 7.1), (30, 7.2), (45, 7))

    out, notes = edited(change)
    kept = without_rest(street())
    assert out.ways[101] == kept.ways[101]
    assert out.ways[102] == ([2, 3], {"type": "virtual"}), "the lanelet keeps its bound"
    (new,) = out.ways.keys() - kept.ways.keys()
    refs, tags = out.ways[new]
    assert refs[0] == 2 and refs[1] not in kept.nodes and tags["type"] == "curbstone"
    assert out.nodes[2][:2] == pytest.approx((30, 7.2), abs=1e-3)
    assert out.nodes[refs[1]][:2] == pytest.approx((45, 7), abs=1e-3)
    assert out.relations == kept.relations
    assert sorted(notes.values()) == [1, 1]


def test_a_piece_with_as_many_vertices_is_not_the_whole(edited: Any) -> None:
    def change(features: Features) -> None:
        reshape(features["way-105"], (0, 0), (12, 0))
        features["way-105.1"] = json.loads(json.dumps(features["way-105"]))
        features["way-105.1"]["id"] = features["way-105.1"]["properties"]["id"] = "way-105.1"
        reshape(features["way-105.1"], (22, 0), (30, 0))

    out, _ = edited(change, "--no-join")
    assert out.ways[105] == ([7, 8], {"type": "virtual"})
    assert out.nodes[8][:2] == pytest.approx((30, 0), abs=1e-3)
    pieces = [refs for refs, tags in out.ways.values() if "rtmap:id" in tags]
    assert len(pieces) == 2 and not any({7, 8} & set(refs) for refs in pieces)


def test_a_line_alone_that_was_drawn_anew_keeps_its_id(edited: Any) -> None:
    def change(features: Features) -> None:
        reshape(features["way-120"], (38, 3.5), (38, 2), (38, 0))

    out, notes = edited(change)
    assert len(out.ways[120][0]) == 3 and out.ways[120][1] == {"type": "stop_line"}
    assert out.relations == without_rest(street()).relations and notes == {}


@pytest.mark.parametrize(("shift", "split"), [(0.6, False), (3.0, True)])
def test_lines_that_moved_apart(edited: Any, shift: float, split: bool) -> None:
    """Ends that shared a node meet in their middle, or part where they are too far from it."""

    def change(features: Features) -> None:
        reshape(features["way-104"], (30, 3.5 - shift), (60, 3.5 - shift))

    out, notes = edited(change, "--no-join")
    assert sum(notes.values()) >= 1
    assert (out.ways[104][0][0] == 5) != split
    middle = 3.5 if split else 3.5 - shift / 2
    assert out.nodes[5][1] == pytest.approx(middle, abs=1e-3)


def test_what_refers_to_nothing_goes_too(edited: Any) -> None:
    out, notes = edited(lambda features: features.pop("way-121"))
    assert 220 not in out.relations
    assert out.relations[204][0] == [("way", 104, "left"), ("way", 106, "right")]
    assert sum(notes.values()) == 3


def test_a_light_without_its_stop_line_stays(edited: Any) -> None:
    out, _ = edited(lambda features: features.pop("way-120"))
    assert out.relations[220][0] == [("way", 121, "refers")]
    assert ("relation", 220, "regulatory_element") in out.relations[204][0]


def test_a_crosswalk_that_is_gone_takes_its_bounds(edited: Any) -> None:
    out, _ = edited(lambda features: features.pop("lanelet-210"))
    wanted = without_rest(street())
    del wanted.ways[110], wanted.ways[111], wanted.relations[210]
    assert_same(wanted, out)


def test_a_crosswalk_of_another_shape_keeps_its_ids(edited: Any) -> None:
    corners = ((40, -1), (44, -1), (44.3, 4), (44, 8), (42, 8.2), (40, 8), (39.7, 4), (40, -1))

    def change(features: Features) -> None:
        reshape(features["lanelet-210"], *corners)

    out, notes = edited(change)
    assert out.relations[210][0] == street().relations[210][0] and notes == {}
    refs = out.ways[110][0] + out.ways[111][0]
    found = {(round(out.nodes[n][0], 2), round(out.nodes[n][1], 2)) for n in refs}
    assert found == set(corners)
    assert out.ways[110][1] == {"type": "pedestrian_marking"}


def test_an_element_of_another_class_gets_another_type(edited: Any) -> None:
    def change(features: Features) -> None:
        features["way-105"]["properties"]["class"] = "boundary"
        features["way-120"]["properties"]["class"] = "kiosk"

    out, _ = edited(change)
    assert out.ways[105][1]["type"] == "road_border" and out.ways[105][1]["color"] == "yellow"
    assert out.ways[120][1]["type"] == "kiosk"


def test_new_elements(rtmap: Rtmap, tmp_path: Path, edited: Any) -> None:
    def change(features: Features) -> None:
        new = [
            line("d", "divider", (0, 1), (9, 1), mark="DOUBLE_SOLID_YELLOW", note="fresh & <new>"),
            line("b", "boundary", (0, -9), (9, -9)),
            line("r", "boundary", (0, -19), (9, -19), (5, -15), (0, -19)),
            line("s", "stop_line", (0, -3), (0, -6)),
            line("p", "ped_crossing", (80, 0), (84, 0), (84, 9), (80, 9), (80, 0)),
        ]
        features.update({f["id"]: f for f in new})

    out, notes = edited(change)
    old = without_rest(street())
    new = {
        t["rtmap:id"]: (r, t)
        for k, (r, t) in out.ways.items()
        if k not in old.ways and t.get("rtmap:id")
    }
    assert new["d"][1] == {
        "type": "line_thin",
        "subtype": "solid_solid",
        "color": "yellow",
        "note": "fresh & <new>",
        "rtmap:id": "d",
    }
    assert new["b"][1]["type"] == "road_border" and new["s"][1]["type"] == "stop_line"
    assert new["r"][0][0] == new["r"][0][-1] and len(new["r"][0]) == 4
    (crossing,) = (r for k, r in out.relations.items() if k not in old.relations)
    assert [m[2] for m in crossing[0]] == ["left", "right"]
    assert crossing[1]["subtype"] == "crosswalk" and crossing[1]["rtmap:id"] == "p"
    for number, content in old.ways.items():
        assert out.ways[number] == content
    assert notes == {}
    ids = [*out.ways, *out.relations, *out.nodes]
    assert min(ids) > 0 and max(ids) < 2**53
    names = read_map(tmp_path / "back").by_id()
    assert {name: names[name].class_name for name in "dbrsp"} == {
        "d": "divider",
        "b": "boundary",
        "r": "boundary",
        "s": "stop_line",
        "p": "ped_crossing",
    }


def test_a_new_line_that_was_cut_keeps_its_name(rtmap: Rtmap, tmp_path: Path, edited: Any) -> None:
    """From rtmap to Lanelet2 and back, shortened there, and to Lanelet2 again."""

    def change(features: Features) -> None:
        features["d"] = line("d", "divider", (0, 1), (9, 1), (40, 1))

    edited(change)
    before = parse(tmp_path / "out.osm").ways
    rtmap("export", "geojson", tmp_path / "back", "-o", tmp_path / "back.geojson")
    collection = json.loads((tmp_path / "back.geojson").read_text(encoding="utf-8"))
    (feature,) = (f for f in collection["features"] if f["id"] == "d")
    reshape(feature, (9, 1), (40, 1))
    (tmp_path / "cut.geojson").write_text(json.dumps(collection), encoding="utf-8")
    rtmap("import", "geojson", tmp_path / "cut.geojson", "-o", tmp_path / "cut")
    rtmap("export", "lanelet2", tmp_path / "cut", "-o", tmp_path / "cut.osm")
    after = parse(tmp_path / "cut.osm").ways
    assert before.keys() == after.keys()
    (number,) = (k for k, (_, tags) in after.items() if tags.get("rtmap:id") == "d")
    assert len(after[number][0]) == 2


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("lanelet2:ways", "[[101"),
        ("lanelet2:ways", "[[101, 7, false]]"),
        ("lanelet2:nodes", "1 two 3"),
        ("lanelet2:node_tags", '{"1": 2}'),
    ],
)
def test_broken_attributes(rtmap: Rtmap, tmp_path: Path, key: str, value: str) -> None:
    path = street().write(tmp_path / "in.osm")
    rtmap("import", "lanelet2", path, "-o", tmp_path / "map")
    rtmap("export", "geojson", tmp_path / "map", "-o", tmp_path / "map.geojson")
    collection = json.loads((tmp_path / "map.geojson").read_text(encoding="utf-8"))
    (feature,) = (f for f in collection["features"] if f["id"] == "way-101")
    feature["properties"][key] = value
    (tmp_path / "bad.geojson").write_text(json.dumps(collection), encoding="utf-8")
    rtmap("import", "geojson", tmp_path / "bad.geojson", "-o", tmp_path / "bad")
    out = tmp_path / "out.osm"
    said = rtmap("export", "lanelet2", tmp_path / "bad", "-o", out, code=3)
    assert "way-101" in said.err and said.err.count("\n") == 1
    assert not out.exists()
