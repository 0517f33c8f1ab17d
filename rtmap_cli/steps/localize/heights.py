"""Height, roll and pitch from the heights of the map: the vehicle stands on its road.

Around every pose a surface z = c + a x + b y + (p x² + q y²) / 2 + r x y goes through the lines of
known height, x ahead and y to the left, robustly and with less weight where they are far or
uncertain. The ego origin stands on c, over ``ground_z`` of the rig; the body leans as the road
does between its axles, but for its springs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rtmap_cli.geometry.polylines import arc_length, resample
from rtmap_cli.geometry.poses import wrap_angle, yaw_of
from rtmap_cli.logs.run import Poses
from rtmap_cli.maps.element import VectorMap

Array = NDArray[np.float64]

REACH_M = 25.0
STEP_M = 2.0
MIN_POINTS = 8

# Sigma of a height of which the map states none, and the length along a line over which errors of
# heights are alike (as the map's planar ones): so many samples count once.
_MAP_SIGMA_M = 0.1
_ALIKE = 12.0 / STEP_M
# What the surface does not follow: gravel, and the third order of a hill (m per m³).
_ROUGH_M, _THIRD = 0.02, 4e-5
# Slopes and curvatures (1/m) of roads.
_SLOPE, _CURVATURE = 0.1, 0.005
# From rear to front axle (m): the body has the mean slope between them.
_WHEELBASE = 2.8
# Heave (m), roll and pitch (rad) of a body on its springs.
_BODY = np.array([0.02, 0.005, 0.005])
# An answer is given where the fit knows height (m) and slopes better than this.
_ENOUGH = (0.3, 0.05)
_ROUNDS = 4
_FEW = 8
"""Frames that tell how good the initial heights, rolls and pitches are."""


class Surface:
    """The heights of a map: ``points`` (n, 3), ``variance`` (n,) of the height."""

    def __init__(self, vector_map: VectorMap) -> None:
        sampled = [_samples(e.points, e.covariance) for e in vector_map]
        every = np.concatenate([*sampled, np.zeros((0, 4))])
        every = every[np.isfinite(every[:, :3]).all(axis=1)]
        self.points, variance = every[:, :3], every[:, 3]
        self.variance = np.where(variance > 0, variance, _MAP_SIGMA_M**2)
        self.tree = cKDTree(self.points[:, :2]) if len(every) else None

    def under(self, xy: Array, yaw: float) -> tuple[Array, Array] | None:
        """Height c and mean slopes ahead and to the left (3,) with their covariance (3, 3).

        ``xy`` (2,) map metres, ``yaw`` radians; None where the map knows too little.
        """
        rows = [] if self.tree is None else self.tree.query_ball_point(xy, REACH_M)
        if len(rows) < MIN_POINTS:
            return None
        d = self.points[rows] - [*xy, 0.0]
        c, s = np.cos(yaw), np.sin(yaw)
        ahead, left = c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]
        one = np.ones(len(d))
        design = np.column_stack([one, ahead, left, ahead**2 / 2, left**2 / 2, ahead * left])
        distance = np.hypot(ahead, left)
        variance = self.variance[rows] + _ROUGH_M**2 + (_THIRD * distance**3) ** 2
        prior = np.diag([1e-6, *[_SLOPE**-2] * 2, *[_CURVATURE**-2] * 3])
        # Roads above each other: the level of the nearest heights decides.
        near = np.argsort(distance)[:MIN_POINTS]
        base = float(np.median(d[near, 2]))
        z = d[:, 2] - base
        fit = np.zeros(6)
        for k in range(_ROUNDS):
            r = z - design @ fit
            # Cauchy weights, wide at first since the slope is not known yet.
            spread = 0.5 if k == 0 else 0.0
            weight = 1.0 / (variance * _ALIKE) / (1.0 + r**2 / (4.0 * variance + spread))
            information = (design.T * weight) @ design + prior
            fit = np.linalg.solve(information, (design.T * weight) @ z)
        take = np.eye(3, 6)
        take[1, 3] = take[2, 5] = _WHEELBASE / 2
        covariance = take @ np.linalg.inv(information) @ take.T
        sigma = np.sqrt(np.diag(covariance))
        if sigma[0] > _ENOUGH[0] or sigma[1:].max() > _ENOUGH[1]:
            return None
        return take @ fit + [base, 0.0, 0.0], covariance


def with_heights(
    poses: Poses, initial: Array, vector_map: VectorMap, ground_z: float | None, live: bool = False
) -> Poses:
    """Poses with height, roll and pitch from the map where it has heights around them.

    ``initial`` (T, 4, 4): where the drive says it is. How good its heights, rolls and pitches
    are shows in the drive, and they count accordingly (not ``live``). ``ground_z``: height of the
    road in the ego frame; None: what the initial heights say on average (0 where there are none).
    """
    surface = Surface(vector_map)
    if surface.tree is None:
        return poses
    given = np.abs(initial[:, 2, 3]).max() > 1e-9
    if ground_z is None and given and live:
        return poses
    yaw = yaw_of(poses.pose)
    found = [surface.under(p[:2, 3], a) for p, a in zip(poses.pose, yaw, strict=True)]
    rows = np.array([t for t, f in enumerate(found) if f is not None], np.int64)
    if not len(rows):
        return poses
    fit = np.array([f[0] for f in found if f is not None])
    spread = np.array([f[1] for f in found if f is not None])
    stand, jacobian = _standing(fit)
    said = _upright(initial[rows])
    if ground_z is None:
        ground_z = -float(np.median(said[:, 0] - stand[:, 0])) if given else 0.0
    stand[:, 0] -= ground_z
    variance = np.einsum("tij,tjk,tik->ti", jacobian, spread, jacobian) + _BODY**2
    trust = np.ones_like(stand)
    if not live and len(rows) >= _FEW:
        trust = _trust(stand, said, variance)
    off = said - stand
    off[:, 1:] = wrap_angle(off[:, 1:])
    upright = stand + (1.0 - trust) * off
    pose, covariance = poses.pose.copy(), poses.covariance.copy()
    pose[rows, 2, 3] = upright[:, 0]
    pose[rows, :3, :3] = _rotation(yaw[rows], upright[:, 1], upright[:, 2])
    # Where the planar pose is wrong, the surface is that of another place.
    c, s = np.cos(yaw[rows]), np.sin(yaw[rows])
    a, b = fit[:, 1], fit[:, 2]
    slide = np.zeros((len(rows), 3, 3))  # z, roll, pitch by x, y, yaw
    slide[:, 0, 0], slide[:, 0, 1] = c * a - s * b, s * a + c * b
    slide[:, 1, 2], slide[:, 2, 2] = -a, -b
    slide *= trust[..., None]
    planar, upper = np.ix_([0, 1, 5], [0, 1, 5]), np.ix_([2, 3, 4], [2, 3, 4])
    for k, t in enumerate(rows):
        square = covariance[t][planar]
        own = np.diag(variance[k] * trust[k])
        covariance[t][upper] = own + slide[k] @ square @ slide[k].T
        cross = slide[k] @ square
        covariance[t][np.ix_([2, 3, 4], [0, 1, 5])] = cross
        covariance[t][np.ix_([0, 1, 5], [2, 3, 4])] = cross.T
    return replace(poses, pose=pose, covariance=covariance)


def _samples(points: Array, covariance: Array | None) -> Array:
    """(n, 4) x, y, z and its variance every two metres along a line."""
    variance = np.full(len(points), np.nan) if covariance is None else covariance[:, 3]
    line = np.column_stack([points, np.where(np.isfinite(variance), variance, 0.0)])
    count = max(2, int(np.ceil(arc_length(points[:, :2])[-1] / STEP_M)) + 1)
    return resample(line, count)


def _standing(fit: Array) -> tuple[Array, Array]:
    """(T, 3) height, roll, pitch on surfaces (T, 3) c, a, b; (T, 3, 3) derivatives by these."""
    a, b = fit[:, 1], fit[:, 2]
    out = np.column_stack([fit[:, 0], np.arctan2(b, np.sqrt(1.0 + a * a)), -np.arctan(a)])
    jacobian = np.zeros((len(fit), 3, 3))
    # Slopes are small: roll b, pitch -a to the third order.
    jacobian[:, 0, 0] = jacobian[:, 1, 2] = 1.0
    jacobian[:, 2, 1] = -1.0
    return out, jacobian


def _upright(pose: Array) -> Array:
    """(T, 3) height, roll and pitch (Z-Y-X) of (T, 4, 4)."""
    roll = np.arctan2(pose[:, 2, 1], pose[:, 2, 2])
    return np.column_stack([pose[:, 2, 3], roll, -np.arcsin(np.clip(pose[:, 2, 0], -1.0, 1.0))])


def _trust(stand: Array, said: Array, variance: Array) -> Array:
    """(T, 3) share that the surface has in height, roll and pitch against what the drive said.

    Squared differences hold both variances; that of the surface is known. What is said to be
    better than half of the surface's sigma is not believed to be better still.
    """
    d = said - stand
    d[:, 1:] = wrap_angle(d[:, 1:])
    square = (1.4826 * np.median(np.abs(d), axis=0)) ** 2
    initial = np.maximum(square - variance.mean(axis=0), 0.25 * variance.mean(axis=0))
    return initial / (initial + variance)


def _rotation(yaw: Array, roll: Array, pitch: Array) -> Array:
    """(T, 3, 3) Z-Y-X rotations."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(r, -1) for r in rows], -2)
