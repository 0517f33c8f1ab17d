"""Odometry and GNSS of a drive as factors between poses and a walking GNSS bias."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import wrap_angle
from rtmap_cli.logs.run import RunFrames
from rtmap_cli.steps.localize.blocks import BlockSystem
from rtmap_cli.steps.localize.model import ErrorModel, Settings

Array = NDArray[np.float64]
Index = NDArray[np.int64]

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


def motion_of(frames: RunFrames, gnss: Array, model: ErrorModel, settings: Settings) -> Motion:
    """The motion of a run; ``gnss`` (T, 3) its initial poses relative to the map's origin.

    The stated sigma of an initial pose is split: what jumps from frame to frame against odometry
    is white, the rest is a bias that walks. White noise is measured in the run itself.
    """
    gnss = gnss.copy()
    gnss[:, 2] = np.unwrap(gnss[:, 2])
    odometry, given = frames.odometry.astype(np.float64), frames.odometry_sigma
    known = np.asarray(np.isfinite(odometry).all(1))
    known[0] = False
    moved = np.zeros(len(gnss))
    moved[1:] = np.hypot(*np.diff(gnss[:, :2], axis=0).T)
    step = np.where(known, np.hypot(odometry[:, 0], odometry[:, 1]), moved)
    shares = np.array([settings.odometry_share] * 2 + [settings.odometry_rad_per_m])
    assumed = np.maximum(shares * step[:, None], [0.002, 0.002, 1e-4])
    usable = np.isfinite(given) & (given > 0)
    white = _white(gnss, odometry, known, frames.sigma)
    slow = np.sqrt(frames.sigma**2 - white**2)
    length = np.full_like(slow, model.gnss_yaw_length_m)
    length[:, :2] = 2.0 * (slow[:, :2] / model.gnss_walk_m) ** 2
    keep = np.exp(-np.maximum(step, 0.1)[:, None] / np.maximum(length, 1.0))
    return Motion(
        gnss=gnss,
        white=white,
        slow=slow,
        keep=keep,
        odometry=np.where(known[:, None], odometry, np.nan),
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


def add_motion(system: BlockSystem, index: Index, motion: Motion, pose: Array, bias: Array) -> None:
    """Add GNSS, bias and odometry factors; frame t owns unknowns ``index[t]`` and five more."""
    for t in range(len(pose)):
        _add_gnss(system, index, motion, pose, bias, t)
        if t:
            _add_step(system, index, motion, pose, bias, t)


def _add_gnss(
    system: BlockSystem, index: Index, motion: Motion, pose: Array, bias: Array, t: int
) -> None:
    """gnss = pose + bias + white; the first bias has the sigma of all."""
    error = pose[t] + bias[t] - motion.gnss[t]
    error[2] = wrap_angle(error[2])
    weight = motion.white[t] ** -2
    information = np.asarray(np.kron(np.ones((2, 2)), np.diag(weight)), np.float64)
    gradient = np.tile(weight * error, 2)
    if t == 0:
        prior = motion.slow[0] ** -2
        information[3:, 3:] += np.diag(prior)
        gradient[3:] += prior * bias[0]
    system.add(index[t] + np.arange(STATE), information, gradient)


def step_error(before: Array, after: Array, odometry: Array) -> tuple[Array, Array]:
    """Error (3,) of an odometry step between two poses and its Jacobian (3, 6) by both."""
    c, s = np.cos(before[2]), np.sin(before[2])
    back = np.array([[c, s], [-s, c]])
    d = after - before
    error = np.append(back @ d[:2], d[2]) - odometry
    error[2] = wrap_angle(error[2])
    jacobian = np.zeros((3, 6))
    jacobian[:2, :2], jacobian[:2, 3:5] = -back, back
    jacobian[:2, 2] = np.array([[-s, c], [-c, -s]]) @ d[:2]
    jacobian[2, 2], jacobian[2, 5] = -1.0, 1.0
    return error, jacobian


def _add_step(
    system: BlockSystem, index: Index, motion: Motion, pose: Array, bias: Array, t: int
) -> None:
    """The bias decays towards zero as it walks; the motion is what odometry says."""
    keep = motion.keep[t]
    weight = 1.0 / ((1.0 - keep * keep) * motion.slow[t] ** 2)
    error = bias[t] - keep * bias[t - 1]
    information, gradient = np.zeros((12, 12)), np.zeros(12)
    a, b = np.arange(3, 6), np.arange(9, 12)
    information[a, a], information[b, b] = keep * keep * weight, weight
    information[a, b] = information[b, a] = -keep * weight
    gradient[a], gradient[b] = -keep * weight * error, weight * error
    if np.isfinite(motion.odometry[t]).all():
        error, jacobian = step_error(pose[t - 1], pose[t], motion.odometry[t])
        weight = motion.odometry_sigma[t] ** -2
        rows = np.array([0, 1, 2, 6, 7, 8])
        information[np.ix_(rows, rows)] += jacobian.T @ (jacobian * weight[:, None])
        gradient[rows] += jacobian.T @ (weight * error)
    first, second = index[t - 1] + np.arange(STATE), index[t] + np.arange(STATE)
    system.add(np.concatenate([first, second]), information, gradient)
