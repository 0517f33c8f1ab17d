"""rtmap localize --search: starts that are many metres, degrees or half a turn off."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from localize_scenes import drive, error_of, observed, run_of, straight_road, town

from rtmap_cli.logs.run import Run
from rtmap_cli.logs.run_files import read_poses, write_run
from rtmap_cli.maps.store import write_new_map

FAR = (8.0, -6.0, np.radians(10.0))
"""10 m and 10° off."""


def _files(folder: Path, run: Run, world) -> tuple[Path, Path]:
    folder.mkdir()
    write_run(run, folder / "run")
    write_new_map(world, folder / "map", "world")
    return folder / "run", folder / "map"


def _written(rtmap, run: Path, vector_map: Path, *options: str):
    result = json.loads(rtmap("localize", run, "--map", vector_map, *options, "--json").out)
    return result, read_poses(run / "poses.parquet")


@pytest.fixture
def truth() -> np.ndarray:
    return drive(14)


@pytest.mark.parametrize("smooth", [(), ("--smooth",)])
def test_a_start_far_off_is_recovered(rtmap, tmp_path: Path, truth, smooth) -> None:
    far = run_of(truth, observed(town(), truth, 0.05), FAR, noise=0.5, seed=1)
    paths = _files(tmp_path / "far", far, town())
    result, poses = _written(rtmap, *paths, "--search", "14", "15", *smooth)
    assert result["search"] == {"metres": 14.0, "degrees": pytest.approx(15.0)}
    assert np.abs(error_of(poses.pose, truth)[:, :2]).max() < 0.3
    assert (poses.status == "ok").all()
    # Without a search it is not found; best is to say so.
    alone = rtmap("localize", paths[0], "--map", paths[1], *smooth, code=None)
    poses = read_poses(paths[0] / "poses.parquet")
    assert alone.code == 4 or np.abs(error_of(poses.pose, truth)[:, :2]).max() > 2.0


def test_large_stated_sigmas_start_the_search(rtmap, tmp_path: Path, truth) -> None:
    lost = run_of(truth, observed(town(), truth, 0.05), (-5.0, 6.0, 2.5))
    sigma = np.tile([6.0, 6.0, np.pi], (len(truth), 1))
    lost = replace(lost, frames=replace(lost.frames, sigma=sigma))
    paths = _files(tmp_path / "lost", lost, town())
    result, poses = _written(rtmap, *paths, "--smooth")
    assert result["search"] == {"metres": 15.0, "degrees": 180.0}
    assert np.abs(error_of(poses.pose, truth)).max() < 0.3
    said = rtmap("localize", paths[0], "--map", paths[1]).out
    assert "searched 15 m and 180° around" in said


def test_without_odometry_frames_are_searched_for_alone(rtmap, tmp_path: Path, truth) -> None:
    alone = run_of(truth, observed(town(), truth, 0.05), FAR)
    unknown = np.full((len(truth), 3), np.nan)
    frames = replace(alone.frames, odometry=unknown, odometry_sigma=unknown)
    paths = _files(tmp_path / "alone", replace(alone, frames=frames), town())
    _, poses = _written(rtmap, *paths, "--search", "14", "15")
    error = error_of(poses.pose, truth)
    right = np.hypot(error[:, 0], error[:, 1]) < 1.0
    assert right.sum() >= len(truth) // 2
    sigma = np.sqrt(np.linalg.eigvalsh(poses.covariance[:, :2, :2])[:, 1])
    wrong = ~right & (poses.status == "ok")
    assert (np.hypot(error[:, 0], error[:, 1])[wrong] < 3 * sigma[wrong]).all()


@pytest.mark.parametrize("smooth", [(), ("--smooth",)])
def test_a_road_that_looks_alike_everywhere_is_said(rtmap, tmp_path: Path, smooth) -> None:
    truth = drive(14, bend=False)
    road = straight_road()
    start = (9.0, 3.0, 0.1)
    paths = _files(tmp_path / "road", run_of(truth, observed(road, truth, 0.05), start), road)
    _, poses = _written(rtmap, *paths, "--search", "14", "15", *smooth)
    assert (poses.status == "degenerate").all()
    error = np.abs(error_of(poses.pose, truth))
    along = np.sqrt(poses.covariance[:, 0, 0])
    assert (along > 3.0).all()
    assert (error[:, 0] < 3 * along).all()
    assert error[:, 1].max() < 0.3


def test_search_and_end_to_end_are_refused(rtmap, tmp_path: Path, truth) -> None:
    paths = _files(tmp_path / "net", run_of(truth, observed(town(), truth)), town())
    options = ("--method", "end-to-end", "--search", "5", "5")
    failed = rtmap("localize", paths[0], "--map", paths[1], *options, code=2)
    assert "--search has no use for --method end-to-end" in failed.err
