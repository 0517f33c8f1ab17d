"""The chain over the fleet benchmark: real maps, simulated poses, detections and changes.

    python -m benchmarks.fleet.chain frames   --golden DIR     single-frame AP of the detections
    python -m benchmarks.fleet.chain poses    --golden DIR     pose errors before and after localize
    python -m benchmarks.fleet.chain changes  --golden DIR     changes found, missed and false
    python -m benchmarks.fleet.chain fusion   --golden DIR     the fused map over cycles

DIR holds ``fleet/`` (default: $RTMAP_GOLDEN). The steps under test run as commands on the prior
and the traversals alone; ``truth/`` is opened by the evaluation only, after they are done.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rtmap_cli.cli import run as rtmap
from rtmap_cli.formats.geojson import read_geojson
from rtmap_cli.logs.run_files import read_run
from rtmap_cli.maps.element import CLASSES, VectorMap
from rtmap_cli.maps.store import read_map
from rtmap_cli.output import plain, table
from rtmap_cli.steps.evaluate.drives import Drive, read_drives
from rtmap_cli.steps.evaluate.judge import judge_changes, judge_poses
from rtmap_cli.steps.evaluate.maps.compare import Settings, compare
from rtmap_cli.steps.evaluate.maps.frames import FrameSet, run_frames
from rtmap_cli.steps.evaluate.maps.precision import PROTOCOLS, MapScore
from rtmap_cli.steps.evaluate.maps.whole import CELL, coverage, honesty, region_in_range
from rtmap_cli.steps.evaluate.poses import pool_poses

MAPS = ("7fab2350", "adcf7d18", "3bffdcff")
SCENARIOS = ("straight", "turning")
REAL = "real_change"
RANGE = PROTOCOLS["rtmap"].range_m
SIGMAS_90 = 1.6449
"""Half width of the 90 % interval of a Gaussian, in standard deviations."""
WITHOUT_U = "--without-sigma"
FUSIONS = {
    "first": ("first",),
    "first, without U": ("first", WITHOUT_U),
    "localized": ("localized",),
    "localized, without U": ("localized", WITHOUT_U),
    "tiled": ("localized", "--tile", "100"),
    "maintenance": ("maintenance",),
    "maintenance, without U": ("maintenance", WITHOUT_U),
}
"""Rows that fuse the first n drives at once: what they are fused into, and options."""
EVERY = 4
"""Fused maps are judged at every fourth frame, as the benchmark asks."""


@dataclass
class Scenario:
    """One folder of the benchmark and a folder to work in."""

    name: str
    folder: Path
    work: Path
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def prior(self) -> Path:
        """The imported prior map; commands that change a map work on a copy."""
        return self.work / "prior"

    def command(self, *arguments: str | Path) -> int:
        """Run one rtmap command quietly; an exit code other than 0 or 4 ends the benchmark."""
        out, err, start = io.StringIO(), io.StringIO(), time.perf_counter()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = rtmap([str(a) for a in arguments])
        verb = str(arguments[0])
        self.seconds[verb] = self.seconds.get(verb, 0.0) + time.perf_counter() - start
        if code not in (0, 4):
            sys.exit(
                f"{self.name}: rtmap {' '.join(map(str, arguments))}: exit {code}\n{err.getvalue()}"
            )
        if code:
            print(f"{self.name}: {err.getvalue().strip()}", file=sys.stderr)
        return code

    def import_prior(self) -> None:
        """prior.geojson becomes a map."""
        self.command(
            "import", "geojson", self.folder / "prior.geojson", "--crs", "EPSG:32617",
            "-o", self.prior, "--overwrite",
        )  # fmt: skip

    def import_run(self, number: int, runs: Path) -> Path:
        """One traversal becomes a run in the folder ``runs``."""
        target = runs / f"{number:02d}"
        source = self.folder / "traversals" / f"{number:02d}.json.gz"
        self.command("import", "detections", source, "-o", target, "--overwrite")
        return target

    def truth(self, count: int | None = None) -> tuple[VectorMap, list[Drive]]:
        """The world and the true poses of the first ``count`` drives."""
        drives = read_drives(self.folder / "truth" / "poses.json.gz")[:count]
        return read_geojson(self.folder / "truth" / "map.geojson", drives[0].crs), drives


def frames(scenario: Scenario, options: argparse.Namespace) -> dict[str, Any]:
    """Single-frame AP of all detections against the world cropped at the true poses."""
    runs = scenario.work / "runs"
    found: dict[str, Any] = {}
    for k in range(options.drives):
        path = scenario.import_run(k, runs)
        found |= run_frames(read_run(path), path).frames
    truth, drives = scenario.truth()
    score = compare(FrameSet(found, list(CLASSES), RANGE, scenario.name), truth, drives)
    return {"AP": by_class(score)}


def poses(scenario: Scenario, options: argparse.Namespace) -> dict[str, Any]:
    """Errors over all frames before and after localization on the prior."""
    scenario.import_prior()
    truth = scenario.folder / "truth" / "poses.json.gz"
    before, after = [], []
    for k in range(options.drives):
        run = scenario.import_run(k, scenario.work / "runs")
        before.append(judge_poses(read_run(run), truth, initial=True))
        scenario.command("localize", run, "--map", scenario.prior, *options.localize)
        after.append(judge_poses(read_run(run), truth))
    return {"before": pool_poses(before).as_json(), "after": pool_poses(after).as_json()}


def changes(scenario: Scenario, options: argparse.Namespace) -> dict[str, Any]:
    """Changes after the first n drives, each localized on the prior."""
    scenario.import_prior()
    runs: list[Path] = []
    out: dict[str, Any] = {}
    for n in range(1, max(options.cycles) + 1):
        run = scenario.import_run(n - 1, scenario.work / "runs")
        scenario.command("localize", run, "--map", scenario.prior, *options.localize)
        runs.append(run)
        if n in options.cycles:
            found = scenario.work / f"changes-{n}.geojson"
            scenario.command(
                "detect-changes", *runs, "--map", scenario.prior, "-o", found, "--overwrite",
                *options.detect,
            )  # fmt: skip
            drives = read_drives(scenario.folder / "truth" / "poses.json.gz")[:n]
            truth = scenario.folder / "truth" / "changes.json"
            out[str(n)] = judge_changes(found, truth, options.min_probability, drives)
    return out


def fusion(scenario: Scenario, options: argparse.Namespace) -> dict[str, Any]:
    """The fused map after n drives, one drive a cycle: the map of a cycle is the next one's prior.

    With ``--batch`` the first n drives are localized on the prior and fused at once; with
    ``--without-prior`` they are fused at their initial poses into a map that starts empty.
    """
    scenario.import_prior()
    scores: dict[str, Any] = {}
    if not options.without_prior:
        scores["0"] = judge_map(scenario, read_map(scenario.prior), max(options.cycles))
    for n, fused in fused_maps(scenario, options):
        scores[str(n)] = judge_map(scenario, fused, n)
    return scores


def fusion_rows(scenario: Scenario, options: argparse.Namespace) -> dict[str, Any]:
    """The rows of the benchmark over cycles, with U and without: the first n drives at once, into a
    new map (``first`` at their initial poses, ``localized`` on the prior) or the prior itself;
    ``tiled`` the localized row again in tiles of 100 m; ``nightly`` one drive after the other, each
    localized on the version before it."""
    scenario.import_prior()
    rows: dict[str, Any] = {}
    for name, (row, *more) in FUSIONS.items():
        runs = scenario.work / ("raw" if row == "first" else "placed")
        scores, target = {}, scenario.work / "map"
        for n in range(1, max(options.cycles) + 1):
            if not (runs / f"{n - 1:02d}").exists():
                run = scenario.import_run(n - 1, runs)
                if row != "first":
                    scenario.command("localize", run, "--map", scenario.prior, *options.localize)
        for n in options.cycles:
            some = scenario.work / "some"
            shutil.rmtree(some, ignore_errors=True)
            some.mkdir()
            for k in range(n):
                (some / f"{k:02d}").symlink_to(runs / f"{k:02d}")
            shutil.rmtree(target, ignore_errors=True)
            if row == "maintenance":
                shutil.copytree(scenario.prior, target)
            scenario.command("crowdsource", some, "--map", target, *more, *options.crowdsource)
            scores[str(n)] = judge_map(scenario, read_map(target), n)
        rows[name] = scores
    fused = fused_maps(scenario, options)
    rows["nightly"] = {str(n): judge_map(scenario, night, n) for n, night in fused}
    return rows


def fused_maps(scenario: Scenario, options: argparse.Namespace) -> Iterator[tuple[int, VectorMap]]:
    """The map after each cycle that is asked for."""
    runs, target = scenario.work / "runs", scenario.work / "map"
    base = target if not (options.batch or options.without_prior) else scenario.prior
    fresh_map(scenario, target, options)
    for n in range(1, max(options.cycles) + 1):
        run = scenario.import_run(n - 1, runs)
        if not options.without_prior:
            scenario.command("localize", run, "--map", base, *options.localize)
        if n in options.cycles or not options.batch:
            if options.batch:
                fresh_map(scenario, target, options)
            scenario.command("crowdsource", runs, "--map", target, *options.crowdsource)
        if n in options.cycles:
            yield n, read_map(target)


def fresh_map(scenario: Scenario, target: Path, options: argparse.Namespace) -> None:
    """``target`` becomes a copy of the prior, or nothing without one."""
    shutil.rmtree(target, ignore_errors=True)
    if not options.without_prior:
        shutil.copytree(scenario.prior, target)


def judge_map(scenario: Scenario, fused: VectorMap, count: int) -> dict[str, Any]:
    """Per frame, as a whole, coverage, honesty: where the first ``count`` drives looked."""
    truth, drives = scenario.truth(count)
    region = region_in_range(np.concatenate([d.pose[::EVERY] for d in drives]), RANGE)
    names = list(CLASSES)
    out: dict[str, Any] = {}
    for kind, thresholds in (("", (0.5, 1.0, 1.5)), ("_strict", (0.2, 0.5, 1.0))):
        for where, cell in (("frames", None), ("cells", CELL)):
            settings = Settings(thresholds=thresholds, every=EVERY, cell=cell)
            out[where + kind] = by_class(compare(fused, truth, drives, settings))
    cover = coverage(fused, truth, region, names)
    sigma = honesty(fused, truth, region, names)
    inside = float((sigma.ratio <= SIGMAS_90).mean()) if len(sigma.ratio) else 0.0
    return out | {
        "coverage": {name: c.as_json() for name, c in cover.items()},
        "sigma": sigma.as_json() | {"inside_90": inside},
    }


def by_class(score: MapScore) -> dict[str, float]:
    """AP by class and mAP."""
    return {name: c.mean for name, c in score.classes.items()} | {"mAP": score.mAP}


def _percent(values: Mapping[str, float | None]) -> list[str]:
    return ["-" if v is None else f"{100 * v:.1f}" for v in values.values()]


def show_frames(results: dict[str, Any]) -> list[str]:
    """Rows of scenarios, and means over the maps."""
    rows = [[name, *_percent(r["AP"])] for name, r in results.items()]
    for scenario in SCENARIOS:
        kept = [r["AP"] for name, r in results.items() if name.endswith(scenario)]
        if len(kept) > 1:
            mean = {k: float(np.mean([r[k] for r in kept])) for k in kept[0]}
            rows.append([f"mean {scenario}", *_percent(mean)])
    return table(["single frame, AP (%)", *CLASSES, "mAP"], rows)


def show_poses(results: dict[str, Any]) -> list[str]:
    """Mean / 90 % errors and the shares of truths inside the stated regions."""
    rows = []
    for name, result in results.items():
        for when in ("before", "after"):
            r = result[when]["all_frames"]
            errors = [
                f"{r[k]['mean']:.3f} / {r[k]['p90']:.3f}"
                for k in ("lateral_m", "longitudinal_m", "yaw_deg")
            ]
            honest, share = result[when]["consistency"], result[when]["share_answered"]
            inside = [f"{100 * v['all']:.0f}" for v in honest["inside"].values()] if honest else []
            rows.append([f"{name} {when}", *errors, f"{100 * share:.1f}", *(inside or "--")])
    header = ["poses, mean / 90 %", "lateral m", "longitudinal m", "yaw deg"]
    return table([*header, "answered %", "in 50 %", "in 90 %"], rows)


def show_changes(results: dict[str, Any]) -> list[str]:
    """Counts over drives."""
    rows = []
    for name, result in results.items():
        for n, r in result.items():
            shares = ["-" if r[k] is None else f"{r[k]:.2f}" for k in ("precision", "recall")]
            counts = [r["found"], r["missed"], r["false"], r["outside_area"]]
            rows.append([f"{name}, {n} drives", *counts, *shares, f"{r['false_per_km']:.2f}"])
    header = ["changes", "found", "missed", "false", "outside", "precision", "recall", "false/km"]
    return table(header, rows)


def show_fusion(results: dict[str, Any]) -> list[str]:
    """One table per figure."""
    out: list[str] = []
    titles = {
        "frames": "per frame, AP (%) at 0.5/1.0/1.5 m",
        "cells": "whole map, AP (%) at 0.5/1.0/1.5 m",
        "frames_strict": "per frame, AP (%) at 0.2/0.5/1.0 m",
        "cells_strict": "whole map, AP (%) at 0.2/0.5/1.0 m",
    }
    for key, title in titles.items():
        rows = [
            [f"{name}, {'prior' if n == '0' else f'cycle {n}'}", *_percent(r[key])]
            for name, result in results.items()
            for n, r in result.items()
        ]
        out += [*table([title, *CLASSES, "mAP"], rows), ""]
    rows = []
    for name, result in results.items():
        for n, r in result.items():
            cover = [
                _percent({c: r["coverage"][c][k] for c in CLASSES}) for k in ("covered", "extra")
            ]
            sigma = _percent(r["sigma"]["within"])
            rows.append([f"{name}, cycle {n}", *map("/".join, cover), "/".join(sigma)])
    header = ["% of true length covered", "covered", "extra", "within 1/2/3 sigma"]
    return out + table(header, rows)


TESTS: dict[str, tuple[Callable[..., dict[str, Any]], Callable[..., list[str]]]] = {
    "frames": (frames, show_frames),
    "poses": (poses, show_poses),
    "changes": (changes, show_changes),
    "fusion": (fusion, show_fusion),
}


def check_golden(golden: Path | None) -> None:
    """One line when the benchmark is not there."""
    if golden is None:
        sys.exit("fleet benchmark not found, set RTMAP_GOLDEN to the folder that holds fleet/")
    if not (golden / "fleet").is_dir():
        sys.exit(f"{golden} holds no folder fleet/, set RTMAP_GOLDEN to the one that does")


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("test", choices=TESTS)
    parser.add_argument("--golden", type=Path, default=os.environ.get("RTMAP_GOLDEN") or None)
    parser.add_argument("--maps", nargs="+", default=list(MAPS), choices=[*MAPS, REAL])
    parser.add_argument("--scenarios", nargs="+", default=list(SCENARIOS), choices=SCENARIOS)
    parser.add_argument("--cycles", nargs="+", type=int, default=[1, 2, 3, 5, 10])
    parser.add_argument("--drives", type=int, default=10, help="drives for frames and poses")
    parser.add_argument("--min-probability", type=float, default=0.5, help="of detected changes")
    parser.add_argument("--batch", action="store_true", help="fuse the first n drives at once")
    parser.add_argument("--without-prior", action="store_true")
    for verb in ("localize", "detect", "crowdsource"):
        parser.add_argument(
            f"--{verb}", type=str.split, default=[], help="more options, one quoted text"
        )
    parser.add_argument("--work", type=Path, help="keep the intermediate files in this folder")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args(arguments)
    check_golden(options.golden)
    return options


def scenarios(options: argparse.Namespace, work: Path) -> list[Scenario]:
    """The folders that are asked for."""
    names = [f"{m}/{s}" for m in options.maps if m != REAL for s in options.scenarios]
    names += [REAL] if REAL in options.maps else []
    return [Scenario(n, options.golden / "fleet" / n, work / n) for n in names]


def main() -> None:
    """Run one test over all scenarios and print its tables."""
    options = parse()
    measure, show = TESTS[options.test]
    with contextlib.ExitStack() as stack:
        work = options.work or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        results, seconds = {}, {}
        for scenario in scenarios(options, work):
            results[scenario.name] = measure(scenario, options)
            seconds[scenario.name] = scenario.seconds
            print(f"{scenario.name}: done", file=sys.stderr)
    print("\n".join(show(results)))
    total: dict[str, float] = {}
    for spent in seconds.values():
        for verb, s in spent.items():
            total[verb] = total.get(verb, 0.0) + s
    print("seconds: " + ", ".join(f"{verb} {s:.1f}" for verb, s in total.items()))
    if options.json:
        options.json.write_text(
            json.dumps(plain({"results": results, "seconds": seconds}), indent=1)
        )


if __name__ == "__main__":
    main()
