"""Frames with their lines and weights held, beside SciPy's least_squares and one step of ours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from localize_scenes import drive, gram, observed, run_of, town
from scipy.optimize import least_squares

from rtmap_cli.steps.localize.frame.held import solve_held
from rtmap_cli.steps.localize.frame.single import _solve
from rtmap_cli.steps.localize.model import ErrorModel, Settings
from rtmap_cli.steps.localize.seeing.frames import read_detections
from rtmap_cli.steps.localize.seeing.lines import MapLines
from rtmap_cli.steps.localize.seeing.residuals import judge, linearize, noise_of

MODEL, SETTINGS = ErrorModel(), Settings()


def _held():
    """Frames that begin a metre and a degree off; the lines are those at a third of that."""
    truth = drive(4)
    run = run_of(truth, observed(town(), truth, 0.1), (0.6, -0.8, 0.02), noise=0.2, seed=1)
    origin = np.round(run.frames.initial[:, :2, 3].mean(axis=0))
    lines = MapLines(town(), list(run.info["classes"]), origin, SETTINGS.heading_weight_m)
    seen = read_detections(run, lines, SETTINGS, False)
    at = seen.pose - [0.4, -0.5, 0.013]
    linear = linearize(lines, seen, at, 1.5)
    noise = noise_of(lines, seen, linear, MODEL, MODEL.offset_share)
    judgement = judge(seen, linear, noise, linear.r, MODEL, SETTINGS.huber)
    return seen, linear, at, replace(noise, weight=judgement.weight(noise))


def test_poses_are_those_of_scipy() -> None:
    seen, linear, at, noise = _held()
    poses, _ = solve_held(seen, linear, at, noise)
    moved = 0.0
    for t in range(len(seen)):
        rows = np.flatnonzero(seen.frame == t)
        lines = linear.jacobian[rows, :, :2]

        def residuals(x, t=t, rows=rows, lines=lines):
            out = [(x - seen.pose[t]) / seen.sigma[t]]
            for n, e in zip(lines, rows, strict=True):
                used = noise.weight[e] > 0
                turned = [_turned(seen.points[e], yaw) for yaw in (x[2], at[t, 2])]
                shift = (n * (turned[0] - turned[1] + x[:2] - at[t, :2])).sum(-1)
                u = noise.shared[e][used]
                covariance = np.diag(1.0 / noise.weight[e][used]) + u @ u.T
                r = (linear.r[e] + shift)[used]
                out.append(np.linalg.solve(np.linalg.cholesky(covariance), r))
            return np.concatenate(out)

        x = least_squares(residuals, seen.pose[t], xtol=1e-12, ftol=1e-12, gtol=1e-12).x
        assert np.abs(x - poses[t]).max() < 1e-6
        moved = max(moved, float(np.abs(x - at[t]).max()))
    assert moved > 0.1


def _turned(points: np.ndarray, yaw: float) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    return points @ np.array([[c, s], [-s, c]])


def test_one_round_is_a_step_of_single_frames() -> None:
    seen, linear, _, noise = _held()
    columns = np.concatenate([linear.jacobian, linear.r[..., None]], -1)
    g = seen.sum_by_frame(gram(columns, noise.weight, noise.shared))
    wanted, covariance = _solve(g, seen, seen.pose)
    poses, information = solve_held(seen, linear, seen.pose, noise, done=np.inf)
    assert np.allclose(poses, wanted, atol=1e-9)
    assert np.allclose(information, np.linalg.inv(covariance), rtol=1e-9)


def test_a_frame_that_sees_nothing_stays_at_its_initial_pose() -> None:
    seen, linear, at, noise = _held()
    blind = seen.frame == 2
    poses, information = solve_held(
        seen, linear, at, replace(noise, weight=np.where(blind[:, None], 0.0, noise.weight))
    )
    assert np.allclose(poses[2], seen.pose[2], atol=1e-12)
    assert np.allclose(information[2], np.diag(seen.sigma[2] ** -2.0))
