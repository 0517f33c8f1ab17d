"""Peak memory of `rtmap label cloud` over drives of growing length: it is that of the local map.

    python -m benchmarks.label.cloud_memory [--log LOG] [--metres 500 1000 2000 3000]

The first metres of one log are registered, each in a process of its own; without ``--log`` the
town and the drive of label/campus.py are simulated. Prints the peak resident memory (VmHWM of
Linux) after the odometry, after the graph, and at the end with all exports, and kB per sweep from
the shortest drive to the longest.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rtmap_cli.cli import run
from rtmap_cli.geometry.polylines import arc_length
from rtmap_cli.logs.cloud import CloudFolder
from rtmap_cli.logs.native import NativeLog
from rtmap_cli.output import table
from rtmap_cli.steps.label.cloud.build import Builder
from rtmap_cli.steps.label.cloud.exports import write_overview, write_ply_of
from rtmap_cli.steps.label.cloud.track import Settings

STAGES = ("odometry", "graph", "map", "exports")


def peak_mb() -> float:
    """Peak resident memory of this process (MB)."""
    found = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found.group(1)) / 1024


def child(path: Path, metres: float, folder: Path) -> None:
    """Register the first ``metres`` of a log; prints sweeps and the peaks as JSON."""
    builder = Builder(NativeLog(path), Settings())
    at = np.stack([f.map_SE3_ego for f in builder.frames])[:, :2, 3]
    truth = NativeLog(path).truth_poses()
    if truth is not None:
        at = truth.pose[: len(at), :2, 3]
    builder.frames = builder.frames[: int((arc_length(at) <= metres).sum())]
    peaks: dict[str, float] = {}

    def shown(items: Iterator[Any], what: str, total: int) -> Iterator[Any]:
        if what == "map":
            peaks["graph"] = peak_mb()
        yield from items
        if what == "sweeps":
            peaks["odometry"] = peak_mb()

    folder.mkdir()
    builder.write(folder, shown)
    peaks["map"] = peak_mb()
    cloud = CloudFolder(folder)
    write_overview(cloud, folder / "overview.png")
    write_ply_of(cloud, folder / "cloud.ply")
    peaks["exports"] = peak_mb()
    print(json.dumps({"sweeps": len(builder.frames), **peaks}))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--log", type=Path)
    parser.add_argument("--metres", type=float, nargs="+", default=[500, 1000, 2000, 3000])
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        child(given.log, given.metres[0], given.child)
        return
    rows, found = [], []
    with tempfile.TemporaryDirectory() as name:
        log = given.log or simulated(Path(name), max(given.metres))
        for metres in given.metres:
            words = ["--log", log, "--metres", metres, "--child", Path(name) / f"{metres:.0f}"]
            done = subprocess.run(
                [sys.executable, "-m", "benchmarks.label.cloud_memory", *map(str, words)],
                check=True,
                stdout=subprocess.PIPE,
            )
            found.append(json.loads(done.stdout.splitlines()[-1]))
            peaks = [f"{found[-1][stage]:.0f}" for stage in STAGES]
            rows.append([f"{metres:.0f}", str(found[-1]["sweeps"]), *peaks])
    print("\n".join(table(["m", "sweeps", *(f"{s} (MB)" for s in STAGES)], rows)))
    more = found[-1]["sweeps"] - found[0]["sweeps"]
    if more:
        grown = [f"{s} {1024 * (found[-1][s] - found[0][s]) / more:.0f}" for s in STAGES]
        print("kB a sweep from the first row to the last: " + ", ".join(grown))


def simulated(folder: Path, metres: float) -> Path:
    """A drive of a VLP-16-like LiDAR through a town."""
    town, log = folder / "town", folder / "log"
    words = ["simulate", "lidar", "--map", town, "--log", "town:", "--route", "tour", "--spacing"]
    more = ["2.5", "--length", metres + 100, "--seed", "1", "--gnss", "rtk", "-q", "-o", log]
    for line in (["simulate", "town", "--seed", "4", "--size", "700", "-o", town], words + more):
        if run([str(w) for w in line]):
            raise SystemExit(3)
    return log


if __name__ == "__main__":
    main()
