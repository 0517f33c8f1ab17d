"""The fleet benchmark with its bars (`make bench-fleet`): drives of a fleet over real maps.

    python -m benchmarks.fleet.tables                      everything
    python -m benchmarks.fleet.tables --parts poses        localization alone
    python -m benchmarks.fleet.tables --parts poses --modes smooth --localize "--lag 10"

The folder of --golden (default: $RTMAP_GOLDEN) holds ``fleet/``: see its README for how the
detections were made. They are simulated over real maps. Every drive that was measured is kept in
the folder --work (default bench_fleet), under a digest of the code that measured it: an
interrupted run goes on, and only what the code changed is measured anew. Ends with a line PASS or
FAIL for each bar; exit code 1 when one fails.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import rtmap_cli
from benchmarks.common.printing import Verdict
from benchmarks.fleet import chain as fleet
from benchmarks.fleet.maps import PRINT, printed
from benchmarks.fleet.poses import figures, pose_tables, verdicts
from rtmap_cli.logs.run_files import read_run
from rtmap_cli.output import plain
from rtmap_cli.steps.evaluate.judge import judge_poses
from rtmap_cli.steps.evaluate.poses import PoseScore

PARTS = ("poses", "frames", "changes", "fusion")
MODES = {"single": (), "smooth": ("--smooth",)}
CODE = {
    "poses": ("geometry", "logs", "maps", "formats", "steps/localize"),
    "frames": ("geometry", "logs", "maps", "formats", "steps/evaluate"),
    "changes": ("geometry", "logs", "maps", "formats", "steps"),
    "fusion": ("geometry", "logs", "maps", "formats", "steps"),
}
"""What of the package the figures of a part depend on."""


@dataclass(frozen=True)
class Unit:
    """One measurement: a drive of a scenario (``poses``) or all of its drives (``drive`` -1)."""

    part: str
    scenario: str
    mode: str
    drive: int
    options: tuple[str, ...]

    @property
    def name(self) -> str:
        """The file that keeps it."""
        number = hashlib.sha256(repr(asdict(self)).encode()).hexdigest()[:6]
        place = self.scenario.replace("/", "-")
        drive = f"-{self.drive:02d}" if self.drive >= 0 else ""
        return f"{place}-{self.mode}{drive}-{number}.json"


def units_of(options: argparse.Namespace) -> list[Unit]:
    """What has to be measured, the long ones first."""
    extra = tuple(options.localize)
    names = [f"{m}/{k}" for m in options.maps for k in options.scenarios]
    out = []
    for part in [p for p in PARTS[:0:-1] if p in options.parts]:
        some = [*names, fleet.REAL] if part == "changes" else names
        out += [Unit(part, name, "smooth", -1, extra) for name in some]
    if "poses" in options.parts:
        drives = range(options.drives)
        out += [
            Unit("poses", n, m, k, extra)
            for m in reversed(options.modes)
            for n in names
            for k in drives
        ]
    return out


def digest(part: str) -> str:
    """Six digits that are others when the code that measures a part is another."""
    package, here = Path(rtmap_cli.__file__).parent, Path(__file__).resolve().parents[1]
    files = [p for name in CODE[part] for p in sorted((package / name).rglob("*.py"))]
    # What a command decides by itself, and what a pose error is.
    files += [package / "commands" / "localize.py", package / "steps/evaluate/poses.py"]
    files += [here / "fleet/chain.py"]
    return hashlib.sha256(b"".join(p.read_bytes() for p in files)).hexdigest()[:6]


def measure(unit: Unit, golden: Path, keep: Path) -> tuple[Unit, dict[str, Any]]:
    """The figures of a unit: read where they were kept, else measured and kept."""
    path = keep / unit.name
    if path.exists():
        return unit, json.loads(path.read_text(encoding="utf-8"))
    started = time.process_time()
    with tempfile.TemporaryDirectory(prefix="rtmap-fleet-") as folder:
        scenario = fleet.Scenario(unit.scenario, golden / "fleet" / unit.scenario, Path(folder))
        result = poses_of(scenario, unit) if unit.part == "poses" else whole(scenario, unit, golden)
    result |= {"cpu_s": time.process_time() - started, "seconds": scenario.seconds}
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(plain(result)), encoding="utf-8")
    part.replace(path)
    return unit, result


def poses_of(scenario: fleet.Scenario, unit: Unit) -> dict[str, Any]:
    """Errors of one drive before and after localization on the prior."""
    scenario.import_prior()
    run = scenario.import_run(unit.drive, scenario.work / "runs")
    truth = scenario.folder / "truth" / "poses.json.gz"
    start = judge_poses(read_run(run), truth, initial=True)
    options = (*MODES[unit.mode], *unit.options)
    code = scenario.command("localize", run, "--map", scenario.prior, *options)
    # A drive without an answer stays where it started.
    after = judge_poses(read_run(run), truth) if code == 0 else start
    return {"start": _frames(start), "after": _frames(after, answered=code == 0)}


def _frames(score: PoseScore, answered: bool = True) -> dict[str, Any]:
    return {
        "errors": score.errors.round(7).tolist(),
        "square": score.squares["all"].tolist(),
        "answered": (score.answered & answered).tolist(),
    }


def whole(scenario: fleet.Scenario, unit: Unit, golden: Path) -> dict[str, Any]:
    """One of the other parts over all drives of a scenario."""
    options = fleet.parse([unit.part, "--golden", str(golden)])
    options.localize = [*MODES[unit.mode], *unit.options]
    measure_ = fleet.fusion_rows if unit.part == "fusion" else fleet.TESTS[unit.part][0]
    return {"figures": measure_(scenario, options)}


def measured(
    units: list[Unit], options: argparse.Namespace
) -> Iterator[tuple[Unit, dict[str, Any]]]:
    """All units, in the order in which they are done, by ``--jobs`` processes."""
    if options.jobs == 1:
        for unit in units:
            yield measure(unit, options.golden, options.keep[unit.part])
        return
    # The drives are the parallel thing: a process has one thread, and starts anew to have it.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.jobs, context) as pool:
        jobs = [
            pool.submit(measure, unit, options.golden, options.keep[unit.part]) for unit in units
        ]
        for job in as_completed(jobs):
            yield job.result()


def scores_of(results: list[tuple[Unit, dict[str, Any]]]) -> dict[tuple[str, str, str], Any]:
    """Figures by map, scenario and mode; the starts are those of any mode."""
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    first = results[0][0].mode
    for unit, result in results:
        name, kind = unit.scenario.split("/")
        groups.setdefault((name, kind, unit.mode), []).append(result["after"])
        if unit.mode == first:
            groups.setdefault((name, kind, "start"), []).append(result["start"])
    order = ["start", *MODES]
    keys = sorted(groups, key=lambda k: (order.index(k[2]), k[1], k[0]))
    return {k: figures(groups[k]) for k in keys}


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--golden", type=Path, default=os.environ.get("RTMAP_GOLDEN") or None)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--modes", nargs="+", choices=MODES, default=list(MODES))
    parser.add_argument("--maps", nargs="+", choices=fleet.MAPS, default=list(fleet.MAPS))
    parser.add_argument(
        "--scenarios", nargs="+", choices=fleet.SCENARIOS, default=list(fleet.SCENARIOS)
    )
    parser.add_argument("--drives", type=int, default=10, help="drives for the poses")
    parser.add_argument(
        "--localize", type=str.split, default=[], help="more options, one quoted text"
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--work", type=Path, default=Path("bench_fleet"), help="kept figures")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args(arguments)
    fleet.check_golden(options.golden)
    options.keep = {part: options.work / f"{part}-{digest(part)}" for part in options.parts}
    return options


def main(arguments: list[str] | None = None) -> int:
    """Measure what is not kept yet, print the tables and the verdicts."""
    options = parse(arguments)
    units = units_of(options)
    results: dict[str, list[tuple[Unit, dict[str, Any]]]] = {}
    for n, (unit, result) in enumerate(measured(units, options), start=1):
        results.setdefault(unit.part, []).append((unit, result))
        print(f"{n}/{len(units)} {unit.part} {unit.name}", file=sys.stderr, flush=True)
    judged: list[Verdict] = []
    kept: dict[str, Any] = {}
    for part in [p for p in PARTS if p in results]:
        found = sorted(results[part], key=lambda r: r[0].name)
        print(f"## {part}\n")
        if part == "poses":
            scores = scores_of(found)
            kept[part] = {"/".join(k): v for k, v in scores.items()}
            print("\n".join(pose_tables(scores)))
            judged += verdicts(scores)
        else:
            kept[part] = {u.scenario: r["figures"] for u, r in found}
            if part in PRINT:
                lines, more = printed(part, kept[part])
                judged += more
            else:
                lines = fleet.TESTS[part][1](kept[part])
            print("\n".join([*lines, ""]))
        spent = sum(r["seconds"].get("localize", 0.0) for _, r in found)
        print(f"localize took {spent:.0f} s, all {sum(r['cpu_s'] for _, r in found):.0f} CPU s\n")
    print("\n".join(v.line for v in judged))
    if options.json:
        options.json.write_text(json.dumps(plain(kept), indent=1), encoding="utf-8")
    return int(any(not v.holds for v in judged))


if __name__ == "__main__":
    sys.exit(main())
