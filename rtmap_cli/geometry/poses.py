"""Rigid transforms as 4×4 float64 matrices named ``target_SE3_source``.

``p_target = target_SE3_source @ p_source``. Units are metres and radians; quaternions are
(w, x, y, z), Hamilton, unit length. The ego frame is x forward, y left, z up.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def wrap_angle(angle: Array | float) -> Array:
    """Angle(s) in radians brought into [-π, π)."""
    return (np.asarray(angle, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi


def se3_from_quaternion(quaternion: Array, translation: Array) -> Array:
    """(..., 4) quaternions w, x, y, z and (..., 3) translations → (..., 4, 4)."""
    q = np.asarray(quaternion, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(q, -1, 0)
    out = np.zeros((*q.shape[:-1], 4, 4))
    out[..., 0, 0] = 1 - 2 * (y * y + z * z)
    out[..., 0, 1] = 2 * (x * y - z * w)
    out[..., 0, 2] = 2 * (x * z + y * w)
    out[..., 1, 0] = 2 * (x * y + z * w)
    out[..., 1, 1] = 1 - 2 * (x * x + z * z)
    out[..., 1, 2] = 2 * (y * z - x * w)
    out[..., 2, 0] = 2 * (x * z - y * w)
    out[..., 2, 1] = 2 * (y * z + x * w)
    out[..., 2, 2] = 1 - 2 * (x * x + y * y)
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1
    return out


def quaternion_from_se3(pose: Array) -> Array:
    """(..., 4, 4) → (..., 4) unit quaternions w, x, y, z with w ≥ 0."""
    m = np.asarray(pose, dtype=np.float64)[..., :3, :3]
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    # All four candidates of Shepperd's method; the one with the largest pivot is stable.
    pivots = np.stack([xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy], axis=-1)
    a, b, c = (
        m[..., 2, 1] - m[..., 1, 2],
        m[..., 0, 2] - m[..., 2, 0],
        m[..., 1, 0] - m[..., 0, 1],
    )
    d, e, f = (
        m[..., 0, 1] + m[..., 1, 0],
        m[..., 0, 2] + m[..., 2, 0],
        m[..., 1, 2] + m[..., 2, 1],
    )
    candidates = np.stack(
        [
            np.stack([1 + pivots[..., 0], a, b, c], axis=-1),
            np.stack([a, 1 + pivots[..., 1], d, e], axis=-1),
            np.stack([b, d, 1 + pivots[..., 2], f], axis=-1),
            np.stack([c, e, f, 1 + pivots[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = pivots.argmax(axis=-1)[..., None, None]
    q = np.take_along_axis(candidates, best, axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def se3_from_xyyaw(x: Array, y: Array, yaw: Array, z: Array | float = 0.0) -> Array:
    """Planar pose(s) (x, y in metres, yaw in radians from +x, counter-clockwise) → (..., 4, 4)."""
    x, y, yaw, z = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (x, y, yaw, z)))
    out = np.zeros((*x.shape, 4, 4))
    out[..., 0, 0] = out[..., 1, 1] = np.cos(yaw)
    out[..., 1, 0] = np.sin(yaw)
    out[..., 0, 1] = -out[..., 1, 0]
    out[..., 2, 2] = out[..., 3, 3] = 1
    out[..., 0, 3], out[..., 1, 3], out[..., 2, 3] = x, y, z
    return out


def yaw_of(pose: Array) -> Array:
    """Yaw (Z-Y-X order, radians in [-π, π]) of (..., 4, 4)."""
    return np.arctan2(pose[..., 1, 0], pose[..., 0, 0])


def xyyaw_of(pose: Array) -> Array:
    """(..., 4, 4) → (..., 3): x, y, yaw."""
    return np.stack([pose[..., 0, 3], pose[..., 1, 3], yaw_of(pose)], axis=-1)


def invert(pose: Array) -> Array:
    """Inverse of (..., 4, 4) rigid transforms."""
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    out = np.zeros_like(pose)
    out[..., :3, :3] = rotation
    out[..., :3, 3] = -(rotation @ pose[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1
    return out


def transform(pose: Array, points: Array) -> Array:
    """Apply one (4, 4) transform to (..., 2) or (..., 3) points of the source frame.

    With (..., 2) points the planar part is used (z = 0, roll and pitch ignored); a NaN height
    (unknown) stays NaN and does not spoil x and y: such a point is taken on the plane z = 0 of the
    frame to whose origin it is nearer, the vehicle's, however far away the map's origin lies.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.shape[-1] == 2:
        yaw = yaw_of(pose)
        c, s = np.cos(yaw), np.sin(yaw)
        return points @ np.array([[c, s], [-s, c]]) + pose[:2, 3]
    unknown = np.isnan(points[..., 2])
    filled = points.copy()
    filled[unknown, 2] = 0.0
    out = filled @ pose[:3, :3].T + pose[:3, 3]
    if unknown.any():
        upright = pose[2, 2] if abs(pose[2, 2]) > 0.1 else 1.0
        on_target = out[unknown] - np.multiply.outer(out[unknown, 2] / upright, pose[:3, 2])
        far = np.hypot(*np.moveaxis(filled[unknown, :2], -1, 0))
        nearer = np.hypot(*np.moveaxis(on_target[..., :2], -1, 0)) < far
        out[unknown, :2] = np.where(nearer[..., None], on_target[..., :2], out[unknown, :2])
        out[unknown, 2] = np.nan
    return out


def interpolate(times_ns: NDArray[np.int64], poses: Array, at_ns: NDArray[np.int64]) -> Array:
    """Poses at the times ``at_ns`` by linear translation and spherical rotation interpolation.

    ``times_ns`` (n,) strictly increasing, ``poses`` (n, 4, 4); times outside are clamped to the
    first or last pose.
    """
    from scipy.spatial.transform import Rotation, Slerp

    at = np.clip(np.asarray(at_ns, np.int64), times_ns[0], times_ns[-1])
    if len(times_ns) == 1:
        return np.repeat(poses, len(at), axis=0)
    # Nanoseconds since 1970 do not fit a float64; relative times do.
    t = (times_ns - times_ns[0]).astype(np.float64)
    u = (at - times_ns[0]).astype(np.float64)
    out = np.zeros((len(at), 4, 4))
    out[:, :3, :3] = Slerp(t, Rotation.from_matrix(poses[:, :3, :3]))(u).as_matrix()
    for axis in range(3):
        out[:, axis, 3] = np.interp(u, t, poses[:, axis, 3])
    out[:, 3, 3] = 1
    return out
