"""Labels edited by hand, generated anew, and merged."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_lanelet2 import EAST, NORTH, Osm, parse, street

from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import read_map
from rtmap_cli.steps.label.merge.edits import edits_between
from rtmap_cli.steps.label.merge.merge import merge_edits

Rtmap = Callable[..., Any]
CRS = "EPSG:32632"


def shifted(osm: Osm, by: float) -> Osm:
    """Labels of another drive: every node a little to the north."""
    osm.nodes = {k: (x, y + by, z) for k, (x, y, z) in osm.nodes.items()}
    return osm


@pytest.fixture
def merged(rtmap: Rtmap, tmp_path: Path) -> Callable[..., tuple[Osm, dict[str, Any], Any]]:
    """``merged(edit, again, *options)``: the street, edited by ``edit``, merged into the street
    ``again``; what was exported, what the command said, and its result."""

    def call(
        edit: Callable[[Osm], None], again: Osm, *options: object, code: int = 0
    ) -> tuple[Osm, dict[str, Any], Any]:
        base = street().write(tmp_path / "base.osm")
        hand = street()
        edit(hand)
        edited = hand.write(tmp_path / "edited.osm")
        new = again.write(tmp_path / "new.osm")
        rtmap("import", "lanelet2", new, "--crs", CRS, "--no-join", "-o", tmp_path / "new")
        said = rtmap("label", "merge", base, edited, "--into", tmp_path / "new", "--json",
                     *options, code=code)  # fmt: skip
        rtmap("export", "lanelet2", tmp_path / "new", "-o", tmp_path / "out.osm")
        return parse(tmp_path / "out.osm"), json.loads(said.out), said

    return call


def move(osm: Osm, node: int, north: float) -> None:
    x, y, z = osm.nodes[node]
    osm.nodes[node] = (x, y + north, z)


def test_a_moved_line_moves_in_the_new_labels_too(merged: Any) -> None:
    """Both the drift of the new drive and the edit count; lanelets keep their nodes."""

    def edit(osm: Osm) -> None:
        for node in (4, 5, 6):
            move(osm, node, -0.4)

    out, said, _ = merged(edit, shifted(street(), 0.1))
    assert said["conflicts"] == [] and said["moved"] == 2 and said["version"] == 1
    for node in (4, 5, 6):
        assert out.nodes[node][1] == pytest.approx(3.5 - 0.4 + 0.1, abs=2e-3)
    assert out.nodes[1][1] == pytest.approx(7.1, abs=2e-3)
    assert out.relations[201][0] == street().relations[201][0]
    assert {n for k in (103, 104) for n in out.ways[k][0]} == {4, 5, 6}


def test_crossings_and_stop_lines_that_were_added_come_along(merged: Any) -> None:
    def edit(osm: Osm) -> None:
        osm.nodes |= {50: (20.0, 8.0, 110.0), 51: (20.0, -1.0, 110.0)}
        osm.nodes |= {52: (23.0, 8.0, 110.0), 53: (23.0, -1.0, 110.0)}
        osm.nodes |= {54: (18.0, 3.5, 110.0), 55: (18.0, 0.0, 110.0)}
        marking = {"type": "pedestrian_marking"}
        osm.ways |= {150: ([50, 51], marking), 151: ([52, 53], marking)}
        osm.ways[152] = ([54, 55], {"type": "stop_line"})
        walk = {"type": "lanelet", "subtype": "crosswalk"}
        osm.relations[250] = ([("way", 150, "left"), ("way", 151, "right")], walk)

    out, said, _ = merged(edit, shifted(street(), 0.1))
    assert said["inserted"] == 2 and said["conflicts"] == []
    assert out.relations[250][1]["subtype"] == "crosswalk"
    assert out.ways[152][1]["type"] == "stop_line"
    assert out.nodes[54][:2] == pytest.approx((18.0, 3.5), abs=2e-3)


def test_what_both_sides_moved_is_a_conflict(merged: Any, rtmap: Rtmap, tmp_path: Path) -> None:
    def edit(osm: Osm) -> None:
        for node in (7, 8, 9):
            move(osm, node, -0.5)

    elsewhere = street()
    for node in (7, 8, 9):
        move(elsewhere, node, 0.8)
    conflicts = tmp_path / "conflicts.geojson"
    out, said, told = merged(edit, elsewhere, "--conflicts", conflicts)
    assert {c["element_id"] for c in said["conflicts"]} == {"way-105", "way-106"}
    assert "conflict: divider way-105" in told.err
    assert out.nodes[8][1] == pytest.approx(-0.5, abs=2e-3), "the hand's word"
    sides = [f["properties"]["side"] for f in json.loads(conflicts.read_text())["features"]]
    assert sides == ["edited", "new"] * 2


def test_a_conflict_may_take_the_new_side_or_stop_everything(
    merged: Any, rtmap: Rtmap, tmp_path: Path
) -> None:
    def edit(osm: Osm) -> None:
        for node in (7, 8, 9):
            move(osm, node, -0.5)

    elsewhere = street()
    for node in (7, 8, 9):
        move(elsewhere, node, 0.8)
    out, said, _ = merged(edit, elsewhere, "--prefer", "new")
    assert said["conflicts"] and out.nodes[8][1] == pytest.approx(0.8, abs=2e-3)
    base, edited = tmp_path / "base.osm", tmp_path / "edited.osm"
    version = read_map(tmp_path / "new").version
    stop = ["--fail-on-conflict", "--prefer", "edited"]
    said = rtmap("label", "merge", base, edited, "--into", tmp_path / "new", *stop, code=1)
    assert "nothing was committed" in said.err
    assert read_map(tmp_path / "new").version == version


def test_deleted_and_tagged(merged: Any) -> None:
    def edit(osm: Osm) -> None:
        del osm.ways[120], osm.relations[220]
        osm.relations[204][0].pop()
        for number in (201, 202):
            osm.relations[number][1]["speed_limit"] = "30"

    out, said, _ = merged(edit, shifted(street(), 0.1))
    assert said["conflicts"] == [] and 120 not in out.ways and 220 not in out.relations
    assert out.relations[201][1]["speed_limit"] == "30"
    assert "speed_limit" not in out.relations[203][1]


def test_the_same_tag_changed_on_both_sides(merged: Any) -> None:
    again = street()
    again.relations[201][1]["speed_limit"] = "40"
    out, said, _ = merged(
        lambda osm: osm.relations[201][1].update(speed_limit="30"), again, "--prefer", "new"
    )
    assert [c["element_id"] for c in said["conflicts"]] == ["lanelet-201"]
    assert "'30' by hand and '40'" in said["conflicts"][0]["why"]
    assert out.relations[201][1]["speed_limit"] == "40"


def test_geojson_goes_round_too_and_twice_changes_nothing(rtmap: Rtmap, tmp_path: Path) -> None:
    street().write(tmp_path / "in.osm")
    rtmap("import", "lanelet2", tmp_path / "in.osm", "--crs", CRS, "-o", tmp_path / "map")
    base, edited = tmp_path / "base.geojson", tmp_path / "edited.geojson"
    rtmap("export", "geojson", tmp_path / "map", "-o", base)
    collection = json.loads(base.read_text(encoding="utf-8"))
    line = next(f for f in collection["features"] if f["id"] == "way-110" or f["id"] == "way-103")
    for place in line["geometry"]["coordinates"]:
        place[1] += 3e-6
    edited.write_text(json.dumps(collection), encoding="utf-8")
    into = ["--into", tmp_path / "map", "--json"]
    first = json.loads(rtmap("label", "merge", base, edited, *into).out)
    again = json.loads(rtmap("label", "merge", base, edited, *into).out)
    assert first["moved"] == 1 and again["already there"] == 1 and "moved" not in again
    nothing = json.loads(rtmap("label", "merge", base, base, *into).out)
    assert nothing["edits"] == 0 and not nothing["committed"]


def bent(element_id: str, north: float, step: float, class_name: str = "divider") -> Element:
    x = np.arange(0.0, 60.0 + step / 2, step)
    y = north + 0.001 * x**2
    return Element(element_id, class_name, np.column_stack([EAST + x, NORTH + y, 0 * x]))


def test_lines_of_other_ids_and_vertices_are_found_where_they_lie() -> None:
    """The new drive has other ids, other vertices, and the line in two; the bump goes along."""
    old = bent("old", 0.0, 2.0)
    bump = old.points.copy()
    bump[10:21, 1] += 0.6 * np.sin(np.linspace(0, np.pi, 11))
    new = bent("a", 0.1, 3.0)
    parts = [Element("a", "divider", new.points[:9]), Element("b", "divider", new.points[8:])]
    base, edited = VectorMap([old], CRS), VectorMap([old.with_points(bump)], CRS)
    edits = edits_between(base, edited, "hand", 0.02)
    out = merge_edits(base, edits, VectorMap(parts, CRS), 0.02, 0.5, "edited")
    assert not out.conflicts
    got = out.vector_map.by_id()
    whole = np.concatenate([got["a"].points, got["b"].points[1:]])
    moved = whole[:, 1] - new.points[:, 1]
    x = new.points[:, 0] - EAST
    wanted = np.interp(x, old.points[:, 0] - EAST, bump[:, 1] - old.points[:, 1])
    assert np.abs(moved - wanted).max() < 0.02 and moved.max() > 0.5


def test_two_editors_who_disagree(rtmap: Rtmap, tmp_path: Path) -> None:
    for name, north in (("base", 0.0), ("one", 0.5), ("two", -0.5)):
        osm = street()
        for node in (4, 5, 6):
            move(osm, node, north)
        osm.write(tmp_path / f"{name}.osm")
    rtmap("import", "lanelet2", tmp_path / "base.osm", "--crs", CRS, "-o", tmp_path / "new")
    files = [tmp_path / f"{n}.osm" for n in ("base", "one", "two")]
    said = rtmap("label", "merge", *files, "--into", tmp_path / "new", "--json")
    told = json.loads(said.out)
    assert told["moved"] == 1 and "one.osm and two.osm" in told["conflicts"][0]["why"]


def test_bad_input_is_one_line(rtmap: Rtmap, tmp_path: Path) -> None:
    street().write(tmp_path / "base.osm")
    rtmap("import", "lanelet2", tmp_path / "base.osm", "-o", tmp_path / "new")
    into = ("--into", tmp_path / "new")
    rtmap("import", "lanelet2", tmp_path / "base.osm", "--crs", "EPSG:32633", "-o",
          tmp_path / "other")  # fmt: skip
    for edited in (tmp_path / "none.osm", tmp_path, tmp_path / "other"):
        said = rtmap("label", "merge", tmp_path / "base.osm", edited, *into, code=3)
        assert said.err.count("\n") == 1 and str(edited) in said.err
