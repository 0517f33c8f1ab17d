"""Change detection over drives with known changes: bars, operating points, calibration.

    python -m benchmarks.changes.drives                 20 worlds, three drives, three changes
    python -m benchmarks.changes.drives --prior-queries the network is asked about the map
    python -m benchmarks.changes.drives --worlds 4 --jobs 2 --json changes.json

Worlds are the maps of three Argoverse 2 logs (RTMAP_DATA, or --data) with changes made by `rtmap
simulate changes`; drives and observations are simulated (presets rtmap-straight, rtmap-turning),
prior maps are off by 0.1 m. With --prior-queries the observations are those of a network that was
given the outdated map, as `rtmap infer --map` gives it. Every drive is localized on the outdated
map and judged alone ("after one traversal": all three, each by itself) and together. A change
counts for the drives that saw it: four frames or more within 14 m of its middle. Runs and figures
are kept in --work under digests of the code behind them. Ends with a line PASS or FAIL for each
bar; exit code 1 when one fails.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import multiprocessing
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import rtmap_cli
from benchmarks.common.places import Place, av2_places, command
from benchmarks.common.printing import Verdict, markdown
from benchmarks.common.worlds import drive_through, outdated
from rtmap_cli.geometry.polylines import is_ring
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.output import plain
from rtmap_cli.steps.evaluate.drives import read_drives
from rtmap_cli.steps.evaluate.judge import judge_changes
from rtmap_cli.steps.simulate.driving.routes import KINDS
from rtmap_cli.steps.simulate.worlds.changes import SEEN_FROM, parse_spec, truth_json
from rtmap_cli.steps.simulate.worlds.degrade import degrade_map

Array = NDArray[np.float64]

CHANGES = ("delete:ped_crossing", "insert:divider", "insert:ped_crossing", "delete:divider")
PER_WORLD = 3
DRIVES = 3
SEEN_FRAMES = 4
"""A drive with so many frames near a change saw it."""
TOLD = 0.5
LEAST = 0.02
"""Changes below this probability are not written: they would fill the curve's tail."""
RECALL = 0.95
"""Recall at which false alarms are counted."""
BARS = {
    "one": {"F1": 0.90, "mAcc": 0.90, "false": 0.1},
    "three": {"F1": 0.99, "mAcc": 0.90, "false": 0.1},
}
EDGES = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 0.97, 1.0)
RUNS_CODE = ("geometry", "logs", "maps", "steps/simulate", "steps/localize")
CODE = ("geometry", "logs", "maps", "formats", "steps")


def digest(folders: Sequence[str]) -> str:
    """Six digits that are others when the code in some folders of the package is another."""
    package, here = Path(rtmap_cli.__file__).parent, Path(__file__).resolve().parents[1]
    files = [p for name in folders for p in sorted((package / name).rglob("*.py"))]
    files += [here / "changes/drives.py", here / "common/worlds.py"]
    return hashlib.sha256(b"".join(p.read_bytes() for p in files)).hexdigest()[:6]


@lru_cache
def places(data: Path) -> list[Place]:
    """The three maps."""
    return av2_places(data)


def make_runs(world: int, data: Path, folder: Path, prior_queries: bool = False) -> None:
    """Outdated map, truth and localized drives of a world; nothing where they are there."""
    if (folder / "done").exists():
        return
    place, kind = places(data)[world % 3], KINDS[world % len(KINDS)]
    specs = [parse_spec(CHANGES[(world + k) % len(CHANGES)]) for k in range(PER_WORLD)]
    old, changes, keys = outdated(place, kind, world, world, specs, DRIVES)
    folder.mkdir(parents=True, exist_ok=True)
    prior = degrade_map(old, 0.1, world)
    write_new_map(prior, folder / "prior", "outdated", overwrite=True)
    asked = prior if prior_queries else None
    paths = []
    for n, key in enumerate(keys):
        d = drive_through(place, kind, key, folder / f"{n:02d}", asked)
        command("localize", d.run, "--map", folder / "prior", "--smooth")
        paths.append(d.drive.pose[:, :2, 3])
    truth = truth_json(changes, place.world.crs)
    for told, change in zip(truth["changes"], changes, strict=True):
        p = change.points
        middle = p[:-1].mean(axis=0) if is_ring(p) else p[len(p) // 2]
        near = [(np.hypot(*(path - middle).T) <= SEEN_FROM).sum() for path in paths]
        told["seen_by"] = [k for k, count in enumerate(near) if count >= SEEN_FRAMES]
    (folder / "truth.json").write_text(json.dumps(truth), encoding="utf-8")
    (folder / "done").touch()


def judge_world(
    world: int, data: Path, runs: Path, keep: Path, prior_queries: bool = False
) -> dict[str, Any]:
    """What is told of a world from each drive alone and from all of them."""
    path = keep / f"{world:02d}.json"
    if path.exists():
        out: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return out
    folder = runs / f"{world:02d}"
    make_runs(world, data, folder, prior_queries)
    groups = [[k] for k in range(DRIVES)] + [list(range(DRIVES))]
    answers = [judged(folder, group) for group in groups]
    keep.mkdir(parents=True, exist_ok=True)
    result = plain({"world": world, "one": answers[:-1], "three": answers[-1:]})
    part = path.with_suffix(".part")
    part.write_text(json.dumps(result), encoding="utf-8")
    part.replace(path)
    return dict(result)


def judged(folder: Path, group: list[int]) -> dict[str, Any]:
    """Rows (verdict, probability, kind and class), kilometres and frames of one answer."""
    told = folder / f"changes-{'-'.join(map(str, group))}.geojson"
    command(
        "detect-changes", *(folder / f"{k:02d}" for k in group), "--map", folder / "prior",
        "-o", told, "--overwrite", "--min-probability", LEAST,
    )  # fmt: skip
    drives = [read_drives(str(folder / f"{k:02d}.truth" / "poses.parquet"))[0] for k in group]
    truth = folder / "truth.json"
    seen = {
        c["element_id"]: set(group) <= set(c["seen_by"])
        for c in json.loads(truth.read_text(encoding="utf-8"))["changes"]
    }
    rows = []
    for c in judge_changes(told, truth, 0.0, drives)["changes"]:
        # What the drives did not all see is neither asked for nor wrong to tell.
        if c["verdict"] == "false" or seen[c["element_id"]]:
            rows.append([c["verdict"], c["probability"], f"{c['kind']} {c['class']}"])
    frames = judge_changes(told, truth, TOLD, drives)["frame_level"]
    changed = frames["changed_frames"]
    return {
        "rows": rows,
        "km": sum(d.kilometres for d in drives),
        "changed": [round((frames["acc_changed"] or 0) * changed), changed],
        "unchanged": [
            round((frames["acc_unchanged"] or 0) * (frames["frames"] - changed)),
            frames["frames"] - changed,
        ],
    }


def figures(answers: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """All answers together: element and frame level, the operating point, calibration."""
    rows = [r for a in answers for r in a["rows"]]
    km = sum(a["km"] for a in answers)
    found = sorted((r[1] for r in rows if r[0] == "found"), reverse=True)
    false = np.array([r[1] for r in rows if r[0] == "false"])
    total = sum(r[0] != "false" for r in rows)
    tp, fp = sum(p >= TOLD for p in found), int((false >= TOLD).sum())
    right = {k: np.sum([a[k] for a in answers], axis=0) for k in ("changed", "unchanged")}
    accuracy = {k: float(v[0] / max(v[1], 1)) for k, v in right.items()}
    need = int(np.ceil(RECALL * total - 1e-9))
    point = found[need - 1] if 0 < need <= len(found) else None
    told = np.array(found + false.tolist())
    real = np.arange(len(told)) < len(found)
    kinds: dict[str, dict[str, int]] = {}
    for r in rows:
        counts = kinds.setdefault(r[2], {"found": 0, "missed": 0, "false": 0})
        weak = r[0] == "found" and r[1] < TOLD
        if r[0] != "false" or r[1] >= TOLD:
            counts["missed" if weak else r[0]] += 1
    return {
        "changes": total,
        "km": km,
        "found": tp,
        "missed": total - tp,
        "false": fp,
        "F1": 2 * tp / max(tp + fp + total, 1),
        "false_per_km": fp / km,
        "acc_c": accuracy["changed"],
        "acc_r": accuracy["unchanged"],
        "mAcc": (accuracy["changed"] + accuracy["unchanged"]) / 2,
        "point": point,
        "false_at_recall": None if point is None else float((false >= point).sum() / km),
        "brier": float(np.mean((told - real) ** 2)) if len(told) else None,
        "brier_base": float(real.mean() * (1 - real.mean())) if len(told) else None,
        "reliability": reliability(told, real),
        "kinds": kinds,
    }


def reliability(told: Array, real: NDArray[np.bool_]) -> list[dict[str, float]]:
    """Per bin of the told probability: how many, their mean, and the share that was real."""
    out = []
    for low, high in itertools.pairwise(EDGES):
        inside = (told >= low) & ((told < high) | (high == EDGES[-1]))
        if inside.any():
            out.append(
                {
                    "from": low,
                    "to": high,
                    "count": int(inside.sum()),
                    "told": float(told[inside].mean()),
                    "real": float(real[inside].mean()),
                }
            )
    return out


def shown(results: dict[str, dict[str, Any]]) -> list[str]:
    """The tables."""
    names = ["changes", "found", "missed", "false", "F1", "false_per_km", "acc_c", "acc_r", "mAcc"]
    rows = []
    for name, r in results.items():
        rows.append([f"after {name}", *(_number(r[k]) for k in names)])
    out = [*markdown(["simulated", *names], rows), ""]
    names = ["point", "false_at_recall", "brier", "brier_base"]
    rows = [[f"after {n}", *(_number(r[k]) for k in names)] for n, r in results.items()]
    header = [f"recall ≥ {RECALL:g}", "probability", "false per km", "Brier", "of the base rate"]
    out += [*markdown(header, rows), ""]
    for name, r in results.items():
        rows = [
            [f"{b['from']:g} to {b['to']:g}", b["count"], _number(b["told"]), _number(b["real"])]
            for b in r["reliability"]
        ]
        out += [*markdown([f"after {name}: told", "changes", "mean", "real"], rows), ""]
        rows = [[k, *v.values()] for k, v in sorted(r["kinds"].items())]
        out += [*markdown([f"after {name}", "found", "missed", "false"], rows), ""]
    return out


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}".rstrip("0").rstrip(".")


def verdicts(results: dict[str, dict[str, Any]]) -> list[Verdict]:
    """Every bar."""
    out = []
    for name, bars in BARS.items():
        r = results[name]
        after = f"after {name} traversal" + ("s" if name == "three" else "")
        out.append(Verdict(f"element F1 {after}", r["F1"], bars["F1"], 1.0))
        out.append(Verdict(f"mAcc (TbV, all frames) {after}", r["mAcc"], bars["mAcc"], 1.0))
        at = r["false_at_recall"]
        text = f"false alarms per km at recall {RECALL:g} {after}"
        out.append(Verdict(text, float("inf") if at is None else at, -np.inf, bars["false"]))
    return out


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=os.environ.get("RTMAP_DATA") or None)
    parser.add_argument("--worlds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="number (and seed) of the first world")
    parser.add_argument("--prior-queries", action="store_true")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--work", type=Path, default=Path("bench_changes"), help="what is kept")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args(arguments)
    if options.data is None:
        sys.exit("sample data folder not found, set RTMAP_DATA")
    return options


def measured(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The worlds one after the other, or by ``--jobs`` processes."""
    kind = "-asked" if options.prior_queries else ""
    runs = options.work / f"runs{kind}-{digest(RUNS_CODE)}"
    keep = options.work / f"figures{kind}-{digest(CODE)}"
    common = options.data, runs, keep, options.prior_queries
    worlds = range(options.first, options.first + options.worlds)
    if options.jobs == 1:
        for world in worlds:
            yield judge_world(world, *common)
        return
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
        jobs = [pool.submit(judge_world, w, *common) for w in worlds]
        for job in jobs:
            yield job.result()


def main(arguments: list[str] | None = None) -> int:
    """Measure what is not kept yet, print the tables and the verdicts."""
    options = parse(arguments)
    worlds = []
    for world in measured(options):
        worlds.append(world)
        print(f"world {world['world']}: done", file=sys.stderr, flush=True)
    results = {k: figures([a for w in worlds for a in w[k]]) for k in BARS}
    print("\n".join(shown(results)))
    judged_ = verdicts(results)
    print("\n".join(v.line for v in judged_))
    if options.json:
        options.json.write_text(json.dumps(plain(results), indent=1), encoding="utf-8")
    return int(any(not v.holds for v in judged_))


if __name__ == "__main__":
    sys.exit(main())
