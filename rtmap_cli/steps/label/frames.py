"""A labelled drive as data: which frames train and which test, and what ground both saw.

Two splits. ``paper``: of the frames of every scenario type a share is drawn for training, the rest
tests (75/25 by scenario type, arXiv 2509.25542); neighbours in one drive land on both sides.
``apart``: a straight cut through the map; frames on one side test, and those frames of the other
that see any ground of a test frame are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput, NoAnswer
from rtmap_cli.geometry.polylines import length
from rtmap_cli.logs.log import Frame, Log
from rtmap_cli.logs.native import NativeLogWriter
from rtmap_cli.logs.run import Poses
from rtmap_cli.maps.crop import DEFAULT_RANGE, Range
from rtmap_cli.maps.element import CLASSES, RING_CLASSES, Element, VectorMap
from rtmap_cli.maps.footprint import points_in_range

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

SPLITS = ("paper", "apart")
TYPES = ("roundabout", "loop", "intersection", "multi-lane", "turning", "straight")
"""Scenario types, the rarer first: a frame is of the first that holds."""
TWICE = 0.4
"""Lines of one class that run nearer than this (m) are one line that two lanes share."""
LEAST = 2.0
"""Shorter rests of such lines are left out (m)."""
CUTS = 24
"""Directions in which the map is cut, to choose the best of them."""


@dataclass(frozen=True)
class Split:
    """Which of the pooled frames (n,) train and which test; the others are left out. ``shared`` is
    the share of the ground seen by test frames that training frames see too; ``by_type`` counts
    (train, test, left out) by scenario type."""

    name: str
    train: Bools
    test: Bools
    shared: float
    by_type: Mapping[str, tuple[int, int, int]]

    def as_json(self) -> dict[str, Any]:
        """Counts and the shared ground."""
        names = ("train", "test", "left_out")
        types = {k: dict(zip(names, v, strict=True)) for k, v in self.by_type.items()}
        left = len(self.train) - int(self.train.sum()) - int(self.test.sum())
        counts = dict(zip(names, (int(self.train.sum()), int(self.test.sum()), left), strict=True))
        return {**counts, "shared_ground": self.shared, "by_type": types}


def types_of(masks: Mapping[str, Bools]) -> NDArray[np.int64]:
    """(n,) the index into ``TYPES`` of each frame, from masks by scenario."""
    out = np.full(len(next(iter(masks.values()))), TYPES.index("straight"))
    for k in range(len(TYPES) - 1, -1, -1):
        if TYPES[k] in masks:
            out[masks[TYPES[k]]] = k
    return out


class Ground:
    """The squares of ground (6 m) in range of frames at ``pose`` (n, 4, 4)."""

    def __init__(self, pose: Array, range_m: Range = DEFAULT_RANGE) -> None:
        parts = [points_in_range(pose[k : k + 1], range_m) for k in range(len(pose))]
        points = np.concatenate(parts) if parts else np.zeros((0, 2))
        _, square = np.unique(points, axis=0, return_inverse=True)
        self.square = square.reshape(-1)
        self.frame = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
        self.count = int(self.square.max(initial=-1)) + 1

    def seen(self, frames: Bools) -> Bools:
        """(squares,) which squares some of the ``frames`` see."""
        out = np.zeros(self.count, bool)
        out[self.square[frames[self.frame]]] = True
        return out

    def touching(self, squares: Bools, frames: int) -> Bools:
        """(n,) which of ``frames`` frames see any of the ``squares``."""
        out = np.zeros(frames, bool)
        out[self.frame[squares[self.square]]] = True
        return out

    def shared(self, train: Bools, test: Bools) -> float:
        """Share of the squares that ``test`` sees which ``train`` sees too."""
        tested = self.seen(test)
        return float((self.seen(train) & tested).sum() / max(int(tested.sum()), 1))


def paper_split(kind: NDArray[np.int64], ground: Ground, share: float, seed: int) -> Split:
    """A ``share`` of the frames of every type trains, drawn with ``seed``; the rest tests."""
    rng = np.random.default_rng([seed, 75])
    train = np.zeros(len(kind), bool)
    for k in range(len(TYPES)):
        rows = rng.permutation(np.flatnonzero(kind == k))
        train[rows[: round(share * len(rows))]] = True
    return _split("paper", train, ~train, kind, ground)


def apart_split(kind: NDArray[np.int64], xy: Array, ground: Ground, share: float) -> Split:
    """The cut that keeps the shares of the types best and leaves out the fewest frames.

    For each of ``CUTS`` directions the 1 − ``share`` of the frames that lie farthest that way test.
    NoAnswer when every cut leaves no frame to train on.
    """
    best: tuple[float, Bools, Bools] | None = None
    for angle in np.arange(CUTS) * 2 * np.pi / CUTS:
        along = (xy - xy.mean(axis=0)) @ [np.cos(angle), np.sin(angle)]
        test = along > np.quantile(along, share)
        train = ~test & ~ground.touching(ground.seen(test), len(kind))
        if not train.any() or not test.any():
            continue
        used = train.sum() + test.sum()
        off = sum(abs(test[kind == k].mean() - (1 - share)) for k in np.unique(kind))
        cost = 2 * float(1 - used / len(kind)) + off / len(np.unique(kind))
        if best is None or cost < best[0] - 1e-9:
            best = cost, train, test
    if best is None:
        raise NoAnswer("no cut parts these frames: they all see the same ground; use more drives")
    return _split("apart", best[1], best[2], kind, ground)


def _split(name: str, train: Bools, test: Bools, kind: NDArray[np.int64], ground: Ground) -> Split:
    rest = ~train & ~test
    by_type = {}
    for k in np.unique(kind).tolist():
        of = kind == k
        by_type[TYPES[k]] = int(train[of].sum()), int(test[of].sum()), int(rest[of].sum())
    return Split(name, train, test, ground.shared(train, test), by_type)


def truth_map(vector_map: VectorMap, max_sigma: float = np.inf) -> VectorMap:
    """The lines of the labels that networks learn (``CLASSES``), each once: bounds that two lanes
    have in common are drawn by both of them. Stretches whose sigma is above ``max_sigma`` metres
    are left out; what has no sigma (drawn by hand) stays."""
    kept: list[Element] = [e for e in vector_map if e.class_name in RING_CLASSES]
    for name in (c for c in CLASSES if c not in RING_CLASSES):
        known = [p for e in vector_map.of_class(name) for p in _certain(e, max_sigma)]
        lines = sorted(known, key=lambda e: (-length(e.points), e.element_id))
        drawn: list[Any] = []
        for element in lines:
            parts = _not_drawn(element, drawn)
            drawn.append(shapely.linestrings(element.xy).buffer(TWICE))
            kept += parts
    return VectorMap(sorted(kept, key=lambda e: e.element_id), vector_map.crs)


def _certain(element: Element, max_sigma: float) -> list[Element]:
    """The stretches of a line whose vertices have at most ``max_sigma`` metres across and along."""
    if element.covariance is None or not np.isfinite(max_sigma):
        return [element]
    loose = (element.covariance[:, 0] + element.covariance[:, 2]) / 2 > max_sigma**2
    if not loose.any():
        return [element]
    ends = np.flatnonzero(np.diff(np.concatenate([[True], loose, [True]]).astype(np.int8)))
    out = []
    for k, (a, b) in enumerate(zip(ends[::2], ends[1::2], strict=True)):
        if b - a > 1 and length(element.points[a:b]) >= LEAST:
            part = element.with_points(element.points[a:b], element.covariance[a:b])
            out.append(replace(part, element_id=f"{element.element_id}-s{k}"))
    return out


def _not_drawn(element: Element, drawn: Sequence[Any]) -> list[Element]:
    """The parts of a line that no band of ``drawn`` covers; itself where none touches it."""
    line = shapely.linestrings(element.xy)
    near = [band for band in drawn if band.intersects(line)]
    rest = line.difference(shapely.union_all(near)) if near else line
    # Lines that only meet or cross are cut short by half a band: those are whole.
    if line.length - rest.length <= 3 * TWICE * max(len(near), 1):
        return [element]
    out = []
    for k, part in enumerate(shapely.get_parts(rest)):
        if part.length >= LEAST:
            points = shapely.get_coordinates(part)
            name = f"{element.element_id}-{k}"
            out.append(Element(name, element.class_name, points, existence=element.existence))
    return out


@dataclass(frozen=True)
class Source:
    """A log with the poses (n, 4, 4) map_SE3_ego of its ``frames`` that the labels go with."""

    log: Log
    frames: list[Frame]
    pose: Array


def write_part(source: Source, rows: NDArray[np.intp], folder: Path, name: str) -> None:
    """The frames ``rows`` of a log as a native log with true poses: images are copied as they
    are; sweeps and masks stay behind. Odometry over frames that are missing is unknown."""
    log = source.log
    if log.rig is None:
        raise BadInput(log.path, "has no cameras, so nothing can be learned from its frames")
    folder.mkdir(parents=True)
    creation = {"cut_from": log.log_id, "part": name}
    writer = NativeLogWriter(folder, f"{log.log_id}-{name}", log.crs, log.rig, log.ground_z,
                             creation)  # fmt: skip
    kept_rows = set(rows.tolist())
    for row in rows.tolist():
        frame = source.frames[row]
        images = {camera: path.read_bytes() for camera, path in frame.images.items()}
        follows = row > 0 and row - 1 in kept_rows
        kept = Frame(
            frame.index, frame.timestamp_ns, frame.map_SE3_ego, frame.sigma,
            frame.odometry if follows else None, frame.odometry_sigma if follows else None,
            occluders=frame.occluders,
        )  # fmt: skip
        writer.add(kept, images, frame.image_time_ns)
    n = len(rows)
    index = np.array([source.frames[r].index for r in rows.tolist()], np.int32)
    times = np.array([source.frames[r].timestamp_ns for r in rows.tolist()], np.int64)
    truth = Poses(
        frame=index, timestamp_ns=times, method="label", pose=source.pose[rows],
        covariance=np.zeros((n, 6, 6)), eigenvalues=np.full((n, 3), np.nan),
        weakest_direction=np.full((n, 3), np.nan), residual_count=np.zeros(n, np.int32),
        chi2=np.zeros(n), status=np.full(n, "ok", object),
    )  # fmt: skip
    writer.write_truth(truth)
    writer.close()
