"""Registration speed beside kiss-icp: the same sweeps, one thread each, CPU times and errors.

    python -m benchmarks.label.cloud_speed [--log LOG] [--sweeps 250] [--points 30000]

Without ``--log`` a town is simulated and driven at 10 sweeps a second (VLP-16-like and 64-beam-
like, 8 m/s). Odometry alone is measured: taking the turn's motion out, thinning, matching, the
local map. Neither side is given wheel odometry or GNSS. Times are CPU milliseconds a sweep
(process_time). Errors: of the motion over ten sweeps, and KITTI's (per cent of the way over
stretches of 100 m and more), both from the 20th sweep on: kiss-icp expects to start at rest, and
the drive starts at speed. With RTMAP_DATA the Argoverse 2 pair is registered by all as well.

kiss-icp is used as its makers do: ``load_config(None)`` (100 m, voxels of 1 m), stamps of the
points, which it scales to [0, 1] of a turn, and poses at the turn's end, which is the time of our
frames. It takes a turn to last as long as the step between sweeps, hence 10 sweeps a second. It
needs kiss-icp installed (PyPI; 1.3 was measured).
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.cli import run
from rtmap_cli.geometry import lie
from rtmap_cli.geometry.polylines import arc_length
from rtmap_cli.geometry.poses import invert
from rtmap_cli.logs.native import NativeLog
from rtmap_cli.output import table
from rtmap_cli.steps.label.cloud.build import sweep_of
from rtmap_cli.steps.label.cloud.match import METHODS
from rtmap_cli.steps.label.cloud.odometry import Odometry
from rtmap_cli.steps.label.cloud.points import Sweep, cleaned

Array = NDArray[np.float64]

SPAN, WARM = 10, 20
"""Sweeps over which a motion is compared, and sweeps before the first that counts."""
STRETCHES, EVERY = (100.0, 150.0, 200.0), 5
"""Lengths (m) of KITTI's stretches that short drives hold; sweeps between their starts."""


def ours(method: str, sweeps: list[Sweep], times: list[float]) -> tuple[Array, Array]:
    """Poses (n, 4, 4) and CPU ms (n,) of rtmap's odometry."""
    odometry = Odometry(method)
    poses, spent = [], []
    for sweep, at in zip(sweeps, times, strict=True):
        start = time.process_time()
        poses.append(odometry.add(sweep, at).pose)
        spent.append(1e3 * (time.process_time() - start))
    return np.stack(poses), np.array(spent)


def kiss(sweeps: list[Sweep], times: list[float]) -> tuple[Array, Array]:
    """The same of kiss-icp with its default configuration on one thread."""
    from kiss_icp.config.parser import load_config
    from kiss_icp.kiss_icp import KissICP

    config: Any = load_config(None)
    config.registration.max_num_threads = 1
    config.data.deskew = sweeps[0].time is not None
    odometry = KissICP(config)
    poses, spent = [], []
    for sweep in sweeps:
        stamp = np.zeros(len(sweep)) if sweep.time is None else sweep.time - sweep.time.min()
        start = time.process_time()
        odometry.register_frame(sweep.xyz, stamp)
        spent.append(1e3 * (time.process_time() - start))
        poses.append(odometry.last_pose.copy())
    return np.stack(poses), np.array(spent)


def error_of(poses: Array, truth: Array) -> tuple[float, float]:
    """Mean error of the motion over `SPAN` sweeps: metres, degrees."""
    found, true = poses[WARM:], truth[WARM:]
    e = lie.log(invert(invert(true[:-SPAN]) @ true[SPAN:]) @ (invert(found[:-SPAN]) @ found[SPAN:]))
    away = np.linalg.norm(e[:, 3:], axis=1)
    return float(away.mean()), float(np.degrees(np.linalg.norm(e[:, :3], axis=1)).mean())


def kitti_error(poses: Array, truth: Array) -> float:
    """Per cent of the way that stretches of `STRETCHES` end off (Geiger et al., CVPR 2012); NaN
    for a shorter drive."""
    found, true = poses[WARM:], truth[WARM:]
    s = arc_length(true[:, :3, 3])
    shares = []
    for length in STRETCHES:
        for k in range(0, len(true), EVERY):
            stop = int(np.searchsorted(s, s[k] + length))
            if stop == len(s):
                break
            e = invert(invert(true[k]) @ true[stop]) @ (invert(found[k]) @ found[stop])
            shares.append(100 * float(np.linalg.norm(e[:3, 3])) / length)
    return float(np.mean(shares)) if shares else float("nan")


def measured(name: str, log: NativeLog, count: int, points: int) -> list[list[str]]:
    """Rows of the table for one log."""
    frames = list(log.frames())[:count]
    found = [sweep_of(log, f) for f in frames]
    sweeps = [cleaned(s) for s in found if s is not None]
    rng = np.random.default_rng(0)
    for k, s in enumerate(sweeps):
        if len(s) > points:
            rows = np.zeros(len(s), bool)
            rows[rng.permutation(len(s))[:points]] = True
            sweeps[k] = s.kept(rows)
    times = [f.timestamp_ns / 1e9 for f in frames]
    poses = log.truth_poses()
    if poses is None:
        raise SystemExit(f"{log.path}: has no truth/poses.parquet")
    truth = poses.pose[: len(sweeps)]
    size = f"{np.mean([len(s) for s in sweeps]):,.0f}"
    results = {"kiss-icp": kiss(sweeps, times)}
    results |= {m: ours(m, sweeps, times) for m in METHODS}
    base = float(results["kiss-icp"][1].mean())
    rows_out = []
    for method, (found_poses, spent) in results.items():
        away, turned = error_of(found_poses, truth)
        mean = float(spent.mean())
        rows_out.append(
            [name, size, method, f"{mean:.1f}", f"{np.percentile(spent, 90):.1f}",
             f"{1e3 / mean:.0f}", f"{base / mean:.2f}", f"{away:.3f}", f"{turned:.3f}",
             f"{kitti_error(found_poses, truth):.2f}"]
        )  # fmt: skip
    return rows_out


def argoverse(data: Path) -> list[str]:
    """Lines on the Argoverse 2 pair: two real sweeps, motion within the turn taken out by their
    makers; metres and degrees off the log's poses."""
    from rtmap_cli.formats.av2.log import Av2Log

    log = Av2Log(next((data / "av2_sensor").glob("7fab2350-*")))
    times = sorted(log.sweeps)[:2]
    sweeps = []
    for at in times:
        raw = log.sweep(at)
        sweeps.append(cleaned(Sweep(np.asarray(raw.xyz, np.float64), raw.intensity / 255.0)))
    truth = log.pose_at(np.array(times))
    step = invert(truth[0]) @ truth[1]
    seconds = [t / 1e9 for t in times]
    found = {"kiss-icp": kiss(sweeps, seconds)[0]}
    found |= {m: ours(m, sweeps, seconds)[0] for m in METHODS}
    out = []
    for method, pose in found.items():
        e = lie.log(invert(step) @ invert(pose[0]) @ pose[1])
        m, deg = np.linalg.norm(e[3:]), np.degrees(np.linalg.norm(e[:3]))
        out.append(f"Argoverse 2 pair, {method}: {m:.3f} m, {deg:.3f}°")
    return out


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--log", type=Path, action="append")
    parser.add_argument("--sweeps", type=int, default=250)
    parser.add_argument("--points", type=int, default=30_000)
    given = parser.parse_args()
    rows: list[list[str]] = []
    with tempfile.TemporaryDirectory() as name:
        logs = given.log or simulated(Path(name), given.sweeps)
        for path in logs:
            rows += measured(path.name, NativeLog(path), given.sweeps, given.points)
    head = [
        "log",
        "points",
        "method",
        "CPU ms",
        "90 %",
        "Hz",
        "times kiss-icp",
        "m",
        "°",
        "% KITTI",
    ]
    print("\n".join(table(head, rows)))
    print(f"m and ° over {SPAN} sweeps; one thread; sweeps simulated unless --log is given")
    if "RTMAP_DATA" in os.environ:
        print("\n".join(argoverse(Path(os.environ["RTMAP_DATA"]))))


def simulated(folder: Path, sweeps: int) -> list[Path]:
    """A drive of two LiDARs through a town."""
    town = folder / "town"
    if run(["simulate", "town", "--seed", "5", "--size", "320", "-o", str(town)]):
        sys.exit(3)
    out = []
    for lidar in ("vlp16", "os64"):
        words = ["simulate", "lidar", "--map", str(town), "--log", "town:", "--lidar", lidar, "-q"]
        words += ["--route", "tour", "--spacing", "0.8", "--length", str(max(0.8 * sweeps, 25))]
        if run([*words, "-o", str(folder / lidar)]):
            sys.exit(3)
        out.append(folder / lidar)
    return out


if __name__ == "__main__":
    main()
