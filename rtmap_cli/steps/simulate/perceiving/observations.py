"""Observe a world without a network: a drive, a perception model, a run (docs/simulate.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli.errors import NoAnswer
from rtmap_cli.logs.log import Occluder
from rtmap_cli.logs.run import Observations, Poses, Run, run_info, true_poses
from rtmap_cli.logs.run_files import OCCLUDERS
from rtmap_cli.maps.crop import DEFAULT_RANGE, Range
from rtmap_cli.maps.element import CLASSES, VectorMap
from rtmap_cli.steps.simulate.driving.drives import Drive, initial_poses
from rtmap_cli.steps.simulate.perceiving.clutter import Clutter
from rtmap_cli.steps.simulate.perceiving.perception import (
    VERTICES,
    Detection,
    DriveKey,
    FalseElements,
    Perception,
    View,
)
from rtmap_cli.steps.simulate.perceiving.presets import Preset
from rtmap_cli.steps.simulate.perceiving.prior_queries import PriorPerception

Array = NDArray[np.float64]
Progress = Callable[[Iterable[int]], Iterator[int]]


def observe(
    world: VectorMap,
    drive: Drive,
    preset: Preset,
    key: DriveKey,
    log_id: str,
    prior: VectorMap | None = None,
    range_m: Range = DEFAULT_RANGE,
    progress: Progress = iter,
    made_by: dict[str, Any] | None = None,
    delineators: Sequence[Array] = (),
) -> tuple[Run, Poses]:
    """The run that a network would write of a drive through ``world``, and its true poses.

    With ``prior`` its elements become queries. ``made_by`` goes into run.json. ``delineators`` are
    rows of posts (n, 2), map frame, which are taken for dividers at times. Everything random hangs
    on ``key``: errors fixed to the place on its world seed, the rest on the drive.
    Raises NoAnswer when nothing of the world is ever in range.
    """
    perception = Perception(world, preset, key, range_m)
    frames = initial_poses(drive, preset, key)
    false = FalseElements(perception, drive.pose)
    clutter = Clutter(delineators, perception.errors, preset.ghost_score)
    asked = PriorPerception(perception, prior, frames.sigma[0]) if prior is not None else None
    boxes = drive.occluders or [()] * len(drive)
    reported: list[list[Detection]] = []
    in_range = 0
    for i in progress(range(len(drive))):
        view = View(i, drive.pose[i], boxes[i])
        pieces = asked.new_pieces(view) if asked else perception.pieces(view)
        found = [d for p in pieces if (d := perception.detect(p, view))] + false.of(view)
        found += clutter.of(view, range_m)
        # A network's queries come in no order that tells what is real.
        found.sort(key=lambda d: -d.score)
        answers = asked.queries(view, frames.initial[i]) if asked else []
        in_range += len(pieces) + len(answers)
        reported.append(found + answers)
    if not in_range:
        raise NoAnswer(f"nothing of the map is in range of any of the {len(drive)} frames")
    x0, y0, x1, y1 = range_m
    info = run_info(
        log_id,
        drive.crs,
        list(CLASSES),
        {"x": [x0, x1], "y": [y0, y1]},
        model="simulated observations",
        model_sha256=None,
        simulated=True,
        preset=preset.as_dict(),
        seed=key.seed,
        world_seed=key.world_seed,
        traversal=key.traversal,
        **(made_by or {}),
    )
    run = Run(info, frames, _rows(reported), _boxes(boxes))
    return run, true_poses(frames.frame, frames.timestamp_ns, drive.pose)


def _rows(reported: list[list[Detection]]) -> Observations:
    """The observations table: one row per detection, frames and queries in order."""
    flat = [(f, q, d) for f, found in enumerate(reported) for q, d in enumerate(found)]
    if not flat:
        return Observations.empty(VERTICES)
    none = np.full((VERTICES, 2), np.nan)
    found = [d for _, _, d in flat]
    return Observations(
        frame=np.array([f for f, _, _ in flat], np.int32),
        query=np.array([q for _, q, _ in flat], np.int32),
        state=np.array([d.state for d in found], np.int8),
        class_name=np.array([d.class_name for d in found], object),
        score=np.array([d.score for d in found], np.float32),
        existence=np.array([d.existence for d in found], np.float32),
        element_id=np.array([d.element_id for d in found], object),
        points=np.stack([d.points for d in found]).astype(np.float32),
        sigma=np.stack([d.sigma for d in found]).astype(np.float32),
        prior_points=np.stack([none if d.prior_points is None else d.prior_points for d in found]),
    )


def _boxes(boxes: list[tuple[Occluder, ...]]) -> pa.Table:
    """The occluders table."""
    names = [n for n in OCCLUDERS.columns.names if n != "frame"]
    flat = [(i, box) for i, found in enumerate(boxes) for box in found]
    columns: dict[str, Any] = {"frame": pa.array([i for i, _ in flat], pa.int32())}
    for name in names:
        columns[name] = pa.array([getattr(b, name) for _, b in flat], pa.float32())
    return pa.table(columns)
