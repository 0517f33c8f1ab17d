"""How fast is a drive smoothed, beside gtsam on the same factors?

    python benchmarks/localize_speed.py                 1,000 poses, and up to 100,000 of ours

A drive of poses every metre through bends, with GNSS at every pose and odometry between them, both
with one sigma for x and y, so that both sides minimise the same cost. Ours carries a GNSS bias
beside every pose (held at zero here), as `rtmap localize --smooth` does. Both sides take turns
within one run; figures are medians of CPU seconds. Needs gtsam (extra ``dev``) for the comparison.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import wrap_angle
from rtmap_cli.steps.localize.motion import Motion, motion_terms, step_error

Array = NDArray[np.float64]

GNSS, ODOMETRY = np.array([0.5, 0.5, 0.02]), np.array([0.02, 0.02, 0.001])
ROUNDS = 20
DONE = 1e-6
"""Largest step (m, rad) after which ours stops: the next one is its square."""


def drive(count: int, seed: int) -> tuple[Array, Array]:
    """(T, 3) GNSS poses of a winding road, and (T, 3) odometry since the pose before."""
    rng = np.random.default_rng(seed)
    turn = 0.02 * np.sin(np.arange(count) / 40.0)
    yaw = np.cumsum(turn)
    before = np.concatenate([[0.0], yaw[:-1]])
    xy = np.cumsum(np.stack([np.cos(before), np.sin(before)], -1), axis=0)
    gnss = np.column_stack([xy, yaw]) + rng.normal(size=(count, 3)) * GNSS
    step = np.column_stack([np.ones(count), np.zeros(count), turn])
    return gnss, step + rng.normal(size=(count, 3)) * ODOMETRY


def ours(gnss: Array, odometry: Array) -> Array:
    """Gauss–Newton on the banded normal equations; (T, 3) poses."""
    count = len(gnss)
    odometry = odometry.copy()
    odometry[0] = np.nan
    motion = Motion(
        gnss,
        np.tile(GNSS, (count, 1)),
        np.full((count, 3), 1e-6),
        np.full((count, 3), 0.5),
        odometry,
        np.tile(ODOMETRY, (count, 1)),
        np.ones(count),
    )
    pose, bias = gnss.copy(), np.zeros((count, 3))
    for _ in range(ROUNDS):
        step = motion_terms(motion, pose, bias).solve()
        pose, bias = pose + step[:, :3], bias + step[:, 3:]
        if np.abs(step).max() < DONE:
            break
    return pose


def theirs(gnss: Array, odometry: Array) -> Array:
    """The same with gtsam's own factors and its Gauss–Newton; (T, 3) poses."""
    import gtsam

    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    of_gnss = gtsam.noiseModel.Diagonal.Sigmas(GNSS)
    of_step = gtsam.noiseModel.Diagonal.Sigmas(ODOMETRY)
    for t, pose in enumerate(gnss):
        start.insert(t, gtsam.Pose2(*pose))
        graph.add(gtsam.PriorFactorPose2(t, gtsam.Pose2(*pose), of_gnss))
        if t:
            graph.add(gtsam.BetweenFactorPose2(t - 1, t, gtsam.Pose2(*odometry[t]), of_step))
    parameters = gtsam.GaussNewtonParams()
    parameters.setMaxIterations(ROUNDS)
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    solved = gtsam.GaussNewtonOptimizer(graph, start, parameters).optimize()
    poses = [solved.atPose2(t) for t in range(len(gnss))]
    return np.array([[p.x(), p.y(), p.theta()] for p in poses])


def cost(pose: Array, gnss: Array, odometry: Array) -> float:
    """What both minimise."""
    off = pose - gnss
    off[:, 2] = wrap_angle(off[:, 2])
    step, _ = step_error(pose[:-1], pose[1:], odometry[1:])
    return 0.5 * float(((off / GNSS) ** 2).sum() + ((step / ODOMETRY) ** 2).sum())


def timed(solver: Callable[[Array, Array], Array], *drive: Array) -> tuple[float, Array]:
    """CPU seconds and the answer."""
    start = time.process_time()
    answer = solver(*drive)
    return time.process_time() - start, answer


def side_by_side(count: int, runs: int) -> dict[str, Any]:
    """Both solvers in turns on drives of ``count`` poses."""
    seconds: dict[str, list[float]] = {"rtmap": [], "gtsam": []}
    apart, costs = 0.0, {"rtmap": 0.0, "gtsam": 0.0}
    for seed in range(runs):
        gnss, odometry = drive(count, seed)
        answers = {}
        for name, solver in (("rtmap", ours), ("gtsam", theirs)):
            spent, answers[name] = timed(solver, gnss, odometry)
            seconds[name].append(spent)
            costs[name] += cost(answers[name], gnss, odometry) / runs
        off = answers["rtmap"] - answers["gtsam"]
        off[:, 2] = wrap_angle(off[:, 2])
        apart = max(apart, float(np.abs(off).max()))
    ratios = np.array(seconds["gtsam"]) / np.array(seconds["rtmap"])
    return {
        "poses": count,
        **{f"{name} s": float(np.median(values)) for name, values in seconds.items()},
        "ratio": float(np.median(ratios)),
        **{f"{name} cost": value for name, value in costs.items()},
        "largest difference": apart,
    }


def main() -> None:
    """Print one JSON object per line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=9)
    parser.add_argument("--longest", type=int, default=100_000, help="poses, of ours alone")
    a = parser.parse_args()
    try:
        print(json.dumps(side_by_side(a.poses, a.runs)), flush=True)
    except ImportError:
        print(json.dumps({"gtsam": "not installed: pip install gtsam"}))
    count = a.poses
    while count <= a.longest:
        spent = [timed(ours, *drive(count, seed))[0] for seed in range(3)]
        print(json.dumps({"poses": count, "rtmap s": float(np.median(spent))}), flush=True)
        count *= 10


if __name__ == "__main__":
    main()
