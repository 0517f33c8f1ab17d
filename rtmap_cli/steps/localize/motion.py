"""Odometry and GNSS of a drive as factors between poses and a walking GNSS bias."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from rtmap_cli.geometry.poses import wrap_angle
from rtmap_cli.logs.run import RunFrames
from rtmap_cli.steps.localize.model import ErrorModel, Settings

Array = NDArray[np.float64]

STATE = 6
"""Unknowns per frame: x, y, yaw and the bias of GNSS in each."""

_MIN_STEPS = 8
"""Fewer known odometry steps than this say nothing about the noise of GNSS."""


@dataclass(frozen=True)
class Motion:
    """What is known of a drive of T frames without a map.

    ``gnss`` (T, 3) x, y, unwrapped yaw; ``white``, ``slow`` (T, 3): sigmas of its independent part
    and of its bias; ``keep`` (T, 3): correlation of the bias with that of the previous frame;
    ``odometry``, ``odometry_sigma`` (T, 3) since the previous frame, NaN where unknown; ``step``
    (T,) metres since the previous frame.
    """

    gnss: Array
    white: Array
    slow: Array
    keep: Array
    odometry: Array
    odometry_sigma: Array
    step: Array

    @property
    def spacing(self) -> Array:
        """(T,) mean distance to the neighbouring frames, 5 cm at least (m)."""
        after = np.append(self.step[1:], self.step[-1:])
        before = np.append(self.step[1:2], self.step[1:]) if len(self.step) > 1 else self.step
        return np.maximum(0.5 * (after + before), 0.05)


def motion_of(
    frames: RunFrames,
    gnss: Array,
    model: ErrorModel,
    settings: Settings,
    known: int | None = None,
) -> Motion:
    """The motion of a run; ``gnss`` (T, 3) its initial poses relative to the map's origin.

    The stated sigma of an initial pose is split: what jumps from frame to frame against odometry
    is white, the rest is a bias that walks. White noise is measured in the run itself, in its
    first ``known`` frames (default: all).
    """
    gnss = gnss.copy()
    gnss[:, 2] = np.unwrap(gnss[:, 2])
    odometry, given = frames.odometry.astype(np.float64), frames.odometry_sigma
    stepped = np.asarray(np.isfinite(odometry).all(1))
    stepped[0] = False
    moved = np.zeros(len(gnss))
    moved[1:] = np.hypot(*np.diff(gnss[:, :2], axis=0).T)
    step = np.where(stepped, np.hypot(odometry[:, 0], odometry[:, 1]), moved)
    shares = np.array([settings.odometry_share] * 2 + [settings.odometry_rad_per_m])
    assumed = np.maximum(shares * step[:, None], [0.002, 0.002, 1e-4])
    usable = np.isfinite(given) & (given > 0)
    white = _white(gnss[:known], odometry[:known], stepped[:known], frames.sigma)
    slow = np.sqrt(frames.sigma**2 - white**2)
    length = np.full_like(slow, model.gnss_yaw_length_m)
    length[:, :2] = 2.0 * (slow[:, :2] / model.gnss_walk_m) ** 2
    keep = np.exp(-np.maximum(step, 0.1)[:, None] / np.maximum(length, 1.0))
    return Motion(
        gnss=gnss,
        white=white,
        slow=slow,
        keep=keep,
        odometry=np.where(stepped[:, None], odometry, np.nan),
        odometry_sigma=np.where(usable, given, assumed),
        step=step,
    )


def _white(gnss: Array, odometry: Array, known: NDArray[np.bool_], sigma: Array) -> Array:
    """(T, 3) sigma of the part of GNSS that is independent from frame to frame."""
    rows = np.flatnonzero(known)
    if len(rows) < _MIN_STEPS:
        return 0.5 * sigma
    c, s = np.cos(gnss[rows - 1, 2]), np.sin(gnss[rows - 1, 2])
    dx, dy, turn = odometry[rows].T
    jump = gnss[rows] - gnss[rows - 1] - np.stack([c * dx - s * dy, s * dx + c * dy, turn], -1)
    jump[:, 2] = wrap_angle(jump[:, 2])
    # Median absolute deviation to sigma, and a difference has twice the variance.
    spread = 1.4826 * np.median(np.abs(jump - np.median(jump, 0)), 0) / np.sqrt(2.0)
    spread[:2] = np.sqrt((spread[:2] ** 2).mean())
    return np.clip(np.broadcast_to(spread, sigma.shape), 0.05 * sigma, 0.95 * sigma)


@dataclass(frozen=True)
class MotionTerms:
    """Normal equations of a drive without a map, `STATE` unknowns a frame: ``own`` (T, 6, 6) of
    each frame, ``below`` (T, 6, 6) of each with the one before (the first is zero), ``gradient``
    (T, 6)."""

    own: Array
    below: Array
    gradient: Array

    def solve(self) -> Array:
        """(T, 6) the step to the minimum (a band of twice a frame's unknowns)."""
        count = len(self.own)
        band: Array = np.zeros((2 * STATE, count, STATE))
        for row in range(STATE):
            for column in range(STATE):
                if row >= column:
                    band[row - column, :, column] = self.own[:, row, column]
                band[STATE + row - column, :-1, column] = self.below[1:, row, column]
        flat = band.reshape(2 * STATE, -1)
        step = solveh_banded(flat, -self.gradient.ravel(), lower=True, check_finite=False)
        return np.asarray(step, np.float64).reshape(count, STATE)


def motion_terms(motion: Motion, pose: Array, bias: Array) -> MotionTerms:
    """GNSS, bias and odometry factors at poses and biases (T, 3)."""
    count = len(pose)
    own, below = np.zeros((count, STATE, STATE)), np.zeros((count, STATE, STATE))
    gradient = np.zeros((count, STATE))
    on, off = (np.einsum("tii->ti", m) for m in (own, below))  # views of the diagonals
    # gnss = pose + bias + white; the first bias has the sigma of all.
    error = pose + bias - motion.gnss
    error[:, 2] = wrap_angle(error[:, 2])
    weight = motion.white**-2
    on += np.tile(weight, 2)
    for both in (own[:, :3, 3:], own[:, 3:, :3]):
        np.einsum("tii->ti", both)[...] += weight
    gradient += np.tile(weight * error, 2)
    prior = motion.slow[0] ** -2
    on[0, 3:] += prior
    gradient[0, 3:] += prior * bias[0]
    # The bias decays towards zero as it walks.
    keep = motion.keep[1:]
    weight = 1.0 / ((1.0 - keep * keep) * motion.slow[1:] ** 2)
    error = weight * (bias[1:] - keep * bias[:-1])
    on[1:, 3:] += weight
    on[:-1, 3:] += keep * keep * weight
    off[1:, 3:] -= keep * weight
    gradient[1:, 3:] += error
    gradient[:-1, 3:] -= keep * error
    # The motion is what odometry says.
    t = 1 + np.flatnonzero(np.isfinite(motion.odometry[1:]).all(1))
    error, jacobian = step_error(pose[t - 1], pose[t], motion.odometry[t])
    weighted = np.swapaxes(jacobian * motion.odometry_sigma[t, :, None] ** -2, -1, -2)
    square, pull = weighted @ jacobian, (weighted @ error[..., None])[..., 0]
    own[t - 1, :3, :3] += square[:, :3, :3]
    own[t, :3, :3] += square[:, 3:, 3:]
    below[t, :3, :3] += square[:, 3:, :3]
    gradient[t - 1, :3] += pull[:, :3]
    gradient[t, :3] += pull[:, 3:]
    return MotionTerms(own, below, gradient)


def step_error(before: Array, after: Array, odometry: Array) -> tuple[Array, Array]:
    """Errors (..., 3) of odometry steps between poses and their Jacobians (..., 3, 6) by both."""
    c, s = np.cos(before[..., 2]), np.sin(before[..., 2])
    back = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)
    d = after - before
    moved = (back @ d[..., :2, None])[..., 0]
    turned = wrap_angle(d[..., 2] - odometry[..., 2])
    error = np.concatenate([moved - odometry[..., :2], np.expand_dims(turned, -1)], -1)
    jacobian = np.zeros((*error.shape, 6))
    jacobian[..., :2, :2], jacobian[..., :2, 3:5] = -back, back
    jacobian[..., 0, 2], jacobian[..., 1, 2] = moved[..., 1], -moved[..., 0]
    jacobian[..., 2, 2], jacobian[..., 2, 5] = -1.0, 1.0
    return error, jacobian
