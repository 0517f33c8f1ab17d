"""Read a log with a network: {M, U, D, T^E} = Model(images, prior) of Eq. 1, frame by frame.

Frames do not depend on one another: with several threads several of them are read at the same
time, each on one thread, which keeps all cores busier than one frame on all of them would.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput, NoAnswer
from rtmap_cli.geometry.poses import se3_from_xyyaw, wrap_angle, xyyaw_of, yaw_of
from rtmap_cli.logs.log import Frame, Log
from rtmap_cli.logs.run import MATCHED, NEW, OUTDATED, Observations, Run, RunFrames, run_info
from rtmap_cli.logs.run_files import OCCLUDERS
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.prior import PriorSlots, on_prior, prior_slots
from rtmap_cli.steps.infer.ahead import in_order
from rtmap_cli.steps.infer.duplicates import fade_duplicates
from rtmap_cli.steps.infer.loading import Loaded, Source, source_of
from rtmap_cli.steps.infer.model import MapModel

Array = NDArray[np.float64]
Progress = Callable[[Iterable[Any]], Iterable[Any]]


@dataclass(frozen=True)
class InferOptions:
    """``score_threshold``: new elements below it are dropped; ``existence_threshold``: prior
    elements below it are outdated; ``batch``: frames per call; ``threads``: how many threads decode
    images and, on a CPU, run the network, each for other frames (no answer depends on it);
    ``skip_bad_frames``: leave out frames that cannot be read and count them;
    ``max_frames``: stop after so many; ``every``: take every n-th frame; ``level``: turn the
    cameras to how the road lies (`RoadUnder`); ``looks``: how often the network is asked, each time
    with the prior cropped at the pose that the time before gave; ``semantic``: the folder of the
    log's rasters, for a network that reads them (default: ``semantic`` in the log)."""

    score_threshold: float = 0.05
    existence_threshold: float = 0.5
    batch: int = 1
    threads: int = 2
    skip_bad_frames: bool = False
    max_frames: int | None = None
    every: int = 1
    level: bool = True
    looks: int = 1
    semantic: Path | None = None


FAR_SIGMAS = 4.0
"""A pose further than this from the initial one is not trusted with another look."""


@dataclass(frozen=True)
class _Answer:
    """Of one frame (its images are let go): ``pose`` (3,) and ``covariance`` (3, 3) end to end, NaN
    without a prior; ``dropped`` prior elements found no slot."""

    frame: Frame
    cameras: int
    observations: Observations
    pose: Array
    covariance: Array
    dropped: int


def infer_log(
    log: Log,
    model: MapModel,
    prior: VectorMap | None,
    options: InferOptions,
    progress: Progress = iter,
    say: Callable[[str], None] = lambda _: None,
    made_by: dict[str, Any] | None = None,
) -> Run:
    """Run the network over a log; without ``prior`` it is a first traversal.

    The prior is cropped at each frame's initial pose, resampled to the model's V vertices and
    given as prior queries; the answer for slot p is an observation with ``element_id``,
    ``prior_points`` (D) and state matched or outdated, the other queries give state new.
    Raises BadInput for unreadable frames (unless skipped) and NoAnswer when no frame is left.
    """
    index = MapIndex(prior) if prior is not None else None
    source = source_of(log, model.info, prior, options.level, options.semantic)
    answers: list[_Answer] = []
    skipped = 0
    pool = ThreadPoolExecutor(options.threads)
    try:
        # In the pool's queue work stands in the order in which it is wanted.
        load = partial(_load, source=source, skip=options.skip_bad_frames)
        loaded = in_order(load, _chosen(log, options), pool, 2 * options.threads + options.batch)
        answer = partial(_answers, model=model, index=index, options=options)
        batches = _batches(progress(loaded), options.batch)
        for some in in_order(answer, batches, pool, options.threads + 1 if model.on_cpu else 1):
            for item in some:
                if isinstance(item, BadInput):
                    skipped += 1
                    say(f"skipped: {item}")
                else:
                    answers.append(item)
    finally:
        pool.shutdown(cancel_futures=True)
    if not answers:
        raise NoAnswer(f"{log.path}: no frame could be read")
    rows = [(a.frame, a.cameras, a.pose, a.covariance) for a in answers]
    dropped = sum(a.dropped for a in answers)
    if dropped:
        say(
            f"{dropped} prior elements found no slot (the model has {model.info.prior_slots}): in "
            "each frame the nearest were asked about"
        )
    _say_missing(source.cameras, rows, say)
    info = run_info(
        log.log_id,
        log.crs,
        model.info.classes,
        {"x": [model.info.range_m[0], model.info.range_m[2]],
         "y": [model.info.range_m[1], model.info.range_m[3]]},
        source="infer",
        ground_z=log.ground_z,
        model=model.info.name,
        model_sha256=model.info.sha256,
        model_footprint=model.info.footprint.as_json(),
        options=_said(options),
        frames=len(rows),
        skipped_frames=skipped,
        prior_elements_without_slot=dropped,
        map_version=prior.version if prior is not None else None,
        **(made_by or {}),
    )  # fmt: skip
    observations = Observations.concatenate([a.observations for a in answers])
    return Run(info, _frames(rows), observations, _occluders(rows))


def _said(options: InferOptions) -> dict[str, Any]:
    """The options that an answer depends on."""
    said = {k: v for k, v in asdict(options).items() if k != "threads"}
    folder = said.pop("semantic")
    return said if folder is None else said | {"semantic": str(folder)}


def _say_missing(
    cameras: Sequence[str],
    rows: list[tuple[Frame, int, Array, Array]],
    say: Callable[[str], None],
) -> None:
    """Warn of cameras that some frames lack: what only they see is not seen there."""
    for name in cameras:
        lacking = sum(name not in row[0].images for row in rows)
        if lacking:
            say(f"{lacking} of {len(rows)} frames have no image of {name}")


def _chosen(log: Log, options: InferOptions) -> Iterator[Frame]:
    taken = 0
    for k, frame in enumerate(log.frames()):
        if k % options.every:
            continue
        if options.max_frames is not None and taken >= options.max_frames:
            return
        taken += 1
        yield frame


def _load(frame: Frame, source: Source, skip: bool) -> Loaded | BadInput:
    """What the network is given of a frame; with ``skip`` an error is returned, not raised."""
    try:
        return source.load(frame)
    except BadInput as error:
        if not skip:
            raise
        return error


def _batches(items: Iterable[Loaded | BadInput], size: int) -> Iterator[list[Loaded | BadInput]]:
    """Consecutive frames with the same number of cameras, at most ``size`` of them."""
    batch: list[Loaded | BadInput] = []
    count = -1
    for item in items:
        n = item.cameras if isinstance(item, Loaded) else count
        if batch and (n != count or len(batch) == size):
            yield batch
            batch = []
        count = n
        batch.append(item)
    if batch:
        yield batch


def _answers(
    batch: list[Loaded | BadInput],
    model: MapModel,
    index: MapIndex | None,
    options: InferOptions,
) -> list[_Answer | BadInput]:
    """What the network says of each frame of a batch, errors of frames in their places."""
    good = [item for item in batch if isinstance(item, Loaded)]
    if not good:
        return [item for item in batch if isinstance(item, BadInput)]
    poses, slots, out = _look(model, index, good, options.looks)
    answers: list[_Answer | BadInput] = []
    k = 0
    for item in batch:
        if isinstance(item, BadInput):
            answers.append(item)
            continue
        seen = _observations(model, out, k, item.frame.index, slots[k], options)
        pose, covariance = _end_to_end(poses[k], out, k, len(slots[k]))
        about = (item.frame, item.cameras)
        answers.append(_Answer(*about, seen, pose, covariance, slots[k].dropped))
        k += 1
    return answers


def _look(
    model: MapModel, index: MapIndex | None, batch: list[Loaded], looks: int
) -> tuple[list[Array], list[PriorSlots], dict[str, Any]]:
    """Ask the network ``looks`` times. Returns the poses that the prior was cropped at in the end
    (map_SE3_ego, (4, 4) each), the prior's slots and the answer."""

    def ask() -> tuple[list[PriorSlots], dict[str, Any]]:
        slots = [_slots(index, pose, model) for pose in poses]
        return slots, _call(model, batch, slots)

    poses = [item.frame.map_SE3_ego for item in batch]
    slots, out = ask()
    for _ in range(looks - 1 if index is not None else 0):
        poses = [
            _corrected(item.frame, poses[k], out, k, len(slots[k])) for k, item in enumerate(batch)
        ]
        slots, out = ask()
    return poses, slots, out


def _corrected(frame: Frame, at: Array, out: dict[str, Any], k: int, slot_count: int) -> Array:
    """The pose of the last answer; the initial one where there is none or it went astray."""
    if not slot_count:
        return at
    pose: Array = at @ se3_from_xyyaw(*np.asarray(out["pose_delta"][k], np.float64))
    moved = xyyaw_of(pose) - xyyaw_of(frame.map_SE3_ego)
    moved[2] = wrap_angle(moved[2])
    return pose if (np.abs(moved) < FAR_SIGMAS * frame.sigma).all() else frame.map_SE3_ego


def _slots(index: MapIndex | None, pose: Array, model: MapModel) -> PriorSlots:
    info = model.info
    local = index.crop(pose, info.range_m) if index is not None else []
    return prior_slots(local, pose, info.classes, info.vertex_count, info.prior_slots)


def _call(model: MapModel, batch: list[Loaded], slots: list[PriorSlots]) -> dict[str, Any]:
    """One call of the network; slots are padded with zeros to the fullest frame (at least 1)."""
    count = max(1, max(len(s) for s in slots))
    points = np.zeros((len(batch), count, model.info.vertex_count, 2), np.float32)
    classes = np.zeros((len(batch), count), np.int64)
    mask = np.zeros((len(batch), count), np.float32)
    for k, s in enumerate(slots):
        points[k, : len(s)] = s.points
        classes[k, : len(s)] = s.class_index
        mask[k, : len(s)] = 1
    given = [np.stack(values) for values in zip(*(item.given for item in batch), strict=True)]
    return model(*given, points, classes, mask)


def _observations(
    model: MapModel,
    out: dict[str, Any],
    k: int,
    frame: int,
    slots: PriorSlots,
    options: InferOptions,
) -> Observations:
    """The observations of frame ``k`` of a batch: prior queries first, then new ones by score.

    A new query that lies on a matched prior element of its class found that element again; one that
    lies on a better new one fades.
    """
    names = np.array(model.info.classes, dtype=object)
    p, v = len(slots), model.info.vertex_count
    first_prior = out["scores"].shape[1] - out["prior_score"].shape[1]
    new_scores = out["scores"][k, :first_prior]
    best = new_scores.argmax(axis=1)
    score = new_scores[np.arange(first_prior), best]
    score = fade_duplicates(out["points"][k, :first_prior], best, score)
    existence = out["prior_score"][k, :p]
    answered = existence >= options.existence_threshold
    lines = out["points"][k, first_prior : first_prior + p]
    twice = on_prior(
        out["points"][k, :first_prior], best, lines[answered], slots.class_index[answered]
    )
    keep = np.flatnonzero((score >= options.score_threshold) & ~twice)
    keep = keep[np.argsort(-score[keep], kind="stable")]
    rows = np.concatenate([first_prior + np.arange(p), keep])
    state = np.where(answered, MATCHED, OUTDATED)
    unknown = np.full(len(keep), np.nan, np.float32)
    return Observations(
        frame=np.full(len(rows), frame, np.int32),
        query=rows.astype(np.int32),
        state=np.concatenate([state, np.full(len(keep), NEW)]).astype(np.int8),
        class_name=np.concatenate([names[slots.class_index], names[best[keep]]]),
        score=np.concatenate([existence, score[keep]]).astype(np.float32),
        existence=np.concatenate([existence, unknown]).astype(np.float32),
        element_id=np.array([*slots.element_ids, *([None] * len(keep))], dtype=object),
        points=out["points"][k, rows].astype(np.float32),
        sigma=np.maximum(out["sigma"][k, rows], 1e-3).astype(np.float32),
        prior_points=np.concatenate([slots.map_points, np.full((len(keep), v, 2), np.nan)]),
    )


def _end_to_end(at: Array, out: dict[str, Any], k: int, slot_count: int) -> tuple[Array, Array]:
    """T^E = T⁰ · SE2(δ): x, y, yaw in the map frame and its covariance; NaN without a prior.

    ``at`` (4, 4) is T⁰, where the prior was cropped."""
    if not slot_count:
        return np.full(3, np.nan), np.full((3, 3), np.nan)
    delta = np.asarray(out["pose_delta"][k], np.float64)
    pose = at @ se3_from_xyyaw(delta[0], delta[1], delta[2])
    yaw = float(yaw_of(at))
    turn = np.eye(3)
    turn[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    return xyyaw_of(pose), turn @ np.asarray(out["pose_covariance"][k], np.float64) @ turn.T


def _frames(rows: list[tuple[Frame, int, Array, Array]]) -> RunFrames:
    unknown = np.full(3, np.nan)

    def known(value: Array | None) -> Array:
        return unknown if value is None else np.asarray(value, np.float64)

    frames = [row[0] for row in rows]
    return RunFrames(
        frame=np.array([f.index for f in frames], np.int32),
        timestamp_ns=np.array([f.timestamp_ns for f in frames], np.int64),
        initial=np.stack([f.map_SE3_ego for f in frames]),
        sigma=np.stack([f.sigma for f in frames]),
        odometry=np.stack([known(f.odometry) for f in frames]),
        odometry_sigma=np.stack([known(f.odometry_sigma) for f in frames]),
        end_to_end=np.stack([row[2] for row in rows]),
        end_to_end_covariance=np.stack([row[3] for row in rows]),
        camera_count=np.array([row[1] for row in rows], np.int32),
    )


def _occluders(rows: list[tuple[Frame, int, Array, Array]]) -> pa.Table | None:
    names = ("x", "y", "yaw", "length", "width", "height", "z")
    boxes = [(frame.index, box) for frame, *_ in rows for box in frame.occluders]
    if not boxes:
        return None
    columns: dict[str, Any] = {"frame": pa.array([f for f, _ in boxes], pa.int32())}
    for name in names:
        columns[name] = pa.array([getattr(box, name) for _, box in boxes], pa.float32())
    return pa.table(columns, schema=OCCLUDERS.columns)
