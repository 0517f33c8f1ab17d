"""Scenarios of frames: hand labels of real logs, towns, and roads drawn for one purpose each."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from rtmap_cli.geometry.poses import se3_from_xyyaw
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.steps.evaluate.drives import Drive, read_drives
from rtmap_cli.steps.evaluate.maps.compare import label_frames
from rtmap_cli.steps.evaluate.scenarios.labels import SCENARIOS, scenarios_of

CRS = "EPSG:32632"
EAST, NORTH = 500_000.0, 5_000_000.0

Times = dict[str, list[tuple[float, float]]]

YES: dict[str, Times] = {
    "3bffdcff": {
        "straight": [(0, 5.5), (13.5, 15.9)],
        "turning": [(7, 11)],
        "intersection": [(5.5, 10.5)],
        "multi-lane": [(0, 5), (13, 15.9)],
    },
    "7fab2350": {
        "straight": [(0, 11.5)],
        "turning": [(13.3, 15.9)],
        "intersection": [(14.2, 15.9)],
        "multi-lane": [(5, 12)],
    },
    "adcf7d18": {
        "straight": [(0, 15.9)],
        "intersection": [(11.2, 15.9)],
        "multi-lane": [(0, 10)],
    },
}
NO: dict[str, Times] = {
    "3bffdcff": {
        "straight": [(7, 11)],
        "turning": [(0, 5.5), (13.5, 15.9)],
        "intersection": [(0, 4.3), (14, 15.9)],
        "loop": [(0, 15.9)],
        "roundabout": [(0, 15.9)],
        "multi-lane": [(6.5, 9.5)],
    },
    "7fab2350": {
        "straight": [(13.3, 15.9)],
        "turning": [(0, 11.5)],
        "intersection": [(0, 11)],
        "loop": [(0, 15.9)],
        "roundabout": [(0, 15.9)],
        "multi-lane": [(1, 3.5)],
    },
    "adcf7d18": {
        "turning": [(0, 15.9)],
        "intersection": [(0, 9)],
        "loop": [(0, 15.9)],
        "roundabout": [(0, 15.9)],
        "multi-lane": [(12, 15)],
    },
}
"""Seconds since the first pose, by eye from the path drawn over the map, before there was a
classifier. What is in neither table is a change from one to the other that nobody can date."""


@pytest.mark.parametrize("log", list(YES))
def test_hand_labels_of_real_logs(rtmap_data: Path, log: str) -> None:
    from rtmap_cli.formats.av2.log import read_av2_map

    folders = sorted((rtmap_data / "av2_sensor").glob(f"{log}-*"))
    if not folders:
        pytest.skip(f"log {log} not found in RTMAP_DATA/av2_sensor")
    found = read_av2_map(folders[0])
    true_map = found[0] if isinstance(found, tuple) else found
    drives = read_drives(folders[0])
    seconds = np.arange(0, 15.9, 0.1)
    start = int(drives[0].timestamp_ns[0])
    keys = [f"{drives[0].name}_{start + round(s * 1e9)}" for s in seconds]
    labels = label_frames(keys, drives, true_map)
    assert tuple(labels) == SCENARIOS
    for table, expected in ((YES, True), (NO, False)):
        for name, spans in table[log].items():
            for low, high in spans:
                inside = (seconds >= low) & (seconds <= high)
                wrong = seconds[inside & (labels[name] != expected)]
                assert not len(wrong), f"{name} is {not expected} at {wrong.round(1)} s"
    judged = sum(h - low for t in (YES, NO) for v in t[log].values() for low, h in v)
    assert judged > 0.75 * 6 * 15.9, "the labels cover most of the log"


# --- roads drawn for one purpose each ----------------------------------------------------------


def rings(surface: Any, name: str = "boundary") -> list[Element]:
    out = []
    for part in shapely.get_parts(surface):
        for ring in (part.exterior, *part.interiors):
            xy = np.asarray(ring.coords) + [EAST, NORTH]
            out.append(Element(f"{name}-{len(out)}", name, xy))
    return out


def road(*lines: list[tuple[float, float]], width: float = 8.0) -> Any:
    return shapely.union_all(
        [shapely.LineString(x).buffer(width / 2, cap_style="flat") for x in lines]
    )


def driven(path: np.ndarray, step: float = 1.0) -> Drive:
    """A drive along a path (n, 2), a frame per metre and 0.1 s, looking where it goes."""
    line = shapely.LineString(path)
    at = np.arange(0, line.length, step)
    xy = shapely.get_coordinates(shapely.line_interpolate_point(line, at))
    way = np.gradient(xy, axis=0)
    pose = se3_from_xyyaw(xy[:, 0] + EAST, xy[:, 1] + NORTH, np.arctan2(way[:, 1], way[:, 0]))
    return Drive("drive", CRS, np.arange(len(xy), dtype=np.int64) * 10**8, pose)


def labels_of(path: np.ndarray, elements: list[Element]) -> tuple[dict[str, np.ndarray], Any]:
    drive = driven(path)
    found = scenarios_of(drive, VectorMap(elements, CRS), drive.timestamp_ns)
    return found, drive.pose[:, :2, 3] - [EAST, NORTH]


def arc(radius: float, start: float, stop: float, n: int = 60) -> np.ndarray:
    angle = np.radians(np.linspace(start, stop, n))
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def test_a_straight_road_has_nothing_else() -> None:
    side_yard = shapely.box(20, 0, 26, 14)
    found, _ = labels_of(
        np.array([[-100, -2], [100, -2.0]]), rings(road([(-120, 0), (120, 0)]) | side_yard)
    )
    assert found["straight"].all()
    assert not any(found[name].any() for name in SCENARIOS[1:]), "a yard is no side road"


def test_crossroads_and_a_turn() -> None:
    surface = rings(road([(-90, 0), (90, 0)], [(0, -90), (0, 90)]))
    through, xy = labels_of(np.array([[-80, -2], [80, -2.0]]), surface)
    near = np.abs(xy[:, 0])
    assert through["intersection"][near <= 8].all() and through["straight"].all()
    assert not through["intersection"][near >= 12].any()
    corner = arc(6, -90, 0) + [-4, 4.0]
    turn, xy = labels_of(np.vstack([[[-80, -2]], corner, [[2, 80]]]), surface)
    at_corner = np.hypot(*(xy - [0.2, -0.2]).T)
    assert turn["turning"][at_corner < 3].all() and not turn["turning"][at_corner > 14].any()
    assert (turn["straight"] != turn["turning"]).all()
    assert not turn["loop"].any() and not turn["roundabout"].any()


def test_waiting_before_a_turn_is_straight() -> None:
    drive = driven(np.vstack([[[-60, 0]], arc(8, -90, 0) + [0, 8.0], [[8, 60]]]))
    stop = 58
    pose = np.concatenate([drive.pose[:stop], drive.pose[stop : stop + 1].repeat(100, 0)])
    # A standing receiver jitters, which is no way driven.
    pose[stop:, :2, 3] += np.random.default_rng(0).normal(0, 0.05, (100, 2))
    pose = np.concatenate([pose, drive.pose[stop:]])
    times = np.arange(len(pose), dtype=np.int64) * 10**8
    found = scenarios_of(Drive("drive", CRS, times, pose), VectorMap([], CRS), times)
    assert found["straight"][: stop + 100].all()
    assert found["turning"][stop + 104 : stop + 110].all()


def test_a_roundabout_with_and_without_its_island() -> None:
    ring = shapely.Point(0, 0).buffer(18) - shapely.Point(0, 0).buffer(9)
    surface = road([(-80, 0), (-12, 0)], [(12, 0), (80, 0)], [(0, 12), (0, 80)]) | ring
    half = np.vstack([[[-80, -2], [-22, -3]], arc(13.5, 200, 340), [[22, -3], [80, -2]]])
    found, xy = labels_of(half, rings(surface))
    inside = np.hypot(*xy.T) < 14
    assert found["roundabout"][inside].mean() > 0.9
    assert not found["roundabout"][np.hypot(*xy.T) > 24].any()
    bare, _ = labels_of(half, rings(surface | shapely.Point(0, 0).buffer(9)))
    assert not bare["roundabout"].any(), "half a circle without an island may be any bend"
    whole = np.vstack([[[-80, -2], [-22, -3]], arc(13.5, 200, 520), [[-80, 2]]])
    circle, _ = labels_of(whole, [])
    assert circle["roundabout"].sum() > 50


def test_a_city_block_is_no_roundabout_but_a_loop() -> None:
    block = shapely.box(0, 0, 60, 60).buffer(4).exterior
    surface = rings(block.buffer(4))
    found, _ = labels_of(np.asarray(block.coords), surface)
    assert found["loop"].mean() > 0.9 and not found["roundabout"].any()
    lollipop = np.vstack([[[-150, 30], [-4, 30]], arc(34, 180, -170) + [30, 30.0], [[-150, 34]]])
    found, xy = labels_of(lollipop, [])
    assert found["loop"][xy[:, 0] > 0].all() and not found["loop"][xy[:, 0] < -20].any()
    there_and_back = np.vstack([[[0, 0], [200, 0]], [[200, 3], [0, 3.0]]])
    assert not labels_of(there_and_back, [])[0]["loop"].any()


def divider(name: str, y: float, x0: float = -100, x1: float = 100) -> Element:
    return Element(name, "divider", np.array([[x0 + EAST, y + NORTH], [x1 + EAST, y + NORTH]]))


def test_lanes_are_counted_across_the_road() -> None:
    surface = rings(road([(-120, 0), (120, 0)], width=14))
    path = np.array([[-90, -2], [90, -2.0]])
    two, _ = labels_of(path, [*surface, divider("a", 0), divider("b", 0.3), divider("c", 9)])
    assert not two["multi-lane"].any(), "a double line is one, beyond the kerb is none"
    four, xy = labels_of(path, [*surface, divider("a", 0), divider("b", 3.5, 0, 100)])
    np.testing.assert_array_equal(four["multi-lane"][2:-2], xy[2:-2, 0] >= 0)
    median = rings(shapely.box(-100, -0.5, 100, 0.5))
    split, _ = labels_of(path, [*surface, *median, divider("b", -4)])
    assert split["multi-lane"].all() and not split["intersection"].any()


@pytest.mark.parametrize("seed", [2, 4])
def test_junctions_of_towns(seed: int) -> None:
    from scipy.spatial import cKDTree

    from rtmap_cli.steps.simulate.towns.town import make_town

    town = make_town(seed)
    ends = [np.array([lane[k] for lane in town.lanes]) for k in (0, -1)]
    branch = np.array([[len(n) for n in cKDTree(e).query_ball_point(e, 0.05)] for e in ends])
    connector = [lane for lane, n in zip(town.lanes, branch.T, strict=True) if n.max() > 1]
    streets = [lane for lane, n in zip(town.lanes, branch.T, strict=True) if n.max() == 1]
    near = cKDTree(np.concatenate(connector))
    hits, beyond = [], []
    for lane in connector[::5] + streets[::3]:
        drive = driven(lane - [EAST, NORTH])
        if len(drive) < 3:
            continue
        label = scenarios_of(drive, town.vector_map, drive.timestamp_ns)["intersection"]
        gap = near.query(drive.pose[:, :2, 3])[0]
        hits.append(label[gap < 1.0])
        beyond.append(label[gap > 12.0])
    assert np.concatenate(hits).mean() > 0.9
    assert np.concatenate(beyond).mean() < 0.2, "side roads without lanes are junctions, too"


# --- the command line --------------------------------------------------------------------------


@pytest.fixture
def crossroads(tmp_path: Path) -> Path:
    """A folder with the map ``world`` of crossroads and the poses of a drive through it."""
    from rtmap_cli.logs.run import true_poses
    from rtmap_cli.logs.run_files import write_poses

    surface = rings(road([(-90, 0), (90, 0)], [(0, -90), (0, 90)]))
    write_new_map(VectorMap([*surface, divider("a", 0, -90, -8)], CRS), tmp_path / "world", "test")
    drive = driven(np.array([[-80, -2], [80, -2.0]]), step=4.0)
    (tmp_path / "truth").mkdir()
    rows = np.arange(len(drive), dtype=np.int32)
    write_poses(true_poses(rows, drive.timestamp_ns, drive.pose), tmp_path / "truth", CRS)
    return tmp_path


def test_by_scenario(rtmap: Any, crossroads: Path) -> None:
    world = crossroads / "world"
    command = ["evaluate", "map", world, "--truth", world, "--poses", crossroads]
    command += ["--classes", "divider,boundary", "--by", "scenario"]
    result = json.loads(rtmap(*command, "--json", "--bootstrap", "20").out)
    parts = result["scenarios"]
    assert list(parts) == list(SCENARIOS)
    assert parts["straight"]["frames"] == result["frames"] == 40
    assert parts["straight"]["classes"] == result["classes"]
    assert 3 <= parts["intersection"]["frames"] <= 7 and parts["loop"]["frames"] == 0
    assert parts["intersection"]["mAP"] == pytest.approx(1.0)
    assert parts["intersection"]["classes"]["boundary"]["num_gt"] > 0
    assert parts["intersection"]["intervals"]["blocks"] >= 1
    text = rtmap(*command).out
    assert "intersection" in text and "roundabout" in text
    rtmap(*command, "--fail-under", "mAP.intersection=0.9")
    assert "mAP.intersection" in rtmap(*command, "--fail-under", "mAP.intersection=1.1", code=1).err


def test_scenarios_need_a_drive_and_a_map(rtmap: Any, crossroads: Path, tmp_path: Path) -> None:
    world = crossroads / "world"
    command = ["evaluate", "map", world, "--truth", world, "--by", "scenario"]
    assert "--poses" in rtmap(*command, code=2).err
    rtmap(*command, "--poses", crossroads, "--cells", "18", code=2)
    element = {"class": "divider", "points": [[-30, 2], [20, 2]]}
    frames = {f"drive_{k * 10**8}": [element] for k in range(0, 40, 4)}
    truth = tmp_path / "truth.json"
    truth.write_text(json.dumps({"classes": ["divider"], "frames": frames}))
    command = ["evaluate", "map", world, "--truth", truth, "--poses", crossroads]
    assert "--scenario-map" in rtmap(*command, "--by", "scenario", code=2).err
    more = ["--by", "scenario", "--scenario-map", world, "--json"]
    result = json.loads(rtmap(*command, *more).out)
    assert result["scenarios"]["straight"]["frames"] == 10
    assert 0 < result["scenarios"]["intersection"]["frames"] < 10
