"""Log, Frame, Camera, Rig: one drive as it came from the vehicle, whatever format it lies in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.lens import Lens

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A camera: where it sits, its pixels and its lens.

    ``intrinsics`` (3, 3) in pixels of a ``width`` × ``height`` image, pixel centres at integers;
    the camera frame is x right, y down, z forward; ``ego_SE3_camera`` (4, 4) in metres. ``model``
    "pinhole" with ``distortion`` k1, k2, k3 or k1 … k6 and ``tangential`` p1, p2, or "fisheye" with
    k1 … k4 (``rtmap_cli.geometry.lens``); ValueError for anything else.
    """

    name: str
    width: int
    height: int
    intrinsics: Array
    ego_SE3_camera: Array
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0)
    model: str = "pinhole"
    tangential: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        Lens(self.model, self.distortion, self.tangential)

    @cached_property
    def lens(self) -> Lens:
        """What bends the rays of this camera."""
        return Lens(self.model, self.distortion, self.tangential)

    def project(self, points: Array) -> Array:
        """(..., 3) points of the camera frame → (..., 2) pixels of the image as it is stored;
        NaN behind the camera and where the lens model means nothing."""
        depth = points[..., 2]
        ahead = depth > 1e-6
        xy = points[..., :2] / np.where(ahead, depth, 1.0)[..., None]
        seen = ahead & self.lens.inside(xy)
        bent = self.lens.distort(np.where(seen[..., None], xy, 0.0))
        pixels = bent @ self.intrinsics[:2, :2].T + self.intrinsics[:2, 2]
        return np.where(seen[..., None], pixels, np.nan)


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
    ``images`` maps camera names to files, ``lidar`` names a sweep or is None. Where the vehicle
    moved between an image and the frame, ``ego_SE3_exposure`` (4, 4) of that camera takes the ego
    frame at its exposure to the ego frame of this frame; a camera that is not in it exposed now.
    ``image_time_ns`` and ``lidar_time_ns`` are the sensors' own times where the log states them;
    readers whose poses are dense move sweeps and exposures to the frame themselves, for native
    logs ``rtmap_cli.logs.sensor_times`` does.
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
    ego_SE3_exposure: dict[str, Array] = field(default_factory=dict)
    image_time_ns: dict[str, int] = field(default_factory=dict)
    lidar_time_ns: int | None = None


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
