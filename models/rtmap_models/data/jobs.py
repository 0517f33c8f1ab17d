"""A log to be turned into training frames, and the poses that its frames are cut out at."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from rtmap_cli.logs.log import Log
from rtmap_models.config import ModelConfig
from rtmap_models.data.samples import Array

SHARD_FRAMES = 24


class LogJob(NamedTuple):
    """One log to be turned into frames in ``folder``."""

    spec: str
    folder: Path
    config: ModelConfig
    map_path: Path | None
    spacing_m: float
    keep_images: bool


def true_poses(log: Log) -> dict[int, Array] | None:
    """Poses that a simulator or a survey laid beside a log, by frame."""
    read = getattr(log, "truth_poses", None)
    poses = read() if read is not None else None
    if poses is None:
        return None
    return {int(k): pose for k, pose in zip(poses.frame, poses.pose, strict=True)}
