"""Vertex observations per CPU second of `rtmap crowdsource` on one tile, beside a plain grid.

    python -m benchmarks.crowdsource.speed                    ten traversals of five streets
    python -m benchmarks.crowdsource.speed --traversals 3 --streets 1

The street of crowdsource/growth.py, side by side in one tile, seen by the simulator; a vertex of a
detection of a frame is one observation. The command fuses the runs into a new map in a process of
its own: "whole" are all its CPU seconds, the start of Python included; the stages are timed inside
of it, "rest" is what they leave (imports, planning). The peer is the simplest thing that makes
lines of the same runs: detections counted on a grid of half a metre, cells seen often enough
thinned to a skeleton. It reads and transforms as the command does, in a process of its own, too,
and writes cells: no lines of vertices, no covariance, no existence. Medians over the repetitions.
Exit status 1 below the bar. The observations are simulated.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import importlib
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.common.streets import long_drive, one_period
from rtmap_cli.logs.run_files import write_run
from rtmap_cli.logs.tracks import read_stretch
from rtmap_cli.logs.traversal import Traversal

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BAR = 300_000
"""Vertex observations per second and core."""
APART = 90.0
"""Metres between streets."""
STAGES = {
    "read": ("rtmap_cli.logs.tracks:read_tracks", "rtmap_cli.logs.tracks:read_run"),
    "transform": ("rtmap_cli.logs.tracks:traversal_of",),
    "associate": ("rtmap_cli.steps.detect_changes.evidence:gather_evidence",),
    "fuse": ("rtmap_cli.steps.crowdsource.fuse:fuse",),
    "write": ("rtmap_cli.commands.crowdsource:_committed",),
}
"""Functions that make up a stage; none calls another one."""
CELL, SURE, OFTEN = 0.5, 0.3, 0.15
"""The peer: cell (m), lowest score, and share of the usual count from which a cell is a line."""


def write_runs(folder: Path, traversals: int, streets: int) -> int:
    """Runs over some streets of a tile; returns the number of vertex observations."""
    shift = np.stack([np.zeros(streets), np.arange(streets) * APART], axis=-1)
    count = 0
    for t in range(traversals):
        run = long_drive(one_period(t), shift, f"t{t:02d}")
        (folder / f"t{t:02d}").mkdir(parents=True)
        write_run(run, folder / f"t{t:02d}")
        count += int(np.prod(run.observations.points.shape[:2]))
    return count


def timed_stages(arguments: list[str]) -> dict[str, float]:
    """CPU seconds of each stage of a command, run in this process."""
    spent = dict.fromkeys(STAGES, 0.0)

    def timed(function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        def inner(*args: Any, **more: Any) -> Any:
            begin = time.process_time()
            try:
                return function(*args, **more)
            finally:
                spent[stage] += time.process_time() - begin

        return inner

    for stage, names in STAGES.items():
        for module, name in (n.split(":") for n in names):
            place = importlib.import_module(module)
            setattr(place, name, timed(getattr(place, name), stage))
    from rtmap_cli.cli import main

    try:
        main(arguments)
    except SystemExit as end:
        if end.code:
            raise
    return spent


def skeleton(mask: Mask) -> Mask:
    """A mask thinned to lines one cell wide (Golay's L, all eight turns, until nothing changes)."""
    edge = np.array([[0, 0, 0], [-1, 1, -1], [1, 1, 1]])
    corner = np.array([[-1, 0, 0], [1, 1, 0], [-1, 1, -1]])
    turns = [np.rot90(m, k) for k in range(4) for m in (edge, corner)]
    while True:
        before = mask.sum()
        for turn in turns:
            mask = mask & ~ndimage.binary_hit_or_miss(mask, turn == 1, turn == 0)
        if mask.sum() == before:
            return mask


def grid_map(folder: Path) -> dict[str, list[list[float]]]:
    """The peer's map: middles of the cells of its lines by class."""
    drives = [read_stretch(path) for path in sorted(folder.iterdir())]
    low = np.min([t.points.min(axis=(0, 1)) for t in drives], axis=0)
    high = np.max([t.points.max(axis=(0, 1)) for t in drives], axis=0)
    shape = np.ceil((high - low) / CELL).astype(int) + 1
    out = {}
    for name in drives[0].classes:
        count = sum(_counted(t, name, low, shape) for t in drives)
        usual = np.quantile(count[count > 0], 0.95)
        lines = np.argwhere(skeleton(count > OFTEN * usual))
        out[name] = ((lines + 0.5) * CELL + low).round(2).tolist()
    return out


def _counted(traversal: Traversal, name: str, low: Array, shape: Any) -> Any:
    """Detections of a class by cell, at steps below a cell."""
    own = (traversal.class_name == name) & (traversal.score >= SURE)
    points = traversal.points[own]
    longest = np.hypot(*np.moveaxis(np.diff(points, axis=1), -1, 0)).max(initial=CELL)
    share = np.linspace(0, 1, int(np.ceil(longest / CELL)), endpoint=False)[:, None]
    places = points[:, :-1, None] * (1 - share) + points[:, 1:, None] * share
    x, y = np.floor((places.reshape(-1, 2) - low) / CELL).astype(int).T
    return np.bincount(x * shape[1] + y, minlength=int(np.prod(shape))).reshape(shape)


def child(arguments: list[str]) -> dict[str, float]:
    """What one of the two programs spent, in a process of its own: CPU seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.crowdsource.speed", *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        sys.exit(done.stderr)
    stages: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    whole = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return stages | {"rest": whole - sum(stages.values()), "whole": whole}


def measure(options: argparse.Namespace) -> bool:
    """Print the figures of both; True when the command reaches the bar."""
    with tempfile.TemporaryDirectory(dir=options.work) as name:
        runs = Path(name) / "runs"
        count = write_runs(runs, options.traversals, options.streets)
        ours, peer = [], []
        for k in range(options.repeat):
            ours.append(child(["--ours", str(runs), str(Path(name) / f"map{k}")]))
            peer.append(child(["--peer", str(runs), str(Path(name) / f"peer{k}.json")]))
    mean = {key: float(np.median([r[key] for r in ours])) for key in ours[0]}
    plain = float(np.median([r["whole"] for r in peer]))
    print(f"{count:,} vertex observations, {options.traversals} traversals, one tile")
    for key, seconds in mean.items():
        print(f"  {key:<10}{seconds:7.2f} s  {1e6 * seconds / count:6.2f} µs each")
    rate = count / mean["whole"]
    print(f"plain grid, whole {plain:.2f} s: {count / plain:,.0f} per CPU second")
    print(f"rtmap crowdsource: {rate:,.0f} per CPU second, without rest "
          f"{count / (mean['whole'] - mean['rest']):,.0f}")  # fmt: skip
    print(f"{'PASS' if rate >= BAR else 'FAIL'}: {rate:,.0f} of {BAR:,} per second and core")
    return rate >= BAR


def main() -> None:
    """Both programs, or one of them as a child process."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--traversals", type=int, default=10)
    parser.add_argument("--streets", type=int, default=5)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--work", type=Path, help="folder for what is thrown away")
    parser.add_argument("--ours", nargs=2, metavar=("RUNS", "MAP"), help=argparse.SUPPRESS)
    parser.add_argument("--peer", nargs=2, metavar=("RUNS", "OUT"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.ours:
        runs, target = options.ours
        print(json.dumps(timed_stages(["crowdsource", runs, "--map", target])))
    elif options.peer:
        runs, target = options.peer
        Path(target).write_text(json.dumps(grid_map(Path(runs))))
        print(json.dumps({}))
    elif not measure(options):
        sys.exit(1)


if __name__ == "__main__":
    main()
