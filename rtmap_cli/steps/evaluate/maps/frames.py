"""What each side of an evaluation says about each frame: runs, cropped maps, result files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.polylines import join_lines, length
from rtmap_cli.logs.run import OUTDATED, Run
from rtmap_cli.maps.crop import MapIndex, Range
from rtmap_cli.maps.element import RING_CLASSES, Element, VectorMap
from rtmap_cli.steps.evaluate.drives import Drive, drive_of
from rtmap_cli.steps.evaluate.maps.precision import Detection

Array = NDArray[np.float64]

MIN_LENGTH = 0.3
"""Pieces of lines that a crop leaves shorter than this (m) are no elements of their own …"""
MIN_AREA = 0.5
"""… nor are pieces of crossings smaller than this (m²); both as in the reference truth."""


@dataclass(frozen=True)
class FrameSet:
    """Elements by frame key ``<log>_<timestamp ns>`` (or any token)."""

    frames: dict[str, list[Detection]]
    classes: list[str] | None
    range_m: Range | None
    where: str

    def keys(self) -> list[str]:
        """The keys in order."""
        return list(self.frames)


def run_frames(run: Run, where: str | Path) -> FrameSet:
    """Detections of a run; elements of the prior that it calls outdated are not predictions."""
    o = run.observations.select(run.observations.state != OUTDATED)
    times = dict(zip(run.frames.frame.tolist(), run.frames.timestamp_ns.tolist(), strict=True))
    frames: dict[str, list[Detection]] = {f"{run.log_id}_{t}": [] for t in times.values()}
    for frame, name, points, score in zip(o.frame, o.class_name, o.points, o.score, strict=True):
        if int(frame) not in times:
            raise BadInput(where, f"observations name frame {frame}, which frames.parquet lacks")
        key = f"{run.log_id}_{times[int(frame)]}"
        frames[key].append((str(name), points.astype(np.float64), float(score)))
    r = run.info["range_m"]
    box = (float(r["x"][0]), float(r["y"][0]), float(r["x"][1]), float(r["y"][1]))
    return FrameSet(frames, [str(c) for c in run.info["classes"]], box, str(where))


def split_key(key: str) -> tuple[str, int | None]:
    """Log and time (ns) of a frame key; the time is None when the key does not end in one."""
    log, _, tail = key.rpartition("_")
    if tail.isdigit():
        return log, int(tail)
    return key, None


def aligned(pred: FrameSet, truth: FrameSet) -> dict[str, list[Detection]]:
    """The predictions by the keys of the truth.

    Frames are found by key, or by time alone when no key is shared (logs may be named
    differently). Frames that the prediction lacks are absent; frames that the truth lacks, or
    none in common, are BadInput.
    """
    names = {key: key for key in pred.frames}
    if not names.keys() & truth.frames.keys():
        by_time = {split_key(k)[1]: k for k in truth.frames}
        names = {k: by_time.get(split_key(k)[1] or -1, k) for k in pred.frames}
    unknown = [k for k, name in names.items() if name not in truth.frames]
    if unknown:
        shared = len(names) - len(unknown)
        what = f"frame {unknown[0]} is not in {truth.where}"
        raise BadInput(pred.where, what if shared else f"{what}, nor is any other")
    return {name: pred.frames[key] for key, name in names.items()}


def check_classes(side: FrameSet, judged: list[str], chosen: bool) -> None:
    """BadInput when a side states or holds other classes than are judged.

    With ``chosen`` classes (--classes) only the ones that a side states not to know are wrong.
    """
    todo = "choose common ones with --classes"
    lacks = [c for c in judged if side.classes is not None and c not in side.classes]
    if lacks:
        raise BadInput(side.where, f"does not know the class {lacks[0]}", todo)
    if chosen:
        return
    for key, elements in side.frames.items():
        for name, _, _ in elements:
            if name not in judged:
                names = ", ".join(judged)
                what = f"frame {key} holds a {name}; the other side has {names}"
                raise BadInput(side.where, what, todo)


def poses_of_keys(keys: list[str], drives: list[Drive], where: str | Path) -> Array:
    """(n, 4, 4) poses at the frames of keys; BadInput when one has none."""
    out = np.zeros((len(keys), 4, 4))
    parts = [split_key(k) for k in keys]
    for log in dict.fromkeys(log for log, _ in parts):
        rows = [i for i, part in enumerate(parts) if part[0] == log]
        if any(parts[i][1] is None for i in rows):
            raise BadInput(where, f"frame {log} does not end in a time in nanoseconds")
        drive = drive_of(drives, log, where)
        times = np.array([parts[i][1] for i in rows], np.int64)
        out[rows], known = drive.at(times)
        if not known.all():
            missing = keys[rows[int(np.flatnonzero(~known)[0])]]
            count = f"{int((~known).sum())} of {len(rows)} frames"
            raise BadInput(where, f"no pose at the time of frame {missing} ({count} have none)")
    return out


class MapSide:
    """Crops of a map as predictions (with the elements' probabilities) or as truth."""

    def __init__(self, vector_map: VectorMap, scored: bool) -> None:
        self.scored = scored
        # Truth is joined once; predictions keep their elements, whose scores differ.
        self.index = MapIndex(vector_map, join=not scored)

    def crop(self, map_SE3_ego: Array, range_m: Range) -> list[Detection]:
        """Elements in range in the ego frame; pieces that meet end to end are one element."""
        least = 0.0 if self.scored else MIN_LENGTH
        local = [
            e
            for e in self.index.crop(map_SE3_ego, range_m, min_length=least)
            if e.class_name not in RING_CLASSES or _area(e.points) >= MIN_AREA
        ]
        if not self.scored:
            return [(e.class_name, e.points[:, :2], 1.0) for e in local]
        out: list[Detection] = []
        for name in dict.fromkeys(e.class_name for e in local):
            rows = [(e.points[:, :2], probability(e.source)) for e in local if e.class_name == name]
            out += [(name, p, s) for p, s in (rows if name in RING_CLASSES else _joined(rows))]
        return out


def _area(ring: Array) -> float:
    """Area inside a closed ring, m² (shoelace)."""
    x, y = (ring[:, :2] - ring[0, :2]).T
    return float(abs((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) / 2)


def probability(element: Element) -> float:
    """Probability that an element exists, from its log-odds."""
    return float(1.0 / (1.0 + np.exp(-np.clip(element.existence, -500, 500))))


def _joined(rows: list[tuple[Array, float]]) -> list[tuple[Array, float]]:
    """Lines joined end to end; the score of a joined line is the mean along it."""
    # The score travels through the joining as a third column of every vertex.
    lines = [np.column_stack([p, np.full(len(p), s)]) for p, s in rows]
    out = []
    for line in join_lines(lines):
        if length(line) >= MIN_LENGTH:
            steps = np.hypot(*np.diff(line[:, :2], axis=0).T)
            middle = (line[1:, 2] + line[:-1, 2]) / 2
            out.append((line[:, :2], float((steps * middle).sum() / steps.sum())))
    return out


def in_crs(vector_map: VectorMap, crs: str) -> VectorMap:
    """The map in another CRS (vertex by vertex); itself when it is already there."""
    from rtmap_cli.maps.crs import convert, same_crs

    if same_crs(vector_map.crs, crs):
        return vector_map
    elements = [
        e.with_points(np.column_stack([convert(vector_map.crs, crs, e.xy), e.points[:, 2]]))
        for e in vector_map
    ]
    return VectorMap(elements, crs, vector_map.version)
