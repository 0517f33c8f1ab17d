"""rtmap localize with T^E as prior or start, and blind to what runs and maps state."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from localize_scenes import CENTRE, drive, error_of, observed, run_of, straight_road, town

from rtmap_cli.geometry.poses import se3_from_xyyaw, wrap_angle, xyyaw_of
from rtmap_cli.logs.run import OUTDATED, Observations, Poses, Run
from rtmap_cli.logs.run_files import read_poses, write_run
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.steps.localize.given import with_prior
from rtmap_cli.steps.localize.localize import localize


def _files(folder: Path, run: Run, world) -> tuple[Path, Path]:
    folder.mkdir()
    write_run(run, folder / "run")
    write_new_map(world, folder / "map", "world")
    return folder / "run", folder / "map"


def _with_te(run: Run, pose: np.ndarray, covariance: np.ndarray) -> Run:
    n = len(run.frames)
    square = np.broadcast_to(covariance, (n, 3, 3)).copy()
    return replace(run, frames=replace(run.frames, end_to_end=pose, end_to_end_covariance=square))


def _planar(poses: Poses) -> np.ndarray:
    return poses.covariance[:, [0, 1, 5]][:, :, [0, 1, 5]]


def tilted(along: float, across: float, yaw: float, heading: float) -> np.ndarray:
    """A covariance that is long along a heading."""
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return turn @ np.diag(np.square([along, across, yaw])) @ turn.T


@pytest.mark.parametrize("heading", [0.0, 0.7])
def test_the_product_of_two_priors(heading: float) -> None:
    """On parallel lines nothing but the priors speaks along the road, whatever its direction."""
    truth = drive(4, bend=False)
    c, s = np.cos(heading), np.sin(heading)
    spin = se3_from_xyyaw(*(CENTRE - [[c, -s], [s, c]] @ CENTRE), heading)
    world = straight_road()
    world = type(world)(
        [e.with_points((e.xy - CENTRE) @ [[c, s], [-s, c]] + CENTRE, e.covariance) for e in world],
        world.crs,
    )
    poses = spin @ truth
    run = run_of(poses, observed(world, poses), start_error=(0.0, 0.0, 0.0))
    along = np.array([c, s])
    te = xyyaw_of(poses)
    te[:, :2] += 0.9 * along
    run = _with_te(run, te, tilted(0.5, 0.1, 0.01, heading))
    got = {}
    for prior, want, sigma in (
        ("initial", 0.0, 1.0),
        ("end-to-end", 0.9, 0.5),
        ("both", 0.9 / 0.25 / (1 + 1 / 0.25), (1 + 1 / 0.25) ** -0.5),
    ):
        got[prior] = localize(run, world, prior=prior)
        off = error_of(got[prior].pose, poses)[:, 0]
        stated = np.sqrt(np.einsum("i,tij,j->t", along, _planar(got[prior])[:, :2, :2], along))
        assert np.allclose(off, want, atol=0.02), prior
        assert np.allclose(stated, np.hypot(sigma, 0.05), rtol=0.03), prior
        assert (got[prior].status == "degenerate").all()


def test_a_prior_keeps_what_its_covariance_knows() -> None:
    truth = drive(5)
    run = run_of(truth, observed(town(), truth))
    root = np.array([[0.8, 0.0, 0.0], [0.5, 0.1, 0.0], [0.01, -0.005, 0.02]])
    square = root @ root.T
    te = xyyaw_of(truth) + [0.3, -0.2, 2 * np.pi]
    te[2] = np.nan
    run = _with_te(run, te, square)
    other, rest = with_prior(run, "end-to-end")
    whole = rest.information + other.frames.sigma[:, :, None] ** -2 * np.eye(3)
    for t in (0, 4):
        assert np.allclose(np.linalg.inv(whole[t]), square)
        assert np.linalg.eigvalsh(rest.information[t]).min() > -1e-6 * np.abs(whole[t]).max()
    off = xyyaw_of(other.frames.initial) - te
    off[:, 2] = wrap_angle(off[:, 2])
    assert np.nanmax(np.abs(off)) < 1e-8
    assert np.allclose(other.frames.initial[2], run.frames.initial[2])
    assert np.allclose(other.frames.sigma[2], run.frames.sigma[2]) and not rest.information[2].any()


def test_a_start_is_no_evidence(rtmap, tmp_path: Path) -> None:
    """T^E brings home a drive that starts too far off, and the covariance knows nothing of it."""
    truth = drive(8)
    run = run_of(truth, observed(town(), truth, 0.05), start_error=(0.4, -12.0, 0.0))
    run = replace(run, frames=replace(run.frames, sigma=np.tile([1.9, 1.9, 0.03], (8, 1))))
    te = xyyaw_of(truth) + [0.2, 0.2, 0.01]
    for name, sigma in (("sure", 0.01), ("unsure", 3.0)):
        square = np.diag(np.square([sigma, sigma, 0.05]))
        path, world = _files(tmp_path / name, _with_te(run, te, square), town())
        if rtmap("localize", path, "--map", world, code=None).code == 0:
            lost = read_poses(path / "poses.parquet").pose
            assert np.abs(error_of(lost, truth)[:, 1]).mean() > 1.5
        words = ["localize", path, "--map", world, "--start", "end-to-end", "--json"]
        assert json.loads(rtmap(*words).out)["start"] == "end-to-end"
        found = read_poses(path / "poses.parquet")
        assert np.abs(error_of(found.pose, truth)[:, 1]).max() < 0.5
        if name == "sure":
            first = found
    assert np.allclose(first.covariance, found.covariance)
    for options in (("--smooth",), ("--smooth", "--lag", "1")):
        rtmap("localize", path, "--map", world, "--start", "end-to-end", *options)
        smooth = read_poses(path / "poses.parquet")
        assert np.abs(error_of(smooth.pose, truth)[:, 1]).max() < 0.5


def test_the_prior_counts_when_smoothing_too(rtmap, tmp_path: Path) -> None:
    truth = drive(8, bend=False)
    run = run_of(truth, observed(straight_road(), truth), start_error=(1.0, 0.0, 0.0))
    run = _with_te(run, xyyaw_of(truth), np.diag([0.04, 0.01, 1e-4]))
    path, world = _files(tmp_path / "a", run, straight_road())
    off = {}
    for prior in ("initial", "end-to-end", "both"):
        rtmap("localize", path, "--map", world, "--smooth", "--prior", prior)
        off[prior] = np.abs(error_of(read_poses(path / "poses.parquet").pose, truth)[:, 0]).mean()
    assert off["initial"] > 0.9 and off["end-to-end"] < 0.05 and off["both"] < 0.15


def test_without_end_to_end_poses_there_is_no_answer(rtmap, tmp_path: Path) -> None:
    truth = drive(3)
    run = run_of(truth, observed(town(), truth))
    path, world = _files(tmp_path / "a", run, town())
    for words in (["--prior", "both"], ["--start", "end-to-end"], ["--method", "end-to-end"]):
        result = rtmap("localize", path, "--map", world, *words, code=4)
        assert "no end-to-end poses" in result.err
    for words in (["--method", "end-to-end"], ["--search", "10", "10"]):
        rtmap("localize", path, "--map", world, "--prior", "both", *words, code=2)
    bad = np.diag([1.0, 1.0, -1.0])
    path, world = _files(tmp_path / "b", _with_te(run, xyyaw_of(truth), bad), town())
    rtmap("localize", path, "--map", world, "--prior", "both", code=4)


def test_the_ablations(rtmap, tmp_path: Path) -> None:
    """Outdated answers pull when they are believed, rough vertices when sigmas are not."""
    truth = drive(6, bend=False)
    right = observed(town(), truth, 0.2, matched=True)
    gone = right.select(right.class_name != "boundary")
    gone = replace(
        gone,
        state=np.full(len(gone), OUTDATED, np.int8),
        existence=np.full(len(gone), 0.02, np.float32),
        points=gone.points + np.array([0.0, 0.4], np.float32),
    )
    rng = np.random.default_rng(2)
    rough = right.class_name == "boundary"
    noise = 0.8 * rng.normal(size=(len(right), 1, 2)) * rough[:, None, None]
    right = replace(
        right,
        points=(right.points + noise).astype(np.float32),
        sigma=np.where(rough[:, None, None], np.float32(0.8), right.sigma),
    )
    run = run_of(truth, Observations.concatenate([right, gone]))
    path, world = _files(tmp_path / "a", run, town())
    error, before = {}, (path / "observations.parquet").read_bytes()
    for flag in ((), ("--with-outdated",), ("--without-sigma",)):
        said = json.loads(rtmap("localize", path, "--map", world, *flag, "--json").out)
        assert said["ablation"] == {
            "with_outdated": flag == ("--with-outdated",),
            "without_sigma": flag == ("--without-sigma",),
        }
        poses = read_poses(path / "poses.parquet")
        error[flag] = np.abs(error_of(poses.pose, truth)[:, :2]).mean()
    assert error["--with-outdated",] > 1.5 * error[()]
    assert error["--without-sigma",] > 1.5 * error[()]
    assert (path / "observations.parquet").read_bytes() == before
