"""Change detection by what the shipped network sees, over towns with known changes.

    python -m benchmarks.changes.network                    20 towns, three drives each
    python -m benchmarks.changes.network --worlds 4 --jobs 2 --json changes.json

As changes/drives.py, but from images: simulated towns that the model did not see in training, three
drives each through rendered cameras, read by `rtmap infer` with the outdated map as prior (0.25 m
off), localized on it, judged alone and together. Towns whose drives share no road, or have no
room for a change, are passed over. The network is shown what the map says: how easily it is talked
into what is gone, and how hard it finds what the map does not have, is what this measures. Runs are
kept in --work. Images are simulated. There are no bars; exit code 0.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import multiprocessing
import shutil
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.changes.drives import DRIVES, SEEN_FRAMES, figures, judged, shown
from benchmarks.common.places import command
from rtmap_cli.maps.crs import lonlat_to
from rtmap_cli.maps.store import read_map
from rtmap_cli.output import plain
from rtmap_cli.steps.evaluate.drives import read_drives
from rtmap_cli.steps.simulate.worlds.changes import SEEN_FROM

KINDS = (
    "delete:boundary",
    "delete:ped_crossing",
    "insert:ped_crossing",
    "delete:divider",
    "insert:divider",
)
"""Changes of a town; where it has no room for all, the first ones are left out."""
PRIOR_SIGMA = 0.25
FRAMES, WIDTH = 64, 256
TRIES = 4
"""So many seeds are tried for every town that is asked for."""


def town_of(seed: int, model: str, folder: Path) -> bool:
    """Town, outdated map, truth and localized runs of a seed; False where there is no such town."""
    if (folder / "none").exists():
        return False
    if not (folder / "done").exists():
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "logs").mkdir(parents=True)
        if not outdated_town(seed, folder):
            shutil.rmtree(folder)
            folder.mkdir()
            (folder / "none").touch()
            return False
        for k in range(DRIVES):
            log, run = folder / "logs" / str(k), folder / f"{k:02d}"
            command("infer", log, "--map", folder / "prior", "--model", model, "-o", run, "-q")
            command("localize", run, "--map", folder / "prior", "--smooth")
            (log / "truth").rename(folder / f"{k:02d}.truth")
        told_seen(folder)
        shutil.rmtree(folder / "logs")
        (folder / "done").touch()
    return True


def outdated_town(seed: int, folder: Path) -> bool:
    """The town, its drives and the outdated map of it; False where that cannot be."""
    common = ("--seed", seed)
    command("simulate", "town", *common, "-o", folder / "town")
    near: list[object] = []
    for k in range(DRIVES):
        log = folder / "logs" / str(k)
        command(
            "simulate", "images", "--map", folder / "town", "--log", "town:", "--drive", k + 1,
            "--frames", FRAMES, "--width", WIDTH, "--route", "turning" if seed % 2 else "straight",
            *common, "-q", "-o", log,
        )  # fmt: skip
        if not log.exists():
            return False
        near += ["--near", log]
    for first in range(len(KINDS)):
        specs = [word for kind in KINDS[first:] for word in ("--change", kind)]
        command(
            "simulate", "changes", "--map", folder / "town", "--outdate", *specs, *near, *common,
            "-o", folder / "stale", "--truth", folder / "truth.json",
        )  # fmt: skip
        if (folder / "stale").exists():
            break
    else:
        return False
    degraded = ("--sigma", PRIOR_SIGMA, *common, "-o", folder / "prior")
    command("simulate", "degrade", "--map", folder / "stale", *degraded)
    return True


def told_seen(folder: Path) -> None:
    """Write into the truth which drives came near each change, as changes/drives.py has it."""
    crs = read_map(folder / "prior").crs
    places = [folder / f"{k:02d}.truth" / "poses.parquet" for k in range(DRIVES)]
    paths = [read_drives(str(p))[0].pose[:, :2, 3] for p in places]
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    for change in truth["changes"]:
        g = change["geometry"]
        ring = g["type"] == "Polygon"
        xy = lonlat_to(crs, np.array(g["coordinates"][0][:-1] if ring else g["coordinates"]))
        middle = xy.mean(axis=0) if ring else xy[len(xy) // 2]
        near = [(np.hypot(*(path - middle).T) <= SEEN_FROM).sum() for path in paths]
        change["seen_by"] = [k for k, count in enumerate(near) if count >= SEEN_FRAMES]
    (folder / "truth.json").write_text(json.dumps(truth), encoding="utf-8")


def judge_town(seed: int, model: str, work: Path) -> dict[str, Any] | None:
    """What is told of a town from each drive alone and from all; None where there is no town."""
    folder = work / str(seed)
    if not town_of(seed, model, folder):
        return None
    answers = [judged(folder, [k]) for k in range(DRIVES)]
    return {"one": answers, "three": [judged(folder, list(range(DRIVES)))]}


def main(arguments: list[str] | None = None) -> int:
    """Make what is not kept yet, print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--worlds", type=int, default=20)
    parser.add_argument("--first", type=int, default=7000, help="seed of the first town")
    parser.add_argument("--model", default="rtmap-tiny")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--work", type=Path, default=Path("bench_network"), help="what is kept")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args(arguments)
    seeds = range(options.first, options.first + TRIES * options.worlds)
    found: list[dict[str, Any]] = []
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
        # As many at a time as are still missing, so that none is made in vain.
        while len(found) < options.worlds and seeds:
            some = seeds[: options.worlds - len(found)]
            seeds = seeds[len(some) :]
            jobs = [pool.submit(judge_town, s, options.model, options.work) for s in some]
            for seed, job in zip(some, jobs, strict=True):
                town = job.result()
                print(f"town {seed}: {'done' if town else 'none'}", file=sys.stderr, flush=True)
                found += [town] if town else []
    if not found:
        sys.exit("no town with room for a change: try another --first")
    results = {k: figures([a for town in found for a in town[k]]) for k in ("one", "three")}
    print(f"{len(found)} simulated towns, {options.model}\n")
    print("\n".join(shown(results)))
    if options.json:
        options.json.write_text(json.dumps(plain(results), indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
