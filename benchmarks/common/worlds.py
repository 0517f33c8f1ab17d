"""What is measured in one world for the paper's tables: mapping, changes, localization, network.

A world is a place with its seed (worn paint, errors that every drive makes there) and a corridor.
Steps run as rtmap commands on files; truth is opened by the evaluation only. Every function works
in an empty folder and returns plain numbers, so that worlds may run in any order.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping as MappingOf
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.places import (
    Place,
    add_frames,
    command,
    percent,
    pose_summary,
    shared_frames,
)
from rtmap_cli.errors import BadInput, NoAnswer
from rtmap_cli.logs.run import MATCHED, OUTDATED, Run, true_poses
from rtmap_cli.logs.run_files import copy_run, read_run, write_poses, write_run
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import read_map, write_new_map
from rtmap_cli.steps.evaluate.changes.elements import changed_frames
from rtmap_cli.steps.evaluate.drives import Drive as TrueDrive
from rtmap_cli.steps.evaluate.drives import read_drives
from rtmap_cli.steps.evaluate.judge import judge_poses
from rtmap_cli.steps.evaluate.maps.compare import Settings, compare
from rtmap_cli.steps.evaluate.maps.precision import Scorer
from rtmap_cli.steps.evaluate.poses import pose_errors
from rtmap_cli.steps.simulate.driving.drives import Drive
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
from rtmap_cli.steps.simulate.worlds.changes import (
    Change,
    ChangeSpec,
    change_world,
    common_path,
    truth_json,
)
from rtmap_cli.steps.simulate.worlds.degrade import degrade_map

Array = NDArray[np.float64]

SPACING, RATE = 2.5, 2.0
EVERY = 2
"""Fused maps are judged at every other frame."""
JUDGED = 3
"""... of the first drives, in the part of the corridor that all of these passed."""
TOLD = 0.5
"""A frame alone says "changed" from this score or existence on."""


@dataclass(frozen=True)
class Mapping:
    """How a world is mapped: ``cycles`` after which the map is judged (a drive each), ``ablate``
    also without U, the prior that drives are localized on and whether they are asked about it,
    ``methods``: names and flags of `rtmap localize`; the map is made from the last one's poses."""

    cycles: Sequence[int] = (1, 2, 3, 5, 10)
    ablate: bool = True
    prior_sigma: float = 0.1
    prior_queries: bool = False
    methods: MappingOf[str, Sequence[str]] = field(
        default_factory=lambda: {"smooth": ("--smooth",)}
    )


@dataclass(frozen=True)
class Driven:
    """A simulated drive: its run and its true poses on disk, and the truth at hand."""

    run: Path
    truth: Path
    drive: Drive


def drive_through(
    place: Place, kind: str, key: DriveKey, run: Path, prior: VectorMap | None = None
) -> Driven:
    """One drive observed and written, its true poses beside the run."""
    drive = place.drive(kind, key, SPACING, RATE)
    seen = place.observe(drive, kind, key, prior)
    run.mkdir(parents=True)
    write_run(seen, run)
    truth = run.with_name(f"{run.name}.truth")
    truth.mkdir()
    write_poses(true_poses(seen.frames.frame, drive.timestamp_ns, drive.pose), truth, drive.crs)
    return Driven(run, truth / "poses.parquet", drive)


def map_world(
    place: Place, kind: str, world_seed: int, seed: int, work: Path, what: Mapping
) -> dict[str, Any]:
    """Tab. 1: pose errors, and AP (%) of one frame and of the map after each cycle.

    All APs are taken at the same frames, so that a map of one drive is judged where the map of
    ten is. The map starts from nothing; drives are localized on a prior of ``prior_sigma``.
    """
    prior = degrade_map(place.world, what.prior_sigma, seed)
    write_new_map(prior, work / "prior", f"the world with an error of {what.prior_sigma} m")
    asked = prior if what.prior_queries else None
    drives = [
        drive_through(place, kind, DriveKey(world_seed, seed, n), work / "runs" / f"{n:02d}", asked)
        for n in range(max(what.cycles))
    ]
    poses = {"initial": judged(drives, initial=True)}
    for name, flags in what.methods.items():
        for d in drives:
            command("localize", d.run, "--map", work / "prior", *flags)
        poses[name] = judged(drives)
    first = drives[:JUDGED]
    shared = shared_frames([d.drive.pose for d in first])
    single = Scorer(place.classes)
    for d, kept in zip(first, shared, strict=True):
        add_frames(single, read_run(d.run), d.drive.pose, place.index, np.flatnonzero(kept))
    where = [
        TrueDrive(d.run.name, place.world.crs, d.drive.timestamp_ns[k], d.drive.pose[k])
        for d, k in zip(first, (np.flatnonzero(s)[::EVERY] for s in shared), strict=True)
    ]
    ap = {"one frame": percent(single.result())}
    ap |= fused(place, drives, where, work, what)
    share = float(np.mean(np.concatenate(shared)))
    return {"poses": poses, "ap": ap, "shared_frames": share}


def fused(
    place: Place, drives: Sequence[Driven], where: list[TrueDrive], work: Path, what: Mapping
) -> dict[str, Any]:
    """AP (%) of the maps over the cycles; the folder of runs grows as it does for a fleet."""
    out = {}
    variants = {"": (), " w/o U": ("--without-sigma",)} if what.ablate else {"": ()}
    for cycle, d in enumerate(drives, start=1):
        shutil.copytree(d.run, work / "fleet" / d.run.name)
        if cycle not in what.cycles:
            continue
        for name, flags in variants.items():
            target = work / f"map{name.replace('/', '').replace(' ', '-')}"
            command("crowdsource", work / "fleet", "--map", target, *flags)
            score = compare(read_map(target), place.world, where, Settings())
            out[f"cycle {cycle}{name}"] = percent(score)
    return out


def judged(drives: Sequence[Driven], initial: bool = False) -> dict[str, float]:
    """Pose errors of all drives together, of the initial or the localized poses."""
    return pose_summary(
        [judge_poses(read_run(d.run), str(d.truth), initial=initial) for d in drives]
    )


# ---- outdated maps


def outdated(
    place: Place, kind: str, world_seed: int, seed: int, specs: Sequence[ChangeSpec], count: int
) -> tuple[VectorMap, list[Change], list[DriveKey]]:
    """An outdated map of a world, what has changed since, and the drives that pass it.

    A change for which the corridor has no place is left out.
    """
    keys = [DriveKey(world_seed, seed, n) for n in range(count)]
    paths = [place.drive(kind, key, SPACING, RATE).pose[:, :2, 3] for key in keys]
    rng = np.random.default_rng([world_seed, seed, 61])
    try:
        near = common_path(paths)
    except NoAnswer:
        near = paths[0]
    old = place.world
    changes: list[Any] = []
    for spec in specs:
        try:
            old, made = apart(old, spec, rng, near, changes)
        except NoAnswer:
            continue
        changes += made
    return old, [c.flipped() for c in changes], keys


def apart(
    old: VectorMap, spec: ChangeSpec, rng: np.random.Generator, near: Array, before: list[Change]
) -> tuple[VectorMap, list[Change]]:
    """One more change, 20 m or more from the middles of those before."""
    for other in before:
        near = near[np.hypot(*(near - other.points.mean(axis=0)).T) > 34.0]
    if not len(near):
        raise NoAnswer("no place is left")
    return change_world(old, [spec.inverse()], rng, near)


def changes_of(
    place: Place, kind: str, world_seed: int, seed: int, work: Path, specs: Sequence[ChangeSpec]
) -> dict[str, Any]:
    """Tab. 2: the counts of `rtmap evaluate changes` for a frame alone, one drive and three."""
    old, changes, keys = outdated(place, kind, world_seed, seed, specs, 3)
    prior = degrade_map(old, 0.1, seed)
    write_new_map(prior, work / "prior", "outdated")
    truth = work / "truth.json"
    truth.write_text(json.dumps(truth_json(changes, place.world.crs)), encoding="utf-8")
    drives = [
        drive_through(place, kind, key, work / "runs" / f"{n:02d}", prior)
        for n, key in enumerate(keys)
    ]
    for d in drives:
        command("localize", d.run, "--map", work / "prior", "--smooth")
    classes = {spec.class_name for spec in specs}
    alone = [frame_answers(read_run(d.run), classes) for d in drives]
    truly = [changed_frames(d.drive.pose[:, :2, 3], [c.points for c in changes]) for d in drives]
    out = {"changes": len(changes), "a frame alone": told_of(truly, alone)}
    for name, groups in (("one drive", [[d] for d in drives]), ("three drives", [drives])):
        parts = [detected(g, drives, work, classes) for g in groups]
        out[name] = {k: sum(p[k] for p in parts) for k in parts[0]}
    return out


def frame_answers(run: Run, classes: set[str]) -> NDArray[np.bool_]:
    """(n,) whether the network's own answers of a frame hold a change nearer than 20 m."""
    o = run.observations
    gone = (o.state == OUTDATED) & (o.existence <= 1 - TOLD)
    new = (o.state != OUTDATED) & (o.state != MATCHED) & (o.score >= TOLD)
    near = np.hypot(o.points[..., 0], o.points[..., 1]).min(axis=1) < 20.0
    said = (gone | new) & near & np.isin(o.class_name, list(classes))
    rows = {int(f): i for i, f in enumerate(run.frames.frame)}
    out = np.zeros(len(run.frames), bool)
    out[[rows[int(f)] for f in o.frame[said]]] = True
    return out


def told_of(
    truly: Sequence[NDArray[np.bool_]], said: Sequence[NDArray[np.bool_]]
) -> dict[str, int]:
    """Frames, changed and unchanged, and how many of each were answered rightly."""
    t, s = np.concatenate(truly), np.concatenate(said)
    return {
        "changed": int(t.sum()), "changed_right": int((t & s).sum()),
        "unchanged": int((~t).sum()), "unchanged_right": int((~t & ~s).sum()),
    }  # fmt: skip


def detected(
    group: Sequence[Driven], drives: Sequence[Driven], work: Path, classes: set[str]
) -> dict[str, int]:
    """Counts of what `rtmap detect-changes` tells from some of the drives."""
    found = work / "changes.geojson"
    command(
        "detect-changes", *(d.run for d in group), "--map", work / "prior", "-o", found,
        "--overwrite",
    )  # fmt: skip
    keep_classes(found, classes)
    out = {name: 0 for name in (*told_of([np.zeros(0, bool)], [np.zeros(0, bool)]),)}
    out |= {"found": 0, "missed": 0, "false": 0, "metres": 0}
    for k, d in enumerate(group):
        said = json.loads(
            command(
                "evaluate", "changes", found, "--truth", work / "truth.json",
                "--poses", d.truth, "--json",
            )
        )  # fmt: skip
        level = said["frame_level"]
        n, changed = level["frames"], level["changed_frames"]
        out["changed"] += changed
        out["unchanged"] += n - changed
        out["changed_right"] += round((level["acc_changed"] or 0) * changed)
        out["unchanged_right"] += round((level["acc_unchanged"] or 0) * (n - changed))
        out["metres"] += round(1000 * said.get("km", 0.0))
        if k == 0:
            out |= {name: said[name] for name in ("found", "missed", "false")}
    return out


def keep_classes(path: Path, classes: set[str]) -> None:
    """Leave the changes of other classes out of a file: the table asks about these."""
    data = json.loads(path.read_text(encoding="utf-8"))
    data["features"] = [f for f in data["features"] if f["properties"]["class"] in classes]
    path.write_text(json.dumps(data), encoding="utf-8")


# ---- localization


NO_SIGMA, BLIND = "Q_map without covariance", ("--without-sigma",)


def localized_on(
    place: Place, kind: str, world_seed: int, seed: int, work: Path, specs: Sequence[ChangeSpec]
) -> dict[str, Any]:
    """Tab. 3: pose errors (n, 3: longitudinal m, lateral m, yaw °) on an outdated map, by who
    takes part: all answers to prior queries (Q_prior), or those that still exist (Q_map), the
    latter also without their covariances."""
    old, changes, keys = outdated(place, kind, world_seed, seed, specs, 2)
    prior = degrade_map(old, 0.1, seed)
    write_new_map(prior, work / "prior", "outdated")
    out: dict[str, Any] = {"changes": len(changes)}
    for n, key in enumerate(keys):
        d = drive_through(place, kind, key, work / "runs" / f"{n:02d}", prior)
        blind = credulous(read_run(d.run), work / "blind" / f"{n:02d}")
        out.setdefault("GNSS", []).extend(errors_of(d.run, d.drive.pose, initial=True))
        ways = (("Q_prior", blind, ()), ("Q_map", d.run, ()), (NO_SIGMA, d.run, BLIND))
        for name, run, extra in ways:
            for how, flags in (("a frame alone", ()), ("whole drive", ("--smooth",))):
                words = (run, "--map", work / "prior", "--method", "matches", *flags, *extra)
                command("localize", *words)
                errors = errors_of(run, d.drive.pose)
                out.setdefault(f"{name}, {how}", []).extend(errors)
    return out


def credulous(run: Run, folder: Path) -> Path:
    """A copy of a run whose network does not tell outdated elements from those that exist."""
    o = run.observations
    asked = np.isfinite(o.existence)
    state = np.where(o.state == OUTDATED, MATCHED, o.state).astype(o.state.dtype)
    existence = np.where(asked, np.float32(1.0), o.existence)
    folder.mkdir(parents=True)
    write_run(replace(run, observations=replace(o, state=state, existence=existence)), folder)
    return folder


def errors_of(run: Path, true: Array, initial: bool = False) -> list[list[float]]:
    """Longitudinal, lateral (m) and yaw (°) errors of every frame."""
    read = read_run(run)
    found = read.frames.initial if initial else read.best_poses()
    out: list[list[float]] = np.round(pose_errors(true, found), 5).tolist()
    return out


def network(town: int, drive: int, work: Path) -> dict[str, Any]:
    """Tab. 4: errors of T^E and T^R of the shipped model on rendered images of an unseen town."""
    world, log, run, seed = work / "town", work / "log", work / "run", ("--seed", drive)
    command("simulate", "town", "--seed", town, "-o", world)
    command("simulate", "degrade", "--map", world, "--sigma", 0.1, *seed, "-o", work / "prior")
    command(
        "simulate", "images", "--map", world, "--log", "town:", *seed, "--drive", drive, "-o", log
    )
    command("infer", log, "--map", work / "prior", "-o", run)
    return of_network(run, work / "prior", log / "truth" / "poses.parquet", work)


def of_network(run: Path, prior: Path, truth: Path, work: Path) -> dict[str, Any]:
    """Errors of a run that has both T^E and detections; the run itself is not changed."""
    true, known = read_drives(truth)[0].at(read_run(run).frames.timestamp_ns)
    if not known.all():
        raise BadInput(truth, "has no pose for some frames of the run")
    out = {"GNSS": errors_of(run, true, initial=True)}
    ways = {
        "T^E": ("--method", "end-to-end"), "T^R": (), "T^R, whole drive": ("--smooth",),
    }  # fmt: skip
    for k, (name, flags) in enumerate(ways.items()):
        copy = work / f"way{k}"
        copy.mkdir()
        copy_run(run, copy)
        command("localize", copy, "--map", prior, *flags)
        out[name] = errors_of(copy, true)
    return out
