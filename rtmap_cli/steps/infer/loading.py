"""What a network is given of a frame: the images of its cameras, or its semantic raster."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.cameras import levelled
from rtmap_cli.logs.log import Frame, Log
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.steps.infer.contract import ModelInfo
from rtmap_cli.steps.infer.images import FittedCamera
from rtmap_cli.steps.infer.levelling import RoadUnder
from rtmap_cli.steps.infer.rasters import LogRasters


@dataclass(frozen=True)
class Loaded:
    """A frame with the first inputs of the model, in their order, and how many cameras saw it."""

    frame: Frame
    given: tuple[NDArray[Any], ...]
    cameras: int


class Source(Protocol):
    """Reads frames of a log for a network; ``cameras`` are the names of those that it looks at."""

    @property
    def cameras(self) -> Sequence[str]: ...

    def load(self, frame: Frame) -> Loaded:
        """What the network is given of a frame; BadInput when that cannot be read."""


class CameraSource:
    """Images fitted to the network's size, levelled where ``level`` asks for it (`RoadUnder`)."""

    def __init__(self, log: Log, info: ModelInfo, prior: VectorMap | None, level: bool) -> None:
        if log.rig is None:
            raise BadInput(log.path, "the log has no camera calibration", "infer needs one")
        self.fitted = {
            camera.name: FittedCamera(camera, info.image_size, info.horizon, log.ground_z)
            for camera in log.rig
        }
        self.cameras = tuple(self.fitted)
        self.road = RoadUnder([f.map_SE3_ego for f in log.frames()], prior) if level else None

    def load(self, frame: Frame) -> Loaded:
        """``images`` (N, H, W, 3) and ``ego_to_image`` (N, 3, 4) of a frame."""
        names = [name for name in self.cameras if name in frame.images]
        if not names:
            todo = "simulate them (rtmap simulate images) or skip"
            raise BadInput(f"frame {frame.index}", "has no images", todo)
        fitted = [self.fitted[name] for name in names]
        images = np.stack(
            [c.load(frame.images[name]) for c, name in zip(fitted, names, strict=True)]
        )
        matrices = np.stack(
            [c.at(frame.ego_SE3_exposure.get(n)) for c, n in zip(fitted, names, strict=True)]
        )
        if self.road is not None:
            matrices = levelled(matrices, self.road.plane(frame.map_SE3_ego)).astype(np.float32)
        return Loaded(frame, (images, matrices), len(names))


class RasterSource:
    """The semantic rasters of a log, by default those in its folder ``semantic``."""

    cameras: Sequence[str] = ()

    def __init__(self, log: Log, info: ModelInfo, folder: Path | None) -> None:
        assert info.raster is not None
        self.rasters = LogRasters(log, info.raster, folder)

    def load(self, frame: Frame) -> Loaded:
        """``raster`` (K, rows, columns) of a frame."""
        return Loaded(frame, (self.rasters.read(frame.index, frame.timestamp_ns),), 0)


def source_of(
    log: Log, info: ModelInfo, prior: VectorMap | None, level: bool, semantic: Path | None
) -> Source:
    """What a model reads of a log, opened and checked."""
    if info.raster is not None:
        return RasterSource(log, info, semantic)
    return CameraSource(log, info, prior, level)
