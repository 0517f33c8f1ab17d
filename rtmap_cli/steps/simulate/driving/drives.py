"""Drives to observe along: true poses from a log or a route, and what the vehicle knows of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.polylines import arc_length
from rtmap_cli.geometry.poses import invert, se3_from_xyyaw, wrap_angle, xyyaw_of
from rtmap_cli.logs.log import Log, Occluder
from rtmap_cli.logs.run import Poses, RunFrames
from rtmap_cli.steps.simulate.driving.traffic import generated_traffic
from rtmap_cli.steps.simulate.perceiving.noise import first_order_walk, generator
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
from rtmap_cli.steps.simulate.perceiving.presets import Preset

Array = NDArray[np.float64]

EPOCH_NS = int(datetime(2026, 1, 5, 8, tzinfo=UTC).timestamp()) * 10**9
DAY_NS = 86_400 * 10**9
"""Drives over a route start on this day and hour, one day later per drive."""

LANE_SD, WANDER_SD, WANDER_LENGTH = 0.3, 0.1, 40.0
"""Where in its lane a drive over a route keeps: sd of the drive, sd and length (m) of its sway."""


@dataclass(frozen=True)
class Drive:
    """True poses map_SE3_ego (n, 4, 4) at times (n,) ns; boxes per frame in the ego frame, or
    None where traffic is unknown."""

    name: str
    crs: str
    timestamp_ns: NDArray[np.int64]
    pose: Array
    occluders: list[tuple[Occluder, ...]] | None = None

    def __len__(self) -> int:
        return len(self.pose)


def drive_over_route(
    name: str, crs: str, route: Array, spacing: float, rate: float, lateral: float, key: DriveKey
) -> Drive:
    """A drive along a route (n, 3), one frame every ``spacing`` metres and 1 / ``rate`` seconds.

    The vehicle keeps ``lateral`` metres to the left of the route and sways a little; each drive
    does so otherwise. Poses are level; times have ±4 ms jitter.
    """
    rng = generator(*key.drive, "route")
    s = arc_length(route)
    # The chords of a bent route are a little shorter than its arc.
    at = np.minimum(np.arange(0.0, s[-1] + 0.1, spacing), s[-1])
    xyz = np.stack([np.interp(at, s, route[:, k]) for k in range(3)], axis=-1)
    headings = np.unwrap(np.arctan2(*np.gradient(route[:, :2], axis=0).T[::-1]))
    yaw = np.interp(at, s, headings)
    place = lateral + LANE_SD * rng.normal()
    sway = WANDER_SD * first_order_walk(rng, at, WANDER_LENGTH, 1)[:, 0]
    side = place + np.convolve(np.pad(sway, 4, mode="edge"), np.ones(9) / 9, mode="valid")
    jitter = rng.integers(-4_000_000, 4_000_001, len(at))
    first = EPOCH_NS + (key.seed * 97 + key.traversal) % 3650 * DAY_NS
    times = first + np.round(np.arange(len(at)) * 1e9 / rate).astype(np.int64) + jitter
    x, y = xyz[:, 0] - side * np.sin(yaw), xyz[:, 1] + side * np.cos(yaw)
    return Drive(name, crs, times, se3_from_xyyaw(x, y, yaw, xyz[:, 2]))


def drive_of_log(log: Log, true_poses: Poses | None, lateral: float) -> Drive:
    """The drive that a log recorded, shifted ``lateral`` metres to the left.

    True poses of the log where it has them (native logs keep them apart), else its own poses.
    """
    frames = list(log.frames())
    if not frames:
        raise BadInput(log.path, "the log has no frames")
    pose = np.stack([f.map_SE3_ego for f in frames])
    if true_poses is not None:
        rows = {int(f): i for i, f in enumerate(true_poses.frame)}
        missing = [f.index for f in frames if f.index not in rows]
        if missing:
            raise BadInput(log.path, f"frame {missing[0]} has no true pose")
        pose = true_poses.pose[[rows[f.index] for f in frames]].copy()
    pose = pose @ se3_from_xyyaw(np.array(0.0), np.array(lateral), np.array(0.0))
    times = np.array([f.timestamp_ns for f in frames], np.int64)
    boxes = [f.occluders for f in frames]
    return Drive(log.log_id, log.crs, times, pose, boxes if any(boxes) else None)


def thinned(drive: Drive, spacing: float | None, rate: float | None) -> Drive:
    """The frames of a drive nearest to every ``spacing`` metres of path, or 1 / ``rate`` seconds.

    With a spacing, a log that stands still keeps one frame of the place.
    """
    if spacing is not None:
        position, step = arc_length(drive.pose[:, :2, 3]), spacing
    elif rate is not None:
        position, step = (drive.timestamp_ns - drive.timestamp_ns[0]) / 1e9, 1.0 / rate
    else:
        return drive
    wanted = np.arange(0.0, position[-1] + 1e-3, step)
    after = np.clip(np.searchsorted(position, wanted), 1, max(len(drive) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(drive) - 1)
    nearer = wanted - position[before] <= position[after] - wanted
    index = np.unique(np.where(nearer, before, after))
    boxes = None if drive.occluders is None else [drive.occluders[i] for i in index]
    return replace(
        drive, timestamp_ns=drive.timestamp_ns[index], pose=drive.pose[index], occluders=boxes
    )


def with_traffic(drive: Drive, preset: Preset, key: DriveKey) -> Drive:
    """The drive with generated vehicles (``vehicles_per_drive`` on average) instead of its own."""
    rng = generator(*key.drive, "traffic")
    seconds = (drive.timestamp_ns - drive.timestamp_ns[0]) / 1e9
    boxes = generated_traffic(rng, xyyaw_of(drive.pose), seconds, preset.vehicles_per_drive)
    return replace(drive, occluders=boxes)


def initial_poses(drive: Drive, preset: Preset, key: DriveKey) -> RunFrames:
    """What the vehicle knows: GNSS poses with bias, drift and white noise, and odometry.

    The stated sigmas are the true totals; height, roll and pitch are the true ones.
    """
    rng = generator(*key.drive, "gnss")
    n = len(drive)
    bias, drift, white = preset.gnss
    travelled = arc_length(drive.pose[:, :2, 3])
    error = bias * rng.normal(size=2)
    error = error + drift * first_order_walk(rng, travelled, preset.gnss_drift_length, 2)
    error = error + white * rng.normal(size=(n, 2))
    yaw_bias, yaw_white = np.radians(preset.gnss_yaw_deg)
    yaw = yaw_bias * rng.normal() + yaw_white * rng.normal(size=n)
    turned = se3_from_xyyaw(np.zeros(n), np.zeros(n), yaw)
    initial = drive.pose.copy()
    initial[:, :3, :3] = turned[:, :3, :3] @ initial[:, :3, :3]
    initial[:, :2, 3] += error
    position_sd = float(np.sqrt(bias**2 + drift**2 + white**2))
    sigma = np.array([position_sd, position_sd, float(np.hypot(yaw_bias, yaw_white))])
    odometry, odometry_sigma = _odometry(drive, preset, key)
    return RunFrames(
        frame=np.arange(n, dtype=np.int32),
        timestamp_ns=drive.timestamp_ns,
        initial=initial,
        # A preset without noise still needs a finite weight.
        sigma=np.tile(np.maximum(sigma, 1e-3), (n, 1)),
        odometry=odometry,
        odometry_sigma=odometry_sigma,
        end_to_end=np.full((n, 3), np.nan),
        end_to_end_covariance=np.full((n, 3, 3), np.nan),
        camera_count=np.zeros(n, np.int32),
    )


def _odometry(drive: Drive, preset: Preset, key: DriveKey) -> tuple[Array, Array]:
    """(n, 3) dx, dy, dyaw since the previous frame in its ego frame and their sd; row 0 is NaN."""
    rng = generator(*key.drive, "odometry")
    motion = np.full((len(drive), 3), np.nan)
    for i in range(1, len(drive)):
        motion[i] = xyyaw_of(invert(drive.pose[i - 1]) @ drive.pose[i])
    step = np.hypot(motion[:, 0], motion[:, 1])
    share, degrees = preset.odometry
    sigma = np.stack([share * step, share * step, np.radians(degrees) * step], axis=-1)
    motion = motion + rng.normal(size=motion.shape) * sigma
    motion[:, 2] = wrap_angle(motion[:, 2])
    return motion, np.maximum(sigma, [1e-3, 1e-3, 1e-5])
