"""Argoverse 2: sensor logs and vector maps, on a small synthetic log and on the sample data."""

from __future__ import annotations

import copy
import gzip
import json
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_logs import av2_archive, rewrite, truncate, write_archive, write_av2_log

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.av2.elements import dividers
from rtmap_cli.formats.av2.log import Av2Log, read_av2_map, thin
from rtmap_cli.formats.av2.vector_map import read_av2_archive, vector_map_of
from rtmap_cli.geometry.polylines import length, resample
from rtmap_cli.geometry.poses import se3_from_xyyaw, xyyaw_of
from rtmap_cli.logs.log import Log
from rtmap_cli.logs.open import open_log
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.crs import city_crs
from rtmap_cli.maps.element import VectorMap

PIT = city_crs("PIT")[1]
START = 315_966_253_000_000_000


@pytest.fixture
def small_log(tmp_path: Path) -> Path:
    return write_av2_log(tmp_path / "small")


# The log ---------------------------------------------------------------------------------------


def test_log_in_utm(small_log: Path) -> None:
    log: Log = open_log(small_log)
    assert isinstance(log, Av2Log)
    assert (log.log_id, log.city, log.crs, log.ground_z) == ("small", "PIT", "EPSG:32617", -0.32)
    frames = list(log.frames())
    assert len(frames) == len(log) == 39  # 20 Hz images of 1.9 s
    np.testing.assert_allclose(frames[10].map_SE3_ego[:2, 3], PIT + [5.0, -1.75], atol=1e-9)
    assert frames[10].map_SE3_ego[2, 3] == pytest.approx(20.37)
    assert set(frames[0].images) == {"ring_front_center", "ring_front_left"}
    assert log.read_image(frames[0], "ring_front_left").shape == (48, 64, 3)
    assert log.notes == []


def test_rig_is_in_the_order_of_the_network(small_log: Path) -> None:
    rig = Av2Log(small_log).rig
    assert rig is not None
    assert [c.name for c in rig] == ["ring_front_center", "ring_front_left"]
    assert (rig.cameras[0].width, rig.cameras[0].height) == (64, 48)
    assert rig.cameras[0].distortion == (-0.2, 0.0, 0.0)
    stereo = Av2Log(small_log, cameras=("stereo_front_left",)).rig
    assert stereo is not None and len(stereo) == 1


def test_frames_without_images_are_annotated_moments(tmp_path: Path) -> None:
    folder = write_av2_log(tmp_path / "small", images=False)
    log = Av2Log(folder)
    assert len(log) == 21 and log.notes == ["no images"]
    assert len(Av2Log(folder, rate_hz=2)) == 5
    (folder / "annotations.feather").unlink()
    assert len(Av2Log(folder)) == 21
    assert len(Av2Log(folder, rate_hz=50)) == 101  # between poses: interpolated


def test_occluders_are_vehicles_in_the_ego_frame(small_log: Path) -> None:
    frames = list(Av2Log(small_log).frames())
    (box,) = frames[0].occluders
    assert (box.x, box.y, box.length) == pytest.approx((12.0, 3.5, 4.5))
    assert box.z == pytest.approx(0.5 - 0.8)
    assert box.yaw == pytest.approx(0.1)
    # 50 ms after the annotation the car has driven 0.5 m towards the standing box.
    assert frames[1].occluders[0].x == pytest.approx(11.5)


def test_cuboids_leave_the_ego_vehicle_out(small_log: Path) -> None:
    cuboids = Av2Log(small_log).cuboids(START)
    assert cuboids is not None
    assert cuboids.category.tolist() == ["REGULAR_VEHICLE", "BOLLARD"]
    assert Av2Log(small_log).cuboids(START - 10**9) is None


def test_sweep_is_float16_with_offsets(small_log: Path) -> None:
    log = Av2Log(small_log)
    sweep = log.sweep(START + 500_000_000)
    assert len(sweep.xyz) == 3  # the point that is not a number is left out
    assert sweep.xyz[1, 0] == pytest.approx(70.0625)
    assert sweep.offset_ns.tolist() == [0, 10, 20]
    frame = list(log.frames())[11]  # 50 ms later, 0.5 m further on
    points = log.read_sweep(frame)
    assert points is not None
    np.testing.assert_allclose(points[0], [4.5, 1.0, -0.32 - 0.005, 0.0], atol=1e-3)
    assert points[2, 3] == 1.0
    with pytest.raises(BadInput, match=r"no sweep 1\.feather"):
        log.sweep(1)


def test_ground_raster_is_bilinear_and_unknown_outside(small_log: Path) -> None:
    log = Av2Log(small_log)
    xy = np.array([[0.0, 0.0], [12.3, 3.1], [-10.0, -10.0], [5.0, 8.2], [-10.1, 0.0], [200.0, 0.0]])
    z = log.ground_height(xy + PIT)
    np.testing.assert_allclose(z[:3], [20.0, 20.123, 19.9], atol=1e-4)
    assert np.isnan(z[3:]).all()


def test_rates() -> None:
    times = START + np.arange(0, 10_000_000_001, 50_000_000)
    for rate in (1.0, 2.0, 7.0, 10.0):
        chosen = thin(times, rate)
        assert len(chosen) == int(10 * rate) + 1
        wanted = START + np.arange(len(chosen)) / rate * 1e9
        assert np.abs(chosen - wanted).max() <= 25_000_128
    np.testing.assert_array_equal(thin(times, 20.0), times)
    np.testing.assert_array_equal(thin(times, 100.0), times)


def test_missing_calibration_is_said(small_log: Path) -> None:
    for path in (small_log / "calibration").iterdir():
        path.unlink()
    log = Av2Log(small_log)
    assert log.rig is None
    assert log.notes == ["no calibration: the log has no rig"]
    assert all(not f.images for f in log.frames())


@pytest.mark.parametrize(
    ("row", "values", "why"),
    [
        (5, {"tx_m": float("nan")}, "the pose of row 5 is not a number"),
        (5, {"timestamp_ns": START}, "row 5 is earlier"),
        (5, {"timestamp_ns": START + 40_000_000}, "row 5 repeats"),
        (5, {"qw": 3.0}, "quaternion of row 5"),
        (5, {"tz_m": None}, "tz_m has missing values"),
    ],
)
def test_bad_poses(small_log: Path, row: int, values: dict[str, Any], why: str) -> None:
    import pyarrow.feather as feather

    path = small_log / "city_SE3_egovehicle.feather"
    for name, value in values.items():
        column = feather.read_table(path)[name].to_pylist()
        column[row] = value
        rewrite(path, **{name: column})
    with pytest.raises(BadInput, match=why):
        Av2Log(small_log)


@pytest.mark.parametrize(
    "name",
    [
        "city_SE3_egovehicle.feather",
        "annotations.feather",
        "calibration/intrinsics.feather",
        "calibration/egovehicle_SE3_sensor.feather",
    ],
)
def test_truncated_files(small_log: Path, name: str) -> None:
    truncate(small_log / name)
    with pytest.raises(BadInput, match="cannot be read as feather"):
        Av2Log(small_log)


def test_raster_without_pickles(small_log: Path) -> None:
    (raster,) = (small_log / "map").glob("*.npy")
    np.save(raster, np.array([{"a": 1}]), allow_pickle=True)
    with pytest.raises(BadInput, match="cannot be read as a height raster"):
        Av2Log(small_log).ground_height(np.zeros((1, 2)))


def test_city_must_be_known(small_log: Path) -> None:
    (path,) = (small_log / "map").glob("log_map*.json")
    path.rename(path.with_name(path.name.replace("PIT", "XYZ")))
    with pytest.raises(BadInput, match="unknown city 'XYZ'; known cities are ATX"):
        Av2Log(small_log)
    for path in (small_log / "map").iterdir():
        path.unlink()
    with pytest.raises(BadInput, match="no map file names its city"):
        Av2Log(small_log)
    assert Av2Log(small_log, city="PIT").ground is None


# The vector map --------------------------------------------------------------------------------


def converted(folder: Path, archive: dict[str, Any]) -> tuple[VectorMap, dict[str, int]]:
    write_archive(folder, archive)
    found = read_av2_archive(folder)
    return vector_map_of(found), {k: v for k, v in found.notes.items() if v}


def test_elements(tmp_path: Path) -> None:
    vector_map, notes = converted(tmp_path / "log", av2_archive())
    assert vector_map.crs == "EPSG:32617"
    by_id = vector_map.by_id()
    assert sorted(by_id) == ["boundary-1", "crossing-7", "divider-11-left", "divider-12-right"]
    shared = by_id["divider-11-left"]  # shared by 11 and 12, joined with that of 13
    np.testing.assert_allclose(
        shared.points - [*PIT, 0],
        [[0, 0, 20], [10, 0, 20.1], [40, 0, 20.4], [60, 0, 20.6]],
        atol=1e-6,
    )
    assert shared.attributes["mark"] == "DOUBLE_SOLID_YELLOW"
    assert shared.attributes["av2_ids"] == "11-left,12-left,13-left"
    outline = by_id["boundary-1"]  # both areas in one
    assert outline.ring and length(outline.points) == pytest.approx(2 * (80 + 8))
    assert shapely.LinearRing(outline.xy).is_ccw  # the drivable side is on the left
    assert outline.points[:, 2] == pytest.approx(20 + (outline.xy[:, 0] - PIT[0]) / 100)
    crossing = by_id["crossing-7"]
    assert crossing.ring and shapely.Polygon(crossing.xy).area == pytest.approx(24)
    assert notes == {
        "references to lanes outside the map": 1,
        "shared lane boundaries taken once": 1,
    }


def test_ids_do_not_depend_on_the_order_of_the_file(tmp_path: Path) -> None:
    archive = av2_archive()
    for name, part in archive.items():
        archive[name] = dict(reversed(part.items()))
    first, _ = converted(tmp_path / "a", av2_archive())
    second, _ = converted(tmp_path / "b", archive)
    assert [e.element_id for e in first] == [e.element_id for e in second]
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.points, b.points)


def test_overlap_with_other_vertices_is_one_line(tmp_path: Path) -> None:
    """The neighbour names the shared line with other vertices, 2 cm off and 10 m longer."""
    archive = av2_archive()
    line = [(50, 0.02, 20.5), (33, 0.01, 20.33), (5, 0.02, 20.05)]
    archive["lane_segments"]["12"]["left_lane_boundary"] = [
        dict(zip("xyz", map(float, p), strict=True)) for p in line
    ]
    vector_map, notes = converted(tmp_path / "log", archive)
    yellow = [e for e in vector_map.of_class("divider") if "YELLOW" in e.attributes["mark"]]
    assert sum(length(e.points) for e in yellow) == pytest.approx(60, abs=0.2)
    assert notes["lane boundaries that overlap another one cut"] >= 1


def test_nothing_is_joined_at_a_fork_or_where_the_mark_changes(tmp_path: Path) -> None:
    archive = av2_archive()
    archive["lane_segments"]["13"]["left_lane_mark_type"] = "DASHED_YELLOW"
    vector_map, _ = converted(tmp_path / "mark", archive)
    assert {"divider-11-left", "divider-13-left"} <= set(vector_map.by_id())
    archive = av2_archive()
    fork = copy.deepcopy(archive["lane_segments"]["13"]) | {"id": 14}
    fork["left_lane_boundary"] = [{"x": 40, "y": 0, "z": 20.4}, {"x": 60, "y": 5, "z": 20.6}]
    archive["lane_segments"]["14"] = fork
    vector_map, _ = converted(tmp_path / "fork", archive)
    assert {"divider-11-left", "divider-13-left", "divider-14-left"} <= set(vector_map.by_id())


def test_a_line_round_an_island_becomes_a_ring(tmp_path: Path) -> None:
    archive = av2_archive()
    corners = [(10, 1), (15, 1), (15, 2), (10, 2), (10, 1)]
    for k in range(4):
        lane = copy.deepcopy(archive["lane_segments"]["13"]) | {"id": 20 + k}
        lane["left_lane_boundary"] = [
            {"x": float(x), "y": float(y), "z": 20.0} for x, y in corners[k : k + 2]
        ]
        archive["lane_segments"][str(20 + k)] = lane
    vector_map, _ = converted(tmp_path / "log", archive)
    ring = vector_map.by_id()["divider-20-left"]
    assert ring.ring and length(ring.points) == pytest.approx(12)


def test_crossing_whose_edges_run_against_each_other(tmp_path: Path) -> None:
    archive = av2_archive()
    archive["pedestrian_crossings"]["7"]["edge2"].reverse()
    vector_map, notes = converted(tmp_path / "log", archive)
    assert shapely.Polygon(vector_map.by_id()["crossing-7"].xy).area == pytest.approx(24)
    assert notes["crossings with crossed edges set right"] == 1


def test_crossings_that_are_no_quadrilaterals(tmp_path: Path) -> None:
    archive = av2_archive()

    def edge(*points: tuple[float, float]) -> list[dict[str, float]]:
        return [{"x": x, "y": y, "z": 20.0} for x, y in points]

    archive["pedestrian_crossings"] |= {
        "8": {"edge1": edge((0, 0), (1, 0)), "edge2": edge((2, 0), (3, 0))},
        "9": {"edge1": edge((0, 0), (9, 9), (0, 9)), "edge2": edge((9, 0), (4, 3), (5, 9))},
        "10": {"edge1": edge((0, 0)), "edge2": edge((2, 0), (3, 0))},
    }
    vector_map, notes = converted(tmp_path / "log", archive)
    rings = vector_map.of_class("ped_crossing")
    assert [e.element_id for e in rings] == ["crossing-7", "crossing-9"]
    assert all(shapely.Polygon(e.xy).is_valid for e in rings)
    assert notes["crossings without area left out"] == 1
    assert notes["crossings without two edges left out"] == 1


@settings(deadline=None, max_examples=40)
@given(
    cuts=st.sets(st.integers(1, 99), max_size=8),
    copies=st.lists(st.tuples(st.integers(0, 8), st.booleans()), max_size=6),
    seed=st.integers(0, 1000),
)
def test_a_line_in_any_pieces_becomes_one(
    cuts: set[int], copies: list[tuple[int, bool]], seed: int
) -> None:
    s = np.arange(101.0)
    line = np.column_stack([s, 5 * np.sin(s / 15), 0.1 * s])
    ends = [0, *sorted(cuts), 100]
    pieces = [line[a : b + 1] for a, b in pairwise(ends)]
    pieces += [pieces[k % len(pieces)][:: -1 if back else 1] for k, back in copies]
    order = np.random.default_rng(seed).permutation(len(pieces))
    named = [(f"{i}-left", "SOLID_WHITE", pieces[k]) for i, k in enumerate(order)]
    (element,) = dividers(named, Counter())
    points = element.points if element.points[0, 0] == 0 else element.points[::-1]
    np.testing.assert_array_equal(points, line)


def test_unknown_heights_come_from_the_raster_or_stay_unknown(tmp_path: Path) -> None:
    archive = av2_archive()
    for lane in archive["lane_segments"].values():
        for point in lane["left_lane_boundary"]:
            point["z"] = float("nan")
    del archive["pedestrian_crossings"]["7"]["edge1"][0]["z"]
    folder = write_av2_log(tmp_path / "log")
    vector_map, notes = converted(folder, archive)
    z = vector_map.by_id()["divider-11-left"].points[:, 2]
    np.testing.assert_allclose(z, [20, 20.1, 20.4, 20.6], atol=1e-4)
    assert notes["heights taken from the ground raster"] == 6
    without, notes = converted(tmp_path / "bare", archive)
    assert np.isnan(without.by_id()["divider-11-left"].points[:, 2]).all()
    assert notes["vertices of unknown height"] == 6


def test_holes_and_separate_areas(tmp_path: Path) -> None:
    archive = av2_archive()
    # An area with a hole, as two halves that meet on both sides of it.
    halves = {
        "5": [(100, 0), (110, 0), (110, 5), (105, 5), (105, 15), (110, 15), (110, 20), (100, 20)],
        "6": [(110, 0), (120, 0), (120, 20), (110, 20), (110, 15), (115, 15), (115, 5), (110, 5)],
    }
    for name, points in halves.items():
        archive["drivable_areas"][name] = {
            "id": int(name),
            "area_boundary": [{"x": float(x), "y": float(y), "z": 1.0} for x, y in points],
        }
    vector_map, _ = converted(tmp_path / "log", archive)
    by_id = vector_map.by_id()
    outer, inner = by_id["boundary-5"], by_id["boundary-5-2"]
    assert shapely.LinearRing(outer.xy).is_ccw and length(outer.points) == pytest.approx(80)
    assert not shapely.LinearRing(inner.xy).is_ccw and length(inner.points) == pytest.approx(40)
    assert (inner.points[:, 2] == 1.0).all()


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda a: a.pop("lane_segments"), "lane_segments is missing"),
        (lambda a: a["lane_segments"]["11"].pop("left_lane_boundary"), "left_lane_boundary of 11"),
        (lambda a: a["drivable_areas"].update(x={}), "'x' is not an id"),
        (lambda a: a["pedestrian_crossings"]["7"].update(edge1=[1]), "edge1 of 7"),
    ],
)
def test_broken_vector_map(tmp_path: Path, change: Callable[[Any], Any], why: str) -> None:
    archive = av2_archive()
    change(archive)
    write_archive(tmp_path / "log", archive)
    with pytest.raises(BadInput, match=why):
        read_av2_map(tmp_path / "log")


# The command -----------------------------------------------------------------------------------


def test_import_command(rtmap: Callable[..., Any], small_log: Path, tmp_path: Path) -> None:
    from rtmap_cli.maps.store import read_map

    out = tmp_path / "map"
    result = rtmap("import", "av2", small_log, "-o", out, "--json")
    told = json.loads(result.out)
    assert told["elements"] == {"ped_crossing": 1, "divider": 2, "boundary": 1}
    assert (told["crs"], told["city"]) == ("EPSG:32617", "PIT")
    assert "1 references to lanes outside the map" in result.err
    stored = read_map(out)
    assert stored.by_id()["divider-11-left"].attributes["mark"] == "DOUBLE_SOLID_YELLOW"
    np.testing.assert_allclose(
        stored.by_id()["crossing-7"].points,
        read_av2_map(small_log).by_id()["crossing-7"].points,
    )
    assert "exists already" in rtmap("import", "av2", small_log, "-o", out, code=2).err
    rtmap("import", "av2", small_log, "-o", out, "--overwrite")


def test_import_command_bad_input(rtmap: Callable[..., Any], tmp_path: Path) -> None:
    out = tmp_path / "map"
    assert "no such folder" in rtmap("import", "av2", tmp_path / "no", "-o", out, code=3).err
    (tmp_path / "empty").mkdir()
    message = rtmap("import", "av2", tmp_path / "empty", "-o", out, code=3).err
    assert "no log_map_archive_" in message and message.count("\n") == 1
    path = write_archive(tmp_path / "cut", av2_archive())
    truncate(path)
    assert (
        "cannot be read as JSON" in rtmap("import", "av2", tmp_path / "cut", "-o", out, code=3).err
    )
    assert not out.exists()


# The sample data -------------------------------------------------------------------------------

SAMPLES = {
    "7fab2350": (11, 26, 11),
    "adcf7d18": (11, 42, 8),
    "3bffdcff": (14, 41, 11),
}


def sample(rtmap_data: Path, name: str) -> Path:
    found = sorted((rtmap_data / "av2_sensor").glob(f"{name}-*"))
    if not found:
        pytest.skip(f"log {name} not found in RTMAP_DATA/av2_sensor")
    return found[0]


@pytest.mark.parametrize("name", SAMPLES)
def test_sample_logs(rtmap_data: Path, name: str) -> None:
    log = Av2Log(sample(rtmap_data, name))
    assert len(log) == 156 and log.city == "PIT"
    assert (log.rig is None) == (name != "7fab2350")
    assert len(log.rig or ()) in (0, 7)
    assert len(Av2Log(log.path, rate_hz=2)) == 31
    assert all(f.occluders for f in log.frames())
    # The ego origin rides 0.32 m above the ground raster.
    gap = log.ground_height(log.poses[:, :2, 3]) - log.poses[:, 2, 3]
    assert np.median(gap) == pytest.approx(log.ground_z, abs=0.01)
    assert log.ground is not None and 0.3 < log.ground.unknown_share < 0.6


def test_sample_sweeps(av2_log: Path) -> None:
    log = Av2Log(av2_log)
    frames = [f for f in log.frames() if f.lidar is not None]
    assert len(frames) == 2
    points = log.read_sweep(frames[0])
    assert points is not None and len(points) == 99_229
    near = np.hypot(points[:, 0], points[:, 1])
    road = points[(near > 3) & (near < 8) & (points[:, 2] < 0.1), 2]
    assert np.median(road) == pytest.approx(log.ground_z, abs=0.05)


@pytest.mark.parametrize("name", SAMPLES)
def test_sample_maps(rtmap_data: Path, name: str) -> None:
    archive = read_av2_archive(sample(rtmap_data, name))
    vector_map = vector_map_of(archive)
    counts = tuple(len(vector_map.of_class(c)) for c in ("ped_crossing", "divider", "boundary"))
    assert counts == SAMPLES[name]
    assert len(vector_map.by_id()) == len(vector_map)
    assert archive.notes["references to lanes outside the map"] in (26, 35, 42)
    points = np.concatenate([e.points for e in vector_map])
    assert np.isfinite(points).all()
    assert archive.ground is not None
    gap = points[:, 2] - archive.ground.at(points[:, :2])
    assert abs(np.nanmedian(gap)) < 0.03


def test_forecasting_maps(rtmap_data: Path) -> None:
    folders = sorted((rtmap_data / "av2_forecasting_osm").glob("*-*"))
    if not folders:
        pytest.skip("av2_forecasting_osm not found in RTMAP_DATA")
    zones = set()
    for folder in folders:
        archive = read_av2_archive(folder)
        vector_map = vector_map_of(archive)
        zones.add((archive.city, vector_map.crs))
        assert vector_map.of_class("boundary") and vector_map.of_class("divider")
    assert zones == {
        ("ATX", "EPSG:32614"),
        ("DTW", "EPSG:32617"),
        ("MIA", "EPSG:32617"),
        ("PAO", "EPSG:32610"),
        ("PIT", "EPSG:32617"),
        ("WDC", "EPSG:32618"),
    }


@pytest.mark.parametrize("name", ["7fab2350", "adcf7d18"])
def test_reference_crops_coincide(rtmap_data: Path, rtmap_golden: Path, name: str) -> None:
    """Local maps cut from the same logs by others: the same lines, to the rounding of the file.

    The reference is planar (roll and pitch ignored), dropped lines below about 0.3 m, and one of
    its frames is empty on purpose.
    """
    folder = sample(rtmap_data, name)
    with gzip.open(rtmap_golden / "evaluate" / "gt.json.gz", "rt") as file:
        reference = json.load(file)
    log, index = Av2Log(folder), MapIndex(read_av2_map(folder), join=True)
    compared = differing = 0
    for key, expected in reference["frames"].items():
        log_id, time = key.split("_")
        if log_id != log.log_id or not expected:
            continue
        pose = log.pose_at(np.array([int(time)]))[0]
        local = index.crop(se3_from_xyyaw(*xyyaw_of(pose), pose[2, 3]), min_length=0.3)
        for class_name in reference["classes"]:
            theirs = [np.array(e["points"]) for e in expected if e["class"] == class_name]
            ours = [e.points[:, :2] for e in local if e.class_name == class_name]
            compared += 1
            differing += len(theirs) != len(ours)
            if theirs and ours:
                assert _farthest(theirs, ours) < 1e-4
                assert _farthest(ours, theirs) < 1e-4
    assert compared == (120 if name == "adcf7d18" else 117)
    assert differing <= 1  # a corner of a crossing of 0.1 m², kept here and dropped there


def _farthest(lines: list[np.ndarray], others: list[np.ndarray]) -> float:
    points = shapely.points(np.concatenate([resample(line, 100) for line in lines]))
    return float(shapely.distance(points, shapely.MultiLineString(others)).max())
