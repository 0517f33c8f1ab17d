"""Changes of the world: what the truth says is what the maps differ in."""

from __future__ import annotations

import json

import numpy as np
import pytest
import shapely

from rtmap_cli.errors import NoAnswer, UsageError
from rtmap_cli.geometry.polylines import length
from rtmap_cli.maps.crs import lonlat_to
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import read_map
from rtmap_cli.steps.simulate.towns.town import Town, make_town
from rtmap_cli.steps.simulate.worlds.changes import ChangeSpec, change_world, parse_spec
from rtmap_cli.steps.simulate.worlds.world import even_odd_surface, world_from_map


@pytest.fixture(scope="module")
def town() -> Town:
    return make_town(4, 260)


def total(vector_map: VectorMap, class_name: str) -> float:
    return sum(length(e.points) for e in vector_map.of_class(class_name))


@pytest.mark.parametrize("name", ["ped_crossing", "divider", "boundary"])
def test_delete_takes_out_what_it_says(town, name):
    before = town.vector_map
    after, changes = change_world(before, [ChangeSpec("delete", name, 2)], np.random.default_rng(1))
    assert [c.kind for c in changes] == ["delete", "delete"]
    gone = sum(length(c.points) for c in changes)
    lost = total(before, name) - total(after, name)
    assert gone - 1e-6 <= lost <= gone + 4 * 3.0
    assert all(c.element_id in before.by_id() for c in changes)
    lines = shapely.union_all([shapely.linestrings(e.xy) for e in after.of_class(name)])
    for change in changes:
        middle = change.points[len(change.points) // 2]
        if name != "ped_crossing":
            assert shapely.distance(lines, shapely.points(middle)) > 0.5
    others = [e for e in before if e.class_name != name]
    assert all(e.element_id in after.by_id() for e in others)


@pytest.mark.parametrize("name", ["ped_crossing", "divider", "boundary"])
def test_insert_lies_on_the_road_apart_from_the_rest(town, name):
    surface = even_odd_surface(town.vector_map).buffer(0.05)
    after, changes = change_world(
        town.vector_map, [ChangeSpec("insert", name)], np.random.default_rng(2)
    )
    (change,) = changes
    assert change.kind == "insert"
    assert change.element_id in after.by_id()
    assert shapely.contains(surface, shapely.linestrings(change.points))
    if name != "ped_crossing":
        old = [shapely.linestrings(e.xy) for e in town.vector_map]
        assert shapely.distance(shapely.linestrings(change.points), old).min() >= 1.1
        assert 10 < length(change.points) < 22


def test_a_crossing_goes_in_beside_one_that_crosses_itself(town):
    (x, y), (u, v) = (
        f(np.concatenate([e.xy for e in town.vector_map]), 0) for f in (np.min, np.max)
    )
    # Two of them that overlap: their outlines meet at points that belong to neither.
    loops = [
        np.array([(x, y), (u, v + k), (u, y + k), (x, v), (x, y)]) * 0.01
        + 0.99 * np.array([x - 50, y - 50])
        for k in (0.0, 3.0)
    ]
    broken = [Element(f"loop-{k}", "ped_crossing", loop) for k, loop in enumerate(loops)]
    before = VectorMap([*town.vector_map, *broken], town.vector_map.crs)
    _, (change,) = change_world(
        before, [ChangeSpec("insert", "ped_crossing")], np.random.default_rng(2)
    )
    assert change.kind == "insert"


def test_move_is_a_delete_and_an_insert_beside(town):
    _, changes = change_world(
        town.vector_map, [ChangeSpec("move", "divider")], np.random.default_rng(3)
    )
    old, new = changes
    assert (old.kind, new.kind) == ("delete", "insert")
    assert old.moved == new.moved is not None
    gap = shapely.distance(shapely.linestrings(old.points), shapely.points(new.points))
    assert 0.8 < np.median(gap) < 1.7


def test_changes_near_a_path_lie_near_it(town):
    path = np.concatenate(town.lanes[:2])
    specs = [ChangeSpec("insert", "divider", 2), ChangeSpec("delete", "boundary")]
    try:
        _, changes = change_world(town.vector_map, specs, np.random.default_rng(4), path)
    except NoAnswer:
        pytest.skip("this path is too short")
    for change in changes:
        middle = change.points[len(change.points) // 2]
        assert np.hypot(*(path - middle).T).min() < 14.1


def test_a_deleted_curb_keeps_the_asphalt(town):
    after, changes = change_world(
        town.vector_map, [ChangeSpec("delete", "boundary", 2)], np.random.default_rng(5)
    )
    before = even_odd_surface(town.vector_map).area
    world = world_from_map(after, surface_map=town.vector_map)
    assert world.surface.area == pytest.approx(before, rel=1e-9)
    assert len(world.soft) == len(changes)
    # Without the old map the gap is closed by a straight line: almost the same road.
    assert world_from_map(after).surface.area == pytest.approx(before, rel=0.02)


@pytest.mark.parametrize(
    "text", ["delete", "vanish:divider", "delete:tree", "move:boundary", "delete:divider*0"]
)
def test_specs_that_cannot_be_meant(text):
    with pytest.raises(UsageError):
        parse_spec(text)


def test_the_command_both_ways(rtmap, tmp_path):
    town = tmp_path / "town"
    rtmap("simulate", "town", "--seed", 4, "--size", 200, "-o", town)
    arguments = ["--change", "delete:ped_crossing", "--change", "insert:divider", "--seed", 3]
    world, prior = tmp_path / "world", tmp_path / "prior"
    truth = tmp_path / "truth.json"
    rtmap("simulate", "changes", "--map", town, *arguments, "-o", world, "--truth", truth)
    changes = json.loads(truth.read_text())["changes"]
    assert [(c["kind"], c["class"]) for c in changes] == [
        ("delete", "ped_crossing"),
        ("insert", "divider"),
    ]
    old, new = read_map(town).by_id(), read_map(world).by_id()
    assert changes[0]["element_id"] in old and changes[0]["element_id"] not in new
    assert changes[1]["element_id"] in new and changes[1]["element_id"] not in old
    ring = np.array(changes[0]["geometry"]["coordinates"][0])
    xy = lonlat_to("EPSG:32632", ring)
    assert np.abs(xy - old[changes[0]["element_id"]].xy).max() < 0.01
    got = rtmap(
        "simulate", "changes", "--map", town, *arguments, "--outdate", "-o", prior, "--json"
    )
    changes = json.loads(got.out)["changes"]
    assert [c["kind"] for c in changes] == ["delete", "insert"]
    stale = read_map(prior).by_id()
    assert changes[0]["element_id"] in stale and changes[0]["element_id"] not in old
    assert changes[1]["element_id"] in old and changes[1]["element_id"] not in stale


def test_bad_input_of_the_command(rtmap, tmp_path):
    town = tmp_path / "town"
    rtmap("simulate", "town", "--seed", 4, "--size", 130, "-o", town)
    call = ["simulate", "changes", "--map", town, "-o", tmp_path / "x"]
    assert "known are" in rtmap(*call, "--change", "burn:divider", code=2).err
    assert "no class" in rtmap(*call, "--change", "delete:lamp", code=2).err
    assert "no place" in rtmap(*call, "--change", "delete:ped_crossing*999", code=4).err
    assert not (tmp_path / "x").exists()
    missing = rtmap("simulate", "changes", "--map", tmp_path / "no", "--change", "delete:divider",
                    "-o", tmp_path / "x", code=3)  # fmt: skip
    assert missing.err.count("\n") == 1
