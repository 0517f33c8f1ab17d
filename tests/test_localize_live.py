"""rtmap localize --smooth --lag: what a live system would have said."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from localize_scenes import CENTRE, CRS, drive, error_of, observed, run_of, town

from rtmap_cli.geometry.poses import se3_from_xyyaw, xyyaw_of
from rtmap_cli.logs.run import Poses, Run
from rtmap_cli.logs.run_files import read_poses, write_run
from rtmap_cli.maps.element import CLASSES, Element, VectorMap
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.steps.localize.drive.motion import motion_of
from rtmap_cli.steps.localize.frame.begin import single_frames
from rtmap_cli.steps.localize.lag.window import Window
from rtmap_cli.steps.localize.localize import localize
from rtmap_cli.steps.localize.model import ErrorModel, Settings
from rtmap_cli.steps.localize.seeing.frames import read_detections
from rtmap_cli.steps.localize.seeing.lines import MapLines


def street(length: float) -> VectorMap:
    """A street along x that swings to and fro, with a crossing every 45 m."""
    x = np.arange(-40.0, length + 40.0, 2.0)
    lines = [("divider", 0.3), ("boundary", -4.8), ("boundary", 5.2)]
    elements = [
        Element(f"line-{k}", name, np.column_stack([x, 3.0 * np.sin(x / 25.0) + y]) + CENTRE)
        for k, (name, y) in enumerate(lines)
    ]
    for x0 in np.arange(-20.0, length, 45.0):
        y = 3.0 * np.sin(x0 / 25.0)
        ring = np.array([[0, -4], [3, -4], [3, 4], [0, 4], [0, -4]]) + [x0, y]
        elements.append(Element(f"crossing-{x0:.0f}", "ped_crossing", ring + CENTRE))
    return VectorMap(elements, CRS)


def noisy(world: VectorMap, truth: np.ndarray, seed: int = 3) -> Run:
    """Detections with offsets of 0.25 m and 0.1 m per vertex, said to be so; odometry to 1 %."""
    rng = np.random.default_rng(seed)
    seen = observed(world, truth, 0.27)
    points = seen.points + 0.25 * rng.normal(size=(len(seen), 1, 2))
    points += 0.1 * rng.normal(size=points.shape)
    run = run_of(truth, replace(seen, points=points.astype(np.float32)), noise=0.3)
    error = rng.normal(size=run.frames.odometry.shape) * [0.05, 0.05, 0.004]
    run.frames = replace(run.frames, odometry=run.frames.odometry + error)
    return run


LENGTH = 300.0
Answer = Callable[[float | None], Poses]


@pytest.fixture(scope="module")
def long_truth() -> np.ndarray:
    x = np.arange(0.0, LENGTH, 7.0)
    y = 3.0 * np.sin(x / 25.0) - 1.7
    return se3_from_xyyaw(x + CENTRE[0], y + CENTRE[1], np.arctan(0.12 * np.cos(x / 25.0)))


@pytest.fixture(scope="module")
def long_run(long_truth: np.ndarray) -> Run:
    return noisy(street(LENGTH), long_truth)


@pytest.fixture(scope="module")
def answer(long_run: Run) -> Answer:
    """The long run smoothed with a lag (None: as a whole), once each."""

    @lru_cache
    def localized(lag: float | None) -> Poses:
        return localize(long_run, street(LENGTH), smooth=True, lag=lag)

    return localized


def _files(folder: Path, run: Run, world: VectorMap) -> tuple[Path, Path]:
    folder.mkdir()
    write_run(run, folder / "run")
    write_new_map(world, folder / "map", "world")
    return folder / "run", folder / "map"


def _first(run: Run, count: int) -> Run:
    """A log that ends after ``count`` frames."""
    names = run.frames.__dataclass_fields__
    frames = replace(run.frames, **{n: getattr(run.frames, n)[:count] for n in names})
    o = run.observations
    return replace(run, frames=frames, observations=o.select(o.frame < count))


def test_a_lag_longer_than_the_log_is_smoothing(rtmap, tmp_path: Path) -> None:
    run, world = _files(tmp_path / "a", noisy(town(), drive(16)), town())

    def written(*options: str) -> Poses:
        rtmap("localize", run, "--map", world, "--smooth", *options)
        return read_poses(run / "poses.parquet")

    whole, late = written(), written("--lag", "60")
    assert (whole.method, late.method) == ("smooth", "fixed-lag")
    assert np.abs(whole.pose - late.pose).max() < 1e-6
    assert np.allclose(whole.covariance, late.covariance, rtol=1e-6, atol=1e-12)
    assert np.allclose(whole.chi2, late.chi2) and (whole.status == late.status).all()
    assert (whole.residual_count == late.residual_count).all()
    now = written("--lag", "0")
    assert np.abs(whole.pose - now.pose).max() > 1e-3


@pytest.mark.parametrize(("lag", "count"), [(0.0, 9), (3.0, 27)])
def test_answers_know_nothing_of_what_comes_later(
    long_run: Run, answer: Answer, lag: float, count: int
) -> None:
    """Two frames a second: with the log cut off, all answers but those within the lag stay."""
    whole = answer(lag)
    part = localize(_first(long_run, count), street(LENGTH), smooth=True, lag=lag)
    sure = slice(0, count - int(2 * lag))
    assert len(part) == count
    assert np.abs(part.pose[sure] - whole.pose[sure]).max() < 1e-6
    assert np.allclose(part.covariance[sure], whole.covariance[sure], rtol=1e-6)
    assert not lag or np.abs(part.pose[count - 1] - whole.pose[count - 1]).max() > 1e-6


def test_waiting_longer_is_better_and_says_so(
    long_run: Run, answer: Answer, long_truth: np.ndarray
) -> None:
    sigma, error = [], []
    for lag in (0.0, 3.0, None):
        poses = answer(lag)
        assert (poses.status[1:] == "ok").all()
        error.append(np.abs(error_of(poses.pose, long_truth)).mean(axis=0))
        square = poses.covariance[:, [0, 1, 5]][:, :, [0, 1, 5]]
        sigma.append(np.sqrt(np.einsum("tii->ti", square)).mean(axis=0))
        off = xyyaw_of(poses.pose) - xyyaw_of(long_truth)
        chi2 = np.einsum("ti,tij,tj->t", off, np.linalg.inv(square), off)
        assert (chi2 < 6.25).mean() > 0.8
    assert (sigma[0] > sigma[1]).all() and (sigma[1] > 0.99 * sigma[2]).all()
    assert error[0][0] > error[1][0] > 0.9 * error[2][0]
    alone = localize(long_run, street(LENGTH))
    assert error[0][0] < np.abs(error_of(alone.pose, long_truth)).mean(axis=0)[0]


def test_a_wrong_lane_is_left_when_frames_tell_so(answer: Answer, long_truth: np.ndarray) -> None:
    """Paint every 3.3 m and a start one lane off: small steps would stay in that lane."""
    world = VectorMap([*street(LENGTH), *_lanes()], CRS)
    truth = long_truth[:16]
    seen = noisy(world, truth).observations
    shown = (seen.class_name == "divider") | (seen.frame > 5)
    run = run_of(truth, seen.select(shown), start_error=(0.2, 2.6, 0.0))
    poses = localize(run, world, smooth=True, lag=0.0)
    error = np.abs(error_of(poses.pose, truth)[:, 1])
    assert error[0] > 1.5 and error[6:].max() < 0.4


def _lanes() -> list[Element]:
    x = np.arange(-40.0, LENGTH + 40.0, 2.0)
    y = 3.0 * np.sin(x / 25.0) + 0.3
    return [
        Element(f"lane-{k}", "divider", np.column_stack([x, y + 3.3 * k]) + CENTRE)
        for k in (-3, -2, -1, 1, 2, 3)
    ]


def test_what_leaves_the_window_leaves_all_it_knew(long_run: Run) -> None:
    """Eliminating the first chunk changes neither estimates nor covariances of the rest."""
    world, settings = street(LENGTH), Settings()
    lines = MapLines(world, list(CLASSES), CENTRE.copy(), settings.heading_weight_m)
    seen = read_detections(long_run, lines, settings, False)
    single, model = single_frames(lines, seen, ErrorModel(), settings)
    window = Window(
        lines, seen, motion_of(long_run.frames, seen.pose, model, settings), model, settings
    )
    window.begin(len(seen) - 1, single)
    last = range(len(seen) - 8, len(seen))
    window.pose[len(seen) - 3 :, :2] += 0.05
    before, first = window.answers(last), window.first
    step = window.step()
    window.leave_behind(len(seen) - 1)
    after = window.answers(last)
    assert window.first > first + 10 and window.prior is not None
    assert len(window.frames) == len(seen) - window.first
    assert np.allclose(before.covariance, after.covariance, rtol=1e-8)
    # The next step is the same one.
    assert np.allclose(step[window.first :], window.step(), atol=1e-9)
    assert np.abs(step).max() > 0.02


def test_frames_without_detections_or_odometry_are_bridged(long_truth: np.ndarray) -> None:
    run = noisy(street(LENGTH), long_truth[:22])
    o = run.observations
    odometry = run.frames.odometry.copy()
    odometry[13] = np.nan
    run = replace(
        run,
        observations=o.select((o.frame < 8) | (o.frame > 10)),
        frames=replace(run.frames, odometry=odometry),
    )
    poses = localize(run, street(LENGTH), smooth=True, lag=0.0)
    error = np.abs(error_of(poses.pose, long_truth[:22]))
    assert error[8:11, :2].max() < 0.6 and error[13:, 1].max() < 0.4
    sigma = np.sqrt(poses.covariance[:, 0, 0])
    assert sigma[10] > sigma[7]
    assert poses.residual_count[8:11].max() == 0 and (poses.status[1:] == "ok").all()


def test_bad_lags_are_told(rtmap, tmp_path: Path) -> None:
    run = noisy(town(), drive(6))
    path, world = _files(tmp_path / "a", run, town())
    for words in (
        ["--lag", "3"],
        ["--smooth", "--lag", "-1"],
        ["--smooth", "--lag", "nan"],
        ["--smooth", "--lag", "2", "--search", "10", "10"],
        ["--smooth", "--lag", "2", "--method", "end-to-end"],
    ):
        result = rtmap("localize", path, "--map", world, *words, code=2)
        assert "--lag" in result.err and not (path / "poses.parquet").exists()
    unsure = replace(run, frames=replace(run.frames, sigma=np.full((6, 3), 5.0)))
    path, world = _files(tmp_path / "b", unsure, town())
    result = rtmap("localize", path, "--map", world, "--smooth", "--lag", "2", code=2)
    assert "sigmas of the initial poses" in result.err


def test_the_lag_is_reported(rtmap, tmp_path: Path) -> None:
    path, world = _files(tmp_path / "a", noisy(town(), drive(6)), town())
    words = ["localize", path, "--map", world, "--smooth", "--lag", "1.5"]
    assert json.loads(rtmap(*words, "--json").out)["lag_s"] == 1.5
    assert "6 frames by fixed-lag of 1.5 s: 6 ok" in rtmap(*words).out
