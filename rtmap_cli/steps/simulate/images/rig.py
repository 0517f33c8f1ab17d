"""A default ring of seven cameras, and its mounting errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtmap_cli.geometry.cameras import horizon_row
from rtmap_cli.logs.log import Camera, Rig

RING = (
    ("ring_front_center", 0.0, 1.63, 0.0, 62.0),
    ("ring_front_left", 45.0, 1.55, 0.20, 64.0),
    ("ring_front_right", -45.0, 1.55, -0.20, 64.0),
    ("ring_side_left", 99.0, 1.31, 0.28, 64.0),
    ("ring_side_right", -99.0, 1.31, -0.28, 64.0),
    ("ring_rear_left", 153.0, 1.09, 0.13, 64.0),
    ("ring_rear_right", -153.0, 1.09, -0.13, 64.0),
)
"""Name, yaw (degrees, left positive), x and y of the mount (m), horizontal field of view (deg)."""

CAMERA_HEIGHT = 1.65
"""Height above the road, metres (the ego origin of a town's log lies on the road)."""


def default_rig(
    width: int = 512, height: int = 336, horizon: float | None = None, ground_z: float = 0.0
) -> Rig:
    """Seven level pinhole cameras of ``width`` × ``height`` pixels without distortion.

    ``horizon`` puts the horizon on row ``horizon * height`` (default: 0.38, little sky);
    ``ground_z`` is the height of the road in the ego frame, metres.
    """
    share = 0.38 if horizon is None else horizon
    cameras = []
    for name, yaw, x, y, fov in RING:
        focal = width / (2 * np.tan(np.radians(fov) / 2))
        intrinsics = np.array(
            [[focal, 0, (width - 1) / 2], [0, focal, share * height], [0, 0, 1.0]]
        )
        c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
        pose = np.eye(4)
        # Columns: camera x (right), y (down), z (forward) in the ego frame.
        pose[:3, 0], pose[:3, 1], pose[:3, 2] = (s, -c, 0), (0, 0, -1), (c, s, 0)
        pose[:3, 3] = (x, y, CAMERA_HEIGHT + ground_z)
        cameras.append(Camera(name, width, height, intrinsics, pose))
    return Rig(tuple(cameras))


CAMPUS = (("front_left", 12.0, 0.95, 0.35), ("front_right", -12.0, 0.95, -0.35))
"""Name, yaw (degrees), x and y of the two cameras of a campus cart (m); 75° wide, 1.9 m high."""


def campus_rig(width: int = 512, height: int = 336, ground_z: float = 0.0) -> Rig:
    """Two front cameras under the roof of a cart, horizon on 0.45 of the height; see `CAMPUS`."""
    focal = width / (2 * np.tan(np.radians(37.5)))
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, 0.45 * height], [0, 0, 1.0]])
    cameras = []
    for name, yaw, x, y in CAMPUS:
        c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
        pose = np.eye(4)
        pose[:3, 0], pose[:3, 1], pose[:3, 2] = (s, -c, 0), (0, 0, -1), (c, s, 0)
        pose[:3, 3] = (x, y, 1.9 + ground_z)
        cameras.append(Camera(name, width, height, intrinsics, pose))
    return Rig(tuple(cameras))


def jitter_rig(
    rig: Rig, rng: np.random.Generator, keep_horizon: bool = True, scale: float = 1.0
) -> Rig:
    """Another vehicle's rig: mounts turned by about 0.6°, moved by 4 cm, raised by −0.15…0.25 m,
    focal lengths ±5 %.

    The jitter is known (it is part of the returned calibration). ``keep_horizon`` shifts the
    principal point so that the horizon stays on its row.
    """
    lift = rng.uniform(-0.15, 0.25) * scale
    cameras = []
    for camera in rig:
        pose = camera.ego_SE3_camera.copy()
        pose[:3, :3] = _rotation(rng.normal(0, 0.01 * scale, 3)) @ pose[:3, :3]
        pose[:3, 3] += rng.normal(0, 0.04 * scale, 3) + (0, 0, lift)
        intrinsics = camera.intrinsics.copy()
        factor = 1 + scale * rng.uniform(-0.05, 0.05)
        intrinsics[0, 0] *= factor
        intrinsics[1, 1] *= factor
        if keep_horizon:
            before = horizon_row(camera.intrinsics, camera.ego_SE3_camera)
            intrinsics[1, 2] += before - horizon_row(intrinsics, pose)
        cameras.append(replace(camera, intrinsics=intrinsics, ego_SE3_camera=pose))
    return Rig(tuple(cameras))


def scale_camera(camera: Camera, width: int) -> Camera:
    """The same camera with images of another width; the aspect is kept."""
    k = width / camera.width
    height = max(1, round(camera.height * k))
    warp = np.array([[k, 0, 0.5 * k - 0.5], [0, k, 0.5 * k - 0.5], [0, 0, 1.0]])
    return replace(camera, width=width, height=height, intrinsics=warp @ camera.intrinsics)


def _rotation(vector: np.ndarray) -> np.ndarray:
    """(3,) rotation vector in radians → (3, 3)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)
