"""A drive with a LiDAR that turns while the vehicle moves: sweeps with times of their points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.geometry import lie
from rtmap_cli.geometry.poses import invert
from rtmap_cli.logs.log import Frame
from rtmap_cli.steps.simulate.driving.drives import Drive, initial_poses
from rtmap_cli.steps.simulate.images.drive_images import leaned, on_springs
from rtmap_cli.steps.simulate.images.style import make_style
from rtmap_cli.steps.simulate.perceiving.noise import generator
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
from rtmap_cli.steps.simulate.perceiving.presets import Preset
from rtmap_cli.steps.simulate.sensing.ground_labels import GroundLabels
from rtmap_cli.steps.simulate.sensing.lidar import LIDARS, Turning, sweep
from rtmap_cli.steps.simulate.sensing.scene import scene_at
from rtmap_cli.steps.simulate.worlds.roadside import BUILDING
from rtmap_cli.steps.simulate.worlds.world import World

if TYPE_CHECKING:
    from rtmap_cli.steps.simulate.driving.drive_source import Source

Array = NDArray[np.float64]

TURN_S = 0.1
"""Seconds of a turn."""
SLOTS = 72
"""Moments of a turn at which the vehicle's place is computed."""
SWAY_S = 0.15
"""Width (s) of a swing of the body on its springs, which is about 1 Hz."""
JUMP_S, JUMP_M = 20.0, (5.0, 30.0)
"""Length (s) and size (m) of a stretch where GNSS is off."""

GNSS = {
    "metre": Preset(),
    "rtk": Preset(gnss=(0.02, 0.02, 0.02), gnss_yaw_deg=(0.1, 0.1)),
}
"""Receivers: bias, drift and white noise of what a vehicle knows of its place."""


@dataclass(frozen=True)
class Recording:
    """What is recorded: ``lidar`` (a key of `LIDARS`), ``gnss`` (a key of `GNSS`), the number of
    stretches where GNSS ``jumps``, the height of curbs (m), whether the turn is skewed."""

    lidar: str = "vlp16"
    gnss: str = "metre"
    jumps: int = 0
    curb: float = 0.12
    skew: bool = True


def with_walls(world: World, seed: int) -> World:
    """The world with garden walls, 8 to 30 m long and 1.2 to 2.6 m high, 3 to 8 m off the road."""
    rng = np.random.default_rng([seed, 83])
    rows = []
    for ring in shapely.get_parts(shapely.boundary(world.surface)):
        at = float(rng.exponential(60.0))
        while at < ring.length:
            size, away = rng.uniform(8.0, 30.0), rng.uniform(3.0, 8.0) * rng.choice([-1.0, 1.0])
            p, q = ring.interpolate(at), ring.interpolate(min(at + 2.0, ring.length))
            heading = float(np.arctan2(q.y - p.y, q.x - p.x))
            x, y = p.x - np.sin(heading) * away, p.y + np.cos(heading) * away
            half = size / 2 * np.array([np.cos(heading), np.sin(heading)])
            line = shapely.linestrings([np.array([x, y]) - half, np.array([x, y]) + half])
            if shapely.distance(world.surface, line) > 1.0:
                box = [x, y, heading, size, 0.3, 0.0, rng.uniform(1.2, 2.6)]
                rows.append([*box, 150.0, 140.0, 130.0, BUILDING])
            at += size + float(rng.exponential(90.0))
    if not rows:
        return world
    return replace(world, objects=np.concatenate([world.objects, np.array(rows)]))


def steady(path: Drive, source: Source, key: DriveKey) -> Drive:
    """The drive on its springs, wheels on the ground: the body pitches and rolls."""
    moved = on_springs(path, source, key)
    lean = lie.log(invert(path.pose) @ moved.pose)[:, :3]
    twist = np.zeros((len(path), 6))
    twist[:, :3] = _swaying(lean, path.timestamp_ns / 1e9)
    pose = path.pose @ lie.exp(twist)
    return replace(path, pose=pose)


def _swaying(lean: Array, seconds: Array) -> Array:
    """Angles (n, 3) of independent frames, as large as they were but smooth in time: neighbouring
    sweeps of a spinning LiDAR show one swing of the body."""
    middle = lean.mean(axis=0)
    out = np.empty_like(lean)
    first = np.searchsorted(seconds, seconds - 4 * SWAY_S)
    last = np.searchsorted(seconds, seconds + 4 * SWAY_S, "right")
    for k, (a, b) in enumerate(zip(first, last, strict=True)):
        w = np.exp(-0.5 * ((seconds[a:b] - seconds[k]) / SWAY_S) ** 2)
        out[k] = w @ (lean[a:b] - middle) / np.sqrt((w**2).sum())
    return np.asarray(middle + out)


def frames_of_drive(path: Drive, key: DriveKey, recording: Recording) -> Iterator[Frame]:
    """What the vehicle knows: poses of its receiver with their sigmas, odometry, boxes."""
    known = initial_poses(path, GNSS[recording.gnss], key)
    initial = leaned(known.initial, generator(*key.drive, "attitude"))
    initial[:, :2, 3] += _jumps(path, key, recording.jumps)
    for k in range(len(path)):
        measured = bool(np.isfinite(known.odometry[k]).all())
        yield Frame(
            index=k,
            timestamp_ns=int(path.timestamp_ns[k]),
            map_SE3_ego=initial[k],
            sigma=known.sigma[k],
            odometry=known.odometry[k] if measured else None,
            odometry_sigma=known.odometry_sigma[k] if measured else None,
            occluders=path.occluders[k] if path.occluders else (),
        )


def _jumps(path: Drive, key: DriveKey, count: int) -> Array:
    """(n, 2) offsets of GNSS where it is off, zero elsewhere."""
    rng = generator(*key.drive, "gnss jumps")
    seconds = (path.timestamp_ns - path.timestamp_ns[0]) / 1e9
    out = np.zeros((len(path), 2))
    for _ in range(count):
        first = rng.uniform(0.0, max(seconds[-1] - JUMP_S, 0.0))
        heading, size = rng.uniform(0, 2 * np.pi), rng.uniform(*JUMP_M)
        rows = (seconds >= first) & (seconds < first + JUMP_S)
        out[rows] = size * np.array([np.cos(heading), np.sin(heading)])
    return out


def sweeps_of_drive(
    ground: GroundLabels, path: Drive, source: Source, key: DriveKey, recording: Recording
) -> Iterator[Array]:
    """The sweep of every frame: (n, 5) where the turn is skewed, else (n, 4)."""
    style = make_style(generator(*key.drive, "style"))
    for k, pose in enumerate(path.pose):
        boxes = path.occluders[k] if path.occluders else ()
        scene = scene_at(ground.world, source, pose, boxes, style)
        turning = _turning(path, k) if recording.skew else None
        rng = generator(*key.drive, "lidar", k)
        yield sweep(LIDARS[recording.lidar], ground, scene, rng, turning, recording.curb)


def _turning(path: Drive, k: int) -> Turning | None:
    """The vehicle's motion in the `TURN_S` before frame ``k``, at the twist of the step there; the
    first frame goes as the second."""
    if len(path) < 2:
        return None
    a = max(k - 1, 0)
    elapsed = float(path.timestamp_ns[a + 1] - path.timestamp_ns[a]) / 1e9
    twist = lie.log(invert(path.pose[a]) @ path.pose[a + 1]) / elapsed
    time = np.linspace(-TURN_S, 0.0, SLOTS + 1)[1:]
    return Turning(time, lie.exp(time[:, None] * twist))
