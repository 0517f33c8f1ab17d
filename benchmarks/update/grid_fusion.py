"""Grid and probabilistic fusion on the same runs: accuracy, completeness, time.

    python -m benchmarks.update.grid_fusion                   6 worlds, first maps of three drives
    python -m benchmarks.update.grid_fusion --worlds 3 --drives 5

Simulated drives over maps of Argoverse 2 logs (update/worlds.py; RTMAP_DATA or --data), fused by
`rtmap crowdsource` without a prior, once with `--method elements` and once with `--method grid`.
mAP (0.5, 1.0, 1.5 m) along the drives; completeness is the share of the true length that has a
fused line of its class within 1 m, extra the share of the fused length that has no true one.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.places import command
from benchmarks.common.printing import markdown
from benchmarks.update.worlds import UpdateWorld, make_world
from rtmap_cli.maps.element import CLASSES
from rtmap_cli.maps.store import read_map
from rtmap_cli.steps.evaluate.drives import read_drives
from rtmap_cli.steps.evaluate.maps.compare import Settings, compare
from rtmap_cli.steps.evaluate.maps.whole import coverage, region_in_range

METHODS = ("elements", "grid")
RANGE = (-36.0, -18.0, 36.0, 18.0)
EVERY = 3


def fused(world: UpdateWorld, method: str, drives: int) -> dict[str, Any]:
    """One first map and its figures."""
    work = world.folder / f"fusion-{drives}"
    shutil.rmtree(work / method, ignore_errors=True)
    if not (work / "runs").exists():
        for run in world.runs[:drives]:
            shutil.copytree(run, work / "runs" / run.name)
    began = time.process_time()
    command("crowdsource", work / "runs", "--map", work / method, "--method", method)
    seconds = time.process_time() - began
    made = read_map(work / method)
    true = [read_drives(str(t))[0] for t in world.truths[:drives]]
    score = compare(made, world.world, true, Settings(every=EVERY))
    region = region_in_range(np.concatenate([d.pose[::EVERY] for d in true]), RANGE)
    lines = coverage(made, world.world, region, list(CLASSES)).values()
    true_m, fused_m = sum(c.true for c in lines), sum(c.fused for c in lines)
    return {name: score.classes[name].mean for name in CLASSES} | {
        "mAP": score.mAP,
        "complete": sum(c.covered for c in lines) / true_m,
        "extra": sum(c.extra for c in lines) / max(fused_m, 1e-9),
        "CPU s": seconds,
    }


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=os.environ.get("RTMAP_DATA") or None)
    parser.add_argument("--worlds", type=int, default=6)
    parser.add_argument("--drives", type=int, default=3)
    parser.add_argument("--work", type=Path, default=Path("bench_update"), help="what is kept")
    options = parser.parse_args(arguments)
    if options.data is None:
        sys.exit("sample data folder not found, set RTMAP_DATA")
    return options


def shown(results: dict[tuple[str, str], list[dict[str, Any]]]) -> Sequence[str]:
    """Mean figures by scenario and method."""
    names = [*CLASSES, "mAP", "complete", "extra", "CPU s"]
    rows = [
        [kind, method, str(len(parts)), *(f"{np.mean([p[n] for p in parts]):.3f}" for n in names)]
        for (kind, method), parts in sorted(results.items(), reverse=True)
    ]
    return markdown(["simulated", "method", "worlds", *names], rows)


def main(arguments: list[str] | None = None) -> int:
    """Fuse every world both ways and print the table."""
    options = parse(arguments)
    results: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for number in range(options.worlds):
        world = make_world(number, options.data, options.work, max(options.drives, 5))
        for method in METHODS:
            found = fused(world, method, options.drives)
            results.setdefault((world.kind, method), []).append(found)
        print(f"world {number}: done", file=sys.stderr, flush=True)
    print("\n".join(shown(results)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
