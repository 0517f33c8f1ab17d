"""rtmap label lanes: lanes of drives, their graph, borders and what Lanelet2 says of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Result
from lane_drives import CRS, PLACE, circle, way, write_drive

from rtmap_cli.geometry.polylines import length, project, resample_step
from rtmap_cli.maps.store import read_map
from rtmap_cli.steps.simulate.towns.town import make_town

Rtmap = Callable[..., Result]
EAST = way((0, 0), (200, 0))
NORTH = way((0, 0), (100, 0), (100, 100))


def graph_of(path: Path) -> dict[str, Any]:
    return {f["id"]: f["properties"] for f in json.loads(path.read_text())["features"]}


def test_a_drive_becomes_lanelets_of_ten_feet(rtmap: Rtmap, tmp_path: Path) -> None:
    log = write_drive(tmp_path / "log", EAST)
    said = json.loads(rtmap("label", "lanes", log, "-o", tmp_path / "map", "--json").out)
    assert said["lanelets"] == 2 and said["forks"] == said["merges"] == 0
    assert said["lanes_m"] == pytest.approx(200, abs=1)
    borders = [e for e in read_map(tmp_path / "map") if e.class_name == "boundary"]
    assert {round(float(v), 3) for e in borders for v in e.xy[:, 1] - PLACE[1]} == {3.048, -3.048}


def test_widths_of_a_stretch(rtmap: Rtmap, tmp_path: Path) -> None:
    log = write_drive(tmp_path / "log", EAST)
    near = tmp_path / "widths.csv"
    near.write_text(f"x,y,radius,left,right\n{PLACE[0] + 50},{PLACE[1]},20,2,4\n")
    rtmap("label", "lanes", log, "-o", tmp_path / "map", "--width", 3, "--widths", near)
    xy = np.concatenate([e.xy for e in read_map(tmp_path / "map").of_class("boundary")]) - PLACE
    inside = np.abs(xy[:, 0] - 50) < 15
    assert set(np.round(xy[inside, 1], 3)) == {2.0, -4.0}
    assert {3.0, -3.0} <= set(np.round(xy[~inside, 1], 3))


def test_passes_that_part_fork(rtmap: Rtmap, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    logs = [
        write_drive(tmp_path / f"log{k}", line + rng.normal(0, 0.1, 2))
        for k, line in enumerate([EAST, NORTH, EAST, NORTH])
    ]
    said = json.loads(rtmap(
        "label", "lanes", *logs, "-o", tmp_path / "map", "--centrelines", tmp_path / "g.geojson",
        "--json",
    ).out)  # fmt: skip
    assert (said["forks"], said["merges"]) == (1, 0)
    assert said["lanes_m"] == pytest.approx(90 + 110 + 105, abs=12)
    lanes = graph_of(tmp_path / "g.geojson")
    fork = [p for p in lanes.values() if len(p["successors"]) == 2]
    assert len(fork) == 1 and fork[0]["passes"] == 4
    assert all(s in lanes for p in lanes.values() for s in p["successors"])


def test_a_merge_and_both_directions(rtmap: Rtmap, tmp_path: Path) -> None:
    back = way((200, 3.5), (0, 3.5))
    lines = [EAST, way((100, -100), (100, 0), (200, 0)), back]
    logs = [write_drive(tmp_path / f"log{k}", line) for k, line in enumerate(lines)]
    said = json.loads(rtmap("label", "lanes", *logs, "-o", tmp_path / "map", "--json").out)
    assert (said["forks"], said["merges"], said["ends"]) == (0, 1, 2)


def test_laps_close_a_loop(rtmap: Rtmap, tmp_path: Path) -> None:
    log = write_drive(tmp_path / "log", circle(20.0, 2.3))
    out = tmp_path / "g.geojson"
    said = json.loads(
        rtmap("label", "lanes", log, "-o", tmp_path / "map", "--centrelines", out, "--json").out
    )
    assert said["ends"] == said["forks"] == said["merges"] == 0
    assert said["lanes_m"] == pytest.approx(2 * np.pi * 20, rel=0.01)
    assert all(len(p["successors"]) == 1 for p in graph_of(out).values())


def test_a_change_of_lanes_is_no_lane(rtmap: Rtmap, tmp_path: Path) -> None:
    s = np.linspace(0, 1, 26)[:, None]
    shift = np.column_stack([80 + 50 * s, 3.5 * s**2 * (3 - 2 * s)])
    change = np.concatenate([EAST[:40], shift, [[p, 3.5] for p in range(132, 200, 2)]])
    lines = [EAST, EAST + [0, 3.5], change]
    logs = [write_drive(tmp_path / f"log{k}", line) for k, line in enumerate(lines)]
    said = json.loads(rtmap("label", "lanes", *logs, "-o", tmp_path / "map", "--json").out)
    assert said["forks"] == said["merges"] == 0
    assert said["lanes_m"] == pytest.approx(400, abs=2)


def test_stops_and_jumps(rtmap: Rtmap, tmp_path: Path) -> None:
    stop = np.repeat(EAST[50:51], 40, axis=0)
    jump = EAST[75:85] + [0.0, 25.0]
    line = np.concatenate([EAST[:50], stop, EAST[50:75], jump, EAST[85:]])
    log = write_drive(tmp_path / "log", line)
    said = json.loads(rtmap("label", "lanes", log, "-o", tmp_path / "map", "--json").out)
    assert said["notes"]["poses of stops"] >= 40
    assert said["notes"]["jumps of positions"] >= 2
    xy = np.concatenate([e.xy for e in read_map(tmp_path / "map")]) - PLACE
    assert not ((xy[:, 1] > 4) & (xy[:, 1] < 21)).any()


def test_lanelet2_loads_and_routes(rtmap: Rtmap, tmp_path: Path) -> None:
    lanelet2 = pytest.importorskip("lanelet2")
    lines = [EAST, NORTH, way((100, -100), (100, 0), (200, 0))]
    logs = [write_drive(tmp_path / f"log{k}", line) for k, line in enumerate(lines)]
    rtmap("label", "lanes", *logs, "-o", tmp_path / "map", "--speed-limit", 40)
    rtmap("export", "lanelet2", tmp_path / "map", "-o", tmp_path / "map.osm")
    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(48.75, 9.0))
    loaded, errors = lanelet2.io.loadRobust(str(tmp_path / "map.osm"), projector)
    assert not errors
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    graph = lanelet2.routing.RoutingGraph(loaded, rules)
    lanelets = list(loaded.laneletLayer)
    assert all(rules.canPass(x) and rules.isOneWay(x) for x in lanelets)
    assert {round(rules.speedLimit(x).speedLimit) for x in lanelets} == {40}
    start = next(
        x for x in lanelets if not graph.previous(x) and len(graph.reachableSet(x, 1e4, 0)) > 2
    )
    goals = [x for x in lanelets if not graph.following(x)]
    assert len(goals) == 2
    assert all(graph.getRoute(start, g) is not None for g in goals)


def test_borders_come_to_observed_lines(rtmap: Rtmap, tmp_path: Path) -> None:
    rtmap("simulate", "town", "--seed", 4, "--size", 300, "-o", tmp_path / "town")
    lane = max(make_town(4, 300.0).lanes, key=length)
    log = write_drive(tmp_path / "log", resample_step(lane[:, :2], 2.0) - PLACE)
    rtmap(
        "simulate", "observations", "--map", tmp_path / "town", "--log", log,
        "-o", tmp_path / "run", "--preset", "perfect", "-q",
    )  # fmt: skip
    said = json.loads(rtmap(
        "label", "lanes", tmp_path / "run", "--snap", tmp_path / "run", "-o", tmp_path / "map",
        "--json",
    ).out)  # fmt: skip
    assert said["vertices"]["paint"] + said["vertices"]["curb"] > said["vertices"]["width"]
    truth = [e.xy for e in read_map(tmp_path / "town") if e.class_name != "ped_crossing"]
    off = [
        np.min([project(e.xy, line)[1] for line in truth], axis=0)
        for e in read_map(tmp_path / "map")
        if e.attributes.get("rtmap:border") in ("paint", "curb")
    ]
    assert np.percentile(np.concatenate(off), 75) < 1.0


@pytest.mark.parametrize("crs", ["EPSG:32633"])
def test_sources_of_two_crs_are_refused(rtmap: Rtmap, tmp_path: Path, crs: str) -> None:
    a, b = write_drive(tmp_path / "a", EAST), write_drive(tmp_path / "b", EAST, crs)
    said = rtmap("label", "lanes", a, b, "-o", tmp_path / "map", code=3)
    assert crs in said.err and CRS in said.err and not (tmp_path / "map").exists()


def test_what_is_no_drive_is_refused(rtmap: Rtmap, tmp_path: Path) -> None:
    (tmp_path / "nothing").mkdir()
    rtmap("label", "lanes", tmp_path / "nothing", "-o", tmp_path / "map", code=3)
    parked = write_drive(tmp_path / "parked", np.repeat(EAST[:1], 20, axis=0) + [[0.0, 0.0]])
    said = rtmap("label", "lanes", parked, "-o", tmp_path / "map", code=4)
    assert "nothing was driven" in said.err
    log = write_drive(tmp_path / "log", EAST)
    rtmap("label", "lanes", log, "--snap", log, "-o", tmp_path / "map", code=3)
    bad = tmp_path / "w.csv"
    bad.write_text("x,y\n1,2\n")
    said = rtmap("label", "lanes", log, "--widths", bad, "-o", tmp_path / "map", code=3)
    assert "no table" in said.err


def test_offsets_of_a_tight_curve_do_not_turn_back(rtmap: Rtmap, tmp_path: Path) -> None:
    log = write_drive(tmp_path / "log", way((0, 0), (40, 0), (40, 40), radius=4.0))
    rtmap("label", "lanes", log, "-o", tmp_path / "map", "--width", 4)
    borders = read_map(tmp_path / "map").of_class("boundary")
    centre = way((0, 0), (40, 0), (40, 40), radius=4.0) + PLACE
    for e in borders:
        d = np.diff(e.xy, axis=0)
        turn = np.degrees(np.abs(np.diff(np.unwrap(np.arctan2(d[:, 1], d[:, 0])))))
        assert turn.max() < 100 and length(e.points) < 90
        assert project(e.xy, centre)[1].max() < 4.6
