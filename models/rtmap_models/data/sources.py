"""Where training frames come from: folders of frames, and logs of any kind that rtmap reads.

A log is turned into frames once and kept in a cache folder: its images fitted as `infer` fits
them, their bird's-eye picture, and what a map says is there. The true poses of a native log are
used where it has any, else the poses of the log: they must be better than the map needs to be.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.cameras import levelled
from rtmap_cli.logs.footprint import footprint_of_log
from rtmap_cli.logs.log import Frame, Log
from rtmap_cli.logs.open import log_format, open_log
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.crs import check_same_crs
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import read_map
from rtmap_cli.steps.infer.checks import check_prior_in_range
from rtmap_cli.steps.infer.images import FittedCamera
from rtmap_cli.steps.infer.levelling import RoadUnder
from rtmap_cli.tables import whole_folder
from rtmap_models.config import ModelConfig, SemanticConfig
from rtmap_models.data.jobs import SHARD_FRAMES, LogJob, true_poses
from rtmap_models.data.samples import Array
from rtmap_models.data.views import Pictures, View, scene_at

SPACING_M = 1.0
"""Frames of a log nearer than this to the last one taken are left out: nothing new in them."""


def gather(
    data: Sequence[str | Path],
    config: ModelConfig,
    cache: Path,
    map_path: Path | None = None,
    report: Callable[[str], None] = lambda _: None,
    workers: int = 1,
    spacing_m: float = SPACING_M,
    keep_images: bool | None = None,
) -> tuple[Path, ...]:
    """Folders of training frames for each of ``data``: a folder of frames as it is; a log (native,
    Argoverse 2, nuScenes …), a nuScenes folder with all its scenes or a folder of logs as folders
    in ``cache``, made where they are not there yet, ``workers`` logs at a time.

    ``map_path`` is the truth of every log (needed for native ones; Argoverse 2 and nuScenes bring
    their own). ``spacing_m`` between frames of a log, metres. BadInput when something is neither
    frames nor a log, and for what is wrong in one.
    """
    keep = config.needs_images if keep_images is None else keep_images
    folders: list[Path] = []
    jobs: list[LogJob] = []
    for spec in data:
        if is_frame_folder(Path(spec)):
            folders.append(Path(spec))
            continue
        if not Path(spec).exists() and not str(spec).partition(":")[2] and "#" not in str(spec):
            raise BadInput(spec, "no such folder", "give a log, or render towns with --frames")
        for found in logs_in(str(spec)):
            job = LogJob(found, cache, config, map_path, spacing_m, keep)
            job = job._replace(folder=cache / _cache_name(job))
            folders.append(job.folder)
            if not job.folder.is_dir():
                jobs.append(job)
    for done, (spec, result) in enumerate(_made(jobs, workers), start=1):
        if not isinstance(result, int):
            raise BadInput(*result)
        report(f"{spec}: {result} training frames ({done} of {len(jobs)} logs)")
    return tuple(folders)


def is_frame_folder(path: Path) -> bool:
    """Whether a folder holds shards of training frames (or nothing yet)."""
    if not path.is_dir() or ":" in path.name:
        return False
    shards = next((p for p in path.glob("*.json") if p.with_suffix(".npz").exists()), None)
    return shards is not None or not any(path.iterdir())


def logs_in(spec: str) -> list[str]:
    """The logs that an argument names: itself, every scene of a nuScenes folder, or every log
    folder right inside a folder. BadInput when there is none."""
    try:
        kind, path = log_format(spec)
    except BadInput:
        folder = Path(spec)
        inside = sorted(p for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []
        found = [p for p in inside if _is_log(p)]
        if not found:
            raise
        return [log for p in found for log in logs_in(str(p))]
    if kind == "nuscenes" and "#" not in str(path) and path.is_dir():
        from rtmap_cli.formats.nuscenes.log import nuscenes_scenes

        return [f"nuscenes:{path}#{scene}" for scene in nuscenes_scenes(path)]
    return [spec]


def _is_log(folder: Path) -> bool:
    try:
        log_format(folder)
    except BadInput:
        return False
    return True


def _cache_name(job: LogJob) -> str:
    """Log and a digest of everything that its frames depend on."""
    _, place = log_format(job.spec)
    config = job.config
    version = None if job.map_path is None else read_map(job.map_path).version
    what = [
        str(place.resolve()),
        config.image_size,
        config.horizon,
        config.range_m,
        config.cell_m,
        config.supersample,
        config.classes,
        job.keep_images,
        job.spacing_m,
        None if job.map_path is None else [str(job.map_path.resolve()), version],
    ]
    if isinstance(config, SemanticConfig):
        file = place / "semantic" / "semantic.json"
        what += [config.planes, file.read_text(encoding="utf-8") if file.is_file() else ""]
    digest = hashlib.sha256(json.dumps(what).encode()).hexdigest()[:12]
    return f"{place.resolve().name.replace('#', '-')}-{digest}"


Outcome = tuple[str, int | tuple[str, str, str]]
"""A log, and its count of frames or the parts of a BadInput (which does not survive pickling)."""


def _made(jobs: Sequence[LogJob], workers: int) -> Iterator[Outcome]:
    if workers == 1 or len(jobs) < 2:
        yield from map(_make, jobs)
        return
    with multiprocessing.get_context("spawn").Pool(min(workers, len(jobs))) as pool:
        yield from pool.imap_unordered(_make, jobs)


def _make(job: LogJob) -> Outcome:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    try:
        return job.spec, make_frames(job)
    except BadInput as error:
        return job.spec, (error.where, error.what, error.todo)


def make_frames(job: LogJob) -> int:
    """Turn one log into shards of frames; returns their count."""
    log = open_log(job.spec)
    truth = truth_of_log(job, log)
    if isinstance(job.config, SemanticConfig):
        from rtmap_models.semantic.logs import make_raster_frames

        return make_raster_frames(job, log, truth)
    with whole_folder(job.folder) as folder:
        count = 0
        for number, views in enumerate(_chunks(log_views(log, truth, job), SHARD_FRAMES)):
            pictures = Pictures(job.config, np.random.default_rng(number), job.keep_images)
            for view in views:
                pictures.add(view)
            seen = np.stack([view.map_SE3_ego for view in views])
            footprint = footprint_of_log(log, job.config.range_m, seen)
            info = {"log": log.log_id, "footprint": footprint.as_json()}
            pictures.write(folder, f"frames-{number:05d}", info)
            count += len(views)
        if not count:
            raise BadInput(log.path, "no frame has images", "train on a log with images")
    return count


def log_views(log: Log, truth: VectorMap, job: LogJob) -> Iterator[View]:
    """The frames of a log at their true poses, levelled as ``infer`` levels them; an absent camera
    is zero in both arrays."""
    config, index = job.config, MapIndex(truth, join=True)
    if log.rig is None:
        raise BadInput(log.path, "the log has no camera calibration", "training needs one")
    cameras = {
        c.name: FittedCamera(c, config.image_size, config.horizon, log.ground_z) for c in log.rig
    }
    true = true_poses(log)
    poses = {f.index: f.map_SE3_ego for f in log.frames()} if true is None else true
    road = RoadUnder(list(poses.values()), truth)
    last: Array | None = None
    for frame in log.frames():
        pose = poses.get(frame.index)
        if pose is None or not any(name in frame.images for name in cameras):
            continue
        if last is not None and np.hypot(*(pose[:2, 3] - last)) < job.spacing_m:
            continue
        last = pose[:2, 3]
        images, projections = _cameras_of(frame, cameras, config)
        projections = levelled(projections, road.plane(pose)).astype(np.float32)
        yield View(images, projections, scene_at(index, pose, config), pose)


def _cameras_of(
    frame: Frame, cameras: dict[str, FittedCamera], config: ModelConfig
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    images = np.zeros((len(cameras), *config.image_size, 3), np.uint8)
    projections = np.zeros((len(cameras), 3, 4), np.float32)
    for k, (name, camera) in enumerate(cameras.items()):
        if name in frame.images:
            try:
                images[k] = camera.load(frame.images[name])
            except BadInput as error:
                raise BadInput(error.where, error.what, "mend the image or take it away") from None
            projections[k] = camera.at(frame.ego_SE3_exposure.get(name))
    return images, projections


def truth_of_log(job: LogJob, log: Log) -> VectorMap:
    """The map that says what is there, in the log's frame."""
    if job.map_path is not None:
        vector_map = read_map(job.map_path)
        check_same_crs(vector_map.crs, log.crs, str(job.map_path))
        check_prior_in_range(vector_map, log, str(job.map_path))
        return vector_map
    kind, _ = log_format(job.spec)
    if kind == "av2":
        from rtmap_cli.formats.av2.vector_map import read_av2_map

        return read_av2_map(log.path)
    location = getattr(log, "location", None)
    if kind == "nuscenes" and location is not None:
        from rtmap_cli.formats.nuscenes.vector_map import read_nuscenes_map

        return read_nuscenes_map(log.path, location)
    raise BadInput(log.path, "the log brings no map of its own", "pass --map with the true map")


def _chunks(views: Iterable[View], size: int) -> Iterator[list[View]]:
    chunk: list[View] = []
    for view in views:
        chunk.append(view)
        if len(chunk) == size:
            yield chunk
            chunk = []
    if chunk:
        yield chunk
