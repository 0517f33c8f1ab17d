"""The native log folder: written, read back, and refused when it cannot be trusted."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from sample_logs import jpeg, rewrite, small_rig, write_native_log

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.log import Camera, Frame, Rig
from rtmap_cli.logs.native import NativeLog, NativeLogWriter, paths_inside
from rtmap_cli.logs.open import open_log
from rtmap_cli.tables import whole_folder


@pytest.fixture
def log_folder(tmp_path: Path) -> Path:
    return write_native_log(tmp_path / "log")


def test_round_trip(log_folder: Path) -> None:
    log = open_log(log_folder)
    assert isinstance(log, NativeLog)
    assert (log.log_id, log.crs, log.ground_z, len(log)) == ("drive-1", "EPSG:32617", -0.3, 4)
    assert log.rig is not None
    for camera, expected in zip(log.rig, small_rig(), strict=True):
        np.testing.assert_allclose(camera.intrinsics, expected.intrinsics)
        np.testing.assert_allclose(camera.ego_SE3_camera, expected.ego_SE3_camera, atol=1e-12)
        assert camera.distortion == expected.distortion
    frames = list(log.frames())
    assert [sorted(f.images) for f in frames] == [["cam_0", "cam_1"], ["cam_0"]] + [
        ["cam_0", "cam_1"]
    ] * 2
    assert frames[0].odometry is None
    np.testing.assert_allclose(frames[1].odometry, [2.5, 0, 0])
    np.testing.assert_allclose(frames[3].map_SE3_ego[:3, 3], [583_007.5, 4_477_000, 30])
    assert frames[0].occluders[0].length == pytest.approx(4.5)
    image = log.read_image(frames[2], "cam_1")
    assert image.shape == (48, 64, 3)
    assert abs(int(image[5, 5, 0]) - 90) <= 2
    np.testing.assert_allclose(
        log.read_sweep(frames[0]), np.arange(12).reshape(3, 4) / 12, atol=1e-7
    )
    assert log.read_sweep(frames[1]) is None
    truth = log.truth_poses()
    assert truth is not None and truth.method == "truth"
    assert log.truth_changes() == {"changes": []}


def test_same_content_same_bytes(tmp_path: Path) -> None:
    def digests(folder: Path) -> dict[str, str]:
        return {
            str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
            for p in sorted(folder.rglob("*"))
            if p.is_file()
        }

    assert digests(write_native_log(tmp_path / "a")) == digests(write_native_log(tmp_path / "b"))


def test_tables_state_frame_units_and_crs(log_folder: Path) -> None:
    metadata = pq.read_schema(log_folder / "frames.parquet").metadata
    assert metadata[b"rtmap.crs"] == b"EPSG:32617"
    assert b"ego" in metadata[b"rtmap.frame"] and b"metres" in metadata[b"rtmap.units"]
    assert "x forward" in json.loads((log_folder / "log.json").read_text())["ego_frame"]


def test_reduced_decoding(tmp_path: Path) -> None:
    from rtmap_cli.logs.native import decode_image

    path = tmp_path / "a.jpg"
    path.write_bytes(jpeg(100, (640, 480)))
    assert decode_image(path).shape == (480, 640, 3)
    assert decode_image(path, (120, 160)).shape == (120, 160, 3)
    assert decode_image(path, (121, 160)).shape == (240, 320, 3)


def test_truncated_image_is_named(log_folder: Path) -> None:
    log = NativeLog(log_folder)
    frame = next(log.frames())
    path = frame.images["cam_0"]
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(BadInput, match=r"000000\.jpg: cannot be read as an image"):
        log.read_image(frame, "cam_0")
    path.write_text("no image")
    with pytest.raises(BadInput, match=r"000000\.jpg"):
        log.read_image(frame, "cam_0")
    path.unlink()
    with pytest.raises(BadInput, match="no such image"):
        log.read_image(frame, "cam_0")


@pytest.mark.parametrize("path", ["../out.jpg", "/etc/passwd", "images/../../x.jpg", "", "a\\b"])
def test_paths_must_stay_inside(log_folder: Path, path: str) -> None:
    rewrite(log_folder / "images.parquet", path=[path] * 7)
    with pytest.raises(BadInput, match="leads out of the log"):
        NativeLog(log_folder)


def test_links_must_stay_inside(log_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "secret.jpg").write_bytes(jpeg(1))
    (log_folder / "link.jpg").symlink_to(tmp_path / "secret.jpg")
    (log_folder / "dir").symlink_to(tmp_path)
    (log_folder / "good.jpg").symlink_to(log_folder / "images" / "cam_0" / "000000.jpg")
    table = log_folder / "images.parquet"
    for name in ("link.jpg", "dir/secret.jpg"):
        with pytest.raises(BadInput, match="link that leads out"):
            paths_inside(log_folder, [name], table)
    assert paths_inside(log_folder, ["good.jpg"], table) == [log_folder / "good.jpg"]


@pytest.mark.parametrize(
    ("table", "columns", "why"),
    [
        ("frames", {"x": [1.0, float("nan"), 3.0, 4.0]}, "row 1 is not a number"),
        ("frames", {"sigma_x": [1.0, None, 3.0, 4.0]}, "sigma_x has missing values"),
        ("frames", {"qw": [2.0] * 4}, "quaternion of row 0"),
        ("frames", {"timestamp_ns": [1, 3, 2, 4]}, "timestamps do not rise"),
        ("frames", {"timestamp_ns": [1, 2, 2, 4]}, "timestamps do not rise"),
        ("frames", {"frame": [0, 1, 1, 3]}, "comes twice"),
        ("images", {"camera": ["cam_9"] * 7}, "cam_9 is not in rig"),
        ("images", {"frame": [9] * 7}, "frame 9 is not in frames"),
        ("rig", {"fx": [1.0, float("inf")]}, "cam_1 has a value"),
        ("rig", {"camera": ["a", "a"]}, "listed twice"),
    ],
)
def test_bad_tables(log_folder: Path, table: str, columns: dict, why: str) -> None:
    rewrite(log_folder / f"{table}.parquet", **columns)
    with pytest.raises(BadInput, match=why):
        NativeLog(log_folder)


@pytest.mark.parametrize("name", ["frames", "rig", "images", "lidar", "occluders"])
def test_truncated_tables(log_folder: Path, name: str) -> None:
    path = log_folder / f"{name}.parquet"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(BadInput, match=rf"{name}\.parquet: cannot be read as Parquet"):
        NativeLog(log_folder)


def test_other_column_types_are_said(log_folder: Path) -> None:
    path = log_folder / "frames.parquet"
    table = pq.read_table(path)
    text = pa.array(["a", "b", "c", "d"])
    pq.write_table(table.set_column(2, "x", text), path)
    with pytest.raises(BadInput, match="a column has another type"):
        NativeLog(log_folder)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"schema": "x"}, "not the log.json"),
        ({"schema_version": "2.0"}, "version 2.0 is unknown"),
        ({"ground_z": None}, "ground_z is not a number"),
        ({"crs": ...}, "crs is missing"),
        ({"crs": "EPSG:4326"}, "is geographic"),
    ],
)
def test_bad_log_json(log_folder: Path, change: dict, why: str) -> None:
    path = log_folder / "log.json"
    info = json.loads(path.read_text()) | change
    path.write_text(json.dumps({k: v for k, v in info.items() if v is not ...}))
    with pytest.raises(BadInput, match=why):
        NativeLog(log_folder)


def test_folders_that_are_no_log(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no such log folder"):
        open_log(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadInput, match="empty folder"):
        open_log(tmp_path / "empty")
    (tmp_path / "file").write_text("x")
    with pytest.raises(BadInput, match="is a file"):
        open_log(tmp_path / "file")
    with pytest.raises(BadInput, match="not a log"):
        open_log(tmp_path)


def test_writer_refuses_nonsense(tmp_path: Path) -> None:
    frame = Frame(0, 1, np.eye(4), np.ones(3))
    with pytest.raises(ValueError, match="folder name"):
        camera = Camera("../x", 4, 4, np.eye(3), np.eye(4))
        NativeLogWriter(tmp_path, "a", "EPSG:32617", Rig((camera,)))
    writer = NativeLogWriter(tmp_path, "a", "EPSG:32617", small_rig())
    with pytest.raises(ValueError, match="at least one frame"):
        writer.close()
    writer.add(frame, {})
    with pytest.raises(ValueError, match="must rise"):
        writer.add(frame, {})
    with pytest.raises(ValueError, match="not in the rig"):
        writer.add(Frame(1, 2, np.eye(4), np.ones(3)), {"other": b""})


def test_a_log_may_have_no_rig_and_no_images(tmp_path: Path) -> None:
    with whole_folder(tmp_path / "log") as folder:
        writer = NativeLogWriter(folder, "a", "EPSG:32617", None)
        writer.add(Frame(5, 7, np.eye(4), np.ones(3)), {})
        writer.close()
    log = NativeLog(tmp_path / "log")
    assert log.rig is None and log.truth_poses() is None
    assert [f.index for f in log.frames()] == [5]
