"""``rtmap infer`` where the input is odd or broken: one line each, or a warning and a count."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_logs import FORWARD, jpeg, rewrite, small_rig, truncate, write_av2_log

from rtmap_cli.geometry.poses import se3_from_xyyaw, transform
from rtmap_cli.logs.log import Camera, Frame, Rig
from rtmap_cli.logs.native import NativeLogWriter
from rtmap_cli.logs.run_files import read_run
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.steps.infer import MapModel, find_model

Call = Callable[..., Any]
CRS = "EPSG:32632"
START = (500_000.0, 5_400_000.0)


def write_log(folder: Path, rig: Rig | None = None, missing: dict[int, str] | None = None) -> Path:
    """Three frames at one place; ``missing`` names the camera that a frame lacks."""
    rig = rig or small_rig(2)
    folder.mkdir()
    writer = NativeLogWriter(folder, folder.name, CRS, rig, -0.3)
    pose = se3_from_xyyaw(*START, 0.0)
    for k in range(3):
        frame = Frame(k, 10**18 + k * 10**9, pose, np.array([1.0, 1.0, 0.02]))
        lost = (missing or {}).get(k)
        images = {c.name: jpeg(90, (c.width, c.height)) for c in rig if c.name != lost}
        writer.add(frame, images)
    writer.close()
    return folder


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "log")


@pytest.fixture
def infer(rtmap: Call, tmp_path: Path) -> Call:
    def call(spec: object, *arguments: object, code: int = 0) -> Any:
        out = ("-o", tmp_path / "run", "-q", "--threads", 1, "--overwrite")
        return rtmap("infer", spec, *out, *arguments, code=code)

    return call


def _one_line(result: Any) -> str:
    assert "Traceback" not in result.err
    assert len(result.err.strip().splitlines()) == 1, result.err
    return str(result.err)


def _map(folder: Path, lines: list[np.ndarray]) -> Path:
    ahead = se3_from_xyyaw(*START, 0.0)
    elements = [Element(f"d{k:03d}", "divider", transform(ahead, p)) for k, p in enumerate(lines)]
    write_new_map(VectorMap(elements, CRS), folder, "test")
    return folder


def test_images_of_another_size(infer: Call, log: Path, tmp_path: Path) -> None:
    image = log / "images" / "cam_1" / "000001.jpg"
    image.write_bytes(jpeg(90, (80, 48)))
    told = _one_line(infer(log, code=3))
    assert "000001.jpg" in told and "80×48" in told and "64×48" in told
    assert not (tmp_path / "run").exists()
    assert "skipped" in infer(log, "--skip-bad-frames").err
    assert read_run(tmp_path / "run").info["skipped_frames"] == 1


def test_cameras_of_different_sizes_are_fine(infer: Call, tmp_path: Path) -> None:
    k = np.array([[90.0, 0, 40.0], [0, 90, 50.0], [0, 0, 1]])
    rig = Rig((*small_rig(1), Camera("tall", 80, 100, k, FORWARD)))
    infer(write_log(tmp_path / "log", rig))
    assert list(read_run(tmp_path / "run").frames.camera_count) == [2, 2, 2]


def test_a_missing_camera_is_told_and_read_without(infer: Call, tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", missing={1: "cam_1"})
    assert "1 of 3 frames have no image of cam_1" in _one_line(infer(log))
    assert list(read_run(tmp_path / "run").frames.camera_count) == [2, 1, 2]


@pytest.mark.parametrize("column", ["fx", "k2", "p1", "x"])
def test_calibration_that_is_not_a_number(infer: Call, log: Path, column: str) -> None:
    rewrite(log / "rig.parquet", **{column: [1.0, float("nan")]})
    told = _one_line(infer(log, code=3))
    assert "rig.parquet" in told and "cam_1" in told and "not a number" in told


def test_fisheye_and_rational_lenses_are_read(infer: Call, tmp_path: Path) -> None:
    k = small_rig(1).cameras[0].intrinsics
    rig = Rig(
        (
            Camera("fish", 64, 48, k, FORWARD, (0.02, 0.0, 0.0, 0.0), "fisheye"),
            Camera("rational", 64, 48, k, FORWARD, (0.5, 0.1, 0.0, 0.8, 0.2, 0.0), "pinhole"),
            Camera("shifted", 64, 48, k, FORWARD, tangential=(0.002, -0.001)),
        )
    )
    infer(write_log(tmp_path / "log", rig))
    assert list(read_run(tmp_path / "run").frames.camera_count) == [3, 3, 3]


def test_lenses_that_are_not_simulated_are_named(rtmap: Call, tmp_path: Path) -> None:
    k = small_rig(1).cameras[0].intrinsics
    fish = Camera("fish", 64, 48, k, FORWARD, (0.02, 0.0, 0.0, 0.0), "fisheye")
    log = write_log(tmp_path / "log", Rig((fish,)))
    town = _map(tmp_path / "map", [np.array([[0.0, 1.0], [20.0, 1.0]])])
    command = ("simulate", "images", "--map", town, "--log", log, "--quiet", "-o", tmp_path / "out")
    told = _one_line(rtmap(*command, code=3))
    assert "fish" in told and "--rig default" in told


def test_more_prior_elements_than_slots(infer: Call, log: Path, tmp_path: Path) -> None:
    slots = MapModel("rtmap-tiny", 1).info.prior_slots
    y = np.linspace(0.5, 17.5, slots + 7)
    town = _map(tmp_path / "map", [np.array([[-5.0, v], [5.0, v]]) for v in y])
    told = _one_line(infer(log, "--map", town))
    assert f"{3 * 7} prior elements found no slot" in told and "nearest" in told
    run = read_run(tmp_path / "run")
    assert run.info["prior_elements_without_slot"] == 21
    asked = run.observations.element_id[run.observations.frame == 0]
    assert {a for a in asked if a} == {f"d{k:03d}" for k in range(slots)}


def test_no_prior_element_in_range_or_at_all(infer: Call, log: Path, tmp_path: Path) -> None:
    aside = _map(tmp_path / "aside", [np.array([[0.0, 50.0], [20.0, 50.0]])])
    infer(log, "--map", aside)
    run = read_run(tmp_path / "run")
    assert not any(run.observations.element_id) and np.isnan(run.frames.end_to_end).all()
    empty = _map(tmp_path / "empty", [])
    assert "empty" in _one_line(infer(log, "--map", empty, code=3))


def test_models_that_cannot_be_trusted(infer: Call, log: Path, tmp_path: Path) -> None:
    content = find_model("rtmap-tiny").read_bytes()
    model = tmp_path / "model.onnx"
    for part in (len(content) // 2, len(content) - 200, 10, 0):
        model.write_bytes(content[:part])
        assert "model.onnx" in _one_line(infer(log, "--model", model, code=3)), part
    model.write_bytes(content.replace(b"rtmap.", b"other."))
    assert "metadata lacks rtmap." in _one_line(infer(log, "--model", model, code=3))
    model.unlink()
    model.mkdir()
    assert "model.onnx" in _one_line(infer(log, "--model", model, code=3))
    assert not (tmp_path / "run").exists()


def test_truncated_images(infer: Call, log: Path, tmp_path: Path) -> None:
    image = log / "images" / "cam_0" / "000002.jpg"
    for count in (40, 400):
        truncate(image, count)
        told = _one_line(infer(log, code=3))
        assert "000002.jpg" in told and "--skip-bad-frames" in told
    image.write_bytes(b"")
    assert "000002.jpg" in _one_line(infer(log, code=3))


def test_tbv_logs_are_argoverse_logs_without_cuboids(
    infer: Call, rtmap: Call, tmp_path: Path
) -> None:
    """Trust-but-Verify: the layout of Argoverse 2, other log ids, no annotations."""
    log = write_av2_log(tmp_path / "VvgE5LfOzIahbS266MFW7tP2al00LhQn__Autumn_2020")
    (log / "annotations.feather").unlink()
    told = infer(log, "--every", 10).err.splitlines()
    assert told == [f"{log.name}: no annotations: nothing is known of occluders"]
    run = read_run(tmp_path / "run")
    assert run.log_id == log.name and run.occluders is None
    assert list(run.frames.camera_count) == [2] * 4
    assert json.loads(rtmap("check-log", log, "--json").out)["errors"] == 0
    rtmap("import", "av2", log, "-o", tmp_path / "map")
    drive = ("--map", tmp_path / "map", "--log", log, "--frames", 1, "--width", 64, "-q")
    assert "no annotations" in rtmap("simulate", "images", *drive, "-o", tmp_path / "drive").err


def test_av2_images_have_their_own_poses(tmp_path: Path) -> None:
    from rtmap_cli.formats.av2.log import Av2Log

    log = Av2Log(write_av2_log(tmp_path / "log"))
    frame = next(log.frames())
    np.testing.assert_allclose(frame.ego_SE3_exposure["ring_front_center"], np.eye(4), atol=1e-9)
    # 12 ms later at 10 m/s.
    moved = frame.ego_SE3_exposure["ring_front_left"]
    np.testing.assert_allclose(moved[:2, 3], [0.12, 0.0], atol=1e-6)
