"""Do the simulated observations start where the RTMap paper starts, and how far does the chain get?

    python -m benchmarks.paper.presets ap                 single-frame AP of the presets
    python -m benchmarks.paper.presets ap --calibrate     find the noise multipliers again
    python -m benchmarks.paper.presets chain              localize, crowdsource, evaluate

Maps are the three Argoverse 2 ones of the sample data (set RTMAP_DATA or pass --data), or with
--towns simulated towns; drives and observations are simulated. Prints one JSON object per line.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.places import BASELINE, Place, add_frames, av2_places, mean_of, town_places
from benchmarks.common.worlds import Mapping, map_world
from rtmap_cli.maps.element import CLASSES
from rtmap_cli.steps.evaluate.maps.precision import Scorer
from rtmap_cli.steps.simulate.driving.routes import KINDS
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
from rtmap_cli.steps.simulate.perceiving.presets import PRESETS, Preset

SPACING, RATE = 5.0, 1.0


def single_frame_ap(
    maps: list[Place], kind: str, preset: Preset, worlds: int, drives: int
) -> dict[str, Any]:
    """AP per class in %, all frames of a map together, and their mean over the maps."""
    per_map = {}
    for seed, place in enumerate(maps, start=1):
        scorer = Scorer(CLASSES)
        for world in range(worlds):
            for number in range(drives):
                # Another seed per map, or the same traffic would drive through all three.
                key = DriveKey(world, seed, number)
                drive = place.drive(kind, key, SPACING, RATE)
                run = place.observe(drive, preset, key)
                add_frames(scorer, run, drive.pose, place.index)
        result = scorer.result()
        per_map[place.name] = [100 * result.classes[c].mean for c in CLASSES]
    mean = np.mean(list(per_map.values()), axis=0)
    return {"mean": mean.tolist(), "mAP": float(mean.mean()), "maps": per_map}


def measure(maps: list[Place], options: argparse.Namespace) -> None:
    """Print the single-frame AP of both presets beside the paper's rows."""
    for kind in options.kinds:
        preset = PRESETS[f"rtmap-{kind}"]
        if options.calibrate:
            preset = calibrated(maps, kind, preset, options)
        got = single_frame_ap(maps, kind, preset, options.worlds, options.drives)
        off = np.array(got["mean"]) - BASELINE[kind]
        report(
            preset=f"rtmap-{kind}",
            noise={c: round(v, 3) for c, v in preset.noise.items()},
            ap=dict(zip(CLASSES, np.round(got["mean"], 1).tolist(), strict=True)),
            mAP=round(got["mAP"], 1),
            paper=dict(zip(CLASSES, BASELINE[kind], strict=True)),
            paper_mAP=round(float(np.mean(BASELINE[kind])), 1),
            within=bool((np.abs(off) <= 1.5).all() and abs(off.mean()) <= 0.7),
            maps={k: np.round(v, 1).tolist() for k, v in got["maps"].items()},
        )


def calibrated(maps: list[Place], kind: str, preset: Preset, options: argparse.Namespace) -> Preset:
    """The preset with the noise that gives the paper's AP: a secant step per class and round."""
    noise = np.array([preset.noise[c] for c in CLASSES])
    slope = np.full(3, -35.0)  # AP in % per unit of log noise, a first guess
    before = None
    for step in range(options.rounds):
        preset = replace(preset, noise=dict(zip(CLASSES, noise.tolist(), strict=True)))
        got = single_frame_ap(maps, kind, preset, options.worlds, options.drives)
        ap = np.array(got["mean"])
        report(
            round=step, kind=kind, noise=np.round(noise, 3).tolist(), ap=np.round(ap, 1).tolist()
        )
        off = ap - BASELINE[kind]
        if (np.abs(off) <= 0.3).all():
            break
        if before is not None:
            moved = np.log(noise) - np.log(before[0])
            far = np.abs(moved) > 0.02
            measured = (ap - before[1]) / np.where(far, moved, 1.0)
            slope = np.where(far, np.clip(measured, -80.0, -15.0), slope)
        before = (noise, ap)
        noise = noise * np.exp(np.clip(-off / slope, -0.4, 0.4))
    return preset


def report(**values: Any) -> None:
    """One JSON object per line."""
    print(json.dumps(values), flush=True)


def chain(maps: list[Place], options: argparse.Namespace) -> None:
    """Drives per map and kind: localize, crowdsource drive by drive, evaluate."""
    what = Mapping(
        cycles=tuple(range(1, options.cycles + 1)),
        ablate=False,
        prior_sigma=options.prior_sigma,
        prior_queries=options.prior_queries,
        methods={"single": (), "smooth": ("--smooth",)},
    )
    for kind in options.kinds:
        rows = []
        for place in maps:
            started = time.perf_counter()
            with tempfile.TemporaryDirectory() as folder:
                work = Path(options.keep or folder) / place.name / kind
                row = map_world(place, kind, 0, options.seed, work, what)
            rows.append(row)
            seconds = round(time.perf_counter() - started)
            report(map=place.name, kind=kind, **rounded(row), seconds=seconds)
        report(kind=kind, mean_over_maps=rounded(mean_of(rows)))


def rounded(value: Any) -> Any:
    """Numbers of a nested dict to three decimals."""
    if isinstance(value, dict):
        return {k: rounded(v) for k, v in value.items()}
    return None if value is None else round(value, 3)


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["ap", "chain"])
    parser.add_argument("--data", type=Path, default=os.environ.get("RTMAP_DATA"))
    parser.add_argument("--towns", action="store_true", help="simulated towns, not real maps")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--calibrate", action="store_true", help="search the noise multipliers")
    parser.add_argument("--rounds", type=int, default=6, help="steps of the search")
    parser.add_argument("--worlds", type=int, default=3, help="worlds (and corridors) per map")
    parser.add_argument("--drives", type=int, default=2, help="drives per world")
    parser.add_argument("--seed", type=int, default=1, help="seed of the chain")
    parser.add_argument("--cycles", type=int, default=3, help="drives of the chain, one a cycle")
    parser.add_argument("--prior-sigma", type=float, default=0.1, help="error of the prior (m)")
    parser.add_argument("--prior-queries", action="store_true", help="simulate with the prior")
    parser.add_argument("--keep", help="folder for the files of the chain (default: none kept)")
    options = parser.parse_args()
    if options.data is None and not options.towns:
        sys.exit("sample data folder not found, set RTMAP_DATA or pass --towns")
    maps = town_places() if options.towns else av2_places(Path(options.data))
    (measure if options.what == "ap" else chain)(maps, options)


if __name__ == "__main__":
    main()
