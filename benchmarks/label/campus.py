"""A simulated campus drive, end to end: LiDAR log, cloud, trajectory error, heights of the map.

    python -m benchmarks.label.campus [--seed 4] [--gnss rtk] [--length 3100]

Simulates the town of a seed (roundabout, loops, multi-lane streets, intersections) and a drive of
``--length`` metres with a VLP-16-like LiDAR and GNSS that jumps three times; registers it without
GNSS (loops alone) and with it; lifts the town's own map, heights taken away, and compares. With
``--town`` and ``--log`` those are taken (made by the commands that are printed).
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.cli import run
from rtmap_cli.geometry.poses import invert
from rtmap_cli.logs.cloud import CloudFolder
from rtmap_cli.logs.native import NativeLog
from rtmap_cli.maps.store import read_map
from rtmap_cli.steps.label.lift.lift import lift

Array = NDArray[np.float64]


def called(*words: object) -> None:
    """Run one rtmap command and say so."""
    text = [str(w) for w in words]
    print("rtmap " + " ".join(text), flush=True)
    if code := run(text):
        raise SystemExit(code)


def aligned(pose: Array, truth: Array) -> Array:
    """(n,) metres between places after the best rigid motion (Umeyama 1991)."""
    a, b = pose[:, :3, 3], truth[:, :3, 3]
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    r = u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt
    return np.asarray(np.linalg.norm((a - a.mean(0)) @ r.T - (b - b.mean(0)), axis=1))


def trajectory_errors(cloud: Path, log: Path) -> str:
    """One line on the trajectory of a cloud folder against the truth of its log."""
    path = CloudFolder(cloud).trajectory()
    poses = NativeLog(log).truth_poses()
    if poses is None:
        raise SystemExit(f"{log}: has no truth")
    row = {int(f): k for k, f in enumerate(poses.frame)}
    truth = poses.pose[[row[int(f)] for f in path.frame]]
    length = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    off = aligned(path.pose, truth)
    place = np.linalg.norm(path.pose[:, :3, 3] - truth[:, :3, 3], axis=1)
    e = (invert(truth) @ path.pose)[:, :3, 3]
    turned = np.einsum("nji,njk->nik", truth[:, :3, :3], path.covariance[:, :3, :3])
    turned = turned @ truth[:, :3, :3]
    chi2 = np.einsum("ni,nij,nj->n", e, np.linalg.inv(turned + 1e-9 * np.eye(3)), e) / 3
    rmse = float(np.sqrt((off**2).mean()))
    return (
        f"{length:.0f} m: aligned {rmse:.3f} m rmse ({100 * rmse / length:.4f} % of the length), "
        f"{off.max():.3f} m at most; in the map {place.mean():.3f} m mean, {place.max():.3f} m at "
        f"most; squared error over stated variance {np.mean(chi2):.2f}"
    )


def height_errors(town: Path, cloud: Path) -> str:
    """One line on the heights of the town's vertices after lifting."""
    truth = read_map(town)
    started = time.process_time()
    _, lifted = lift([e.with_points(e.xy) for e in truth], CloudFolder(cloud))
    spent = time.process_time() - started
    off = np.abs(lifted.z - np.concatenate([e.points[:, 2] for e in truth]))
    known = np.isfinite(off)
    inside = float((off[known] < 1.645 * lifted.sigma[known]).mean())
    return (
        f"{int(known.sum()):,} of {len(off):,} vertices lifted in {spent:.1f} s CPU: error median "
        f"{np.median(off[known]):.3f} m, 90 % {np.percentile(off[known], 90):.3f} m, "
        f"95 % {np.percentile(off[known], 95):.3f} m; "
        f"{inside:.0%} within the stated 90 %"
    )


def main() -> None:
    """Print what was run and what came out."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--town", type=Path)
    parser.add_argument("--log", type=Path)
    parser.add_argument("--seed", type=int, default=4)
    parser.add_argument("--gnss", choices=["rtk", "metre"], default="rtk")
    parser.add_argument("--length", type=float, default=3100.0)
    parser.add_argument("--spacing", type=float, default=2.5)
    parser.add_argument("--size", type=float, default=700.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        town, log = given.town or folder / "town", given.log or folder / "log"
        if given.town is None:
            called("simulate", "town", "--seed", given.seed, "--size", given.size, "-o", town)
        if given.log is None:
            called("simulate", "lidar", "--map", town, "--log", "town:", "--route", "tour",
                   "--length", given.length, "--spacing", given.spacing, "--seed", 1,
                   "--gnss", given.gnss, "--gnss-jumps", 3, "-q", "-o", log)  # fmt: skip
        for title, more in (("loops alone", ["--no-gnss"]), ("with GNSS", [])):
            cloud = folder / ("cloud" + "".join(more))
            started = time.process_time()
            called("label", "cloud", log, *more, "-q", "-o", cloud)
            spent = time.process_time() - started
            said = json.loads((cloud / "cloud.json").read_text())
            print(f"{title}: {trajectory_errors(cloud, log)}; {said['loops']} loops, "
                  f"{said['gnss_rejected']} fixes rejected, {spent:.0f} s CPU")  # fmt: skip
        print(f"lift: {height_errors(town, folder / 'cloud')}")


if __name__ == "__main__":
    main()
