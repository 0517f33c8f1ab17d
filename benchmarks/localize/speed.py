"""How fast is a drive smoothed, beside gtsam on the same factors, and how does time grow?

    python -m benchmarks.localize.speed                 1,000 poses; then up to 100,000 of ours

A drive of poses every metre through bends, with GNSS at every pose and odometry between them;
"map" adds what the map says of every pose: x and y with a full covariance, and yaw. Ours are the
normal equations from which `rtmap localize --smooth` starts. They carry a GNSS bias beside every
pose, which gtsam is spared: it is held at zero here.

gtsam takes its own C++ factors and the order of the drive, and is run by Gauss-Newton and
Levenberg-Marquardt, sequentially and multifrontally, with GNSS as one factor per pose or as two
that have our cost (but for the logarithm by which gtsam compares steps: some micrometres); the
fastest counts. Both begin at GNSS and end when a round lowers the
cost by less than a millionth. "build" makes the graph (in gtsam's case through Python) and is not
part of "solve"; "ratio" is that of "solve" alone. CPU seconds of one core, medians over turns.
Needs gtsam (extra ``dev``) for the comparison.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import wrap_angle
from rtmap_cli.steps.localize.drive.motion import Motion, motion_terms, step_error

Array = NDArray[np.float64]

GNSS, ODOMETRY = np.array([0.5, 0.5, 0.02]), np.array([0.02, 0.02, 0.001])
MAP = np.array([0.4, 0.12, 0.005])
"""Sigmas along and across the road (m), of yaw (rad)."""
BIAS = 1e-4
"""Sigma of the bias (m, rad) that ours carries: it moves no pose by a millionth."""
METHODS, SOLVERS = ("GaussNewton", "LevenbergMarquardt"), ("SEQUENTIAL", "MULTIFRONTAL")
ROUNDS = 20
DONE = 1e-6
TURN = 0.1
"""CPU seconds a turn lasts at least."""


@dataclass(frozen=True)
class Drive:
    """``gnss`` (T, 3), ``odometry`` (T, 3) since the pose before, ``seen`` (T, 3) where the map
    puts the poses with ``information`` (T, 3, 3); zero where there is no map."""

    gnss: Array
    odometry: Array
    seen: Array
    information: Array


def drive(count: int, seed: int, with_map: bool) -> Drive:
    """A winding road."""
    rng = np.random.default_rng(seed)
    turn = 0.02 * np.sin(np.arange(count) / 40.0)
    yaw = np.cumsum(turn)
    before = np.concatenate([[0.0], yaw[:-1]])
    xy = np.cumsum(np.stack([np.cos(before), np.sin(before)], -1), axis=0)
    true = np.column_stack([xy, yaw])
    step = np.column_stack([np.ones(count), np.zeros(count), turn])
    gnss = true + rng.normal(size=(count, 3)) * GNSS
    odometry = step + rng.normal(size=(count, 3)) * ODOMETRY
    frame = np.zeros((count, 3, 3))
    frame[:, 0, 0], frame[:, 0, 1] = np.cos(yaw), -np.sin(yaw)
    frame[:, 1, 0], frame[:, 1, 1], frame[:, 2, 2] = np.sin(yaw), np.cos(yaw), 1.0
    seen = true + (frame @ (rng.normal(size=(count, 3)) * MAP)[..., None])[..., 0]
    information = (frame * MAP**-2.0) @ np.swapaxes(frame, 1, 2)
    return Drive(gnss, odometry, seen, information if with_map else np.zeros_like(information))


def build_ours(d: Drive) -> Motion:
    """The factors as arrays, and what of the normal equations is the same at all poses."""
    count = len(d.gnss)
    odometry = d.odometry.copy()
    odometry[0] = np.nan
    motion = Motion(
        d.gnss,
        np.tile(GNSS, (count, 1)),
        np.full((count, 3), BIAS),
        np.full((count, 3), 0.5),
        odometry,
        np.tile(ODOMETRY, (count, 1)),
        np.ones(count),
    )
    _ = motion.fixed
    return motion


def solve_ours(d: Drive, motion: Motion, done: float = DONE) -> Array:
    """Gauss-Newton on the banded normal equations; (T, 3) poses."""
    pose, bias, with_map = d.gnss.copy(), np.zeros_like(d.gnss), bool(d.information.any())
    for _ in range(ROUNDS):
        terms = motion_terms(motion, pose, bias)
        if with_map:
            off = pose - d.seen
            off[:, 2] = wrap_angle(off[:, 2])
            terms.add(d.information, (d.information @ off[..., None])[..., 0])
        step = terms.solve()
        pose, bias = pose + step[:, :3], bias + step[:, 3:]
        # What the step was to gain, of a cost of at least one per pose.
        if -0.5 * np.vdot(terms.gradient, step) < done * len(pose):
            break
    return pose


def build_theirs(d: Drive, exact: bool) -> tuple[Any, Any, Any]:
    """Graph, start and order of gtsam."""
    import gtsam

    graph, start, order = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Ordering()
    of_gnss = gtsam.noiseModel.Diagonal.Sigmas(GNSS)
    of_xy, of_yaw = (gtsam.noiseModel.Diagonal.Sigmas(s) for s in (GNSS[:2], GNSS[2:]))
    of_step = gtsam.noiseModel.Diagonal.Sigmas(ODOMETRY)
    of_map_yaw = gtsam.noiseModel.Diagonal.Sigmas(MAP[2:])
    with_map = d.information.any()
    for t, pose in enumerate(d.gnss):
        here = gtsam.Pose2(*pose)
        start.insert(t, here)
        order.push_back(t)
        if exact:
            graph.add(gtsam.PoseTranslationPrior2D(t, here, of_xy))
            graph.add(gtsam.PoseRotationPrior2D(t, here, of_yaw))
        else:
            graph.add(gtsam.PriorFactorPose2(t, here, of_gnss))
        if with_map:
            there = gtsam.Pose2(*d.seen[t])
            of_map = gtsam.noiseModel.Gaussian.Information(d.information[t, :2, :2])
            graph.add(gtsam.PoseTranslationPrior2D(t, there, of_map))
            graph.add(gtsam.PoseRotationPrior2D(t, there, of_map_yaw))
        if t:
            step = gtsam.Pose2(*d.odometry[t])
            graph.add(gtsam.BetweenFactorPose2(t - 1, t, step, of_step))
    return graph, start, order


def solve_theirs(
    built: tuple[Any, Any, Any], method: str, solver: str, done: float = DONE
) -> Array:
    """gtsam's own optimizers; (T, 3) poses."""
    import gtsam

    graph, start, order = built
    parameters = getattr(gtsam, f"{method}Params")()
    parameters.setMaxIterations(ROUNDS)
    parameters.setRelativeErrorTol(done)
    parameters.setAbsoluteErrorTol(done)
    parameters.setLinearSolverType(f"{solver}_CHOLESKY")
    parameters.setOrdering(order)
    solved = getattr(gtsam, f"{method}Optimizer")(graph, start, parameters).optimize()
    return np.asarray(gtsam.utilities.extractPose2(solved), np.float64)


def cost(pose: Array, d: Drive) -> float:
    """What both minimise."""
    off, seen = pose - d.gnss, pose - d.seen
    off[:, 2], seen[:, 2] = wrap_angle(off[:, 2]), wrap_angle(seen[:, 2])
    step, _ = step_error(pose[:-1], pose[1:], d.odometry[1:])
    of_map = np.einsum("ti,tij,tj", seen, d.information, seen)
    return 0.5 * float(((off / GNSS) ** 2).sum() + ((step / ODOMETRY) ** 2).sum() + of_map)


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds of a call, the mean of as many as fit into a turn, and its answer."""
    start, times, answer = time.process_time(), 0, None
    while times == 0 or time.process_time() - start < TURN:
        answer = work()
        times += 1
    return (time.process_time() - start) / times, answer


def side_by_side(count: int, with_map: bool, turns: int) -> dict[str, Any]:
    """Both sides in turns on drives of ``count`` poses."""
    seconds: dict[str, list[float]] = {}
    apart, above = [0.0, 0.0], -np.inf
    for seed in range(turns):
        d = drive(count, seed, with_map)
        spent = {}
        spent["rtmap build"], motion = timed(partial(build_ours, d))
        spent["rtmap solve"], own = timed(partial(solve_ours, d, motion))
        for name in ("one factor", "two factors"):
            exact = name == "two factors"
            spent[f"gtsam build, {name}"], built = timed(partial(build_theirs, d, exact))
            for method, solver in product(METHODS, SOLVERS):
                key = f"gtsam {method}, {solver.lower()}, {name}"
                spent[key], other = timed(partial(solve_theirs, built, method, solver))
                above = max(above, cost(own, d) / cost(other, d) - 1.0)
        # Of the two factors, which have our cost: as they ended, and run on.
        to_the_end = solve_theirs(built, METHODS[0], SOLVERS[0], 1e-15)
        pairs = ((own, other), (solve_ours(d, motion, 1e-15), to_the_end))
        apart = [max(a, difference(*pair)) for a, pair in zip(apart, pairs, strict=True)]
        for key, value in spent.items():
            seconds.setdefault(key, []).append(value)
    return summary(count, with_map, seconds) | {
        "our cost above theirs, at most": above,
        "largest difference": apart[0],
        "largest difference, both run on": apart[1],
    }


def difference(a: Array, b: Array) -> float:
    """The largest of (T, 3) poses in any of m, m, rad."""
    off = a - b
    off[:, 2] = wrap_angle(off[:, 2])
    return float(np.abs(off).max())


def summary(count: int, with_map: bool, seconds: dict[str, list[float]]) -> dict[str, Any]:
    """Medians, the fastest of gtsam's ways, and how many times as long it takes."""
    medians = {key: float(np.median(values)) for key, values in seconds.items()}
    ways = [key for key in medians if key.startswith("gtsam") and "build" not in key]
    best = min(ways, key=medians.__getitem__)
    build = medians[f"gtsam build, {best.rpartition(', ')[2]}"]
    ours, theirs = medians["rtmap solve"], medians[best]
    return {
        "poses": count,
        "factors": "GNSS, odometry, map" if with_map else "GNSS, odometry",
        "milliseconds": {key: round(1e3 * value, 2) for key, value in medians.items()},
        "fastest": best,
        "ratio": round(theirs / ours, 2),
        "ratio with build": round((theirs + build) / (ours + medians["rtmap build"]), 2),
    }


def growth(counts: list[int]) -> dict[str, Any]:
    """Time and peak memory of ours, and the power of the count with which they grow."""
    seconds, megabytes = [], []
    for count in counts:
        d = drive(count, 0, True)
        seconds.append(float(np.median([timed(partial(whole, d))[0] for _ in range(3)])))
        tracemalloc.start()
        whole(d)
        megabytes.append(tracemalloc.get_traced_memory()[1] / 1e6)
        tracemalloc.stop()
    powers = [np.polyfit(np.log(counts), np.log(v), 1)[0] for v in (seconds, megabytes)]
    return {
        "poses": counts,
        "seconds": [float(f"{s:.3g}") for s in seconds],
        "peak megabytes": [float(f"{m:.3g}") for m in megabytes],
        "exponent of time": round(float(powers[0]), 3),
        "exponent of memory": round(float(powers[1]), 3),
    }


def whole(d: Drive) -> Array:
    """Build and solve."""
    return solve_ours(d, build_ours(d))


def main() -> None:
    """Print one JSON object per line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--counts", type=int, nargs="+", default=[1000, 10_000, 100_000])
    a = parser.parse_args()
    try:
        for with_map in (False, True):
            print(json.dumps(side_by_side(a.poses, with_map, a.turns)), flush=True)
    except ImportError:
        print(json.dumps({"gtsam": "not installed: pip install gtsam"}))
    print(json.dumps(growth(a.counts)), flush=True)


if __name__ == "__main__":
    main()
