"""``rtmap evaluate poses``: reference numbers, matching by time, honest covariances."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtmap_cli.geometry.poses import se3_from_xyyaw
from rtmap_cli.logs.run import Observations, Poses, Run, RunFrames, run_info, true_poses
from rtmap_cli.logs.run_files import write_poses, write_run
from rtmap_cli.steps.evaluate.poses import (
    PoseScore,
    chi_squares,
    effective_count,
    mean_interval,
    pool_poses,
    pose_errors,
    upright_errors,
    whitened_errors,
)

CRS = "EPSG:32617"
N = 40


def test_reference_cases(rtmap: Any, rtmap_golden: Path) -> None:
    path = rtmap_golden / "evaluate" / "localization.json"
    want = {c["name"]: c["expected"] for c in json.loads(path.read_text())["cases"]}
    got = json.loads(rtmap("evaluate", "poses", path, "--truth", path, "--json").out)["cases"]
    assert set(got) == set(want) and len(want) == 9
    for name, expected in want.items():
        assert got[name]["n"] == expected["n"]
        for axis in ("lateral_m", "longitudinal_m", "yaw_deg"):
            assert got[name][axis] == pytest.approx(expected[axis], abs=1e-9), name


def truth() -> tuple[np.ndarray, np.ndarray]:
    """Times and true poses of a curve."""
    times = 1_700_000_000_000_000_000 + np.arange(N, dtype=np.int64) * 500_000_000
    yaw = np.linspace(3.0, 3.6, N)
    return times, se3_from_xyyaw(588_000 + 2.5 * np.arange(N), 4_479_000 + yaw, yaw)


def moved(pose: np.ndarray, forward: float, left: float, turn: float) -> np.ndarray:
    return pose @ se3_from_xyyaw(forward, left, turn)


def write(folder: Path, answered: bool = True) -> Path:
    """A run 0.5 m behind and 0.2 m to the left after localization, worse before; its truth."""
    times, pose = truth()
    index = np.arange(N, dtype=np.int32)
    nan = np.full((N, 3), np.nan)
    frames = RunFrames(
        frame=index,
        timestamp_ns=times,
        initial=moved(pose, 1.0, -2.0, 0.01),
        sigma=np.tile([1.0, 1.0, 0.02], (N, 1)),
        odometry=nan,
        odometry_sigma=nan,
        end_to_end=nan,
        end_to_end_covariance=np.full((N, 3, 3), np.nan),
        camera_count=np.zeros(N, np.int32),
    )
    status = np.array(["ok"] * N, object)
    status[:10] = "no-match"
    poses = Poses(
        frame=index,
        timestamp_ns=times,
        method="test",
        pose=moved(pose, -0.5, 0.2, np.radians(-0.3)),
        covariance=np.tile(np.diag([0.3, 0.3, 1, 1, 1, 0.01]) ** 2, (N, 1, 1)),
        eigenvalues=nan,
        weakest_direction=nan,
        residual_count=np.full(N, 9, np.int32),
        chi2=np.zeros(N),
        status=status,
    )
    box = {"x": [-36.0, 36.0], "y": [-18.0, 18.0]}
    info = run_info("fleet-7fab2350-straight-03", CRS, ["divider"], box)
    run = Run(info, frames, Observations.empty(), poses=poses if answered else None)
    (folder / "run").mkdir()
    write_run(run, folder / "run")
    (folder / "truth").mkdir()
    write_poses(true_poses(index, times, pose), folder / "truth", CRS)
    return folder / "run"


def test_localized_and_initial(rtmap: Any, tmp_path: Path) -> None:
    run = write(tmp_path)
    command = ["evaluate", "poses", run, "--truth", tmp_path, "--json"]
    got = json.loads(rtmap(*command).out)
    assert (got["n"], got["frames"], got["share_answered"]) == (30, 40, 0.75)
    assert got["status"] == {"no-match": 10, "ok": 30}
    assert got["longitudinal_m"] == pytest.approx({"mean": 0.5, "p90": 0.5}, abs=1e-6)
    assert got["lateral_m"] == pytest.approx({"mean": 0.2, "p90": 0.2}, abs=1e-6)
    assert got["yaw_deg"] == pytest.approx({"mean": 0.3, "p90": 0.3}, abs=1e-6)
    # Frames without an answer stand where they started.
    assert got["all_frames"]["lateral_m"]["mean"] == pytest.approx(0.75 * 0.2 + 0.25 * 2.0)
    before = json.loads(rtmap(*command, "--initial").out)
    assert before["n"] == 40 and before["lateral_m"]["mean"] == pytest.approx(2.0)
    rtmap(*command, "--fail-over", "lateral_m.mean=0.1", code=1)
    rtmap(*command, "--fail-over", "lateral_m.mean=0.3", "--fail-under", "share_answered=0.7")
    told = rtmap("evaluate", "poses", run, "--truth", tmp_path / "truth" / "poses.parquet").out
    assert "30 of 40 frames have an answer" in told and "90 % region" in told


def test_fleet_truth_is_picked_by_the_log_id(rtmap: Any, tmp_path: Path) -> None:
    run = write(tmp_path)
    times, pose = truth()
    rows = [
        {"frame": k, "timestamp_ns": int(t), "easting": p[0, 3], "northing": p[1, 3],
         "yaw_rad": float(np.arctan2(p[1, 0], p[0, 0]))}
        for k, (t, p) in enumerate(zip(times, pose, strict=True))
    ]  # fmt: skip
    other = [r | {"timestamp_ns": r["timestamp_ns"] + 10**15} for r in rows]
    path = tmp_path / "poses.json"
    path.write_text(json.dumps({"crs": CRS, "traversals": {"02": other, "03": rows}}))
    command = ["evaluate", "poses", run, "--truth", path, "--json"]
    assert json.loads(rtmap(*command).out)["lateral_m"]["mean"] == pytest.approx(0.2, abs=1e-6)
    assert "no pose at" in rtmap(*command, "--traversal", "02", code=3).err
    assert "no traversal 7" in rtmap(*command, "--traversal", "7", code=3).err


def test_poses_between_the_frames_are_interpolated(tmp_path: Path) -> None:
    from rtmap_cli.steps.evaluate.drives import Drive

    times, pose = truth()
    fine = Drive("fine", CRS, times // 5, pose)  # a pose every 0.1 s
    at, known = fine.at(np.array([times[3] // 5 + 50_000_000, times[-1], times[0] // 5 - 1]))
    assert known.tolist() == [True, False, False]
    np.testing.assert_allclose(at[0, :2, 3], (pose[3, :2, 3] + pose[4, :2, 3]) / 2)
    coarse, known = Drive("coarse", CRS, times, pose).at(times[:1] + 250_000_000)
    assert not known.any() and np.isnan(coarse).all()


def test_bad_input(rtmap: Any, tmp_path: Path) -> None:
    run = write(tmp_path, answered=False)
    assert "--initial" in rtmap("evaluate", "poses", run, "--truth", tmp_path, code=3).err
    empty = tmp_path / "empty"
    empty.mkdir()
    for missing in (empty, tmp_path / "nowhere.parquet", run):
        result = rtmap("evaluate", "poses", run, "--truth", missing, "--initial", code=3)
        assert len(result.err.strip().splitlines()) == 1
    times, pose = truth()
    index = np.arange(N, dtype=np.int32)
    write_poses(true_poses(index, times, pose), tmp_path / "truth", "EPSG:32618")
    error = rtmap("evaluate", "poses", run, "--truth", tmp_path, "--initial", code=3).err
    assert "EPSG:32618" in error and "EPSG:32617" in error


def test_honest_covariances_hold_what_they_say() -> None:
    rng = np.random.default_rng(0)
    n = 20_000
    yaw = rng.uniform(-3, 3, n)
    true = se3_from_xyyaw(rng.normal(0, 100, n), rng.normal(0, 100, n), yaw)
    square = np.diag([0.6, 0.1, 0.01]) ** 2
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.zeros((n, 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = c
    turn[:, 1, 0], turn[:, 0, 1], turn[:, 2, 2] = s, -s, 1
    error = turn @ (rng.normal(size=(n, 3, 1)) * [[0.6], [0.1], [0.01]])
    estimate = se3_from_xyyaw(
        true[:, 0, 3] + error[:, 0, 0], true[:, 1, 3] + error[:, 1, 0], yaw + error[:, 2, 0]
    )
    covariance = turn @ square @ turn.swapaxes(1, 2)

    def score(factor: float) -> dict[str, Any]:
        squares = chi_squares(true, estimate, factor * covariance)
        whitened = whitened_errors(true, estimate, factor * covariance)
        upright = upright_errors(true, estimate)
        errors = pose_errors(true, estimate)
        found = PoseScore(errors, np.full(n, "ok"), squares, whitened, upright)
        told = pool_poses([found, found]).consistency()
        assert told is not None and told["n"] == 2 * n
        return told

    honest = score(1.0)
    assert honest["nees"] == pytest.approx(1.0, abs=0.03)
    for name in ("all", "longitudinal", "lateral", "yaw"):
        assert honest["inside"]["50"][name] == pytest.approx(0.5, abs=0.015)
        assert honest["inside"]["90"][name] == pytest.approx(0.9, abs=0.015)
    assert honest["verdict"] == "consistent"
    low, high = honest["nees_interval"]["independent"]
    assert high - 1 == pytest.approx(1.96 * np.sqrt(2 / (3 * 2 * n)), rel=0.02) and low < 1
    assert honest["nees_interval"]["n_effective"] == pytest.approx(2 * n, rel=0.05)
    assert score(0.25)["nees"] == pytest.approx(4.0, abs=0.1)
    assert score(0.25)["verdict"] == "overconfident"
    assert score(4.0)["verdict"] == "underconfident"
    unknown = chi_squares(true[:2], estimate[:2], np.zeros((2, 3, 3)))
    assert np.isnan(unknown["all"]).all()


def test_frames_that_err_alike_count_less() -> None:
    rng = np.random.default_rng(3)
    rho, n = 0.9, 400
    verdicts, worth = [], []
    for _ in range(200):
        w = np.empty((n, 3))
        w[0] = rng.normal(size=3)
        for k in range(1, n):
            w[k] = rho * w[k - 1] + np.sqrt(1 - rho**2) * rng.normal(size=3)
        count = effective_count(w)
        mean = float((w**2).sum(axis=1).mean() / 3)
        inside = [low <= mean <= high for low, high in (mean_interval(c, 3) for c in (n, count))]
        verdicts.append(inside)
        worth.append(count)
    alone, alike = np.mean(verdicts, axis=0)
    # Honest, but as if independent half of the runs would be called liars.
    assert alone < 0.75 and alike > 0.88
    # The χ² of an AR(1) correlate by ρ^2k.
    assert np.median(worth) == pytest.approx(n * (1 - rho**2) / (1 + rho**2), rel=0.2)
    assert effective_count(np.ones((50, 3))) == pytest.approx(1.0, abs=0.05)


def test_height_roll_and_pitch(rtmap: Any, tmp_path: Path) -> None:
    times, pose = truth()
    tilt = np.eye(4)
    angle = np.radians(0.4)
    tilt[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    nod = np.eye(4)
    nod[0, 0] = nod[2, 2] = np.cos(angle / 2)
    nod[0, 2], nod[2, 0] = np.sin(angle / 2), -np.sin(angle / 2)
    hills = pose.copy()
    hills[:, 2, 3] = 250.0 + np.arange(N)
    hills = hills @ tilt
    up = np.eye(4)
    up[2, 3] = 0.3
    got = upright_errors(hills, hills @ up @ nod @ tilt)
    np.testing.assert_allclose(got, np.tile([0.3, 0.4, 0.2], (N, 1)), atol=1e-9)
    assert np.isnan(upright_errors(pose, hills)).all()
    # A run that took them over from its initial poses did not estimate them.
    run = write(tmp_path)
    command = ["evaluate", "poses", run, "--truth", tmp_path, "--json"]
    write_poses(true_poses(np.arange(N, dtype=np.int32), times, hills), tmp_path / "truth", CRS)
    assert "z_m" not in json.loads(rtmap(*command).out)
    moved_up = true_poses(np.arange(N, dtype=np.int32), times, hills @ up @ tilt)
    write_poses(moved_up, run, CRS)
    got = json.loads(rtmap(*command).out)
    assert got["z_m"] == pytest.approx({"mean": 0.3, "p90": 0.3})
    assert got["roll_deg"]["mean"] == pytest.approx(0.4)
    assert got["pitch_deg"]["mean"] == pytest.approx(0.0, abs=1e-9)
    told = rtmap("evaluate", "poses", run, "--truth", tmp_path).out
    assert "roll (°)" in told and "(100.0%)" in told
