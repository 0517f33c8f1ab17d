"""DGP scenes: a miniature of the same layout, and the real one where it is at hand."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_logs import FORWARD, jpeg

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.dgp import dgp_scenes
from rtmap_cli.geometry.poses import quaternion_from_se3, se3_from_xyyaw
from rtmap_cli.logs.open import open_log
from rtmap_cli.logs.run_files import read_run
from rtmap_cli.maps.crs import is_local

Call = Callable[..., Any]
CAMERAS = {"CAMERA_09": np.pi, "CAMERA_05": 0.8, "CAMERA_01": 0.0, "CAMERA_06": -0.8}
SPEED = 8.0


def ego_at(seconds: float) -> np.ndarray:
    """world_SE3_ego of a straight drive."""
    return se3_from_xyyaw(
        100 + SPEED * seconds * np.cos(2.0), SPEED * seconds * np.sin(2.0), 2.0, 5.0
    )


def _pose(pose: np.ndarray) -> dict[str, Any]:
    q = quaternion_from_se3(pose)
    return {
        "rotation": dict(zip(("qw", "qx", "qy", "qz"), q.tolist(), strict=True)),
        "translation": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
    }


def write_dgp(root: Path, year: int = 2464, frames: int = 3) -> Path:
    """A data set with one scene that is there and one that is not; images 0.1 s before sweeps."""
    folder = root / "scene_02"
    extrinsics = {n: se3_from_xyyaw(0, 0, a) @ FORWARD for n, a in CAMERAS.items()}
    extrinsics["LIDAR"] = se3_from_xyyaw(1.0, 0.0, 0.0, 2.0)
    lens = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "skew": 0.0, "k1": -0.1, "p1": 0.001}
    calibration = {
        "names": list(extrinsics),
        "extrinsics": [_pose(p) for p in extrinsics.values()],
        "intrinsics": [lens if n in CAMERAS else dict.fromkeys(lens, 0.0) for n in extrinsics],
    }
    data, samples = [], []
    for k in range(frames):
        keys = []
        for name, extrinsic in extrinsics.items():
            late = 0.9 if name in CAMERAS else 1.0
            stamp = f"{year}-11-12T01:04:{10 + k - 1:02d}.{int(late * 10) % 10}00000Z"
            if late == 1.0:
                stamp = f"{year}-11-12T01:04:{10 + k:02d}.000000Z"
            record: dict[str, Any] = {"pose": _pose(ego_at(k + late) @ extrinsic)}
            if name in CAMERAS:
                file = f"rgb/{name}/{k}.jpg"
                record |= {"width": 64, "height": 48}
            else:
                file = f"point_cloud/{name}/{k}.npz"
            path = folder / file
            path.parent.mkdir(parents=True, exist_ok=True)
            if name in CAMERAS:
                path.write_bytes(jpeg(100))
            else:
                road = np.array([[x, 0.5, -1.9, 0.25] for x in np.linspace(5, 15, 40)])
                np.savez(path, data=np.concatenate([road, [[3.0, 4.0, 1.0, 0.5]]]))
            key = f"{name}-{k}"
            keys.append(key)
            kind = "image" if name in CAMERAS else "point_cloud"
            datum = {kind: record | {"filename": file}}
            data.append({"key": key, "id": {"name": name, "timestamp": stamp}, "datum": datum})
        samples.append({"calibration_key": "abc", "datum_keys": keys, "id": {}})
    (folder / "calibration").mkdir()
    (folder / "calibration" / "abc.json").write_text(json.dumps(calibration))
    (folder / "scene_123.json").write_text(json.dumps({"data": data, "samples": samples}))
    splits = {"0": {"filenames": ["scene_01/scene_9.json", "scene_02/scene_123.json"]}}
    (root / "scene_dataset_v1.0.json").write_text(json.dumps({"scene_splits": splits}))
    return root


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_dgp(tmp_path / "dgp")


def test_a_scene_is_a_log(folder: Path) -> None:
    assert list(dgp_scenes(folder)) == ["scene_02"]
    for spec in (f"dgp:{folder}#scene_02", folder, folder / "scene_02", f"{folder}#scene_02"):
        log = open_log(spec)
        assert log.log_id == "scene_02" and len(log) == 3 and is_local(log.crs)
    assert log.rig is not None
    names = [c.name for c in log.rig]
    assert names == ["CAMERA_01", "CAMERA_05", "CAMERA_06", "CAMERA_09"]
    front = log.rig.cameras[0]
    assert front.distortion == (-0.1, 0.0, 0.0) and front.tangential == (0.001, 0.0)
    assert log.ground_z == pytest.approx(0.1)
    for k, frame in enumerate(log.frames()):
        np.testing.assert_allclose(frame.map_SE3_ego, ego_at(k + 1.0), atol=1e-9)
        assert list(frame.images) == names
        for motion in frame.ego_SE3_exposure.values():
            expected = np.eye(4)
            expected[0, 3] = -0.1 * SPEED
            np.testing.assert_allclose(motion, expected, atol=1e-9)


def test_sweeps_come_in_the_ego_frame(folder: Path) -> None:
    log = open_log(folder)
    np.testing.assert_allclose(log.read_sweep(next(log.frames()))[-1], [4.0, 4.0, 3.0, 0.5])


@pytest.mark.parametrize(("year", "told"), [(2464, 2064), (2262, 1862), (2019, 2019)])
def test_times_fit_64_bits(tmp_path: Path, year: int, told: int) -> None:
    log = open_log(write_dgp(tmp_path / "dgp", year))
    times = [f.timestamp_ns for f in log.frames()]
    assert np.array(times, np.int64).tolist() == times
    assert np.diff(times).tolist() == [10**9] * 2
    seconds = datetime(told, 11, 12, 1, 4, 10, tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)
    assert times[0] == round(seconds.total_seconds()) * 10**9
    assert any("400 years" in note for note in log.notes) == (year != told)


def test_infer_and_check_log_read_it(rtmap: Call, folder: Path, tmp_path: Path) -> None:
    spec = f"dgp:{folder}#scene_02"
    result = rtmap("infer", spec, "-o", tmp_path / "run", "-q", "--threads", 1)
    assert "400 years" in result.err
    run = read_run(tmp_path / "run")
    assert list(run.frames.camera_count) == [4, 4, 4] and is_local(run.crs)
    assert "0 errors, 2 warnings" in rtmap("check-log", spec).out


def _change(folder: Path, change: Callable[[Any], Any], name: str = "scene_123.json") -> str:
    path = folder / "scene_02" / name
    before = path.read_text()
    content = json.loads(before)
    change(content)
    path.write_text(json.dumps(content))
    return before


def test_scenes_that_cannot_be_trusted_are_named(folder: Path) -> None:
    def image(c: Any) -> Any:
        return c["data"][0]["datum"]["image"]

    cases: list[tuple[Callable[[Any], Any], str, str]] = [
        (lambda c: image(c).update(filename="../../secret.jpg"), "scene_123.json", "leads out"),
        (lambda c: image(c).update(filename="/etc/hosts"), "scene_123.json", "leads out"),
        (lambda c: image(c).update(width=0), "scene_123.json", "width"),
        (lambda c: image(c)["pose"]["rotation"].update(qw=None), "scene_123.json", "number"),
        (lambda c: image(c)["pose"]["translation"].pop("x"), "scene_123.json", "no x"),
        (lambda c: c["data"][4]["id"].update(timestamp="noon"), "scene_123.json", "not a time"),
        (lambda c: c["samples"][1].update(calibration_key="x"), "scene_123.json", "changes"),
        (lambda c: c["samples"][0]["datum_keys"].append("x"), "scene_123.json", "no x"),
        (lambda c: c.pop("samples"), "scene_123.json", "samples"),
        (lambda c: c["intrinsics"][0].update(fx="nan"), "calibration/abc.json", "not a number"),
        (lambda c: c["intrinsics"][0].update(xi=0.4), "calibration/abc.json", "lens"),
        (lambda c: c["extrinsics"].pop(), "calibration/abc.json", "LIDAR"),
    ]
    for change, name, told in cases:
        before = _change(folder, change, name)
        with pytest.raises(BadInput, match=told):
            open_log(folder)
        (folder / "scene_02" / name).write_text(before)
    with pytest.raises(BadInput, match="no scene scene_01"):
        open_log(f"dgp:{folder}#scene_01")
    sweep = folder / "scene_02" / "point_cloud" / "LIDAR" / "0.npz"
    np.savez(sweep, data=np.array([object()], object), allow_pickle=True)
    with pytest.raises(BadInput, match="sweep"):
        open_log(folder)


def test_the_real_scene(rtmap: Call, rtmap_data: Path, tmp_path: Path) -> None:
    if not (rtmap_data / "dgp" / "test_scene").is_dir():
        pytest.skip("dgp/test_scene not found in RTMAP_DATA")
    spec = f"dgp:{rtmap_data / 'dgp' / 'test_scene'}#scene_02"
    log = open_log(spec)
    assert len(log) == 3 and log.rig is not None and len(log.rig) == 6
    assert 0.05 < log.ground_z < 0.15
    frames = list(log.frames())
    step = np.linalg.norm(frames[2].map_SE3_ego[:3, 3] - frames[0].map_SE3_ego[:3, 3])
    assert 2.4 < step < 2.7
    # The sweeps of two moments show the same road once both are brought to the world frame.
    for frame in frames:
        points = log.read_sweep(frame)
        road = (np.abs(points[:, 0]) < 15) & (np.abs(points[:, 1]) < 2) & (points[:, 2] < 0.5)
        assert abs(np.median(points[road, 2]) - log.ground_z) < 0.06
    rtmap("infer", spec, "-o", tmp_path / "run", "-q", "--threads", 1)
    assert list(read_run(tmp_path / "run").frames.camera_count) == [6, 6, 6]
    rtmap("picture", spec, "--grid", "-o", tmp_path / "grid.png", "--width", 320)
