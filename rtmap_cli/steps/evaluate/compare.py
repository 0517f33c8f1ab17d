"""One map evaluation from whatever the two sides are: result frames, runs or maps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput, NoAnswer, UsageError
from rtmap_cli.maps.crop import Range
from rtmap_cli.maps.element import CLASSES, VectorMap
from rtmap_cli.steps.evaluate.drives import Drive
from rtmap_cli.steps.evaluate.frames import (
    FrameSet,
    MapSide,
    aligned,
    in_crs,
    poses_of_keys,
    run_frames,
)
from rtmap_cli.steps.evaluate.precision import (
    PROTOCOLS,
    THRESHOLDS,
    Detection,
    MapScore,
    Scorer,
)
from rtmap_cli.steps.evaluate.whole import cell_range, cells_in, region_in_range

Array = NDArray[np.float64]
Side = FrameSet | VectorMap
Pair = tuple[str, list[Detection], list[Detection]]


@dataclass(frozen=True)
class Settings:
    """How to compare. ``range_m`` and ``classes`` None: as the sides state them.

    ``every`` takes every n-th frame; ``cell`` (m) judges two maps by cells of that size in place
    of frames.
    """

    protocol: str = "rtmap"
    thresholds: Sequence[float] = THRESHOLDS
    classes: Sequence[str] | None = None
    range_m: Range | None = None
    every: int = 1
    cell: float | None = None


def read_side(
    path: str | Path, scored: bool, drives: list[Drive], version: int | None = None
) -> Side:
    """A run, a map, a GeoJSON map or a JSON file of frames; ``scored`` for the predictions."""
    from rtmap_cli.formats.map_frames import SUFFIXES, read_map_frames
    from rtmap_cli.logs.run import read_run
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
        return read_map(path, version)
    what = "is no run, map or JSON file of frames" if local.exists() else "no such file or folder"
    raise BadInput(path, what)


def compare(
    pred: Side, truth: Side, drives: list[Drive], settings: Settings | None = None
) -> MapScore:
    """Score one side against the other; see ``evaluate_frames`` for the arithmetic.

    A map is cropped at the poses of ``drives``: at the frames of the other side, found by time, or
    at every n-th pose when both are maps. Raises UsageError without drives where they are needed,
    BadInput when frames or poses do not correspond, NoAnswer when nothing lies in range.
    """
    s = settings or Settings()
    scorer = Scorer(_classes(pred, truth, s), s.thresholds, s.protocol)
    counts = [0, 0]
    for key, predicted, true in _pairs(pred, truth, drives, s):
        counts[0] += len(predicted)
        counts[1] += len(true)
        scorer.add(predicted, true, key)
    if not scorer.frames:
        raise NoAnswer("there is no frame to compare")
    if not counts[1] and isinstance(truth, VectorMap):
        raise NoAnswer("nothing of the true map lies in range of the poses")
    if not counts[0] and isinstance(pred, VectorMap) and len(pred):
        raise NoAnswer("nothing of the predicted map lies in range of the poses")
    return scorer.result()


def missing_frames(pred: Side, truth: Side) -> int:
    """Frames of the truth that a prediction by frames says nothing about: they count as empty."""
    if isinstance(pred, FrameSet) and isinstance(truth, FrameSet):
        return len(truth.frames) - len(pred.frames)
    return 0


def _classes(pred: Side, truth: Side, s: Settings) -> list[str]:
    if s.classes:
        return list(s.classes)
    for side in (truth, pred):
        if isinstance(side, FrameSet) and side.classes:
            return side.classes
    return list(CLASSES)


def _range(pred: Side, truth: Side, s: Settings) -> Range:
    for side in (pred, truth):
        if s.range_m is None and isinstance(side, FrameSet) and side.range_m:
            return side.range_m
    return s.range_m or PROTOCOLS[s.protocol].range_m


def _pairs(pred: Side, truth: Side, drives: list[Drive], s: Settings) -> Iterator[Pair]:
    if isinstance(pred, FrameSet) and isinstance(truth, FrameSet):
        for n, (key, predicted) in enumerate(aligned(pred, truth)):
            if n % s.every == 0:
                yield key, predicted, truth.frames[key]
        return
    if not drives:
        raise UsageError("a map is compared along a drive: pass its poses with --poses")
    crs = drives[0].crs
    box = _range(pred, truth, s)
    if isinstance(pred, VectorMap) and isinstance(truth, VectorMap):
        keys, poses = _places(drives, s)
        if s.cell:
            region = region_in_range(poses, box)
            poses, box = cells_in(region, s.cell), cell_range(s.cell)
            keys = [f"cell {x:.0f} {y:.0f}" for x, y in poses[:, :2, 3]]
        left, right = MapSide(in_crs(pred, crs), True), MapSide(in_crs(truth, crs), False)
        for key, pose in zip(keys, poses, strict=True):
            yield key, left.crop(pose, box), right.crop(pose, box)
        return
    if s.cell:
        raise UsageError("--cells compares two maps; one of these is not a map")
    if isinstance(pred, FrameSet):
        frames, map_side = pred, MapSide(in_crs(_as_map(truth), crs), False)
    else:
        frames, map_side = _as_frames(truth), MapSide(in_crs(pred, crs), True)
    keys = frames.keys()[:: s.every]
    for key, pose in zip(keys, poses_of_keys(keys, drives, frames.where), strict=True):
        local = map_side.crop(pose, box)
        yield (
            (key, frames.frames[key], local) if frames is pred else (key, local, frames.frames[key])
        )


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
