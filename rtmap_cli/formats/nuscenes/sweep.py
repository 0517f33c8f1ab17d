"""LiDAR sweeps of nuScenes: ``.pcd.bin``, five float32 a point (x, y, z, intensity, ring)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput

Array = NDArray[np.float64]


def read_sweep_file(path: Path, ego_SE3_lidar: Array, features: int = 5) -> Array:
    """(n, 4) x, y, z (ego frame, metres) and intensity in [0, 1]; BadInput when it is broken.

    Points that are not numbers are left out. ``features`` values are stored per point; info files
    that state four describe files of five.
    """
    if not path.exists():
        raise BadInput(path, "no such sweep")
    data = np.frombuffer(path.read_bytes()[: path.stat().st_size // 4 * 4], np.float32)
    if path.stat().st_size % 20 == 0:
        features = 5
    if not len(data) or path.stat().st_size % (4 * features) or features < 4:
        raise BadInput(path, f"is not a sweep of {features} float32 a point", "is it truncated?")
    points = data.reshape(-1, features)[:, :4].astype(np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    xyz = points[:, :3] @ ego_SE3_lidar[:3, :3].T + ego_SE3_lidar[:3, 3]
    return np.column_stack([xyz, np.clip(points[:, 3] / 255.0, 0.0, 1.0)])
