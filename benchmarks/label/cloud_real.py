"""Registration of real sweeps against the poses that come with them.

    RTMAP_DATA=DIR python -m benchmarks.label.cloud_real [--method vgicp gicp ndt]

KITTI 07: five sweeps up to 12 m apart, no motion given, against their graph. Argoverse 2: two
sweeps 0.1 s apart in their own ego frames, against the log's poses. Newer College: turns of a
hand-held sensor de-skewed here, with the motion that registers each on another turn, against those
that their makers de-skewed. The small_gicp pair: against the transform beside it (known to 0.5°).

KITTI's figures are: pair_*, the worst motion from a sweep to the next, without any alignment;
first_*, the last pose when the first one is laid on the truth; aligned_m, the worst place when all
five are laid on the truth (Umeyama, rigid).
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.formats.clouds import read_cloud
from rtmap_cli.geometry import lie
from rtmap_cli.geometry.poses import invert, transform
from rtmap_cli.logs.open import open_log
from rtmap_cli.output import table
from rtmap_cli.steps.label.cloud.build import sweep_of
from rtmap_cli.steps.label.cloud.match import best_start, make_matcher
from rtmap_cli.steps.label.cloud.odometry import Odometry
from rtmap_cli.steps.label.cloud.place import starts
from rtmap_cli.steps.label.cloud.points import Sweep, cleaned, deskewed

Array = NDArray[np.float64]


def difference(pose: Array, truth: Array) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    e = lie.log(invert(truth) @ pose)
    return float(np.linalg.norm(e[3:])), float(np.degrees(np.linalg.norm(e[:3])))


def registered(spec: str, method: str, spacing_s: float | None = None) -> tuple[Array, Array, Any]:
    """Poses (n, 4, 4) of a log's sweeps by the odometry alone, the log's own, and the log."""
    log: Any = open_log(spec)
    odometry = Odometry(method)
    frames = [f for f in log.frames() if f.lidar is not None]
    poses = []
    for k, frame in enumerate(frames):
        sweep = sweep_of(log, frame)
        assert sweep is not None
        at = k * spacing_s if spacing_s else frame.timestamp_ns / 1e9
        poses.append(odometry.add(cleaned(sweep), at).pose)
    return np.stack(poses), np.stack([f.map_SE3_ego for f in frames]), log


def aligned(pose: Array, truth: Array) -> Array:
    """(n,) metres between places after the best rigid motion (Umeyama 1991)."""
    a, b = pose[:, :3, 3], truth[:, :3, 3]
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    r = u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt
    return np.asarray(np.linalg.norm((a - a.mean(0)) @ r.T - (b - b.mean(0)), axis=1))


def kitti(data: Path, method: str) -> dict[str, float]:
    """Five sweeps: the worst motion between neighbours, and places after alignment."""
    folder = data / "lidar_registration" / "gtsam_points" / "kitti_07_dump"
    pose, truth, _ = registered(f"sweeps:{folder}", method)
    steps = [
        difference(invert(pose[k]) @ pose[k + 1], invert(truth[k]) @ truth[k + 1])
        for k in range(len(pose) - 1)
    ]
    last = difference(invert(pose[0]) @ pose[-1], invert(truth[0]) @ truth[-1])
    return {
        "pair_m": max(s[0] for s in steps), "pair_deg": max(s[1] for s in steps),
        "first_m": last[0], "first_deg": last[1], "aligned_m": float(aligned(pose, truth).max()),
    }  # fmt: skip


def av2(data: Path, method: str) -> dict[str, float]:
    """Two sweeps 0.1 s apart: frames of the log are elsewhere, so each is moved back to its own."""
    from rtmap_cli.formats.av2.log import Av2Log

    folder = next((data / "av2_sensor").glob("7fab2350-*"))
    log = Av2Log(folder)
    times = sorted(log.sweeps)[:2]
    odometry = Odometry(method)
    found = []
    for at in times:
        raw = log.sweep(at)
        sweep = cleaned(Sweep(np.asarray(raw.xyz, np.float64), raw.intensity / 255.0))
        found.append(odometry.add(sweep, at / 1e9).pose)
    truth = log.pose_at(np.array(times))
    m, deg = difference(invert(found[0]) @ found[1], invert(truth[0]) @ truth[1])
    return {"m": m, "deg": deg}


def newer(data: Path, method: str) -> dict[str, float]:
    """Three turns of a hand-held sensor; nothing says how it moved, or how much time lies between
    them. Mean distance (m) to the makers' de-skewed points after the best rigid motion of a turn:
    ``m`` with the motion that registers the raw turn on another turn's cloud (the makers' result
    for the turn itself is not looked at), ``fitted_m`` with the constant twist that explains every
    fortieth of the makers' points best, which is what a constant twist can reach, ``raw_m`` as
    the points were."""
    from scipy.optimize import least_squares

    folder = data / "lidar_registration" / "gtsam_points" / "newer_06"
    log: Any = open_log(f"sweeps:{folder}#raw_*.bin")
    sweeps, clouds = [], []
    for frame in log.frames():
        sweep = sweep_of(log, frame)
        assert sweep is not None
        made = read_cloud(folder / frame.lidar.name.replace("raw", "deskewed"))
        sweeps.append(sweep)
        clouds.append(np.stack([made["x"], made["y"], made["z"]], axis=-1))
    off: dict[str, list[float]] = {"m": [], "fitted_m": [], "raw_m": []}
    for k, (sweep, theirs) in enumerate(zip(sweeps, clouds, strict=True)):
        some = np.arange(len(sweep)) % 40 == 0
        part = sweep.kept(some)
        target = theirs[some]

        def away(twist: Array, part: Sweep = part, target: Array = target) -> Array:
            return (_fitted(deskewed(part, twist), target)[0] - target).ravel()

        fitted = least_squares(away, np.zeros(6), loss="soft_l1", f_scale=0.05).x
        _, r, t = _fitted(deskewed(part, fitted), target)
        rest = deskewed(sweep, fitted)[~some] @ r.T + t
        off["fitted_m"].append(np.linalg.norm(rest - theirs[~some], axis=1).mean())
        found = turning(clouds[0 if k else 2], sweep)
        off["m"].append(_apart(deskewed(sweep, found), theirs))
        off["raw_m"].append(_apart(sweep.xyz, theirs))
    return {name: float(np.mean(values)) for name, values in off.items()}


GATES = (3.0, 3.0, 3.0, 2.0, 2.0, 2.0, 1.5, 1.5, 1.0, 1.0, 0.7, 0.7, 0.5, 0.5, 0.4, 0.4, 0.3, 0.3)
"""How far partners may be (m), round by round."""


def turning(cloud: Array, sweep: Sweep) -> Array:
    """The constant twist (6,) of a raw turn that, with a pose, lays its points on the planes of
    another turn's cloud (n, 3); the start is looked for under all yaws."""
    from scipy.optimize import least_squares
    from scipy.spatial import cKDTree

    matcher = make_matcher("vgicp", 0.5)
    matcher.insert(matcher.prepare(cloud), np.eye(4))
    found = starts(cloud, sweep.xyz, 25.0, np.radians(np.arange(-180.0, 180.0, 6.0)), 8)
    match = best_start(matcher, matcher.prepare(sweep.xyz), [start for _, start in found])
    tree = cKDTree(cloud)
    near = cloud[tree.query(cloud, 12)[1]]
    near = near - near.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
    normal, flat = axes[:, :, 0], spread[:, 0] < 0.05 * spread[:, 1]
    part = sweep.kept(np.random.default_rng(0).random(len(sweep)) < 4000 / len(sweep))
    pose, twist = match.pose, np.zeros(6)
    for gate in GATES:
        far, at = tree.query(transform(pose, deskewed(part, twist)))
        rows = (far < gate) & flat[at]
        points, on, up = part.kept(rows), cloud[at[rows]], normal[at[rows]]

        def over(
            v: Array, p: Array = pose, t: Array = twist, points: Sweep = points,
            on: Array = on, up: Array = up,
        ) -> Array:  # fmt: skip
            laid = transform(p @ lie.exp(v[:6]), deskewed(points, t + v[6:]))
            return np.asarray(((laid - on) * up).sum(axis=1))

        scale = max(gate / 10, 0.05)
        step = least_squares(over, np.zeros(12), loss="soft_l1", f_scale=scale, max_nfev=5).x
        pose, twist = pose @ lie.exp(step[:6]), twist + step[6:]
    return twist


def _apart(a: Array, b: Array) -> float:
    """Mean distance (m) between points after the best rigid motion."""
    return float(np.linalg.norm(_fitted(a, b)[0] - b, axis=1).mean())


def _fitted(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Points moved onto others by the best rigid motion, and its rotation and translation: the
    makers' frame is that of another sensor, at another moment of the turn."""
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    r = u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt
    t = b.mean(0) - r @ a.mean(0)
    return a @ r.T + t, r, t


def pair(data: Path, method: str) -> dict[str, float]:
    """Source against target of small_gicp's test pair."""
    folder = data / "lidar_registration" / "small_gicp_pair"
    truth = np.loadtxt(folder / "T_target_source.txt")
    clouds = {}
    for name in ("target", "source"):
        c = read_cloud(folder / f"{name}.ply")
        xyz = np.stack([c["x"], c["y"], c["z"]], axis=-1)
        clouds[name] = cleaned(Sweep(xyz, np.zeros(len(xyz))))
    odometry = Odometry(method)
    odometry.add(clouds["target"], 0.0)
    step = odometry.add(clouds["source"], 0.1)
    m, deg = difference(step.pose, truth)
    met = transform(step.pose, clouds["source"].xyz[:10])
    assert np.isfinite(met).all()
    return {"m": m, "deg": deg}


ROWS = {"KITTI 07": kitti, "Argoverse 2 pair": av2, "Newer College": newer, "small_gicp pair": pair}


def main() -> None:
    """Print one line a data set and method."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--method", nargs="+", default=["vgicp", "gicp", "ndt"])
    given = parser.parse_args()
    if "RTMAP_DATA" not in os.environ:
        raise SystemExit("sample data folder not found, set RTMAP_DATA")
    data = Path(os.environ["RTMAP_DATA"])
    rows = []
    for name, measure in ROWS.items():
        for method in given.method if name != "Newer College" else ["-"]:
            found = measure(data, method)
            rows.append([name, method, ", ".join(f"{k} {v:.3f}" for k, v in found.items())])
    print("\n".join(table(["data", "method", "figures"], rows)))


if __name__ == "__main__":
    main()
