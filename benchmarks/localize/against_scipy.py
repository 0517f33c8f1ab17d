"""How fast is one frame solved, beside SciPy's least_squares on the same residuals?

    python -m benchmarks.localize.against_scipy                 three simulated drives

Every frame keeps the lines and weights of its answer by `rtmap localize`; both sides begin at the
initial poses and find where the whitened residuals of vertices (one offset common to an element)
and of the initial pose are least. SciPy solves frame by frame with the analytic Jacobian, by each
of its methods; the fastest counts, and its whitening is made beforehand, off the clock. "vertices"
evaluates the residuals from the vertices, as one writes it; "folded" is told that they are linear
in cos, sin, x and y, and gets these rows whitened, which leaves it little more than its own steps.
Ours begins from the vertices. CPU seconds of one core per frame, medians over turns.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.common.places import Place, town_places
from rtmap_cli.geometry.poses import wrap_angle
from rtmap_cli.steps.localize.frame.held import solve_held
from rtmap_cli.steps.localize.frame.single import solve_single
from rtmap_cli.steps.localize.model import ErrorModel, Settings
from rtmap_cli.steps.localize.seeing.frames import Detections, read_detections
from rtmap_cli.steps.localize.seeing.lines import MapLines
from rtmap_cli.steps.localize.seeing.residuals import Linear, Noise, judge, linearize, noise_of
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey

Array = NDArray[np.float64]
Residuals = Callable[[Array], Array]
Functions = Callable[["Frame"], tuple[Residuals, Residuals]]

METHODS = ("lm", "trf", "dogbox")
TOLERANCE = 1e-8
TURN = 0.1
"""CPU seconds a turn lasts at least."""


@dataclass(frozen=True)
class Problem:
    """Frames of a drive with the lines and weights of their answers ``at`` (T, 3)."""

    seen: Detections
    linear: Linear
    noise: Noise
    at: Array


def problem(place: Place, kind: str, seed: int) -> Problem:
    """One simulated drive, localized."""
    model, settings, key = ErrorModel(), Settings(), DriveKey(0, seed, 0)
    run = place.observe(place.drive(kind, key, 2.5, 2.0), kind, key)
    origin = np.round(run.frames.initial[:, :2, 3].mean(axis=0))
    lines = MapLines(place.world, list(run.info["classes"]), origin, settings.heading_weight_m)
    seen = read_detections(run, lines, settings, False)
    at = solve_single(lines, seen, model, settings).pose
    linear = linearize(lines, seen, at, settings.gates_m[-1])
    noise = noise_of(lines, seen, linear, model, model.offset_share)
    judgement = judge(seen, linear, noise, linear.r, model, settings.huber)
    return Problem(seen, linear, replace(noise, weight=judgement.weight(noise)), at)


@dataclass(frozen=True)
class Frame:
    """What SciPy gets of one frame: vertices (E, V, 2), ``normal`` (E, V, 2) of their lines and
    ``offset`` (E, V) of these from the origin, ``root`` (E, V, V) with rootᵀ root the information,
    the same as rows of [cos, sin, x, y, 1]; the initial pose and 1 / sigma of it (3,)."""

    points: Array
    normal: Array
    offset: Array
    root: Array
    rows: Array
    start: Array
    scale: Array


def frames_of(p: Problem) -> list[Frame]:
    """Every frame of a drive for itself, whitened by Cholesky of its elements' covariances."""
    out = []
    for t in range(len(p.seen)):
        e = slice(*np.searchsorted(p.seen.frame, (t, t + 1)))
        points, normal = p.seen.points[e], p.linear.jacobian[e, :, :2]
        offset = (normal * (_turned(points, p.at[t, 2]) + p.at[t, :2])).sum(-1) - p.linear.r[e]
        root = np.zeros((*offset.shape, offset.shape[1]))
        for k, (w, u) in enumerate(zip(p.noise.weight[e], p.noise.shared[e], strict=True)):
            used = np.flatnonzero(w > 0)
            covariance = np.diag(1.0 / w[used]) + u[used] @ u[used].T
            root[k][np.ix_(used, used)] = np.linalg.inv(np.linalg.cholesky(covariance))
        across = normal[..., 1] * points[..., 0] - normal[..., 0] * points[..., 1]
        plain = np.stack([(normal * points).sum(-1), across, *np.moveaxis(normal, -1, 0), -offset])
        rows = (root @ np.moveaxis(plain, 0, -1)).reshape(-1, 5)
        rows = rows[rows.any(1)]
        start, scale = p.seen.pose[t], 1.0 / p.seen.sigma[t]
        out.append(Frame(points, normal, offset, root, rows, start, scale))
    return out


def _turned(points: Array, yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return points @ np.array([[c, s], [-s, c]])


def _prior(f: Frame, x: Array) -> Array:
    d = x - f.start
    d[2] = wrap_angle(d[2])
    return d * f.scale


def from_vertices(f: Frame) -> tuple[Residuals, Residuals]:
    """Residuals and Jacobian of a frame, evaluated from its vertices."""
    count, prior = f.offset.size, np.diag(f.scale)
    jacobian_of = np.empty((*f.offset.shape, 3))
    jacobian_of[..., :2] = f.normal

    def residuals(x: Array) -> Array:
        at = _turned(f.points, x[2]) + x[:2]
        r = np.einsum("evi,evi->ev", f.normal, at) - f.offset
        return np.concatenate([(f.root @ r[..., None]).ravel(), _prior(f, x)])

    def jacobian(x: Array) -> Array:
        turned = _turned(f.points, x[2])
        across = f.normal[..., 1] * turned[..., 0] - f.normal[..., 0] * turned[..., 1]
        jacobian_of[..., 2] = across
        return np.concatenate([(f.root @ jacobian_of).reshape(count, 3), prior])

    return residuals, jacobian


def from_rows(f: Frame) -> tuple[Residuals, Residuals]:
    """The same from whitened rows of [cos, sin, x, y, 1]."""
    count = len(f.rows)
    shift, turn = np.ascontiguousarray(f.rows[:, 2:4]), np.ascontiguousarray(f.rows[:, :2])
    prior = np.diag(f.scale)

    def residuals(x: Array) -> Array:
        r = np.empty(count + 3)
        r[:count] = f.rows @ np.array([np.cos(x[2]), np.sin(x[2]), x[0], x[1], 1.0])
        r[count:] = _prior(f, x)
        return r

    def jacobian(x: Array) -> Array:
        j = np.empty((count + 3, 3))
        j[:count, :2] = shift
        j[:count, 2] = turn @ np.array([-np.sin(x[2]), np.cos(x[2])])
        j[count:] = prior
        return j

    return residuals, jacobian


def scipy_drive(drives: list[list[Frame]], functions: Functions, method: str, k: int) -> Array:
    """(T, 3) poses of the k-th drive, frame by frame."""
    out = []
    for f in drives[k]:
        residuals, jacobian = functions(f)
        tolerances = {"xtol": TOLERANCE, "ftol": TOLERANCE, "gtol": TOLERANCE}
        solved = least_squares(residuals, f.start, jacobian, method=method, **tolerances)
        out.append(solved.x)
    return np.array(out)


def ours(p: Problem) -> Array:
    """(T, 3) poses of a drive, all frames at once."""
    return solve_held(p.seen, p.linear, p.at, p.noise)[0]


def turn(solver: Callable[[int], Array], drives: int) -> tuple[float, Array]:
    """CPU seconds that all drives take, as often as fits into `TURN`, and their poses."""
    start, times, answers = time.process_time(), 0, np.empty(0)
    while times == 0 or time.process_time() - start < TURN:
        answers = np.concatenate([solver(k) for k in range(drives)])
        times += 1
    return (time.process_time() - start) / times, answers


def main() -> None:
    """Print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--towns", type=int, nargs="+", default=[700, 701, 702])
    parser.add_argument("--kind", choices=["straight", "turning"], default="straight")
    parser.add_argument("--turns", type=int, default=7)
    a = parser.parse_args()
    problems = [problem(p, a.kind, 1) for p in town_places(a.towns)]
    frames = [frames_of(p) for p in problems]
    count = sum(map(len, frames))
    solvers: dict[str, Callable[[int], Array]] = {"rtmap": lambda k: ours(problems[k])}
    for name, functions in (("vertices", from_vertices), ("folded", from_rows)):
        for m in METHODS:
            solvers[f"{name} {m}"] = partial(scipy_drive, frames, functions, m)
    seconds: dict[str, list[float]] = {name: [] for name in solvers}
    answers: dict[str, Array] = {}
    for _ in range(a.turns):
        for name, solver in solvers.items():
            spent, answers[name] = turn(solver, len(problems))
            seconds[name].append(spent)
    medians = {name: float(np.median(s)) / count * 1e6 for name, s in seconds.items()}
    report = {
        "frames": count,
        "vertices per frame": round(sum(p.noise.weight.size for p in problems) / count),
        "microseconds per frame": {k: round(v, 1) for k, v in medians.items()},
    }
    for kind in ("vertices", "folded"):
        best = min((m for m in medians if m.startswith(kind)), key=medians.__getitem__)
        off = answers[best] - answers["rtmap"]
        off[:, 2] = wrap_angle(off[:, 2])
        report[f"scipy, {kind}"] = {
            "fastest": best.split()[1],
            "ratio": round(medians[best] / medians["rtmap"], 1),
            "largest difference": float(np.abs(off).max()),
        }
    print(json.dumps(report))


if __name__ == "__main__":
    main()
