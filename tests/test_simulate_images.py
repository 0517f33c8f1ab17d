"""rtmap simulate images through the command line: native logs of towns and of real logs."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from rtmap_cli.geometry.poses import invert, xyyaw_of
from rtmap_cli.logs.native import NativeLog

SMALL = ["--width", "96", "--length", "60", "--frames", "3", "--quiet"]


@pytest.fixture(scope="module")
def town(tmp_path_factory) -> Path:
    from rtmap_cli.cli import run

    folder = tmp_path_factory.mktemp("town") / "map"
    assert run(["simulate", "town", "--seed", "4", "--size", "260", "-o", str(folder)]) == 0
    return folder


def digest(folder: Path) -> str:
    found = sorted(p for p in folder.rglob("*") if p.is_file())
    parts = [f"{p.relative_to(folder)} {hashlib.sha256(p.read_bytes()).hexdigest()}" for p in found]
    return "\n".join(parts)


def test_a_town_drive(rtmap, town, tmp_path):
    log = tmp_path / "log"
    rtmap("simulate", "images", "--map", town, "--log", "town:", "--seed", 1, *SMALL, "-o", log)
    native = NativeLog(log)
    assert (len(native), native.crs, native.ground_z) == (3, "EPSG:32632", 0.0)
    assert len(native.rig) == 7
    truth = native.truth_poses()
    for k, frame in enumerate(native.frames()):
        assert set(frame.images) == {c.name for c in native.rig}
        for camera in native.rig:
            image = native.read_image(frame, camera.name)
            assert image.shape == (camera.height, camera.width, 3)
            assert image.std() > 5
        error = frame.map_SE3_ego[:2, 3] - truth.pose[k][:2, 3]
        assert 0 < np.hypot(*error) < 6
        assert np.abs(error).max() < 5 * frame.sigma[:2].max()
        if k:
            moved = xyyaw_of(invert(truth.pose[k - 1]) @ truth.pose[k])
            assert np.abs(frame.odometry - moved).max() < 0.15
    rtmap("check-log", log)


def test_same_seed_same_bytes(rtmap, town, tmp_path):
    logs = [tmp_path / name for name in ("a", "b", "c")]
    for log, seed in zip(logs, (1, 1, 2), strict=True):
        rtmap("simulate", "images", "--map", town, "--log", "town:", "--seed", seed, *SMALL,
              "--change", "delete:boundary", "-o", log)  # fmt: skip
    assert digest(logs[0]) == digest(logs[1])
    assert digest(logs[0]) != digest(logs[2])
    changes = json.loads((logs[0] / "truth" / "changes.json").read_text())["changes"]
    assert [(c["kind"], c["class"]) for c in changes] == [("delete", "boundary")]


def test_another_drive_sees_the_same_world(rtmap, town, tmp_path):
    for drive in (0, 1):
        rtmap("simulate", "images", "--map", town, "--log", "town:", "--drive", drive, *SMALL,
              "-o", tmp_path / str(drive))  # fmt: skip
    a, b = (NativeLog(tmp_path / str(d)).truth_poses() for d in (0, 1))
    assert not np.allclose(a.pose, b.pose)


def test_a_tour_comes_back(rtmap, town, tmp_path):
    log = tmp_path / "log"
    rtmap("simulate", "images", "--map", town, "--log", "town:", "--route", "tour", "--length", 800,
          "--spacing", 20, "--width", 32, "--rig", "campus", "-q", "-o", log)  # fmt: skip
    xy = NativeLog(log).truth_poses().pose[:, :2, 3]
    apart = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    later = np.arange(len(xy))[:, None] - np.arange(len(xy)) > 4
    assert len(xy) >= 40 and apart[later].min() < 12


def test_lanes_survive_changes_of_the_map(rtmap, town, tmp_path):
    world = tmp_path / "world"
    rtmap("simulate", "changes", "--map", town, "--change", "delete:ped_crossing", "-o", world)
    rtmap("simulate", "images", "--map", world, "--log", "town:", *SMALL, "--frames", 1,
          "-o", tmp_path / "log")  # fmt: skip


def test_an_argoverse_log(rtmap, av2_log, tmp_path):
    world, log = tmp_path / "map", tmp_path / "log"
    rtmap("import", "av2", av2_log, "-o", world)
    rtmap("simulate", "images", "--map", world, "--log", f"av2:{av2_log}", "--seed", 1, "--width",
          64, "--frames", 2, "-o", log)  # fmt: skip
    native = NativeLog(log)
    assert len(native) == 2
    assert native.ground_z == pytest.approx(-0.32)
    front = next(c for c in native.rig if c.name == "ring_front_center")
    assert front.height > front.width == 64
    assert any(front.distortion)
    frames = list(native.frames())
    assert frames[0].occluders, "the cuboids of the log hide the road"
    gap = (frames[1].timestamp_ns - frames[0].timestamp_ns) / 1e9
    assert gap == pytest.approx(0.5, abs=0.06)


def test_a_log_without_calibration_needs_a_rig(rtmap, rtmap_data, tmp_path):
    logs = sorted((rtmap_data / "av2_sensor").glob("adcf7d18-*"))
    if not logs:
        pytest.skip("log adcf7d18 not found in RTMAP_DATA/av2_sensor")
    world = tmp_path / "map"
    rtmap("import", "av2", logs[0], "-o", world)
    call = ["simulate", "images", "--map", world, "--log", f"av2:{logs[0]}", "--width", 64,
            "--frames", 1, "-o", tmp_path / "log"]  # fmt: skip
    assert "--rig default" in rtmap(*call, code=3).err
    rtmap(*call, "--rig", "default")


def test_bad_input(rtmap, town, av2_log, tmp_path):
    call = ["simulate", "images", "-o", tmp_path / "x"]
    for arguments, code, words in (
        (["--map", tmp_path / "no", "--log", "town:"], 3, "no"),
        (["--map", town, "--log", f"av2:{av2_log}"], 3, "EPSG"),
        (["--map", town, "--log", tmp_path / "none"], 3, "no such log"),
        (["--map", town, "--log", "town:", "--change", "melt:divider"], 2, "known are"),
        (["--map", town, "--log", "town:", "--length", "5000"], 4, "no turning route"),
        (["--map", town, "--log", "town:", "--rig", "log"], 3, "calibration"),
    ):
        got = rtmap(*call, *arguments, code=code)
        assert words in got.err and got.err.count("\n") == 1, got.err
        assert not (tmp_path / "x").exists()


def test_a_map_elsewhere_is_out_of_range(rtmap, town, tmp_path):
    far = tmp_path / "far"
    log = tmp_path / "log"
    rtmap("simulate", "images", "--map", town, "--log", "town:", *SMALL, "-o", log)
    from dataclasses import replace

    from rtmap_cli.maps.element import VectorMap
    from rtmap_cli.maps.store import read_map, write_new_map

    old = read_map(town)
    moved = [replace(e, points=e.points + (5000.0, 0, 0)) for e in old]
    write_new_map(VectorMap(moved, old.crs), far, "elsewhere")
    got = rtmap("simulate", "images", "--map", far, "--log", log, "-o", tmp_path / "x", code=3)
    assert "out of range" in got.err and " m away" in got.err
