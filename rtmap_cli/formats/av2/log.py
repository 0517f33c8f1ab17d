"""Argoverse 2 sensor logs as they lie on disk, by pyarrow and JSON alone (docs/formats/av2.md).

Everything comes out in the UTM frame of the log's city (city frame + origin of the city); the ego
frame is x forward, y left, z up, its origin about 0.32 m above the road.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.av2.files import (
    OCCLUDING,
    RING_CAMERAS,
    Cuboids,
    Sweep,
    find_city,
    read_cuboids,
    read_poses,
    read_rig,
    read_sweep,
    timed_files,
)
from rtmap_cli.formats.av2.ground import GroundHeight, read_ground
from rtmap_cli.formats.av2.vector_map import read_av2_archive, read_av2_map, vector_map_of
from rtmap_cli.geometry.poses import interpolate, invert, yaw_of
from rtmap_cli.logs.log import Frame, Occluder
from rtmap_cli.logs.native import decode_image
from rtmap_cli.maps.crs import city_code, city_crs

__all__ = ["Av2Log", "read_av2_archive", "read_av2_map", "vector_map_of"]

Array = NDArray[np.float64]
Times = NDArray[np.int64]

GROUND_Z = -0.32
"""Height of the road in the ego frame, m: raster minus ego height has medians -0.324 to -0.313."""

POSE_SIGMA = np.array([0.1, 0.1, np.radians(0.1)])
"""Assumed standard deviations of the poses (m, m, rad); Argoverse 2 states none."""

CAMERA_TOLERANCE_NS = 30_000_000
CUBOID_TOLERANCE_NS = 60_000_000


class Av2Log:
    """One Argoverse 2 sensor log; satisfies ``Log``.

    ``poses`` (n, 4, 4) map_SE3_ego in UTM at ``pose_times``. Frames lie at the times of the front
    camera's images; without images at the annotated moments (10 Hz); without either every 0.1 s.
    ``notes`` says what the log lacks. Cameras expose up to 25 ms apart: each image has the pose of
    its own time.
    """

    def __init__(
        self,
        path: str | Path,
        rate_hz: float | None = None,
        city: str | None = None,
        cameras: tuple[str, ...] = RING_CAMERAS,
    ) -> None:
        """``rate_hz`` thins the frames; ``city`` is needed only where no map file names it."""
        self.path = Path(path)
        if not self.path.is_dir():
            raise BadInput(self.path, "no such log folder")
        self.log_id = self.path.resolve().name
        self.city = city_code(city or find_city(self.path) or _no_city(self.path), self.path)
        self.crs, self.origin = city_crs(self.city, self.path)
        self.ground_z = GROUND_Z
        self.pose_times, city_SE3_ego = read_poses(self.path)
        self.poses = city_SE3_ego.copy()
        self.poses[:, :2, 3] += self.origin
        self.rig = read_rig(self.path, cameras)
        self.annotations = read_cuboids(self.path)
        self.images = {
            name: timed_files(self.path / "sensors" / "cameras" / name, ".jpg") for name in cameras
        }
        self.sweeps = timed_files(self.path / "sensors" / "lidar", ".feather")
        self.frame_times = self._frame_times(rate_hz)

    def __len__(self) -> int:
        return len(self.frame_times)

    @property
    def notes(self) -> list[str]:
        """What the log lacks, one sentence each."""
        out = []
        if self.rig is None:
            out.append("no calibration: the log has no rig")
        if not any(self.images.values()):
            out.append("no images")
        if self.annotations is None:
            out.append("no annotations: nothing is known of occluders")
        if not self.sweeps:
            out.append("no LiDAR sweeps")
        return out

    @cached_property
    def ground(self) -> GroundHeight | None:
        """The ground-height raster, None without one."""
        return read_ground(self.path, self.origin)

    def ground_height(self, xy: Array) -> Array:
        """(n,) height of the ground under (n, 2) map points, metres; NaN where unknown."""
        return np.full(len(xy), np.nan) if self.ground is None else self.ground.at(xy)

    def pose_at(self, times_ns: Times) -> Array:
        """(n, 4, 4) map_SE3_ego at times within the log, interpolated."""
        return interpolate(self.pose_times, self.poses, np.asarray(times_ns, np.int64))

    def cuboids(self, moment: Frame | int) -> Cuboids | None:
        """Cuboids in the ego frame of a frame (or time), from the nearest annotated moment.

        Boxes annotated at another time (at most 60 ms away) are taken as standing still. None
        where nothing was annotated near.
        """
        time = moment if isinstance(moment, int) else moment.timestamp_ns
        if self.annotations is None or not len(self.annotations):
            return None
        known = self.annotations.timestamp_ns
        nearest = _nearest(known, time)
        if abs(nearest - time) > CUBOID_TOLERANCE_NS:
            return None
        rows = self.annotations.select(
            slice(*np.searchsorted(known, [nearest, nearest + 1]).tolist())
        )
        if nearest == time:
            return rows
        there, here = self.pose_at(np.array([nearest, time]))
        moved = invert(here) @ there @ rows.ego_SE3_object
        return Cuboids(
            **{n: getattr(rows, n) for n in Cuboids.__dataclass_fields__}
            | {"ego_SE3_object": moved}
        )

    def sweep(self, timestamp_ns: int) -> Sweep:
        """The LiDAR sweep of exactly this time, in the ego frame of this time."""
        if timestamp_ns not in self.sweeps:
            raise BadInput(self.path / "sensors" / "lidar", f"no sweep {timestamp_ns}.feather")
        return read_sweep(self.sweeps[timestamp_ns])

    def read_sweep(self, frame: Frame) -> Array | None:
        """(n, 4) x, y, z (ego frame of the frame, metres) and intensity in [0, 1], or None."""
        if frame.lidar is None:
            return None
        sweep = read_sweep(frame.lidar)
        there, here = self.pose_at(np.array([sweep.timestamp_ns, frame.timestamp_ns]))
        move = invert(here) @ there
        xyz = sweep.xyz @ move[:3, :3].T + move[:3, 3]
        return np.column_stack([xyz, sweep.intensity / 255.0])

    def read_image(
        self, frame: Frame, camera: str, at_least: tuple[int, int] | None = None
    ) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB of one camera of one frame (see ``decode_image``)."""
        if camera not in frame.images:
            raise BadInput(self.path, f"frame {frame.index} has no image of {camera}")
        return decode_image(frame.images[camera], at_least)

    def frames(self) -> Iterator[Frame]:
        """The frames in time order."""
        poses = self.pose_at(self.frame_times)
        times = {name: np.array(list(files), np.int64) for name, files in self.images.items()}
        sweep_times = np.array(list(self.sweeps), np.int64)
        for index, (time, pose) in enumerate(zip(self.frame_times.tolist(), poses, strict=True)):
            images, exposed = {}, []
            for camera in self.rig or ():
                found = _within(times[camera.name], time, CAMERA_TOLERANCE_NS)
                if found is not None:
                    images[camera.name] = self.images[camera.name][found]
                    exposed.append(found)
            motion = invert(pose) @ self.pose_at(np.array(exposed)) if exposed else ()
            sweep = _within(sweep_times, time, CUBOID_TOLERANCE_NS)
            yield Frame(
                index=index,
                timestamp_ns=time,
                map_SE3_ego=pose,
                sigma=POSE_SIGMA.copy(),
                images=images,
                lidar=None if sweep is None else self.sweeps[sweep],
                occluders=occluders_of(self.cuboids(time)),
                ego_SE3_exposure=dict(zip(images, motion, strict=True)),
                image_time_ns=dict(zip(images, exposed, strict=True)),
            )

    def _frame_times(self, rate_hz: float | None) -> Times:
        first, last = int(self.pose_times[0]), int(self.pose_times[-1])
        images = next((files for files in self.images.values() if files), None)
        if images:
            base = np.array(list(images), np.int64)
        elif self.annotations is not None and len(self.annotations):
            base = np.unique(self.annotations.timestamp_ns)
        else:
            base = np.arange(first, last + 1, int(1e9 / (rate_hz or 10.0)), dtype=np.int64)
        base = base[(base >= first) & (base <= last)]
        if not len(base):
            raise BadInput(self.path, "no image and no annotation lies in the time of the poses")
        return base if rate_hz is None else thin(base, rate_hz)


def thin(times: Times, rate_hz: float) -> Times:
    """Those of the rising ``times`` (n,) nearest to a regular rate, each at most once.

    All of them where they are not denser than the rate asked for.
    """
    duration = (times[-1] - times[0]) / 1e9
    if len(times) < 2 or (len(times) - 1) / duration <= 1.05 * rate_hz:
        return times
    steps = int(duration * rate_hz + 1e-6) + 1
    wanted = times[0] + (np.arange(steps) * (1e9 / rate_hz)).astype(np.int64)
    right = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    left_nearer = wanted - times[right - 1] <= times[right] - wanted
    return times[np.unique(np.where(left_nearer, right - 1, right))]


def occluders_of(cuboids: Cuboids | None) -> tuple[Occluder, ...]:
    """The boxes that hide the road (vehicles and trailers), upright, in the cuboids' frame."""
    if cuboids is None:
        return ()
    hiding = np.array([name in OCCLUDING for name in cuboids.category], bool)
    rows = cuboids.select(hiding)
    yaw = yaw_of(rows.ego_SE3_object)
    return tuple(
        Occluder(
            x=float(pose[0, 3]),
            y=float(pose[1, 3]),
            yaw=float(angle),
            length=float(size[0]),
            width=float(size[1]),
            height=float(size[2]),
            z=float(pose[2, 3] - size[2] / 2),
        )
        for pose, angle, size in zip(rows.ego_SE3_object, yaw, rows.size, strict=True)
    )


def _nearest(times: Times, time: int) -> int:
    k = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1)) if len(times) > 1 else 0
    if k and time - times[k - 1] <= times[k] - time:
        k -= 1
    return int(times[k])


def _within(times: Times, time: int, tolerance: int) -> int | None:
    if not len(times):
        return None
    nearest = _nearest(times, time)
    return nearest if abs(nearest - time) <= tolerance else None


def _no_city(path: Path) -> str:
    raise BadInput(path, "no map file names its city", "give the city (ATX, DTW, MIA, PAO, …)")
