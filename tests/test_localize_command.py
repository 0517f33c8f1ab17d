"""rtmap localize on real files, like a user."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from localize_scenes import CRS, drive, error_of, observed, run_of, straight_road, town

from rtmap_cli.logs.residuals import RESIDUALS
from rtmap_cli.logs.run import Run
from rtmap_cli.logs.run_files import read_poses, write_run
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.tables import read_table


def _write(run: Run, folder: Path) -> Path:
    folder.mkdir(parents=True)
    write_run(run, folder)
    return folder


@pytest.fixture
def truth() -> np.ndarray:
    return drive(8)


@pytest.fixture
def map_path(tmp_path: Path) -> Path:
    write_new_map(town(), tmp_path / "map", "town")
    return tmp_path / "map"


@pytest.fixture
def run_path(tmp_path: Path, truth: np.ndarray) -> Path:
    return _write(run_of(truth, observed(town(), truth, 0.05)), tmp_path / "run")


def test_poses_are_written_and_right(rtmap, run_path, map_path, truth) -> None:
    before = {p.name: p.read_bytes() for p in run_path.iterdir()}
    result = json.loads(rtmap("localize", run_path, "--map", map_path, "--json").out)
    assert result["status"] == {"ok": 8, "degenerate": 0, "no-match": 0}
    assert result["method"] == "geometry"
    assert result["map_version"] == 0
    assert result["replaced"] is False
    assert result["median_sigma"]["lateral_m"] < 0.2
    poses = read_poses(run_path / "poses.parquet")
    assert np.abs(error_of(poses.pose, truth)[:, :2]).max() < 0.05
    assert poses.covariance.shape == (8, 6, 6)
    assert (np.linalg.eigvalsh(poses.covariance) > 0).all()
    after = {p.name: p.read_bytes() for p in run_path.iterdir()}
    assert set(after) - set(before) == {"poses.parquet"}
    assert all(after[name] == before[name] for name in before)


def test_an_older_answer_is_replaced_and_said(rtmap, run_path, map_path) -> None:
    rtmap("localize", run_path, "--map", map_path)
    first = (run_path / "poses.parquet").read_bytes()
    again = rtmap("localize", run_path, "--map", map_path)
    assert "replaced" in again.err
    assert (run_path / "poses.parquet").read_bytes() == first
    smooth = rtmap("localize", run_path, "--map", map_path, "--smooth")
    assert "by smooth: 8 ok" in smooth.out
    assert read_poses(run_path / "poses.parquet").method == "smooth"


def test_residuals_tell_why(rtmap, run_path, map_path, truth) -> None:
    rtmap("localize", run_path, "--map", map_path)
    assert not (run_path / "residuals.parquet").exists()
    rtmap("localize", run_path, "--map", map_path, "--residuals")
    rows = read_table(run_path / "residuals.parquet", RESIDUALS).to_pandas()
    used = rows[(rows["weight"] > 0) & (rows["inlier"] > 0.5)]
    count = read_poses(run_path / "poses.parquet").residual_count
    assert (used.groupby("frame").size().to_numpy() == count).all()
    near = rows[rows["element_id"].notna()]
    assert near["across"].abs().median() < 0.1
    assert np.allclose(np.hypot(near["normal_x"], near["normal_y"]), 1.0)
    assert set(near["element_id"]) <= {e.element_id for e in town()}
    kerb = near[near["element_id"] == "boundary-0"]
    assert (kerb["class_name"] == "boundary").all()
    straight = kerb[kerb["x"] < 499_990.0]
    off = straight["y"] - 5_300_000.0 - 5.4 * straight["normal_y"].abs()
    assert np.allclose(off.abs(), straight["across"].abs(), atol=0.02)


def test_degenerate_frames_are_said(rtmap, tmp_path: Path) -> None:
    truth = drive(4, bend=False)
    run = _write(run_of(truth, observed(straight_road(), truth)), tmp_path / "run")
    write_new_map(straight_road(), tmp_path / "road", "road")
    assert "4 degenerate" in rtmap("localize", run, "--map", tmp_path / "road").out


def test_no_answer_is_exit_4_and_leaves_nothing(rtmap, tmp_path, truth, map_path) -> None:
    seen = observed(town(), truth)
    elsewhere = replace(seen, class_name=np.full(len(seen), "kerbstone", object))
    run = _write(run_of(truth, elsewhere), tmp_path / "run")
    result = rtmap("localize", run, "--map", map_path, code=4)
    assert len(result.err.strip().splitlines()) == 1
    assert not (run / "poses.parquet").exists()


def test_bad_input_is_one_line_and_exit_3(rtmap, tmp_path, run_path, map_path) -> None:
    write_new_map(VectorMap(town().elements, "EPSG:32633"), tmp_path / "zone", "other zone")
    far = [Element("far", "divider", np.array([[4e5, 5e6], [4e5 + 9, 5e6]]))]
    write_new_map(VectorMap(far, CRS), tmp_path / "far", "far away")
    cases = {
        tmp_path / "zone": "EPSG:32633",
        tmp_path / "far": "no element within",
        tmp_path / "nothing": "nothing",
    }
    for path, told in cases.items():
        result = rtmap("localize", run_path, "--map", path, code=3)
        assert told in result.err
        assert len(result.err.strip().splitlines()) == 1
    rtmap("localize", tmp_path / "no-run", "--map", map_path, code=3)
    rtmap("localize", run_path, "--map", map_path, "--map-version", 7, code=3)
    rtmap("localize", run_path, "--map", map_path, "--method", "matches", code=2)
    (run_path / "observations.parquet").write_bytes(b"PAR1 cut off")
    result = rtmap("localize", run_path, "--map", map_path, code=3)
    assert "observations.parquet" in result.err
    assert not (run_path / "poses.parquet").exists()


def test_fleet_drive(rtmap, tmp_path: Path, rtmap_golden: Path) -> None:
    """One drive of the fleet benchmark by the command line alone (simulated detections)."""
    drive_path = rtmap_golden / "fleet" / "adcf7d18" / "straight"
    if not drive_path.is_dir():
        pytest.skip("no fleet benchmark in RTMAP_GOLDEN")
    prior, run = tmp_path / "prior", tmp_path / "run"
    crs = "EPSG:32617"
    rtmap("import", "geojson", drive_path / "prior.geojson", "--crs", crs, "-o", prior)
    rtmap("import", "detections", drive_path / "traversals" / "00.json.gz", "-o", run)
    mean = {}
    for option in ((), ("--smooth",)):
        rtmap("localize", run, "--map", prior, *option)
        truth = drive_path / "truth" / "poses.json.gz"
        result = json.loads(rtmap("evaluate", "poses", run, "--truth", truth, "--json").out)
        mean[bool(option)] = {k: result[k]["mean"] for k in ("lateral_m", "longitudinal_m")}
    assert mean[False]["lateral_m"] < 0.24
    assert mean[True]["lateral_m"] < 0.13
    assert mean[True]["longitudinal_m"] < mean[False]["longitudinal_m"]
