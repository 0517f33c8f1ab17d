"""Registration speed beside kiss-icp: the same sweeps, one thread each, medians and errors.

    python benchmarks/label_cloud_speed.py [--log LOG] [--sweeps 30] [--points 30000]

Without ``--log`` a town is simulated and driven (VLP-16-like and 64-beam-like). Odometry alone is
measured: taking the turn's motion out, thinning, matching, the local map. Neither side is given
wheel odometry. Times are CPU milliseconds a sweep (process_time); the error is that of the motion
over ten sweeps, against the truth.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.cli import run
from rtmap_cli.geometry import lie
from rtmap_cli.geometry.poses import invert
from rtmap_cli.logs.native import NativeLog
from rtmap_cli.output import table
from rtmap_cli.steps.label.cloud.build import sweep_of
from rtmap_cli.steps.label.cloud.odometry import Odometry
from rtmap_cli.steps.label.cloud.points import Sweep, cleaned

Array = NDArray[np.float64]

SPAN = 10
"""Sweeps over which a motion is compared."""


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
    from kiss_icp.config import KISSConfig
    from kiss_icp.config.parser import load_config
    from kiss_icp.kiss_icp import KissICP

    config: Any = KISSConfig() if load_config is None else load_config(None)
    config.registration.max_num_threads = 1
    if config.mapping.voxel_size is None:
        config.mapping.voxel_size = config.data.max_range / 100.0
    odometry = KissICP(config)
    poses, spent = [], []
    for sweep in sweeps:
        stamp = np.zeros(len(sweep)) if sweep.time is None else sweep.time - sweep.time.min()
        start = time.process_time()
        # It takes stamps in [0, 1] of a turn, and moves points to its end.
        odometry.register_frame(sweep.xyz, stamp / max(float(stamp.max()), 1e-9))
        spent.append(1e3 * (time.process_time() - start))
        poses.append(odometry.last_pose.copy())
    return np.stack(poses), np.array(spent)


def error_of(poses: Array, truth: Array) -> tuple[float, float, float]:
    """Mean error of the motion over `SPAN` sweeps: metres, degrees, and per cent of the way."""
    a, b = truth[:-SPAN], truth[SPAN:]
    e = lie.log(invert(invert(a) @ b) @ (invert(poses[:-SPAN]) @ poses[SPAN:]))
    way = np.linalg.norm(b[:, :3, 3] - a[:, :3, 3], axis=1)
    away = np.linalg.norm(e[:, 3:], axis=1)
    turned = np.degrees(np.linalg.norm(e[:, :3], axis=1))
    return float(away.mean()), float(turned.mean()), float(100 * away.sum() / way.sum())


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
    results |= {m: ours(m, sweeps, times) for m in ("vgicp", "gicp", "ndt")}
    base = float(np.median(results["kiss-icp"][1]))
    rows_out = []
    for method, (found_poses, spent) in results.items():
        away, turned, share = error_of(found_poses, truth)
        median = float(np.median(spent))
        rows_out.append(
            [name, size, method, f"{median:.1f}", f"{np.percentile(spent, 90):.1f}",
             f"{1e3 / median:.0f}", f"{base / median:.2f}", f"{away:.3f}", f"{turned:.3f}",
             f"{share:.2f}"]
        )  # fmt: skip
    return rows_out


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--log", type=Path, action="append")
    parser.add_argument("--sweeps", type=int, default=30)
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
        "% of way",
    ]
    print("\n".join(table(head, rows)))
    print(f"errors over {SPAN} sweeps; one thread; sweeps simulated unless --log is given")


def simulated(folder: Path, sweeps: int) -> list[Path]:
    """Two drives through a town."""
    town = folder / "town"
    if run(["simulate", "town", "--seed", "5", "--size", "320", "-o", str(town)]):
        sys.exit(3)
    out = []
    for lidar in ("vlp16", "os64"):
        words = ["simulate", "lidar", "--map", str(town), "--log", "town:", "--lidar", lidar, "-q"]
        words += [
            "--spacing",
            "0.8",
            "--length",
            str(max(0.8 * sweeps, 25)),
            "-o",
            str(folder / lidar),
        ]
        if run(words):
            sys.exit(3)
        out.append(folder / lidar)
    return out


if __name__ == "__main__":
    main()
