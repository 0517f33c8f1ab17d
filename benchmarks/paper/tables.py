"""The four tables of the RTMap paper, our rows beside the paper's (`make bench-tables`).

    python -m benchmarks.paper.tables                  real maps from RTMAP_DATA, else towns
    python -m benchmarks.paper.tables --quick          one place, one world, three cycles
    python -m benchmarks.paper.tables --tables 1 3     some of the tables

Every world that was measured is kept in the folder --work (default bench_tables), under a digest
of the code that measured it: an interrupted run goes on, tables are printed again in no time, and
after a change of the code everything is measured anew. Ends with a line PASS or FAIL for each
claim; exit code 1 when one fails.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import rtmap_cli
from benchmarks.common import worlds as paper_worlds
from benchmarks.common.places import LOGS, TOWNS, Place, av2_places, town_places
from benchmarks.paper.printing import Claim, claims_of, shown
from rtmap_cli.steps.simulate.driving.routes import KINDS
from rtmap_cli.steps.simulate.worlds.changes import parse_spec

CROSSINGS = ("delete:ped_crossing", "insert:ped_crossing")
"""The paper's changes of Tab. 2."""
ALL_CHANGES = (
    *CROSSINGS, "delete:divider*2", "insert:divider*2", "delete:boundary", "insert:boundary",
)  # fmt: skip
CYCLES = (1, 2, 3, 5, 10)
NETWORK_TOWNS = (90_000_101, 90_000_102, 90_000_103)
"""Towns that the shipped model was neither trained nor calibrated with."""


@dataclass(frozen=True)
class Unit:
    """One measurement: ``what`` (mapping, crossings, changes, poses, network) in one world."""

    what: str
    place: str
    kind: str
    world: int
    cycles: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        """The file that keeps it."""
        number = hashlib.sha256(repr(asdict(self)).encode()).hexdigest()[:6]
        return f"{self.what}-{self.place}-{self.kind}-w{self.world}-{number}.json"


def units_of(options: argparse.Namespace) -> list[Unit]:
    """What has to be measured for the tables that are asked for, the long ones first."""
    names = LOGS if options.data else [f"town-{seed}" for seed in TOWNS]
    names = list(names)[: options.places]
    worlds = [(p, k, w) for w in range(options.worlds) for p in names for k in options.kinds]
    short = tuple(c for c in options.cycles if c <= 3)
    out = []
    if 1 in options.tables:
        out += [
            Unit("mapping", *w, tuple(options.cycles) if w[2] < options.long_worlds else short)
            for w in worlds
        ]
    few = [w for w in worlds if w[2] < max(options.worlds // 4, 1)]
    if 2 in options.tables:
        out += [Unit(what, *w) for what in ("crossings", "changes") for w in few]
    if 3 in options.tables:
        out += [Unit("poses", *w) for w in few]
    if 4 in options.tables and not options.run:
        out += [
            Unit("network", f"town-{t}", "straight", 0) for t in NETWORK_TOWNS[: options.places]
        ]
    return out


def code_digest() -> str:
    """Six digits that are others when the code that measures is another."""
    here = Path(__file__).resolve().parents[1]
    package = Path(rtmap_cli.__file__).parent
    parts = ("geometry", "logs", "maps", "steps")
    files = [p for part in parts for p in sorted((package / part).rglob("*.py"))]
    files += [here / "common/places.py", here / "common/worlds.py"]
    return hashlib.sha256(b"".join(p.read_bytes() for p in files)).hexdigest()[:6]


@lru_cache
def _places(data: Path | None) -> dict[str, Place]:
    found = av2_places(data) if data else town_places()
    return {place.name: place for place in found}


def measure(unit: Unit, data: Path | None, keep: Path) -> tuple[Unit, dict[str, Any]]:
    """The figures of a unit: read where they were kept, else measured and kept."""
    path = keep / unit.name
    if path.exists():
        return unit, json.loads(path.read_text(encoding="utf-8"))
    started = time.process_time()
    with tempfile.TemporaryDirectory(prefix="rtmap-tables-") as folder:
        result = _measured(unit, data, Path(folder))
    result["cpu_s"] = round(time.process_time() - started, 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(result), encoding="utf-8")
    part.replace(path)
    return unit, result


def _measured(unit: Unit, data: Path | None, work: Path) -> dict[str, Any]:
    if unit.what == "network":
        try:
            import cv2  # noqa: F401
        except ImportError:
            return {"not_run": "rendering needs pip install 'rtmap[simulate]'"}
        return paper_worlds.network(int(unit.place.removeprefix("town-")), unit.world, work)
    places = _places(data)
    # Another seed per place, or the same traffic would drive through all of them.
    seed = 1 + list(places).index(unit.place)
    where = (places[unit.place], unit.kind, unit.world, seed, work)
    if unit.what == "mapping":
        return paper_worlds.map_world(*where, paper_worlds.Mapping(cycles=unit.cycles))
    specs = [parse_spec(s) for s in (CROSSINGS if unit.what == "crossings" else ALL_CHANGES)]
    if unit.what == "poses":
        return paper_worlds.localized_on(*where, specs)
    return paper_worlds.changes_of(*where, specs)


def measured(
    units: list[Unit], options: argparse.Namespace
) -> Iterator[tuple[Unit, dict[str, Any]]]:
    """All units, in the order in which they are done, by ``--jobs`` processes."""
    if options.jobs == 1:
        for unit in units:
            yield measure(unit, options.data, options.work)
        return
    with ProcessPoolExecutor(options.jobs) as pool:
        jobs = [pool.submit(measure, unit, options.data, options.work) for unit in units]
        for job in as_completed(jobs):
            yield job.result()


def of_run(options: argparse.Namespace) -> dict[str, Any]:
    """Tab. 4 from a run of the user's own."""
    with tempfile.TemporaryDirectory() as folder:
        return paper_worlds.of_network(options.run, options.map, options.truth, Path(folder))


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--tables", nargs="+", type=int, choices=[1, 2, 3, 4], default=[1, 2, 3, 4])
    parser.add_argument("--data", type=Path, default=os.environ.get("RTMAP_DATA") or None)
    parser.add_argument("--towns", action="store_true", help="simulated towns, not real maps")
    parser.add_argument("--work", type=Path, default=Path("bench_tables"), help="kept figures")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument(
        "--worlds",
        type=int,
        default=8,
        help="worlds per place and scenario of Tab. 1; a fourth of them for Tab. 2 and 3",
    )
    parser.add_argument("--long-worlds", type=int, default=1, help="... with all --cycles")
    parser.add_argument("--places", type=int, default=3)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--cycles", nargs="+", type=int, default=list(CYCLES))
    parser.add_argument("--quick", action="store_true", help="one place, one world, three cycles")
    parser.add_argument("--run", type=Path, help="Tab. 4: a run of a network with T^E")
    parser.add_argument("--map", type=Path, help="... the prior map that it was asked about")
    parser.add_argument("--truth", type=Path, help="... its true poses (Parquet)")
    parser.add_argument("--ablations", type=Path, help="Tab. 4: JSON of paper/ablations.py --json")
    options = parser.parse_args(arguments)
    if options.run and not (options.map and options.truth):
        parser.error("--run needs --map and --truth")
    options.data = None if options.towns or options.data is None else Path(options.data)
    if options.quick:
        options.worlds, options.places, options.cycles = 1, 1, [1, 2, 3]
    options.cycles = sorted({2, 3, *options.cycles})
    options.work = options.work / f"{'av2' if options.data else 'towns'}-{code_digest()}"
    return options


def main(arguments: list[str] | None = None) -> int:
    """Measure what is not kept yet, print the tables and the claims."""
    options = parse(arguments)
    units = units_of(options)
    results: dict[str, list[tuple[Unit, dict[str, Any]]]] = {}
    for n, (unit, result) in enumerate(measured(units, options), start=1):
        results.setdefault(unit.what, []).append((unit, result))
        print(f"{n}/{len(units)} {unit.name}", file=sys.stderr, flush=True)
    if options.run:
        results["network"] = [(Unit("network", str(options.run), "-", 0), of_run(options))]
    for found in results.values():
        found.sort(key=lambda r: r[0].name)
    ablations = json.loads(options.ablations.read_text()) if options.ablations else None
    print("\n".join(shown(results, options, ablations)))
    claims = claims_of(results)
    print("\n".join(c.line for c in claims))
    return int(any(not c.holds for c in claims))


__all__ = ["Claim", "main", "units_of"]

if __name__ == "__main__":
    sys.exit(main())
