"""How do time and memory of `rtmap crowdsource` grow with kilometres and traversals?

    python -m benchmarks.crowdsource.growth                        1, 10, 100 km, 3 traversals
    python -m benchmarks.crowdsource.growth --kilometres 2 --traversals 1 3 10

An endless street that bends, with lanes, side streets and crossings, seen by the simulator
(preset rtmap-straight) over one period of it; drives of 5 km are made of copies of that period,
side by side, in rows of 10 km. Poses are the true ones with 0.1 m and 0.1 degrees. Each size is
fused into a new map by the command itself, in its own process: CPU seconds (of all its processes),
peak memory, vertex observations per CPU second, and the power of kilometres × traversals with
which time and memory grow. The observations are simulated.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.streets import PERIOD, long_drive, one_period
from rtmap_cli.logs.run import Run
from rtmap_cli.logs.run_files import write_run

DRIVE, ROW, APART = 5.0, 10.0, 1000.0
"""Kilometres of a drive and of a row of them; metres between rows."""


def copies_of(kilometres: float) -> int:
    """Whole periods of about so many kilometres."""
    return max(1, round(kilometres * 1000 / PERIOD))


def write_fleet(folder: Path, kilometres: float, bases: list[Run]) -> int:
    """Runs over so many kilometres; returns the number of vertex observations."""
    copies = copies_of(kilometres)
    per_row, per_drive = round(ROW * 1000 / PERIOD), round(DRIVE * 1000 / PERIOD)
    index = np.arange(copies)
    shift = np.stack([index % per_row * PERIOD, index // per_row * APART], axis=-1)
    count = 0
    for t, base in enumerate(bases):
        for k, first in enumerate(range(0, copies, per_drive)):
            name = f"t{t:02d}-{k:03d}"
            run = long_drive(base, shift[first : first + per_drive], name)
            (folder / name).mkdir(parents=True)
            write_run(run, folder / name)
            count += int(run.observations.points.shape[0] * run.observations.points.shape[1])
    return count


def timed(arguments: list[str]) -> tuple[float, float, float]:
    """CPU seconds, wall seconds and peak megabytes (of the largest process) of a command."""
    begin = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "rtmap_cli.cli", *arguments], stdout=subprocess.DEVNULL
    )
    _, status, used = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"rtmap {' '.join(arguments)}: failed")
    return used.ru_utime + used.ru_stime, time.perf_counter() - begin, used.ru_maxrss / 1024


def measure(bases: list[Run], kilometres: float, options: argparse.Namespace) -> dict[str, Any]:
    """One size: made, fused, thrown away."""
    with tempfile.TemporaryDirectory(dir=options.work) as name:
        folder = Path(name)
        count = write_fleet(folder / "runs", kilometres, bases)
        more = options.crowdsource
        cpu, wall, peak = timed(
            ["crowdsource", str(folder / "runs"), "--map", str(folder / "map"), *more]
        )
    return {
        "kilometres": copies_of(kilometres) * PERIOD / 1000,
        "traversals": len(bases),
        "vertex observations": count,
        "cpu seconds": round(cpu, 1),
        "wall seconds": round(wall, 1),
        "peak megabytes": round(peak),
        "observations per cpu second": round(count / cpu),
    }


def main() -> None:
    """Print one JSON object per size, then the exponents."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kilometres", type=float, nargs="+", default=[1.0, 10.0, 100.0])
    parser.add_argument("--traversals", type=int, nargs="+", default=[3])
    parser.add_argument("--crowdsource", type=str.split, default=[], help="more options, quoted")
    parser.add_argument("--work", type=Path, help="folder for what is thrown away")
    options = parser.parse_args()
    bases = [one_period(t) for t in range(max(options.traversals))]
    rows = []
    for kilometres in options.kilometres:
        for traversals in options.traversals:
            rows.append(measure(bases[:traversals], kilometres, options))
            print(json.dumps(rows[-1]), flush=True)
    if len(rows) > 1:
        size = np.log([r["kilometres"] * r["traversals"] for r in rows])
        powers = {
            name: round(float(np.polyfit(size, np.log([r[name] for r in rows]), 1)[0]), 3)
            for name in ("cpu seconds", "peak megabytes")
        }
        print(json.dumps({"exponents": powers}))


if __name__ == "__main__":
    main()
