"""Flagged cells and what applying the changes makes of a map, over real maps that are out of date.

    python -m benchmarks.update.cells                  12 worlds of five drives, four changes each
    python -m benchmarks.update.cells --worlds 3 --drives 3

Per world `rtmap update`, `rtmap map apply --all` and `rtmap map revert` run as a user runs them
(update/worlds.py: simulated drives over maps of Argoverse 2 logs, RTMAP_DATA or --data). A cell of
18 m is changed when 3 m of a true change lie in it, unchanged when nothing of one does, and counts
when half of it was observed. AP is that of the map against the world (0.5, 1.0, 1.5 m) in changed
cells that were flagged, before and after. Ends with a line PASS or FAIL for each bar.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from benchmarks.common.places import command
from benchmarks.common.printing import Verdict, markdown
from benchmarks.update.worlds import UpdateWorld, make_world
from rtmap_cli.geometry.poses import se3_from_xyyaw
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.element import CLASSES, VectorMap
from rtmap_cli.maps.store import read_map
from rtmap_cli.steps.evaluate.judge import judge_changes
from rtmap_cli.steps.evaluate.maps.precision import Scorer

Array = NDArray[np.float64]

CELL = 18.0
CHANGED_M = 3.0
OBSERVED = 0.5
BARS = {"flagged of changed cells": (0.95, 1.0), "flagged of unchanged cells": (0.0, 0.05)}
AP = 0.8
EDGES = (0.5, 0.7, 0.9, 0.97, 1.0)
"""Bins of the told probability."""


def judged(world: UpdateWorld, work: Path) -> dict[str, Any]:
    """Cells, APs and what stayed the same of one world."""
    work.mkdir(parents=True, exist_ok=True)
    target, changes = work / "map", work / "changes.geojson"
    command("map", "ls", world.prior)
    _copy(world.prior, target)
    start = time.perf_counter()
    said = json.loads(
        command(
            "update", *world.runs, "--map", target, "-o", changes, "--cell", CELL,
            "--report", work / "report", "--overwrite", "--json",
        )
    )  # fmt: skip
    seconds = time.perf_counter() - start
    before = read_map(target)
    cells = [_cell(c, world) for c in said["cells"] if c["observed"] >= OBSERVED]
    out: dict[str, Any] = {"world": world.number, "seconds": seconds, "cells": cells}
    out["told"] = [
        [c["kind"], c["class"], c["reason"], round(c["probability"], 3)] for c in said["changes"]
    ]
    out["judged"] = [
        [c["verdict"], c["probability"]]
        for c in judge_changes(changes, world.folder / "truth.json")["changes"]
        if c["verdict"] != "missed"
    ]
    if said["changes"]:
        command("map", "apply", target, changes, "--all")
    after = read_map(target)
    flagged = [c["low"] for c in cells if c["flagged"] and c["metres"] >= CHANGED_M]
    out["before"] = scored(before, world.world, flagged)
    out["after"] = scored(after, world.world, flagged)
    named = {c["element_id"] for c in said["changes"] if c["element_id"]}
    out["same"] = unchanged(before, after, named)
    if said["changes"]:
        command("map", "revert", target)
    out["reverted"] = unchanged(before, read_map(target), set())
    return out


def _copy(source: Path, target: Path) -> None:
    import shutil

    if target.exists():
        shutil.rmtree(target)
    shutil.copytree(source, target)


def _cell(told: dict[str, Any], world: UpdateWorld) -> dict[str, Any]:
    """A cell with the metres of true change in it."""
    x, y = told["low"]
    box = shapely.box(x, y, x + CELL, y + CELL)
    metres = [
        float(shapely.intersection(shapely.LineString(c.points), box).length) for c in world.changes
    ]
    return told | {"metres": max(metres, default=0.0), "which": int(np.argmax([0.0, *metres])) - 1}


def scored(vector_map: VectorMap, world: VectorMap, lows: Sequence[Sequence[float]]) -> list[Any]:
    """Of each cell the judged elements, to be pooled over worlds."""
    index, true = MapIndex(vector_map, join=True), MapIndex(world, join=True)
    half = (-CELL / 2, -CELL / 2, CELL / 2, CELL / 2)
    out = []
    for x, y in lows:
        centre = np.array([[x + CELL / 2, y + CELL / 2]])
        pose = se3_from_xyyaw(centre[:, 0], centre[:, 1], np.zeros(1))[0]
        sides = [
            [(e.class_name, e.points, 1.0) for e in side.crop(pose, half)] for side in (index, true)
        ]
        out.append(Scorer(CLASSES).judge(sides[0], sides[1], f"{x:.0f} {y:.0f}"))
    return out


def pooled(parts: Sequence[list[Any]]) -> dict[str, float]:
    """AP by class and mAP over the cells of all worlds."""
    scorer = Scorer(CLASSES)
    for part in parts:
        for cell in part:
            scorer.collect(cell)
    score = scorer.result()
    return {name: c.mean for name, c in score.classes.items()} | {"mAP": score.mAP}


def unchanged(before: VectorMap, after: VectorMap, named: set[str]) -> bool:
    """Whether every element that no change names is the same, bit for bit."""
    new = after.by_id()
    for e in before:
        if e.element_id in named:
            continue
        other = new.get(e.element_id)
        if other is None or e.points.tobytes() != other.points.tobytes():
            return False
        sides = [None if x.covariance is None else x.covariance.tobytes() for x in (e, other)]
        if sides[0] != sides[1]:
            return False
    return True


def shown(results: Sequence[dict[str, Any]], aps: dict[str, dict[str, float]]) -> list[str]:
    """The tables."""
    rows = []
    for r in results:
        changed = [c for c in r["cells"] if c["metres"] >= CHANGED_M]
        other = [c for c in r["cells"] if c["metres"] <= 0.0]
        rows.append(
            [
                r["world"], r["name"], len(changed), sum(c["flagged"] for c in changed),
                len(other), sum(c["flagged"] for c in other), len(r["told"]), f"{r['seconds']:.1f}",
            ]
        )  # fmt: skip
    header = ["world", "place", "changed", "flagged", "unchanged", "flagged", "told", "s"]
    out = [*markdown(header, rows), ""]
    names = [*CLASSES, "mAP"]
    body = [[when, *(f"{ap[n]:.3f}" for n in names)] for when, ap in aps.items()]
    out += [*markdown(["AP in flagged changed cells", *names], body), ""]
    return [*out, *markdown(["told probability", "changes", "mean", "real"], reliability(results))]


def reliability(results: Sequence[dict[str, Any]]) -> list[list[Any]]:
    """By bins of the told probability: changes, their mean, and the share that is true (a move is
    two true changes)."""
    verdict, told = zip(*(row for r in results for row in r["judged"]), strict=True)
    real, p = np.array(verdict) == "found", np.array(told)
    out = []
    for low, high in itertools.pairwise(EDGES):
        inside = (p >= low) & ((p < high) | (high == EDGES[-1]))
        if inside.any():
            row = [int(inside.sum()), f"{p[inside].mean():.3f}", f"{real[inside].mean():.3f}"]
            out.append([f"{low:g} to {high:g}", *row])
    return out


def verdicts(results: Sequence[dict[str, Any]], aps: dict[str, dict[str, float]]) -> list[Verdict]:
    """Every bar."""
    cells = [c for r in results for c in r["cells"]]
    changed = [c["flagged"] for c in cells if c["metres"] >= CHANGED_M]
    other = [c["flagged"] for c in cells if c["metres"] <= 0.0]
    rates = (np.mean(changed), np.mean(other))
    out = [
        Verdict(f"{name} ({len(side)})", float(rate), *bar)
        for (name, bar), rate, side in zip(BARS.items(), rates, (changed, other), strict=True)
    ]
    out.append(Verdict("mAP in flagged cells after apply", aps["after"]["mAP"], AP, 1.0))
    same = np.mean([r["same"] for r in results])
    out.append(Verdict("worlds whose other elements kept every bit", float(same), 1.0, 1.0))
    back = np.mean([r["reverted"] for r in results])
    out.append(Verdict("worlds that revert exactly", float(back), 1.0, 1.0))
    return out


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=os.environ.get("RTMAP_DATA") or None)
    parser.add_argument("--worlds", type=int, default=12)
    parser.add_argument("--first", type=int, default=0, help="number (and seed) of the first world")
    parser.add_argument("--drives", type=int, default=5)
    parser.add_argument("--work", type=Path, default=Path("bench_update"), help="what is kept")
    options = parser.parse_args(arguments)
    if options.data is None:
        sys.exit("sample data folder not found, set RTMAP_DATA")
    return options


def main(arguments: list[str] | None = None) -> int:
    """Measure, print the tables and the verdicts."""
    options = parse(arguments)
    results = []
    for number in range(options.first, options.first + options.worlds):
        world = make_world(number, options.data, options.work, options.drives)
        result = judged(world, world.folder / "update")
        result["name"] = f"{world.place.name} {world.kind}"
        results.append(result)
        print(f"world {number}: done", file=sys.stderr, flush=True)
    aps = {when: pooled([r[when] for r in results]) for when in ("before", "after")}
    print("\n".join(shown(results, aps)))
    said = verdicts(results, aps)
    print("\n".join(v.line for v in said))
    return int(any(not v.holds for v in said))


if __name__ == "__main__":
    sys.exit(main())
