"""One frame of a log: its masks and its points, at one time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.poses import transform
from rtmap_cli.logs.log import Frame, Log, Rig
from rtmap_cli.logs.sensor_times import ego_at
from rtmap_cli.steps.semantic.evidence import Weighting
from rtmap_cli.steps.semantic.ground import split
from rtmap_cli.steps.semantic.labels import IGNORE
from rtmap_cli.steps.semantic.masks import Masks
from rtmap_cli.steps.semantic.project import View, label_points

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

PLANE_STEP = 0.1
"""Spacing of the points of the ground plane that is looked at without LiDAR (m)."""
PLANE_REACH = 0.6
"""Share of the range up to which a plane may stand in for the ground."""


@dataclass(frozen=True)
class Sweep:
    """Points of a frame in its ego frame: (n, 3) m and intensity (n,), None for a plane."""

    xyz: Floats
    intensity: Floats | None


@dataclass(frozen=True)
class SemanticPoints:
    """Points of the ground with a class: (n, 3) of the ego frame (m), classes and weights (n,)."""

    xyz: Floats
    classes: NDArray[np.uint8]
    weight: Floats


class Observer:
    """Reads frames of a log. ``reach`` (m): points farther away are not used; ``max_delay`` (s):
    how far apart a sweep and an image may be taken; ``plane``: look at the ground plane instead of
    the LiDAR. BadInput when the log has no calibration."""

    def __init__(
        self, log: Log, masks: Masks, weighting: Weighting, reach: float, max_delay: float,
        plane: bool,
    ) -> None:  # fmt: skip
        self.log, self.rig = log, rig_of(log)
        self.masks, self.weighting = masks, weighting
        self.reach, self.max_delay, self.plane = reach, max_delay, plane

    def sweep(self, frames: Sequence[Frame], k: int) -> Sweep | None:
        """The points of a frame, moved to its time; None where it has no sweep."""
        frame = frames[k]
        if self.plane:
            return Sweep(plane_points(self.reach * PLANE_REACH, self.log.ground_z), None)
        reader: Any = self.log
        points = reader.read_sweep(frame)
        if points is None:
            return None
        if not len(points):
            raise BadInput(frame.lidar or self.log.path, "holds no point", "drop the sweep")
        xyz = points[:, :3]
        if frame.lidar_time_ns is not None:
            xyz = transform(ego_at(frames, k, frame.lidar_time_ns), xyz)
        return Sweep(xyz.astype(np.float32), points[:, 3].astype(np.float32))

    def views(self, frames: Sequence[Frame], k: int) -> list[View]:
        """The cameras of a frame that have a mask, each where it was when it exposed."""
        out = []
        for camera in self.rig:
            mask = self.masks.read(frames[k], camera)
            if mask is not None:
                pose = self._exposure(frames, k, camera.name) @ camera.ego_SE3_camera
                out.append(View(camera, pose, mask))
        return out

    def _exposure(self, frames: Sequence[Frame], k: int, camera: str) -> Array:
        """(4, 4) ego frame at an exposure → ego frame of the frame."""
        frame = frames[k]
        time = frame.image_time_ns.get(camera)
        sweep = frame.timestamp_ns if frame.lidar_time_ns is None else frame.lidar_time_ns
        if time is not None and frame.lidar and not self.plane:
            apart = abs(time - sweep) / 1e9
            if apart > self.max_delay:
                raise BadInput(
                    self.log.path,
                    f"frame {frame.index}: {camera} and the LiDAR are {apart:.2f} s apart",
                    "check the times, or raise --max-delay",
                )
        if camera in frame.ego_SE3_exposure:
            return frame.ego_SE3_exposure[camera]
        return np.eye(4) if time is None else ego_at(frames, k, time)

    def observe(self, sweep: Sweep, views: Sequence[View]) -> SemanticPoints:
        """Points of the ground with their classes and weights."""
        return semantic_points(sweep, views, self.log.ground_z, self.reach, self.weighting)


def semantic_points(
    sweep: Sweep, views: Sequence[View], ground_z: float, reach: float, weighting: Weighting
) -> SemanticPoints:
    """The points of a sweep that lie on the ground within ``reach`` (m) and whose class a camera
    sees, with what they weigh (`Weighting`)."""
    xyz, intensity = sweep.xyz, sweep.intensity
    near = xyz[:, 0] ** 2 + xyz[:, 1] ** 2 < reach**2
    if intensity is None:
        ground, standing = xyz[near], np.zeros((0, 3), np.float32)
    else:
        xyz, intensity = xyz[near], intensity[near]
        below, above = split(xyz, ground_z)
        ground, standing, intensity = xyz[below], xyz[above], intensity[below]
    classes = label_points(ground, standing, views)
    kept = np.flatnonzero(classes != IGNORE)
    ground, classes = ground[kept], classes[kept]
    intensity = None if intensity is None else intensity[kept]
    return SemanticPoints(ground, classes, weighting.of(ground, intensity, classes))


def plane_points(reach: float, ground_z: float) -> Floats:
    """(n, 3) points every `PLANE_STEP` on the plane z = ``ground_z`` within ``reach`` (m)."""
    side = (np.arange(-reach, reach, PLANE_STEP) + PLANE_STEP / 2).astype(np.float32)
    x, y = np.meshgrid(side, side)
    inside = x * x + y * y < reach * reach
    x, y = x[inside], y[inside]
    return np.stack([x, y, np.full_like(x, ground_z)], axis=-1)


def has_sweeps(frames: Sequence[Frame]) -> bool:
    """Whether any frame has a sweep."""
    return any(f.lidar is not None for f in frames)


def rig_of(log: Log) -> Rig:
    """The rig of a log; BadInput without one."""
    if log.rig is None or not len(log.rig):
        raise BadInput(
            log.path, "has no calibration: points cannot be projected into images",
            "add rig.parquet",
        )  # fmt: skip
    return log.rig
