"""How fast `rtmap update` is: a kilometre, growth with observations, against shapely's buffers.

    python -m benchmarks.update.speed
    python -m benchmarks.update.speed --kilometres 1 2 4 --traversals 10

The street and drives of crowdsource/growth.py (simulated). One process per size: the CPU seconds of
the whole command (reading, grids, lines, cells, changes, writing), of the accumulation alone (with
the looks of every frame, past its occluders), and the power of observations with which that grows.
Rasterising alone is compared with the plain way, detection by detection: a shapely buffer of half a
grid cell, the cells whose centres lie in it, added up; timed on some of the frames. Ends with a
line PASS or FAIL for each bar.
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
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from benchmarks.common.printing import Verdict, markdown
from benchmarks.common.streets import long_drive, one_period, street
from rtmap_cli.geometry.blocks import cells_inside, points_along
from rtmap_cli.logs.run import Run
from rtmap_cli.logs.run_files import write_run
from rtmap_cli.logs.traversal import Traversal, read_traversals
from rtmap_cli.maps.element import CLASSES, RING_CLASSES, Element, VectorMap
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.steps.update.accumulate import accumulate, layout_of
from rtmap_cli.steps.update.settings import Settings

Array = NDArray[np.float64]

PERIOD = 400.0
KILOMETRE_S, FASTER, POWER = 10.0, 10.0, 1.15
PLAIN_FRAMES = 150
"""Frames that the plain way is timed on."""


def prior(periods: int) -> VectorMap:
    """The street's map without one crossing in each period."""
    out = []
    for k in range(periods):
        for e in street():
            x = e.xy[:, 0] - street().elements[0].xy[:, 0].min()
            if e.class_name in RING_CLASSES and x.mean() > 200.0:
                continue
            points = e.points + [k * PERIOD, 0.0, 0.0]
            out.append(Element(f"{e.element_id}.{k}", e.class_name, points))
    return VectorMap(out, street().crs)


def make(folder: Path, kilometres: float, traversals: int) -> None:
    """Map and runs of one size."""
    periods = round(1000 * kilometres / PERIOD)
    write_new_map(prior(periods), folder / "map", "street")
    shift = np.stack([np.arange(periods) * PERIOD, np.zeros(periods)], axis=-1)
    for t in range(traversals):
        run: Run = long_drive(one_period(t), shift, f"drive-{t}")
        (folder / "runs" / f"{t:02d}").mkdir(parents=True)
        write_run(run, folder / "runs" / f"{t:02d}")


def measured(folder: Path) -> dict[str, Any]:
    """Seconds of the command in its own process, and of the accumulation alone."""
    words = ["update", "runs", "--map", "map", "-o", "changes.geojson", "--json"]
    start = os.times()
    said = subprocess.run(
        [sys.executable, "-m", "rtmap_cli", *words], cwd=folder, capture_output=True, text=True
    )
    end = os.times()
    if said.returncode:
        sys.exit(said.stderr)
    cpu = end.children_user + end.children_system - start.children_user - start.children_system
    traversals, _ = read_traversals(sorted((folder / "runs").iterdir()))
    settings = Settings()
    began = time.process_time()
    accumulate(traversals, CLASSES, layout_of(traversals, settings), settings)
    return {
        "observations": sum(len(t) for t in traversals),
        "cpu_s": cpu,
        "accumulate_s": time.process_time() - began,
        "changes": len(json.loads(said.stdout)["changes"]),
        "ratio": plain_way(traversals, settings),
    }


def plain_way(traversals: Sequence[Traversal], settings: Settings) -> float:
    """Time per detection that the plain way takes to rasterise, over ours; the best of three."""
    some, cell = traversals[0], settings.grid_m
    chosen = np.flatnonzero(some.frame < PLAIN_FRAMES)
    layout = layout_of([some], settings)
    rings = np.isin(some.class_name, list(RING_CLASSES))

    def plain() -> None:
        counts: dict[tuple[int, int], float] = {}
        for k in chosen.tolist():
            points = some.points[k]
            shape = shapely.Polygon(points) if rings[k] else shapely.LineString(points)
            shape = shape if rings[k] else shape.buffer(cell / 2)
            x0, y0, x1, y1 = np.floor(np.array(shape.bounds) / cell).astype(int)
            i, j = np.meshgrid(np.arange(x0, x1 + 1), np.arange(y0, y1 + 1))
            inside = shapely.contains_xy(shape, (i + 0.5) * cell, (j + 0.5) * cell)
            for x, y in zip(i[inside].tolist(), j[inside].tolist(), strict=True):
                counts[x, y] = counts.get((x, y), 0.0) + float(some.score[k])

    def ours() -> None:
        which, xy, span = points_along(some.points[~rings], cell)
        layout.deposit(xy, span * some.score[~rings][which])
        which, cells = cells_inside(some.points[rings], cell)
        layout.count(cells, some.score[rings][which])

    return best_of(plain) / max(len(chosen), 1) / (best_of(ours) / max(len(some), 1))


def best_of(work: Callable[[], None], times: int = 3) -> float:
    """The least CPU seconds that a function takes."""
    out = np.inf
    for _ in range(times):
        began = time.process_time()
        work()
        out = min(out, time.process_time() - began)
    return out


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--kilometres", type=float, nargs="+", default=[0.4, 1.2, 3.6])
    parser.add_argument("--traversals", type=int, default=10)
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Measure every size, print the table and the verdicts."""
    options = parse(arguments)
    results: list[dict[str, Any]] = []
    for kilometres in options.kilometres:
        with tempfile.TemporaryDirectory() as name:
            make(Path(name), kilometres, options.traversals)
            results.append({"km": kilometres} | measured(Path(name)))
        print(f"{kilometres:g} km: done", file=sys.stderr, flush=True)
    header = ["km", "observations", "command CPU s", "accumulation s", "changes", "× buffers"]
    rows = [
        [
            f"{r['km']:g}", r["observations"], f"{r['cpu_s']:.2f}", f"{r['accumulate_s']:.2f}",
            r["changes"], f"{r['ratio']:.1f}",
        ]
        for r in results
    ]  # fmt: skip
    print("\n".join(markdown([f"simulated, {options.traversals} traversals", *header[1:]], rows)))
    per_km = float(np.interp(1.0, [r["km"] for r in results], [r["cpu_s"] for r in results]))
    said = [
        Verdict("CPU seconds of a kilometre", per_km, -np.inf, KILOMETRE_S),
        Verdict("times faster than buffers", min(r["ratio"] for r in results), FASTER, np.inf),
    ]
    if len(results) > 1:
        sizes = np.log([r["observations"] for r in results])
        power = float(np.polyfit(sizes, np.log([r["accumulate_s"] for r in results]), 1)[0])
        said.append(Verdict("power of observations (accumulation)", power, -np.inf, POWER))
    print("\n".join(["", *(v.line for v in said)]))
    return int(any(not v.holds for v in said))


if __name__ == "__main__":
    sys.exit(main())
