"""The frames and pictures of a drive, one at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rtmap_cli.logs.log import Frame, Rig
from rtmap_cli.logs.run import Poses
from rtmap_cli.steps.simulate.driving.drive import lane_traffic
from rtmap_cli.steps.simulate.driving.drives import Drive, initial_poses, with_traffic
from rtmap_cli.steps.simulate.images.render import body_motion, render_cameras
from rtmap_cli.steps.simulate.images.style import make_style
from rtmap_cli.steps.simulate.perceiving.noise import generator
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
from rtmap_cli.steps.simulate.perceiving.presets import Preset
from rtmap_cli.steps.simulate.worlds.heights import level
from rtmap_cli.steps.simulate.worlds.world import World
from rtmap_cli.steps.simulate.worlds.world_ground import opencv

if TYPE_CHECKING:
    from rtmap_cli.steps.simulate.driving.drive_source import Source

Array = NDArray[np.float64]


def with_vehicles(
    path: Drive, source: Source, surface: Any, key: DriveKey, traffic: str | None
) -> Drive:
    """The drive with the vehicles that ``traffic`` asks for: log, generated or none.

    None: the log's boxes, generated ones where it has none. Generated vehicles follow the lanes of
    a town; along a log, whose lanes are unknown, they keep beside its path.
    """
    if traffic == "none":
        return replace(path, occluders=[()] * len(path))
    if traffic == "log" or (traffic is None and path.occluders is not None):
        return path
    if source.lanes is not None:
        return lane_traffic(path, source.lanes, surface, key)
    path = with_traffic(path, Preset(), key)
    lifted = [tuple(replace(o, z=source.ground_z) for o in b) for b in path.occluders or []]
    return replace(path, occluders=lifted)


ATTITUDE_DEG = 0.1
"""How well a vehicle knows its roll and pitch (standard deviation), as with an inertial unit."""


def on_springs(path: Drive, source: Source, key: DriveKey) -> Drive:
    """The drive as the body makes it: pitch, roll and heave on the springs are part of its poses.

    The poses of a recorded log have them already.
    """
    if source.lanes is None:
        return path
    style = make_style(generator(*key.drive, "style"))
    rng = generator(*key.drive, "springs")
    return replace(path, pose=np.stack([pose @ body_motion(style, rng) for pose in path.pose]))


def leaned(poses: Array, rng: np.random.Generator) -> Array:
    """Poses (n, 4, 4) whose roll and pitch are known to `ATTITUDE_DEG`."""
    about = np.radians(rng.normal(0.0, ATTITUDE_DEG, (len(poses), 3)) * [1, 1, 0])
    out = poses.copy()
    out[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(about).as_matrix()
    return out


def frames_of(path: Drive, key: DriveKey) -> Iterator[Frame]:
    """What the vehicle knows: rough poses with their sigmas, odometry, boxes."""
    known = initial_poses(path, Preset(), key)
    initial = leaned(known.initial, generator(*key.drive, "attitude"))
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


def lean_of(world: World, source: Source, pose: Array) -> Array:
    """(4, 4) the level frame under a vehicle from its ego frame (see `images_of`)."""
    lean = np.eye(4)
    if world.ground is None and source.lanes is not None:
        lean[:3, :3] = level(pose)[:3, :3].T @ pose[:3, :3]
    return lean


def images_of(
    world: World, path: Drive, rig: Rig, source: Source, key: DriveKey, quality: int
) -> Iterator[dict[str, bytes]]:
    """JPEG files of every frame by camera name; weather belongs to the drive.

    The vehicle leans as its pose says: over flat ground in a town, and over any hills. A recorded
    pose over a map without heights leans with slopes that are not drawn, and is taken upright.
    """
    cv2 = opencv()
    style = make_style(generator(*key.drive, "style"))
    parameters = [cv2.IMWRITE_JPEG_QUALITY, quality]
    for k, pose in enumerate(path.pose):
        boxes = path.occluders[k] if path.occluders else ()
        rng = generator(*key.drive, "camera", k)
        lean = lean_of(world, source, pose)
        images = render_cameras(world, pose, rig.cameras, style, boxes, rng, source.ground_z, lean)
        yield {
            camera.name: cv2.imencode(".jpg", image[..., ::-1], parameters)[1].tobytes()
            for camera, image in zip(rig, images, strict=True)
        }


def poses_of(path: Drive) -> Poses:
    """The true poses as a table of method ``truth`` with zero covariance."""
    n = len(path)
    return Poses(
        frame=np.arange(n, dtype=np.int32),
        timestamp_ns=path.timestamp_ns,
        method="truth",
        pose=path.pose,
        covariance=np.zeros((n, 6, 6)),
        eigenvalues=np.full((n, 3), np.nan),
        weakest_direction=np.full((n, 3), np.nan),
        residual_count=np.zeros(n, np.int32),
        chi2=np.zeros(n),
        status=np.full(n, "ok", dtype=object),
    )
