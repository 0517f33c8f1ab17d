"""nuScenes folders, map expansions and info files: a miniature of the same layout."""

from __future__ import annotations

import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_nuscenes import (
    EARLY,
    POINTS,
    SPEED,
    START,
    T0,
    camera_pose,
    pose_at,
    write_info,
    write_nuscenes,
)

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.nuscenes.log import NuscenesLog, nuscenes_scenes
from rtmap_cli.formats.nuscenes.tables import ORIGINS, location_crs
from rtmap_cli.formats.pickles import read_plain_pickle
from rtmap_cli.logs.open import open_log
from rtmap_cli.logs.run_files import read_run
from rtmap_cli.maps.crs import is_local, to_lonlat
from rtmap_cli.maps.store import read_map

Call = Callable[..., Any]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_nuscenes(tmp_path / "nuscenes")


def _edit(folder: Path, table: str, change: Callable[[list[dict[str, Any]]], None]) -> None:
    path = folder / "v1.0-mini" / f"{table}.json"
    records = json.loads(path.read_text())
    change(records)
    path.write_text(json.dumps(records))


def _one_line(result: Any) -> str:
    assert "Traceback" not in result.err
    assert len(result.err.strip().splitlines()) == 1, result.err
    return str(result.err)


def test_a_scene_is_a_log(folder: Path) -> None:
    assert nuscenes_scenes(folder) == ["scene-0001", "scene-0002"]
    log = open_log(f"nuscenes:{folder}#scene-0002")
    assert isinstance(log, NuscenesLog) and log.location == "singapore-onenorth"
    assert (log.log_id, len(log), log.ground_z, log.notes) == ("scene-0002", 3, 0.0, [])
    assert log.rig is not None
    assert [c.name for c in log.rig] == ["CAM_FRONT", "CAM_FRONT_LEFT", "CAM_BACK"]
    np.testing.assert_allclose(log.rig.cameras[1].ego_SE3_camera, camera_pose("CAM_FRONT_LEFT"))
    frames = list(log.frames())
    times = [(T0 + 10**8 + 500_000 * k) * 1000 for k in range(3)]
    assert [f.timestamp_ns for f in frames] == times
    for k, frame in enumerate(frames):
        np.testing.assert_allclose(frame.map_SE3_ego, pose_at(1, 500_000 * k), atol=1e-9)
        assert set(frame.images) == {"CAM_FRONT", "CAM_FRONT_LEFT", "CAM_BACK"}
        assert all(p.exists() and "samples" in p.parts for p in frame.images.values())


def test_poses_are_planar(folder: Path) -> None:
    """Heights are 0 in nuScenes while roll and pitch follow the road."""
    a = np.radians(2.0)
    tilted = [np.cos(a / 2), 0.0, np.sin(a / 2), 0.0]
    _edit(folder, "ego_pose", lambda records: _set(records, "rotation", tilted))
    for frame in NuscenesLog(folder, "scene-0001").frames():
        np.testing.assert_allclose(frame.map_SE3_ego[:3, :3], np.eye(3), atol=1e-9)


def test_every_image_has_its_own_pose(folder: Path) -> None:
    log = NuscenesLog(folder, "scene-0001")
    for frame in log.frames():
        for name, motion in frame.ego_SE3_exposure.items():
            expected = np.eye(4)
            expected[0, 3] = -SPEED * EARLY[name] / 1e6
            np.testing.assert_allclose(motion, expected, atol=1e-9)


def test_sweeps_come_in_the_ego_frame(folder: Path) -> None:
    log = NuscenesLog(folder, "scene-0001")
    points = log.read_sweep(next(log.frames()))
    # The LiDAR looks along its y; it sits at (0.9, 0, 1.8), turned by -90°.
    np.testing.assert_allclose(points[:, :2], [[8.9, 0.0], [4.9, -2.0]], atol=1e-6)
    np.testing.assert_allclose(points[:, 2:], [[0.0, 0.2], [0.1, 1.0]], atol=1e-6)
    assert len(POINTS) == 2


def test_infer_and_check_log_read_it(rtmap: Call, folder: Path, tmp_path: Path) -> None:
    spec = f"{folder}#scene-0001"
    rtmap("infer", spec, "-o", tmp_path / "run", "-q", "--threads", 1)
    run = read_run(tmp_path / "run")
    assert run.log_id == "scene-0001" and list(run.frames.camera_count) == [3, 3, 3]
    assert "0 errors, 0 warnings" in rtmap("check-log", spec).out
    min((folder / "samples" / "CAM_BACK").glob("*.jpg")).unlink()
    assert "no such image" in rtmap("check-log", spec, code=None).out
    min((folder / "samples" / "LIDAR_TOP").glob("*.bin")).write_bytes(b"12345")
    assert "sweep" in rtmap("check-log", f"nuscenes:{spec}", code=3).out


def test_coordinates_stay_and_have_a_place_on_earth() -> None:
    for location, (latitude, longitude) in ORIGINS.items():
        crs = location_crs(location)
        lonlat = to_lonlat(crs, np.array([[0.0, 0.0], [0.0, 1000.0], [1000.0, 0.0]]))
        np.testing.assert_allclose(lonlat[0], [longitude, latitude], atol=1e-9)
        # A kilometre north and east, to the metre, on the ellipsoid.
        from pyproj import Geod

        _, _, away = Geod(ellps="WGS84").inv(
            *[np.repeat(v, 2) for v in lonlat[0]], lonlat[1:, 0], lonlat[1:, 1]
        )
        np.testing.assert_allclose(away, 1000.0, atol=0.01)
    assert is_local(location_crs("tokyo"))


def test_the_map_expansion_becomes_a_map(rtmap: Call, folder: Path, tmp_path: Path) -> None:
    import shapely

    out = json.loads(rtmap("import", "nuscenes", folder, "-o", tmp_path / "map", "--json").out)
    assert out["location"] == "singapore-onenorth"
    assert out["elements"] == {"ped_crossing": 2, "divider": 2, "boundary": 2}
    assert out["notes"]["crossings merged with others"] == 1
    assert out["notes"]["lines that come twice taken once"] == 1
    found = read_map(tmp_path / "map").by_id()
    both = shapely.Polygon(found["crossing-cross-a"].xy)
    assert both.bounds == (410, 1090, 414, 1104) and both.area == pytest.approx(56)
    assert found["divider-ld-a"].attributes == {"layer": "lane_divider", "mark": "DASHED"}
    assert np.isnan(found["divider-ld-a"].points[:, 2]).all()
    rings = [e for e in found.values() if e.class_name == "boundary"]
    outline = max(rings, key=lambda e: shapely.Polygon(e.xy).area)
    # Street and lane overlap by 40 x 4; the island is a ring of its own.
    assert shapely.Polygon(outline.xy).area == pytest.approx(100 * 14 + 40 * 8 - 40 * 4)
    assert shapely.Polygon(outline.xy).exterior.is_ccw
    (island,) = [e for e in rings if e is not outline]
    assert shapely.Polygon(island.xy).area == pytest.approx(20)
    assert not shapely.Polygon(island.xy).exterior.is_ccw
    again = tmp_path / "again"
    rtmap("import", "nuscenes", folder / "v1.0-mini", "-o", again)
    assert read_map(again).by_id().keys() == found.keys()
    rtmap("map", "validate", tmp_path / "map")
    rtmap("export", "geojson", tmp_path / "map", "-o", tmp_path / "map.geojson")
    rtmap("import", "geojson", tmp_path / "map.geojson", "-o", tmp_path / "back")
    back = read_map(tmp_path / "back").by_id()["divider-ld-a"]
    np.testing.assert_allclose(back.xy, found["divider-ld-a"].xy, atol=1e-3)
    # Map and log share a frame: the map is a prior of the scene.
    rtmap(
        "infer",
        f"{folder}#scene-0001",
        "--map",
        tmp_path / "map",
        "-o",
        tmp_path / "run",
        "-q",
        "--threads",
        1,
    )
    states = read_run(tmp_path / "run").observations.element_id
    assert "divider-ld-a" in set(states.tolist())
    again = rtmap("import", "nuscenes", folder, "-o", tmp_path / "map", code=2)
    assert "exists" in again.err


def test_broken_expansions_are_named(rtmap: Call, folder: Path, tmp_path: Path) -> None:
    path = folder / "maps" / "expansion" / "singapore-onenorth.json"
    good = json.loads(path.read_text())
    command = ("import", "nuscenes", folder, "-o", tmp_path / "map")
    lost = json.loads(path.read_text())
    lost["line"][0]["node_tokens"][0] = "nowhere"
    endless = json.loads(path.read_text())
    endless["node"][0]["x"] = float("nan")
    cases = [
        (json.dumps({k: v for k, v in good.items() if k != "lane"}), "lane"),
        (json.dumps(lost), "nowhere"),
        (json.dumps(endless), "finite"),
        (json.dumps(good)[:500], "JSON"),
    ]
    for text, told in cases:
        path.write_text(text)
        assert told in _one_line(rtmap(*command, code=3))
    path.write_text(json.dumps(good))
    assert "boston" in _one_line(rtmap(*command, "--location", "boston-seaport", code=3))
    path.rename(path.with_name("new-town.json"))
    assert "place on earth" in _one_line(rtmap(*command, code=3))
    path.with_name("old-town.json").write_text(json.dumps(good))
    assert "--location" in _one_line(rtmap(*command, code=3))
    assert not (tmp_path / "map").exists()


def test_scenes_are_chosen_by_name(rtmap: Call, folder: Path) -> None:
    for spec, told in (
        (folder, "scene-0001, scene-0002"),
        (f"{folder}#scene-9", "no scene scene-9"),
        (f"nuscenes:{folder}/nowhere", "no such folder"),
    ):
        with pytest.raises(BadInput, match=told):
            open_log(spec)
    (folder / "v1.0-test").mkdir()
    (folder / "v1.0-test" / "sample_data.json").write_text("[]")
    with pytest.raises(BadInput, match=r"v1\.0-mini, v1\.0-test"):
        open_log(f"{folder}#scene-0001")
    assert open_log(f"{folder / 'v1.0-mini'}#scene-0001").log_id == "scene-0001"


def _set(table: list[dict[str, Any]], key: str, value: Any) -> None:
    for record in table:
        record[key] = value


def test_tables_that_cannot_be_trusted_are_named(rtmap: Call, folder: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret.jpg"
    secret.write_bytes(b"x")
    (folder / "link").symlink_to(tmp_path)
    cases: list[tuple[str, str, Any, str]] = [
        ("sample_data", "filename", "../secret.jpg", "leads out"),
        ("sample_data", "filename", str(secret), "leads out"),
        ("sample_data", "filename", "link/secret.jpg", "leads out"),
        ("sample_data", "ego_pose_token", "nowhere", "no record 'nowhere'"),
        ("sample_data", "width", 0, "width"),
        ("calibrated_sensor", "rotation", [1.0, 0.0, 0.0, float("nan")], "not a number"),
        ("calibrated_sensor", "rotation", [2.0, 0.0, 0.0, 0.0], "length 1"),
        ("calibrated_sensor", "camera_intrinsic", [[1.0]], "intrinsics"),
        ("ego_pose", "translation", [0.0], "translation"),
        ("sample", "scene_token", "other", "no frame"),
    ]
    for table, key, value, told in cases:
        path = folder / "v1.0-mini" / f"{table}.json"
        before = path.read_text()
        _edit(folder, table, lambda records, k=key, v=value: _set(records, k, v))
        result = rtmap(
            "infer", f"{folder}#scene-0001", "-o", tmp_path / "run", "-q", "--threads", 1, code=3
        )
        assert told in _one_line(result), (table, key)
        path.write_text(before)
    (folder / "v1.0-mini" / "ego_pose.json").write_text(before[:100])
    assert "read as JSON" in rtmap("check-log", f"{folder}#scene-0001", code=3).out


def test_info_files_are_logs(rtmap: Call, tmp_path: Path) -> None:
    path = write_info(tmp_path / "info")
    log = open_log(path)
    assert len(log) == 1 and is_local(log.crs)
    frame = next(log.frames())
    assert frame.timestamp_ns == T0 * 1000
    np.testing.assert_allclose(frame.map_SE3_ego[:2, 3], START, atol=1e-9)
    for name, motion in frame.ego_SE3_exposure.items():
        np.testing.assert_allclose(motion[0, 3], -SPEED * EARLY[name] / 1e6, atol=1e-6)
    np.testing.assert_allclose(log.read_sweep(frame)[0, :3], [8.9, 0.0, 0.0], atol=1e-5)
    rtmap("infer", path, "-o", tmp_path / "run", "-q", "--threads", 1)
    assert read_run(tmp_path / "run").frames.camera_count[0] == 3
    told = rtmap("crowdsource", tmp_path / "run", "--map", tmp_path / "map", code=3)
    assert "place on earth" in told.err
    assert "0 errors, 1 warnings" in rtmap("check-log", path).out


class _Evil:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.marker),)


def test_hostile_pickles_are_refused_and_not_run(rtmap: Call, tmp_path: Path) -> None:
    marker = tmp_path / "was-here"
    out = ("-o", tmp_path / "run", "-q", "--threads", 1)
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        path = write_info(tmp_path / "info")
        content = {"data_list": [{"timestamp": _Evil(marker)}]}
        path.write_bytes(pickle.dumps(content, protocol=protocol))
        told = _one_line(rtmap("infer", path, *out, code=3))
        assert "mkdir" in told and "not loaded" in told
        assert not marker.exists()
    pickle.loads(path.read_bytes())
    assert marker.exists(), "the pickle was not hostile at all"
    for value in (np.array([object()], object), np.zeros(2, [("a", "f8")]), open_log, Path("x")):
        path.write_bytes(pickle.dumps({"data_list": [value]}))
        assert "not loaded" in _one_line(rtmap("infer", path, *out, code=3))
    for junk in (b"", b"junk", pickle.dumps({"data_list": [1] * 99})[:-9], pickle.dumps([1])):
        path.write_bytes(junk)
        assert path.name in _one_line(rtmap("infer", path, *out, code=3))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_pickles_come_out_as_they_went_in(tmp_path: Path, protocol: int) -> None:
    value = {
        "rows": np.arange(6.0).reshape(2, 3),
        "columns": np.asfortranarray(np.arange(6, dtype=">i4").reshape(2, 3)),
        "empty": np.zeros((0, 3)),
        "flags": np.array([True, False]),
        "one": np.float32(2.5),
        "rest": [1, (2.0, "three"), {4}, None, {"five": b"6"}],
    }
    path = tmp_path / "plain.pkl"
    path.write_bytes(pickle.dumps(value, protocol=protocol))
    got = read_plain_pickle(path)
    assert got.pop("rest") == value.pop("rest")
    for name, array in got.items():
        np.testing.assert_array_equal(array, value[name])
        assert np.asarray(array).shape == np.shape(value[name])


def test_info_files_that_do_not_fit_are_named(rtmap: Call, tmp_path: Path) -> None:
    out = ("-o", tmp_path / "run", "-q", "--threads", 1)
    bad = np.eye(4)
    bad[0, 0] = np.nan
    cases: list[tuple[dict[str, Any], str]] = [
        ({"ego2global": bad}, "not a number"),
        ({"ego2global": 2 * np.eye(4)}, "rigid"),
        ({"timestamp": "noon"}, "time"),
        ({"lidar_points": {"lidar_path": "../sweep.pcd.bin", "lidar2ego": np.eye(4)}}, "leads out"),
        ({"images": {"CAM_FRONT": {"img_path": "x.jpg"}}}, "cam2ego"),
    ]
    for changes, told in cases:
        path = write_info(tmp_path / "info", **changes)
        assert told in _one_line(rtmap("infer", path, *out, code=3)), told
    path = write_info(tmp_path / "info")
    (tmp_path / "info" / "CAM_FRONT.jpg").unlink()
    assert "no such image" in _one_line(rtmap("infer", path, *out, code=3))


def test_the_real_keyframe(rtmap: Call, rtmap_data: Path, tmp_path: Path) -> None:
    files = sorted((rtmap_data / "nuscenes" / "demo").glob("*.pkl"))
    if not files:
        pytest.skip("nuscenes/demo not found in RTMAP_DATA")
    log = open_log(files[0])
    frame = next(log.frames())
    assert len(frame.images) == 6
    points = log.read_sweep(frame)
    ahead = (np.abs(points[:, 0] - 8) < 6) & (np.abs(points[:, 1]) < 2)
    assert abs(np.median(points[ahead, 2])) < 0.05, "the road is not at z = 0"
    # The vehicle drives about 9 m/s and the cameras expose before the LiDAR.
    motion = frame.ego_SE3_exposure["CAM_FRONT"]
    assert -0.5 < motion[0, 3] < -0.2 and abs(motion[1, 3]) < 0.05
    rtmap("infer", files[0], "-o", tmp_path / "run", "-q", "--threads", 1)
    assert read_run(tmp_path / "run").frames.camera_count[0] == 6
    rtmap("picture", files[0], "--grid", "-o", tmp_path / "grid.png", "--width", 320)
    with pytest.raises(BadInput, match="CameraInstance3DBoxes"):
        read_plain_pickle(rtmap_data / "nuscenes/mmdet3d_tests/mono3d_sample_results.pkl")
