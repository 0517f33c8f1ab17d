"""Small motions of rigid transforms: exp, log and adjoint of SE(3), vectorised.

A twist (..., 6) is a rotation vector (rad), then a translation (m). Poses are perturbed on the
right, T exp(ξ): ξ lives in the source frame of T. (Solà et al., "A micro Lie theory", 2018.)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SMALL = 1e-8


def skew(v: Array) -> Array:
    """(..., 3) → (..., 3, 3) with skew(a) b = a × b."""
    v = np.asarray(v, np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    x, y, z = np.moveaxis(v, -1, 0)
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    return out


def _terms(angle: Array) -> tuple[Array, Array, Array]:
    """sin θ/θ, (1 − cos θ)/θ², (θ − sin θ)/θ³ without trouble at 0."""
    a2 = angle**2
    safe = np.where(a2 < _SMALL, 1.0, a2)
    root = np.sqrt(safe)
    near = a2 < _SMALL
    return (
        np.where(near, 1 - a2 / 6, np.sin(root) / root),
        np.where(near, 0.5 - a2 / 24, (1 - np.cos(root)) / safe),
        np.where(near, 1 / 6 - a2 / 120, (root - np.sin(root)) / (safe * root)),
    )


def exp(twist: Array) -> Array:
    """(..., 6) twists → (..., 4, 4) transforms."""
    twist = np.asarray(twist, np.float64)
    w, v = twist[..., :3], twist[..., 3:]
    k = skew(w)
    a, b, c = (t[..., None, None] for t in _terms(np.linalg.norm(w, axis=-1)))
    k2, eye = k @ k, np.eye(3)
    out = np.zeros((*twist.shape[:-1], 4, 4))
    out[..., :3, :3] = eye + a * k + b * k2
    out[..., :3, 3] = ((eye + b * k + c * k2) @ v[..., None])[..., 0]
    out[..., 3, 3] = 1
    return out


def log(pose: Array) -> Array:
    """(..., 4, 4) transforms → (..., 6) twists; the angle lies in [0, π]."""
    from scipy.spatial.transform import Rotation

    pose = np.asarray(pose, np.float64)
    flat = pose.reshape(-1, 4, 4)
    w = Rotation.from_matrix(flat[:, :3, :3]).as_rotvec()
    a, b, _ = _terms(np.linalg.norm(w, axis=-1))
    angle2 = (w**2).sum(axis=-1)
    d = np.where(angle2 < _SMALL, 1 / 12, (1 - a / (2 * b)) / np.where(angle2 < _SMALL, 1, angle2))
    k = skew(w)
    inverse = np.eye(3) - k / 2 + d[:, None, None] * (k @ k)
    v = (inverse @ flat[:, :3, 3, None])[..., 0]
    return np.concatenate([w, v], axis=-1).reshape(*pose.shape[:-2], 6)


def adjoint(pose: Array) -> Array:
    """(..., 4, 4) → (..., 6, 6) with T exp(ξ) T⁻¹ = exp(Ad ξ)."""
    r, t = pose[..., :3, :3], pose[..., :3, 3]
    out = np.zeros((*pose.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = r
    out[..., 3:, :3] = skew(t) @ r
    return out
