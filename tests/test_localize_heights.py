"""Height, roll and pitch where the map has heights."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from localize_scenes import CENTRE, CRS, drive, observed, run_of, town

from rtmap_cli.geometry.poses import se3_from_xyyaw, xyyaw_of, yaw_of
from rtmap_cli.logs.run import Poses, Run, true_poses
from rtmap_cli.logs.run_files import read_poses, write_poses, write_run
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.steps.evaluate.poses import upright_errors
from rtmap_cli.steps.localize.heights import _rotation, _upright, with_heights
from rtmap_cli.steps.simulate.towns.town import make_town
from rtmap_cli.steps.simulate.worlds.heights import Ground, ground_of, stand_on

UPPER = [2, 3, 4]


def lifted(world: VectorMap, z, sigma: float = 0.03, seed: int | None = None) -> VectorMap:
    """The map with heights z(x, y); with a seed they err by sigma, alike over some 12 m."""
    rng = np.random.default_rng(seed)
    out = []
    for e in world:
        x, y = (e.xy - CENTRE).T
        points = np.column_stack([e.xy, z(x, y)])
        if seed is not None:
            knots = np.arange(-200.0, 301.0, 17.0)
            along = np.interp(x + y, knots, sigma * rng.normal(size=len(knots)))
            points[:, 2] += along
        covariance = np.tile([4e-4, 0.0, 4e-4, sigma**2], (len(points), 1))
        out.append(Element(e.element_id, e.class_name, points, covariance))
    return VectorMap(out, CRS)


def leaning(truth: np.ndarray, rng: np.random.Generator, size: float = 1.0) -> np.ndarray:
    """Poses whose height is 1 m and whose roll and pitch are 1.5° off."""
    n = len(truth)
    upright = _upright(truth) + size * rng.normal(size=(n, 3)) * [1.0, 0.026, 0.026]
    out = truth.copy()
    out[:, 2, 3] = upright[:, 0]
    out[:, :3, :3] = _rotation(yaw_of(truth), upright[:, 1], upright[:, 2])
    return out


def said(pose: np.ndarray, planar: float = 0.05) -> Poses:
    """Poses as localization has them before heights come in."""
    n = len(pose)
    poses = true_poses(np.arange(n, dtype=np.int32), np.arange(n), pose)
    variances = [planar**2, planar**2, 1.0, 0.0025, 0.0025, 1e-5]
    return replace(poses, covariance=np.tile(np.diag(variances), (n, 1, 1)))


def plane(climb: float, lean: float) -> Ground:
    x, y = np.meshgrid(np.arange(-300, 301, 4.0), np.arange(-300, 301, 4.0))
    z = (climb * x + lean * y).astype(np.float32)
    return Ground(CENTRE - 300, 4.0, z, 50.0)


def test_on_a_slope_the_vehicle_stands_as_the_slope() -> None:
    flat = drive(16)
    truth = stand_on(plane(0.06, -0.04), flat)
    world = lifted(town(), lambda x, y: 50.0 + 0.06 * x - 0.04 * y)
    start = leaning(truth, np.random.default_rng(1))
    out = with_heights(said(start), start, world, 0.0)
    error = upright_errors(truth, out.pose)
    assert error[:, 0].max() < 0.02 and error[:, 1:].max() < 0.3
    assert upright_errors(truth, start).mean(axis=0)[1] > 0.8
    assert (
        np.allclose(yaw_of(out.pose), yaw_of(truth))
        and (out.pose[:, :2, 3] == truth[:, :2, 3]).all()
    )
    assert np.linalg.eigvalsh(out.covariance).min() > 0
    # Whoever is wrong along the slope is wrong in height.
    gradient = out.covariance[:, 2, 0] / out.covariance[:, 0, 0]
    assert np.allclose(gradient, 0.06, atol=0.01)


def test_regions_hold_on_a_hill_whose_map_errs() -> None:
    def hill(x, y):
        return 100.0 + 1.5 * np.sin(x / 30.0) + 1.2 * np.cos(y / 35.0)

    inside, errors = [], []
    for seed in range(12):
        x, y = np.meshgrid(np.arange(-300, 301, 2.0), np.arange(-300, 301, 2.0))
        ground = Ground(CENTRE - 300, 2.0, (hill(x, y) - 100.0).astype(np.float32), 100.0)
        truth = stand_on(ground, drive(14))
        rng = np.random.default_rng(seed)
        start = leaning(truth, rng)
        out = with_heights(said(start), start, lifted(town(), hill, 0.08, seed), 0.0)
        error = upright_errors(truth, out.pose) * [1.0, np.radians(1), np.radians(1)]
        sigma = np.sqrt(out.covariance[:, UPPER, UPPER])
        inside.append(error < 1.645 * sigma)
        errors.append(error)
    mean = np.concatenate(errors).mean(axis=0)
    assert mean[0] < 0.08 and np.degrees(mean[1:]).max() < 0.6
    share = np.concatenate(inside).mean(axis=0)
    assert ((share > 0.85) & (share < 0.999)).any() and (share > 0.85).all()


def test_initial_heights_that_are_good_are_kept() -> None:
    truth = stand_on(plane(0.05, 0.02), drive(16))
    world = lifted(town(), lambda x, y: 50.0 + 0.05 * x + 0.02 * y, 0.1, seed=4)
    start = leaning(truth, np.random.default_rng(2), 0.02)
    kept = upright_errors(truth, with_heights(said(start), start, world, 0.0).pose).mean(axis=0)
    live = with_heights(said(start), start, world, 0.0, live=True)
    assert (kept[1:] < upright_errors(truth, live.pose).mean(axis=0)[1:]).all()


def test_a_bridge_above_is_another_road() -> None:
    truth = stand_on(plane(0.0, 0.0), drive(8, bend=False))
    world = lifted(town(), lambda x, y: 50.0 + 0.0 * x)
    y = np.arange(-60.0, 60.0, 2.0)
    across = [
        Element(
            f"bridge-{k}", "boundary", np.column_stack([0 * y + k, y, 0 * y + 56.0]) + [*CENTRE, 0]
        )
        for k in (-30.0, -22.0)
    ]
    out = with_heights(said(truth), truth, VectorMap([*world, *across], CRS), 0.0, live=True)
    assert np.abs(out.pose[:, 2, 3] - 50.0).max() < 0.05


def _written(folder: Path, run: Run, world: VectorMap) -> tuple[Path, Path]:
    folder.mkdir()
    write_run(run, folder / "run")
    write_new_map(world, folder / "map", "world")
    return folder / "run", folder / "map"


@pytest.mark.parametrize(
    ("info", "options", "height"),
    [
        ({}, [], 50.4),
        ({"ground_z": -0.3}, [], 50.3),
        ({"ground_z": -0.3}, ["--ground-z", "-0.5"], 50.5),
    ],
)
def test_the_height_of_the_rig(rtmap, tmp_path: Path, info, options, height) -> None:
    """Initial heights are 0.4 m above the road on average, unless the run says better."""
    truth = drive(9, bend=False)
    run = run_of(truth, observed(town(), truth, 0.05))
    initial = run.frames.initial.copy()
    initial[:, 2, 3] = 50.4 + np.linspace(-2.0, 2.0, 9)
    run = replace(run, info=run.info | info, frames=replace(run.frames, initial=initial))
    paths = _written(tmp_path / "a", run, lifted(town(), lambda x, y: 50.0 + 0 * x))
    rtmap("localize", paths[0], "--map", paths[1], *options)
    poses = read_poses(paths[0] / "poses.parquet")
    assert np.abs(poses.pose[:, 2, 3] - height).max() < 0.15
    assert np.sqrt(poses.covariance[:, 2, 2]).max() < 0.15


def test_without_heights_nothing_is_claimed(rtmap, tmp_path: Path) -> None:
    truth = drive(6)
    level = VectorMap([e.with_points(e.xy, e.covariance) for e in town()], CRS)
    run, world = _written(tmp_path / "a", run_of(truth, observed(town(), truth)), level)
    rtmap("localize", run, "--map", world, "--ground-z", "0")
    poses = read_poses(run / "poses.parquet")
    assert (poses.pose[:, 2, 3] == 3.0).all()
    assert (poses.covariance[:, 2, 2] == 1.0).all()
    assert np.allclose(poses.covariance[:, [3, 4], [3, 4]], 0.0025)


def test_a_simulated_hilly_town(rtmap, tmp_path: Path) -> None:
    """By the command line: heights a metre and leans a degree off come down to the road."""
    made = make_town(5, 200)
    ground = ground_of(made.vector_map)
    assert ground is not None
    lane = max(made.lanes, key=len)[::3][:18]
    ahead = np.diff(lane, axis=0)
    flat = se3_from_xyyaw(*lane[:-1].T, np.arctan2(ahead[:, 1], ahead[:, 0]))
    truth = stand_on(ground, flat)
    run = run_of(truth, observed(made.vector_map, truth, 0.05))
    rough = leaning(se3_from_xyyaw(*xyyaw_of(run.frames.initial).T), np.random.default_rng(3))
    rough[:, 2, 3] += truth[:, 2, 3]
    run = replace(run, frames=replace(run.frames, initial=rough))
    path, world = _written(tmp_path / "a", run, made.vector_map)
    write_poses(true_poses(run.frames.frame, run.frames.timestamp_ns, truth), tmp_path, run.crs)
    before = upright_errors(truth, rough).mean(axis=0)
    assert before[0] > 0.5 and before[1:].min() > 0.8
    for options in ((), ("--smooth",), ("--smooth", "--lag", "1")):
        rtmap("localize", path, "--map", world, "--ground-z", 0, *options)
        words = ["evaluate", "poses", path, "--truth", tmp_path / "poses.parquet", "--json"]
        got = json.loads(rtmap(*words).out)
        after = [got[k]["mean"] for k in ("z_m", "roll_deg", "pitch_deg")]
        assert after[0] < 0.08 and max(after[1:]) < 0.5
        poses = read_poses(path / "poses.parquet")
        error = upright_errors(truth, poses.pose) * [1.0, np.radians(1), np.radians(1)]
        sigma = np.sqrt(poses.covariance[:, UPPER, UPPER])
        assert ((error < 1.645 * sigma).mean(axis=0) > 0.85).all()
