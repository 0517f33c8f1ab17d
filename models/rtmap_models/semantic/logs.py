"""Training frames from logs that carry semantic rasters (``semantic`` inside the log)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.footprint import footprint_of_log
from rtmap_cli.logs.log import Log
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.steps.infer.rasters import LogRasters, RasterSpec
from rtmap_cli.tables import whole_folder
from rtmap_models.config import SemanticConfig
from rtmap_models.data.jobs import SHARD_FRAMES, LogJob, true_poses
from rtmap_models.data.samples import Scene
from rtmap_models.data.shards import write_shard
from rtmap_models.data.views import scene_at
from rtmap_models.semantic.picture import wide_picture


def raster_spec(config: SemanticConfig) -> RasterSpec:
    """The rasters that a network of this configuration reads."""
    return RasterSpec(config.planes, config.raster_cell_m, *config.raster_half_m)


def make_raster_frames(job: LogJob, log: Log, truth: VectorMap) -> int:
    """Turn one log into shards of frames; returns their count.

    The elements around a frame are those at its true pose where the log has one, else at the pose
    that the raster was laid down with. BadInput when the log carries no rasters that fit.
    """
    config = job.config
    assert isinstance(config, SemanticConfig)
    rasters, index, true = (
        LogRasters(log, raster_spec(config)), MapIndex(truth, join=True), true_poses(log),
    )  # fmt: skip
    pictures: list[NDArray[np.uint8]] = []
    scenes: list[Scene] = []
    poses: list[NDArray[np.float64]] = []
    for frame in log.frames():
        pose = None
        if frame.index in rasters:
            pose = rasters.pose(frame.index) if true is None else true.get(frame.index)
        if pose is None:
            continue
        if poses and np.hypot(*(pose[:2, 3] - poses[-1][:2, 3])) < job.spacing_m:
            continue
        poses.append(pose)
        pictures.append(wide_picture(rasters.read(frame.index, frame.timestamp_ns), config))
        scenes.append(scene_at(index, pose, config))
    if not poses:
        raise BadInput(log.path, "no frame has a raster", "run rtmap semantic-map on the log")
    with whole_folder(job.folder) as folder:
        for start in range(0, len(poses), SHARD_FRAMES):
            some = slice(start, start + SHARD_FRAMES)
            footprint = footprint_of_log(log, config.range_m, np.stack(poses[some]))
            info = {"log": log.log_id, "footprint": footprint.as_json()}
            name = f"frames-{start // SHARD_FRAMES:05d}"
            write_shard(folder, name, np.stack(pictures[some]), scenes[some], info)
    return len(poses)
