"""rtmap check-log names what was broken on purpose, and nothing in a clean log."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.feather as feather
import pyarrow.parquet as pq
import pytest
from sample_logs import jpeg, rewrite, truncate, write_av2_log, write_native_log

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.av2.check import check_av2
from rtmap_cli.logs.check import check_native
from rtmap_cli.logs.check_parts import Report, check_camera
from rtmap_cli.logs.log import Camera

NAN = float("nan")


@pytest.fixture
def native(tmp_path: Path) -> Path:
    return write_native_log(tmp_path / "log", frames=12)


@pytest.fixture
def av2(tmp_path: Path) -> Path:
    return write_av2_log(tmp_path / "small")


def column(path: Path, name: str) -> list[Any]:
    reader = feather.read_table if path.suffix == ".feather" else pq.read_table
    return reader(path)[name].to_pylist()


def spoil(path: Path, name: str, row: int, value: Any) -> None:
    values = column(path, name)
    values[row] = value
    rewrite(path, **{name: values})


def test_a_clean_log_has_no_finding(rtmap: Callable[..., Any], native: Path) -> None:
    result = rtmap("check-log", native)
    assert result.out == f"{native}: 0 errors, 0 warnings\n"
    rtmap("check-log", native, "--fast")
    told = json.loads(rtmap("check-log", native, "--json").out)
    assert told == {
        "log": str(native),
        "format": "native",
        "errors": 0,
        "warnings": 0,
        "findings": [],
    }


def test_a_clean_av2_log_has_no_finding(rtmap: Callable[..., Any], av2: Path) -> None:
    told = json.loads(rtmap("check-log", f"av2:{av2}", "--json").out)
    assert (told["format"], told["findings"]) == ("av2", [])


def test_errors_exit_with_3_and_are_all_named(rtmap: Callable[..., Any], native: Path) -> None:
    truncate(native / "images/cam_1/000003.jpg", 30)
    (native / "images/cam_0/000002.jpg").unlink()
    (native / "images/cam_0/000004.jpg").write_bytes(jpeg(9, (32, 24)))
    spoil(native / "frames.parquet", "qw", 5, 2.0)
    lines = rtmap("check-log", native, code=3).out.splitlines()
    assert len(lines) == 5 and lines[-1] == f"{native}: 4 errors, 0 warnings"
    text = "\n".join(lines)
    assert "error: images/cam_0/000002.jpg: no such image; copy it, or drop its row" in text
    assert "000003.jpg: truncated (no end marker); copy it again" in text
    assert "000004.jpg: is 32 × 24, the calibration of cam_0 says 64 × 48" in text
    assert "frames.parquet: quaternions not of length 1 (row 5); normalise them" in text


def change(path: Path, name: str, of: Callable[[int, Any], Any]) -> None:
    """Replace every value of a column by ``of(row, value)``."""
    rewrite(path, **{name: [of(i, v) for i, v in enumerate(column(path, name))]})


def replace_text(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(old, new))


def rename_city(folder: Path) -> None:
    for file in (folder / "map").iterdir():
        file.rename(file.with_name(file.name.replace("PIT", "ABC")))


FRAMES = "frames.parquet"
NATIVE_FAULTS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "nan": (lambda p: spoil(p / FRAMES, "x", 2, NAN), r"error: .*not numbers \(row 2\)"),
    "null": (lambda p: spoil(p / FRAMES, "x", 2, None), r"error: .*not numbers \(row 2\)"),
    "order": (
        lambda p: spoil(p / FRAMES, "timestamp_ns", 7, 1_700_000_000_000_000_001),
        r"error: .*timestamps go backwards \(row 7\)",
    ),
    "repeat": (
        lambda p: spoil(p / FRAMES, "timestamp_ns", 1, 1_700_000_000_000_000_000),
        r"error: .*timestamps repeated \(row 1\)",
    ),
    "numbers": (lambda p: spoil(p / FRAMES, "frame", 1, 0), "error: .*frame numbers used twice"),
    "jump": (
        lambda p: spoil(p / FRAMES, "y", 6, 4_478_000.0),
        r"error: .*the pose jumps by 1000 m in 0\.5 s after row 5",
    ),
    "sigma": (lambda p: spoil(p / FRAMES, "sigma_x", 0, 0.0), "error: .*sigmas that are not above"),
    "lonlat": (
        lambda p: rewrite(p / FRAMES, x=[-80.0] * 12, y=[40.0] * 12),
        r"error: frames\.parquet: positions .*lie outside EPSG:32617",
    ),
    "city": (
        lambda p: rewrite(p / FRAMES, x=[5000.0] * 12, y=[2400.0] * 12),
        r"error: frames\.parquet: positions .*lie outside EPSG:32617",
    ),
    "milliseconds": (
        lambda p: change(p / FRAMES, "timestamp_ns", lambda i, t: t // 10**6),
        "warning: .*are the timestamps in nanoseconds",
    ),
    "heading": (
        lambda p: rewrite(p / FRAMES, qw=[0.0] * 12, qz=[1.0] * 12),
        "warning: .*moves 180° away from where it looks",
    ),
    "gap": (
        lambda p: change(p / FRAMES, "timestamp_ns", lambda i, t: t + (i > 5) * 10**10),
        r"warning: .*10\.5 s without a row after row 5",
    ),
    "odometry": (
        lambda p: rewrite(p / FRAMES, odometry_dx=[None] + [0.1] * 11),
        "warning: .*odometry adds up to 1 m forward, the poses to 28 m",
    ),
    "cut table": (lambda p: truncate(p / FRAMES), r"error: frames\.parquet: cannot be read"),
    "no table": (lambda p: (p / FRAMES).unlink(), r"error: frames\.parquet: no such file"),
    "no rig": (lambda p: (p / "rig.parquet").unlink(), r"error: rig\.parquet: no such file"),
    "unit": (
        lambda p: rewrite(p / "rig.parquet", fx=[0.9, 0.9], fy=[0.9, 0.9]),
        "warning: .*focal length 0.9 px for 64 px",
    ),
    "centre": (
        lambda p: spoil(p / "rig.parquet", "cx", 0, 700.0),
        r"error: .*principal point \(700, 24\) outside 64 × 48",
    ),
    "axes": (
        lambda p: rewrite(
            p / "rig.parquet", qw=[1.0] * 2, qx=[0.0] * 2, qy=[0.0] * 2, qz=[0.0] * 2
        ),
        "warning: .*looks up or down",
    ),
    "camera": (
        lambda p: spoil(p / "images.parquet", "camera", 0, "cam_7"),
        r"error: images\.parquet: camera cam_7 is not in rig\.parquet",
    ),
    "path": (
        lambda p: spoil(p / "images.parquet", "path", 0, "../secret.jpg"),
        "error: .*leads out of the log",
    ),
    "twice": (
        lambda p: spoil(p / "images.parquet", "frame", 2, 0),
        r"error: .*images listed twice for one frame and camera \(row 2\)",
    ),
    "no images": (lambda p: (p / "images.parquet").unlink(), "warning: .*no images"),
    "image time": (
        lambda p: spoil(p / "images.parquet", "timestamp_ns", 0, 1_700_000_001_000_000_000),
        "warning: .*taken 1 s away from the time of its frame",
    ),
    "sweep": (
        lambda p: truncate(p / "lidar" / "000000.parquet"),
        r"error: lidar/000000\.parquet: cannot be read as Parquet",
    ),
    "box": (
        lambda p: rewrite(p / "occluders.parquet", length=[0.0]),
        r"error: occluders\.parquet: boxes without size",
    ),
    "truth": (lambda p: truncate(p / "truth/poses.parquet"), r"error: truth/poses\.parquet"),
    "degrees": (
        lambda p: replace_text(p / "log.json", "EPSG:32617", "EPSG:4326"),
        r"error: log\.json: EPSG:4326 is geographic",
    ),
    "version": (
        lambda p: replace_text(p / "log.json", '"1.0"', '"9.0"'),
        r"error: log\.json: log version 9\.0 is unknown",
    ),
}


@pytest.mark.parametrize("name", NATIVE_FAULTS)
def test_native_fault(native: Path, name: str) -> None:
    break_it, pattern = NATIVE_FAULTS[name]
    break_it(native)
    lines = [f.line() for f in check_native(native).findings]
    assert any(re.match(pattern, line) for line in lines), lines


POSES = "city_SE3_egovehicle.feather"
AV2_FAULTS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "nan": (lambda p: spoil(p / POSES, "tx_m", 3, NAN), r"error: city_SE3.*not numbers \(row 3\)"),
    "order": (lambda p: spoil(p / POSES, "timestamp_ns", 3, 5), "error: .*timestamps go backwards"),
    "jump": (lambda p: spoil(p / POSES, "tx_m", 3, 900.0), "error: .*the pose jumps by 900 m"),
    "no poses": (lambda p: (p / POSES).unlink(), "error: city_SE3_ego.*feather: no such file"),
    "no calibration": (
        lambda p: shutil.rmtree(p / "calibration"),
        "warning: calibration: no calibration of ring cameras",
    ),
    "half a calibration": (
        lambda p: (p / "calibration/intrinsics.feather").unlink(),
        "error: calibration/intrinsics.feather: no such file",
    ),
    "image": (
        lambda p: truncate(min((p / "sensors/cameras/ring_front_left").iterdir()), 30),
        "error: sensors/cameras/ring_front_left/.*truncated",
    ),
    "annotations": (lambda p: truncate(p / "annotations.feather"), "error: annotations.feather"),
    "sweep": (
        lambda p: truncate(next((p / "sensors/lidar").iterdir())),
        r"error: sensors/lidar/315966253500000000\.feather",
    ),
    "city": (
        rename_city,
        "error: map/.*unknown city 'ABC'; known cities are",
    ),
    "vector map": (
        lambda p: truncate(next((p / "map").glob("log_map*"))),
        "error: map/log_map_archive.*cannot be read as JSON",
    ),
    "raster": (
        lambda p: truncate(next((p / "map").glob("*.npy"))),
        "error: map/.*cannot be read as a height raster",
    ),
    "another drive": (
        lambda p: change(p / POSES, "timestamp_ns", lambda i, t: t + 10**12),
        "error: sensors/cameras/ring_front_center: all images lie outside the time of the poses",
    ),
    "another place": (
        lambda p: change(p / POSES, "tx_m", lambda i, x: x + 5000),
        "error: map: the poses lie outside the ground raster",
    ),
}


@pytest.mark.parametrize("name", AV2_FAULTS)
def test_av2_fault(av2: Path, name: str) -> None:
    break_it, pattern = AV2_FAULTS[name]
    break_it(av2)
    lines = [f.line() for f in check_av2(av2).findings]
    assert any(re.match(pattern, line) for line in lines), lines


def test_many_findings_of_a_kind_are_counted(native: Path) -> None:
    for path in (native / "images/cam_0").iterdir():
        path.write_bytes(jpeg(1, (16, 16)))
    lines = [f.line() for f in check_native(native).findings]
    assert len(lines) == 6
    assert lines[-1] == "error: images.parquet: 7 more: images of another size"


@pytest.mark.parametrize("fast", [True, False])
def test_truncated_image_is_found_fast_too(native: Path, fast: bool) -> None:
    truncate(native / "images/cam_0/000001.jpg", 2)
    assert check_native(native, fast).errors == 1


def test_folding_distortion() -> None:
    k = np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])
    forward = np.array([[0, 0, 1, 1.6], [-1, 0, 0, 0], [0, -1, 0, 1.4], [0, 0, 0, 1.0]])
    for k1, count in ((-0.2, 0), (-3.0, 1)):
        report = Report(Path("log"))
        check_camera(report, Path("log/rig.parquet"), Camera("a", 64, 48, k, forward, (k1, 0, 0)))
        assert len(report.findings) == count


def test_folders_that_are_no_log(rtmap: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for name in ("none", "empty"):
        result = rtmap("check-log", tmp_path / name, code=3)
        assert result.out == "" and result.err.count("\n") == 1
    with pytest.raises(BadInput, match="no such log folder"):
        check_av2(tmp_path / "none")


@pytest.mark.parametrize("name", ["7fab2350", "adcf7d18", "3bffdcff"])
def test_sample_logs_have_no_errors(rtmap_data: Path, name: str) -> None:
    found = sorted((rtmap_data / "av2_sensor").glob(f"{name}-*"))
    if not found:
        pytest.skip(f"log {name} not found in RTMAP_DATA/av2_sensor")
    report = check_av2(found[0])
    told = {f.file for f in report.findings}
    assert report.errors == 0
    assert told == {"sensors/cameras"} | (set() if name == "7fab2350" else {"calibration"})


def test_a_damaged_copy_of_a_sample_log(av2_log: Path, tmp_path: Path) -> None:
    copy = tmp_path / av2_log.name
    shutil.copytree(av2_log, copy)
    for path in copy.rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o644)
    truncate(copy / "annotations.feather", 1000)
    spoil(copy / POSES, "qx", 100, NAN)
    truncate(min((copy / "sensors/lidar").iterdir()), 1000)
    assert {f.file for f in check_av2(copy).findings if f.level == "error"} == {
        "annotations.feather",
        POSES,
        "sensors/lidar/315966265259836000.feather",
    }
