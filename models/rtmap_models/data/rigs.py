"""Rigs to train with: other counts, fields of view and mountings than any one vehicle has."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.cameras import fit_camera
from rtmap_cli.logs.log import Camera, Rig
from rtmap_models.config import ModelConfig

Array = NDArray[np.float64]

LAYOUTS: dict[str, list[tuple[float, float]]] = {
    # yaw (degrees, left positive), horizontal field of view (degrees)
    "six": [(0, 65), (55, 65), (-55, 65), (110, 65), (-110, 65), (180, 105)],
    "ring": [(0, 62), (45, 64), (-45, 64), (99, 64), (-99, 64), (153, 64), (-153, 64)],
    "narrow": [(0, 47), (45, 62), (-45, 62), (99, 62), (-99, 62), (153, 62), (-153, 62)],
    "round": [(0, 70), (51, 70), (-51, 70), (103, 70), (-103, 70), (154, 70), (-154, 70)],
    "eight": [(k * 45.0, 60) for k in range(8)],
}
"""``narrow`` has a portrait front camera between wider ones."""

SHARES = {"six": 0.12, "ring": 0.36, "narrow": 0.28, "round": 0.12, "eight": 0.12}


def sample_rig(config: ModelConfig, rng: np.random.Generator) -> Rig:
    """A random rig whose cameras already have the network's image size and horizon."""
    layout = LAYOUTS[str(rng.choice(list(SHARES), p=list(SHARES.values())))]
    height, zoom = rng.uniform(1.3, 2.1), rng.uniform(0.92, 1.1)
    ahead = rng.uniform(0.6, 1.7)
    cameras = []
    for k, (yaw, view) in enumerate(layout):
        angle = np.radians(yaw + rng.normal(0, 2.0))
        place = [
            ahead + rng.uniform(0.2, 0.6) * (np.cos(angle) - 1) + rng.normal(0, 0.08),
            0.4 * np.sin(angle) + rng.normal(0, 0.05),
            height + rng.normal(0, 0.05),
        ]
        pitch, roll = np.radians(rng.normal([1.0, 0.0], [1.5, 0.7]))
        pose = camera_pose(angle, pitch, roll, np.array(place))
        half_view = np.radians(np.clip(view * zoom * rng.uniform(0.97, 1.03), 35, 115)) / 2
        cameras.append(_fitted(f"camera_{k}", half_view, pose, config, rng))
    return Rig(tuple(cameras))


def camera_pose(yaw: float, pitch: float, roll: float, place: Array) -> Array:
    """ego_SE3_camera of a camera that looks to ``yaw`` (left positive), ``pitch`` down; radians."""
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([c * right + s * down, c * down - s * right, forward])
    pose[:3, 3] = place
    return pose


def _fitted(
    name: str, half_view: float, pose: Array, config: ModelConfig, rng: np.random.Generator
) -> Camera:
    height, width = config.image_size
    focal = 0.5 * width / np.tan(half_view)
    middle = 0.5 * (width - 1) + rng.normal(0, 0.01) * width
    plain = np.array([[focal, 0, middle], [0, focal, 0.5 * (height - 1)], [0, 0, 1]])
    _, fitted = fit_camera(plain, pose, (height, width), (height, width), config.horizon)
    return Camera(name, width, height, fitted, pose)
