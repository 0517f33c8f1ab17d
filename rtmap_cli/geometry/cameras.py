"""Pinhole projection and the fitting of any camera to a network's image size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import invert

Array = NDArray[np.float64]


def projection(intrinsics: Array, ego_SE3_camera: Array) -> Array:
    """(3, 4) matrix that maps ego points (x, y, z, 1) in metres to (u·w, v·w, w) in pixels.

    Pixel centres lie at integers; w is the depth in metres, positive in front of the camera.
    """
    return intrinsics @ invert(ego_SE3_camera)[:3]


def horizon_row(intrinsics: Array, ego_SE3_camera: Array) -> float:
    """Image row of the horizon of the ego plane in the column of the principal point, pixels.

    The viewing direction is brought to zero elevation in the ego frame and projected.
    """
    forward = ego_SE3_camera[:3, 2].copy()
    forward[2] = 0.0
    norm = np.linalg.norm(forward)
    if norm < 1e-6:
        return float(intrinsics[1, 2])
    direction = ego_SE3_camera[:3, :3].T @ (forward / norm)
    return float(intrinsics[1, 1] * direction[1] / direction[2] + intrinsics[1, 2])


def fit_camera(
    intrinsics: Array,
    ego_SE3_camera: Array,
    source_size: tuple[int, int],
    target_size: tuple[int, int],
    horizon: float,
) -> tuple[Array, Array]:
    """Scale a camera to the width of a target image and put its horizon on one row.

    Sizes are (height, width) in pixels. Returns the warp (3, 3) that takes source pixels to target
    pixels (a uniform scale and a vertical shift) and the intrinsics (3, 3) of the target image.
    The horizon lands on row ``horizon * height``; what falls outside the target is cropped, what is
    missing is black.
    """
    height, width = target_size
    scale = width / source_size[1]
    # Pixel centres at integers: the image spans [-0.5, size - 0.5].
    warp = np.array([[scale, 0.0, 0.5 * scale - 0.5], [0.0, scale, 0.5 * scale - 0.5], [0, 0, 1.0]])
    fitted = warp @ intrinsics
    shift = horizon * height - horizon_row(fitted, ego_SE3_camera)
    warp[1, 2] += shift
    return warp, warp @ intrinsics
