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


PLANE_REACH_M = 15.0
"""A point of the road this far from the vehicle counts half."""


def fit_plane(points: Array) -> Array:
    """(3,) a, b, c of the road z = a x + b y + c through (n, 3) points of it in the ego frame,
    metres, the nearer the heavier; least squares.

    Level where there are fewer than eight points or they hardly span a plane.
    """
    rows = np.column_stack([points[:, :2], np.ones(len(points))])
    weight = 1.0 / (1.0 + (np.hypot(points[:, 0], points[:, 1]) / PLANE_REACH_M) ** 2)
    rows, z = rows * weight[:, None], points[:, 2] * weight
    if len(points) < 8 or np.linalg.svd(rows, compute_uv=False)[-1] < 1.0:
        return np.zeros(3)
    return np.asarray(np.linalg.lstsq(rows, z, rcond=None)[0], dtype=np.float64)


def levelled(ego_to_image: NDArray[np.floating], plane: Array) -> Array:
    """Projections (..., 3, 4) in which the road z = a x + b y + c, ``plane`` (3,), is z = 0.

    With e_k the columns, a point of the road is seen at e_0 x + e_1 y + e_2 (a x + b y + c) + e_3.
    """
    out: Array = np.array(ego_to_image, dtype=np.float64)
    up = out[..., 2]
    for column, slope in zip((0, 1, 3), plane, strict=True):
        out[..., column] += slope * up
    return out
