"""One map evaluation from whatever the two sides are: result frames, runs or maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput, NoAnswer, UsageError
from rtmap_cli.maps.crop import Range
from rtmap_cli.maps.element import CLASSES, VectorMap
from rtmap_cli.steps.evaluate.drives import Drive, drive_of
from rtmap_cli.steps.evaluate.maps.frames import (
    FrameSet,
    MapSide,
    aligned,
    check_classes,
    in_crs,
    poses_of_keys,
    run_frames,
    split_key,
)
from rtmap_cli.steps.evaluate.maps.pairs import Pairs
from rtmap_cli.steps.evaluate.maps.parallel import judge_all
from rtmap_cli.steps.evaluate.maps.precision import (
    PROTOCOLS,
    THRESHOLDS,
    Detection,
    Judged,
    MapScore,
    Scorer,
)
from rtmap_cli.steps.evaluate.maps.whole import cell_range, cells_in, region_in_range
from rtmap_cli.steps.evaluate.scenarios.labels import SCENARIOS, scenarios_of

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Side = FrameSet | VectorMap


@dataclass(frozen=True)
class Settings:
    """How to compare. ``range_m`` and ``classes`` None: as the sides state them.

    ``every`` takes every n-th frame; ``cell`` (m) judges two maps by cells of that size in place
    of frames. ``shape`` also measures smoothness and topology; ``jobs`` processes share the work.
    """

    protocol: str = "rtmap"
    thresholds: Sequence[float] = THRESHOLDS
    classes: Sequence[str] | None = None
    range_m: Range | None = None
    every: int = 1
    cell: float | None = None
    shape: bool = False
    jobs: int = 1


@dataclass(frozen=True)
class Comparison:
    """What was judged: the frames' keys, in order, their scores, the box (m) to which maps were
    cropped (None: nothing was), and what deserves a warning."""

    keys: list[str]
    scorer: Scorer
    box: Range | None = None
    notes: list[str] = field(default_factory=list)


def read_side(
    path: str | Path, scored: bool, drives: list[Drive], version: int | None = None
) -> Side:
    """A run, a map, a GeoJSON map or a JSON file of frames; ``scored`` for the predictions."""
    from rtmap_cli.formats.map_frames import SUFFIXES, read_map_frames
    from rtmap_cli.logs.run_files import read_run
    from rtmap_cli.maps.store import map_exists, read_map

    local = Path(path)
    if (local / "run.json").exists():
        return run_frames(read_run(local), local)
    if local.name.endswith(".geojson"):
        from rtmap_cli.formats.geojson import read_geojson

        if not drives:
            raise UsageError(f"{path} is a map: say along which drive with --poses")
        return read_geojson(local, drives[0].crs)
    if local.name.endswith(SUFFIXES):
        found = read_map_frames(local, scored)
        frames: dict[str, list[Detection]] = found.frames
        return FrameSet(frames, found.classes, found.range_m, str(path))
    if "://" in str(path) or map_exists(path):
        found_map = read_map(path, version)
        if not scored and not len(found_map):
            raise BadInput(path, "is an empty truth: a map without elements")
        return found_map
    what = "is no run, map or JSON file of frames" if local.exists() else "no such file or folder"
    raise BadInput(path, what)


def compare(
    pred: Side, truth: Side, drives: list[Drive], settings: Settings | None = None
) -> MapScore:
    """Score one side against the other; see ``evaluate_frames`` for the arithmetic.

    A map is cropped at the poses of ``drives``: at the frames of the other side, found by time, or
    at every n-th pose when both are maps. Raises UsageError without drives where they are needed,
    BadInput when frames, classes or poses do not correspond or the truth is empty, NoAnswer when
    nothing lies in range.
    """
    return compare_frames(pred, truth, drives, settings).scorer.result()


def compare_frames(
    pred: Side, truth: Side, drives: list[Drive], settings: Settings | None = None
) -> Comparison:
    """As ``compare``, with everything that is kept of each frame."""
    s = settings or Settings()
    scorer = Scorer(_classes(pred, truth, s), s.thresholds, s.protocol, s.shape)
    notes = _notes(pred, truth, s, scorer.classes)
    pairs = pairs_of(pred, truth, drives, s)
    out = Comparison([], scorer, pairs.box, notes)
    counts = np.zeros(3, np.int64)
    for key, judged, found in judge_all(pairs, _Judge(scorer), s.jobs):
        out.keys.append(key)
        scorer.collect(judged)
        counts += found
    if not scorer.frames:
        raise NoAnswer("there is no frame to compare")
    if not counts[1] and isinstance(truth, VectorMap):
        raise NoAnswer("nothing of the true map lies in range of the poses")
    if not counts[0] and isinstance(pred, VectorMap) and len(pred):
        raise NoAnswer("nothing of the predicted map lies in range of the poses")
    if counts[2] and scorer.protocol.drop_single:
        out.notes.append(f"{counts[2]} predictions of one vertex are left out by the protocol")
    return out


class _Judge:
    """Judges frames in any process; gives key, what was found by class, and counts of elements:
    predicted, true, predicted of one vertex."""

    def __init__(self, scorer: Scorer) -> None:
        self.scorer = Scorer(
            scorer.classes, scorer.thresholds.tolist(), scorer.protocol.name, scorer.shape
        )

    def __call__(
        self, key: str, pred: list[Detection], true: list[Detection]
    ) -> tuple[str, dict[str, Judged], tuple[int, int, int]]:
        judged = self.scorer.judge(pred, true, key)
        single = sum(len(p[1]) < 2 and p[0] in judged for p in pred)
        return key, judged, (len(pred), len(true), single)


def _notes(pred: Side, truth: Side, s: Settings, classes: list[str]) -> list[str]:
    """Warnings about two sides by frames; BadInput when they cannot belong together."""
    for side in (pred, truth):
        if isinstance(side, FrameSet):
            check_classes(side, classes, chosen=s.classes is not None)
    if isinstance(truth, FrameSet):
        if not truth.frames:
            raise BadInput(truth.where, "holds no frame")
        true = [e[0] for elements in truth.frames.values() for e in elements if e[0] in classes]
        if not true and len(classes) > 1:
            first = next(iter(truth.frames))
            names = ", ".join(classes)
            raise BadInput(truth.where, f"is an empty truth: no {names} in {first} or any other")
    if isinstance(pred, FrameSet) and not pred.frames:
        raise BadInput(pred.where, "holds no frame")
    if not (isinstance(pred, FrameSet) and isinstance(truth, FrameSet)):
        return []
    notes = []
    if not pred.frames.keys() & truth.frames.keys():
        mine, theirs = next(iter(pred.frames)), next(iter(truth.frames))
        notes.append(f"no frame has the same name on both sides ({mine}, {theirs}): found by time")
    lacking = len(truth.frames) - len(pred.frames)
    if lacking:
        notes.append(f"{pred.where} lacks {lacking} frames of {truth.where}: they count as empty")
    return notes


def _classes(pred: Side, truth: Side, s: Settings) -> list[str]:
    if s.classes:
        return list(s.classes)
    for side in (truth, pred):
        if isinstance(side, FrameSet) and side.classes:
            return side.classes
    return list(CLASSES)


def range_of(pred: Side, truth: Side, s: Settings) -> Range:
    """The range of an evaluation: as asked for, that of a side, or that of the protocol."""
    for side in (pred, truth):
        if s.range_m is None and isinstance(side, FrameSet) and side.range_m:
            return side.range_m
    return s.range_m or PROTOCOLS[s.protocol].range_m


def pairs_of(pred: Side, truth: Side, drives: list[Drive], s: Settings) -> Pairs:
    """The frames that are compared; UsageError and BadInput as ``compare``."""
    if isinstance(pred, FrameSet) and isinstance(truth, FrameSet):
        keys = list(truth.frames)[:: s.every]
        return Pairs(keys, aligned(pred, truth), truth.frames)
    if not drives:
        raise UsageError("a map is compared along a drive: pass its poses with --poses")
    crs = drives[0].crs
    box = range_of(pred, truth, s)
    if isinstance(pred, VectorMap) and isinstance(truth, VectorMap):
        keys, poses = _places(drives, s)
        if s.cell:
            region = region_in_range(poses, box)
            poses, box = cells_in(region, s.cell), cell_range(s.cell)
            keys = [f"cell {x:.0f} {y:.0f}" for x, y in poses[:, :2, 3]]
        sides = MapSide(in_crs(pred, crs), True), MapSide(in_crs(truth, crs), False)
        return Pairs(keys, *sides, poses, box)
    if s.cell:
        raise UsageError("--cells compares two maps; one of these is not a map")
    frames = pred if isinstance(pred, FrameSet) else _as_frames(truth)
    keys = frames.keys()[:: s.every]
    poses = poses_of_keys(keys, drives, frames.where)
    if frames is pred:
        true = MapSide(in_crs(_as_map(truth), crs), False)
        return Pairs(keys, frames.frames, true, poses, box)
    return Pairs(keys, MapSide(in_crs(_as_map(pred), crs), True), frames.frames, poses, box)


def label_frames(keys: Sequence[str], drives: list[Drive], true_map: VectorMap) -> dict[str, Bools]:
    """Which scenarios (frames,) hold at each frame; BadInput when a key names no drive or time."""
    crs = drives[0].crs
    vector_map = in_crs(true_map, crs)
    out = {name: np.zeros(len(keys), dtype=bool) for name in SCENARIOS}
    rows: dict[int, list[int]] = {}
    times = np.zeros(len(keys), np.int64)
    for k, key in enumerate(keys):
        log, time = split_key(key)
        if time is None:
            raise BadInput(f"frame {key}", "does not end in a time in nanoseconds")
        drive = drive_of(drives, log, f"frame {key}")
        rows.setdefault(next(i for i, d in enumerate(drives) if d is drive), []).append(k)
        times[k] = time
    for i, mine in rows.items():
        for name, mask in scenarios_of(drives[i], vector_map, times[mine]).items():
            out[name][mine] = mask
    return out


def _as_map(side: Side) -> VectorMap:
    assert isinstance(side, VectorMap)
    return side


def _as_frames(side: Side) -> FrameSet:
    assert isinstance(side, FrameSet)
    return side


def _places(drives: list[Drive], s: Settings) -> tuple[list[str], Array]:
    """Keys and poses of every n-th frame of all drives."""
    keys = [f"{d.name}_{t}" for d in drives for t in d.timestamp_ns[:: s.every].tolist()]
    return keys, np.concatenate([d.pose[:: s.every] for d in drives])
