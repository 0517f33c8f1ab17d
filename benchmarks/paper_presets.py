"""Do the simulated observations start where the RTMap paper starts, and how far does the chain get?

    python benchmarks/paper_presets.py ap                 single-frame AP of the presets
    python benchmarks/paper_presets.py ap --calibrate     find the noise multipliers again
    python benchmarks/paper_presets.py chain              localize, crowdsource, evaluate

Needs the three Argoverse 2 sensor logs of the sample data: set RTMAP_DATA or pass --data. Maps are
real; drives and observations are simulated. Prints one JSON object per line.
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
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from rtmap_cli.cli import run as rtmap
from rtmap_cli.formats.av2.vector_map import read_av2_archive, vector_map_of
from rtmap_cli.logs.run import OUTDATED, Run, read_run
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.element import CLASSES
from rtmap_cli.maps.store import read_map, write_new_map
from rtmap_cli.steps.evaluate.compare import Settings, compare
from rtmap_cli.steps.evaluate.drives import read_drives
from rtmap_cli.steps.evaluate.judge import judge_poses
from rtmap_cli.steps.evaluate.poses import pool_poses
from rtmap_cli.steps.evaluate.precision import MapScore, Scorer
from rtmap_cli.steps.simulate.driving.drives import drive_over_route, with_traffic
from rtmap_cli.steps.simulate.driving.routes import KINDS, corridor, find_routes, lanes_of_av2
from rtmap_cli.steps.simulate.perceiving.observations import observe
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
from rtmap_cli.steps.simulate.perceiving.presets import PRESETS, Preset
from rtmap_cli.steps.simulate.worlds.degrade import degrade_map

LOGS = ("7fab2350", "adcf7d18", "3bffdcff")
PAPER = {  # RTMap, Table 1, MapTRv2 rows: crossing, divider, boundary
    "straight": (31.7, 42.0, 37.3),
    "turning": (28.2, 31.6, 18.3),
}
ROUTE_LENGTH, SPACING, RATE = 180.0, 5.0, 1.0
EVERY = 2
"""Fused maps are judged at every other frame."""


class Place:
    """One Argoverse 2 map: its elements, its lanes, its index for crops."""

    def __init__(self, folder: Path) -> None:
        archive = read_av2_archive(folder)
        self.folder, self.name = folder, folder.name[:8]
        self.world = vector_map_of(archive)
        self.lanes = lanes_of_av2(archive)
        self.index = MapIndex(self.world, join=True)

    @lru_cache  # noqa: B019 - three places live as long as the process
    def corridor(self, kind: str, world_seed: int) -> list[np.ndarray]:
        """The routes of one world."""
        return corridor(find_routes(self.lanes, kind, ROUTE_LENGTH), world_seed)

    def observe(self, kind: str, preset: Preset, key: DriveKey) -> tuple[Run, np.ndarray]:
        """One simulated drive without a prior, and its true poses."""
        routes = self.corridor(kind, key.world_seed)
        route = routes[(key.seed + key.traversal) % len(routes)]
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


def add_frames(
    scorer: Scorer, run: Run, poses: np.ndarray, index: MapIndex, rows: Iterable[int] | None = None
) -> None:
    """Score frames of a run (default: all) against the world cropped at the true poses."""
    o = run.observations
    for row in range(len(poses)) if rows is None else rows:
        pose = poses[row]
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
    """Three drives per map and kind: localize, crowdsource drive by drive, evaluate."""
    for kind in options.kinds:
        rows = []
        for place in maps:
            with tempfile.TemporaryDirectory() as folder:
                work = Path(options.keep or folder) / place.name / kind
                rows.append(chain_of(place, kind, work, options))
            report(map=place.name, kind=kind, **rows[-1])
        report(kind=kind, mean_over_maps=mean_of(rows))


def chain_of(place: Place, kind: str, work: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Pose errors before and after localize, and AP over the cycles, on one map.

    All APs are taken at the same frames: those of all drives, in the part of the corridor that
    every drive passed. A map of one drive is judged where the map of three is.
    """
    started = time.perf_counter()
    command("import", "av2", place.folder, "-o", work / "world")
    prior = degrade_map(read_map(work / "world"), options.prior_sigma, options.seed)
    write_new_map(prior, work / "prior", f"the world with an error of {options.prior_sigma} m")
    asked = ("--prior", work / "prior") if options.prior_queries else ()
    runs = [work / "runs" / f"{number:02d}" for number in range(options.cycles)]
    for number, run in enumerate(runs):
        command(
            "simulate", "observations", "--map", work / "world", "--log", f"av2:{place.folder}",
            "--route", kind, "--preset", f"rtmap-{kind}", "--seed", options.seed,
            "--traversal", number, "-o", run, *asked,
        )  # fmt: skip
    truths = [run.with_name(f"{run.name}.truth.parquet") for run in runs]
    poses = {
        "initial": judged(runs, truths, True),
        "single": localized(runs, truths, work / "prior"),
        "smooth": localized(runs, truths, work / "prior", "--smooth"),
    }
    drives = [read_drives(truth)[0] for truth in truths]
    shared = shared_frames([d.pose for d in drives])
    single = Scorer(CLASSES)
    for run, drive, kept in zip(runs, drives, shared, strict=True):
        add_frames(single, read_run(run), drive.pose, place.index, np.flatnonzero(kept))
    scores = {"single_frame": percent(single.result())}
    judged_at = [
        replace(d, timestamp_ns=d.timestamp_ns[k][::EVERY], pose=d.pose[k][::EVERY])
        for d, k in zip(drives, shared, strict=True)
    ]
    for cycle, run in enumerate(runs, start=1):
        # The folder of runs grows drive by drive, as it does every night for a fleet.
        shutil.copytree(run, work / "fleet" / run.name)
        command("crowdsource", work / "fleet", "--map", work / "map")
        score = compare(read_map(work / "map"), place.world, judged_at, Settings())
        scores[f"cycle_{cycle}"] = percent(score)
    command("crowdsource", work / "runs", "--map", work / "batch")
    score = compare(read_map(work / "batch"), place.world, judged_at, Settings())
    scores["all_at_once"] = percent(score)
    share = float(np.mean(np.concatenate(shared)))
    seconds = time.perf_counter() - started
    return {"poses": poses, "ap": scores, "shared_frames": share, "seconds": round(seconds)}


def localized(runs: list[Path], truths: list[Path], prior: Path, *flags: str) -> dict[str, float]:
    """Errors after localizing every run on the prior."""
    for run in runs:
        command("localize", run, "--map", prior, *flags)
    return judged(runs, truths, False)


def judged(runs: list[Path], truths: list[Path], initial: bool) -> dict[str, float]:
    """Errors of the initial or localized poses of all runs together."""
    pairs = zip(runs, truths, strict=True)
    parts = [judge_poses(read_run(run), str(truth), initial=initial) for run, truth in pairs]
    return pose_errors(pool_poses(parts).as_json())


def shared_frames(paths: list[np.ndarray], near: float = 10.0) -> list[np.ndarray]:
    """Per drive, which frames lie within ``near`` metres of the path of every drive."""
    trees = [cKDTree(path[:, :2, 3]) for path in paths]
    return [
        np.all([tree.query(path[:, :2, 3])[0] <= near for tree in trees], axis=0) for path in paths
    ]


def command(*arguments: object) -> None:
    """Run one rtmap command quietly; what it says on failure ends the benchmark."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = rtmap([str(a) for a in arguments])
    if code not in (0, 4):
        sys.exit(f"rtmap {' '.join(map(str, arguments))}: exit {code}\n{said.getvalue()}")


def percent(score: MapScore) -> dict[str, float]:
    """AP by class and mAP in %."""
    values = {name: c.mean for name, c in score.classes.items()} | {"mAP": score.mAP}
    return {name: round(100 * v, 1) for name, v in values.items()}


def pose_errors(result: dict[str, Any]) -> dict[str, float]:
    """Mean and 90th percentile errors over all frames, and how honest their covariances are."""
    names, frames = ("lateral_m", "longitudinal_m", "yaw_deg"), result["all_frames"]
    out = {f"{k}_{what}": round(frames[k][what], 3) for k in names for what in ("mean", "p90")}
    out["answered"] = result["share_answered"]
    inside = (result.get("consistency") or {}).get("inside", {})
    return out | {f"in_{k}": round(v["all"], 3) for k, v in inside.items()}


def mean_of(rows: list[Any]) -> Any:
    """Mean of equally built nested dicts of numbers."""
    if isinstance(rows[0], dict):
        return {k: mean_of([r[k] for r in rows]) for k in rows[0]}
    return round(float(np.mean(rows)), 3)


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["ap", "chain"])
    parser.add_argument("--data", type=Path, default=os.environ.get("RTMAP_DATA"))
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
    if options.data is None:
        sys.exit("sample data folder not found, set RTMAP_DATA")
    (measure if options.what == "ap" else chain)(places(Path(options.data)), options)


if __name__ == "__main__":
    main()
