"""Log, Frame, Camera, Rig: one drive as it came from the vehicle, whatever format it lies in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with radial distortion k1, k2, k3.

    ``intrinsics`` (3, 3) in pixels of a ``width`` × ``height`` image, pixel centres at integers;
    the camera frame is x right, y down, z forward; ``ego_SE3_camera`` (4, 4) in metres.
    """

    name: str
    width: int
    height: int
    intrinsics: Array
    ego_SE3_camera: Array
    distortion: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Rig:
    """The cameras of a vehicle, in the order in which a network sees them."""

    cameras: tuple[Camera, ...]

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    def __len__(self) -> int:
        return len(self.cameras)


@dataclass(frozen=True)
class Occluder:
    """A box that hides what stands behind it: ego frame, metres, radians; z is the bottom."""

    x: float
    y: float
    yaw: float
    length: float
    width: float
    height: float = 1.6
    z: float = 0.0


@dataclass(frozen=True)
class Frame:
    """One moment of a log.

    ``map_SE3_ego`` (4, 4) is the initial pose T⁰ (metre level) in the log's CRS, ``sigma``
    (3,) its standard deviations (x m, y m, yaw rad); ``odometry`` (3,) the motion dx, dy, dyaw
    since the previous frame in the previous frame's ego frame, None where unknown.
    ``images`` maps camera names to files, ``lidar`` names a sweep or is None.
    """

    index: int
    timestamp_ns: int
    map_SE3_ego: Array
    sigma: Array
    odometry: Array | None = None
    odometry_sigma: Array | None = None
    images: dict[str, Path] = field(default_factory=dict)
    lidar: Path | None = None
    occluders: tuple[Occluder, ...] = ()


class Log(Protocol):
    """What every reader of logs offers; frames come lazily and in time order.

    ``ground_z`` is the ego-frame height of the road under the vehicle, metres (0 when the ego
    origin lies on the road, about -0.32 on an Argoverse 2 vehicle).
    """

    log_id: str
    crs: str
    rig: Rig | None
    path: Path
    ground_z: float

    def __len__(self) -> int:
        """Number of frames."""
        ...

    def frames(self) -> Iterator[Frame]:
        """The frames in time order."""
        ...
