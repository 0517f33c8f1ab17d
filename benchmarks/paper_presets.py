"""Do the simulated observations start where the RTMap paper starts, and how far does the chain get?

    python benchmarks/paper_presets.py ap                 single-frame AP of the presets
    python benchmarks/paper_presets.py ap --calibrate     find the noise multipliers again
    python benchmarks/paper_presets.py chain              localize, crowdsource, evaluate

Needs the three Argoverse 2 sensor logs of the sample data: set RTMAP_DATA or pass --data. Maps are
real; drives and observations are simulated. Prints one JSON object per line.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rtmap_cli.formats.av2_map import read_av2_archive, vector_map_of
from rtmap_cli.logs.run import OUTDATED, Run
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.element import CLASSES
from rtmap_cli.steps.evaluate.precision import Scorer
from rtmap_cli.steps.simulate.drives import drive_over_route, with_traffic
from rtmap_cli.steps.simulate.observations import observe
from rtmap_cli.steps.simulate.perception import DriveKey
from rtmap_cli.steps.simulate.presets import PRESETS, Preset
from rtmap_cli.steps.simulate.routes import KINDS, lanes_of_av2, route_of

LOGS = ("7fab2350", "adcf7d18", "3bffdcff")
PAPER = {  # RTMap, Table 1, MapTRv2 rows: crossing, divider, boundary
    "straight": (31.7, 42.0, 37.3),
    "turning": (28.2, 31.6, 18.3),
}
ROUTE_LENGTH, SPACING, RATE = 180.0, 2.5, 2.0


class Place:
    """One Argoverse 2 map: its elements, its lanes, its index for crops."""

    def __init__(self, folder: Path) -> None:
        archive = read_av2_archive(folder)
        self.folder, self.name = folder, folder.name[:8]
        self.world = vector_map_of(archive)
        self.lanes = lanes_of_av2(archive)
        self.index = MapIndex(self.world, join=True)

    def observe(self, kind: str, preset: Preset, key: DriveKey) -> tuple[Run, np.ndarray]:
        """One simulated drive without a prior, and its true poses."""
        number = key.seed + key.traversal
        route = route_of(self.lanes, kind, ROUTE_LENGTH, key.world_seed, number)
        drive = drive_over_route(self.name, self.world.crs, route, SPACING, RATE, 0.0, key)
        run, _ = observe(self.world, with_traffic(drive, preset, key), preset, key, self.name)
        return run, drive.pose


def places(data: Path) -> list[Place]:
    """The three maps."""
    found = [sorted((data / "av2_sensor").glob(f"{name}-*")) for name in LOGS]
    if not all(found):
        sys.exit("sample data folder not found, set RTMAP_DATA")
    return [Place(folders[0]) for folders in found]


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
                run, poses = place.observe(kind, preset, DriveKey(world, seed, number))
                add_frames(scorer, run, poses, place.index)
        result = scorer.result()
        per_map[place.name] = [100 * result.classes[c].mean for c in CLASSES]
    mean = np.mean(list(per_map.values()), axis=0)
    return {"mean": mean.tolist(), "mAP": float(mean.mean()), "maps": per_map}


def add_frames(scorer: Scorer, run: Run, poses: np.ndarray, index: MapIndex) -> None:
    """Score every frame of a run against the world cropped at the true poses."""
    o = run.observations
    for row, pose in enumerate(poses):
        found = np.flatnonzero((o.frame == row) & (o.state != OUTDATED))
        pred = [(str(o.class_name[k]), o.points[k], float(o.score[k])) for k in found]
        scorer.add(pred, [(e.class_name, e.points, 1.0) for e in index.crop(pose)])


def measure(maps: list[Place], options: argparse.Namespace) -> None:
    """Print the single-frame AP of both presets beside the paper's rows."""
    for kind in options.kinds:
        preset = PRESETS[f"rtmap-{kind}"]
        if options.calibrate:
            preset = calibrated(maps, kind, preset, options)
        got = single_frame_ap(maps, kind, preset, options.worlds, options.drives)
        off = np.array(got["mean"]) - PAPER[kind]
        report(
            preset=f"rtmap-{kind}",
            noise={c: round(v, 3) for c, v in preset.noise.items()},
            ap=dict(zip(CLASSES, np.round(got["mean"], 1).tolist(), strict=True)),
            mAP=round(got["mAP"], 1),
            paper=dict(zip(CLASSES, PAPER[kind], strict=True)),
            paper_mAP=round(float(np.mean(PAPER[kind])), 1),
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
        off = ap - PAPER[kind]
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
    """Run the chain of commands on every map and kind; a folder keeps what it wrote."""
    from chain_commands import run_chain

    for kind in options.kinds:
        rows = []
        for place in maps:
            with tempfile.TemporaryDirectory() as folder:
                work = Path(options.keep or folder) / place.name / kind
                rows.append(run_chain(place.folder, kind, work, options.seed, report))
        report(kind=kind, mean_over_maps=mean_of(rows))


def mean_of(rows: list[Any]) -> Any:
    """Mean of equally built nested dicts of numbers."""
    if isinstance(rows[0], dict):
        return {k: mean_of([r[k] for r in rows]) for k in rows[0]}
    return round(float(np.mean(rows)), 4)


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["ap", "chain"])
    parser.add_argument("--data", type=Path, default=os.environ.get("RTMAP_DATA"))
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--calibrate", action="store_true", help="search the noise multipliers")
    parser.add_argument("--rounds", type=int, default=6, help="steps of the search")
    parser.add_argument("--worlds", type=int, default=3, help="worlds (and corridors) per map")
    parser.add_argument("--drives", type=int, default=4, help="drives per world")
    parser.add_argument("--seed", type=int, default=1, help="seed of the chain")
    parser.add_argument("--keep", help="folder for the files of the chain (default: none kept)")
    options = parser.parse_args()
    if options.data is None:
        sys.exit("sample data folder not found, set RTMAP_DATA")
    (measure if options.what == "ap" else chain)(places(Path(options.data)), options)


if __name__ == "__main__":
    main()
