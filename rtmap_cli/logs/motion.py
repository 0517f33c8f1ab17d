"""Odometry and GNSS of a drive as factors between poses and a walking GNSS bias."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from rtmap_cli.geometry.poses import wrap_angle
from rtmap_cli.logs.run import RunFrames

Array = NDArray[np.float64]

STATE = 6
"""Unknowns per frame: x, y, yaw and the bias of GNSS in each."""

REACH = STATE + 1
"""How many unknowns further on one may be coupled: x with the y of the next frame."""

_MIN_STEPS = 8
"""Fewer known odometry steps than this say nothing about the noise of GNSS."""


@dataclass(frozen=True)
class MotionModel:
    """Noise of odometry that states none (share of a step, radians per metre) and how the bias of
    GNSS walks: its growth (m per √m driven), travel over which a yaw bias persists (m)."""

    odometry_share: float = 0.01
    odometry_rad_per_m: float = 0.0009
    gnss_walk_m: float = 0.06
    gnss_yaw_length_m: float = 2000.0


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

    @cached_property
    def fixed(self) -> _Fixed:
        """What is the same at all poses."""
        return _fixed(self)

    @property
    def spacing(self) -> Array:
        """(T,) mean distance to the neighbouring frames, 5 cm at least (m)."""
        after = np.append(self.step[1:], self.step[-1:])
        before = np.append(self.step[1:2], self.step[1:]) if len(self.step) > 1 else self.step
        return np.maximum(0.5 * (after + before), 0.05)


def motion_of(
    frames: RunFrames,
    gnss: Array,
    model: MotionModel,
    known: int | None = None,
) -> Motion:
    """The motion of a run; ``gnss`` (T, 3) its initial poses, perhaps relative to some origin.

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
    shares = np.array([model.odometry_share] * 2 + [model.odometry_rad_per_m])
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
class _Fixed:
    """What of the normal equations is the same at all poses.

    ``white`` (T, 3), ``walk`` (T - 1, 3), ``first`` (3,): information of GNSS, of the steps of its
    bias and of the first one; ``odometry``, ``weight`` (3, T - 1) to the frame after, with the
    weight zero where it is unknown; ``band`` (T, STATE, REACH + 1).
    """

    white: Array
    walk: Array
    first: Array
    odometry: Array
    weight: Array
    band: Array


def _fixed(motion: Motion) -> _Fixed:
    """The linear factors of a drive: GNSS, its bias, and what odometry says of yaw."""
    keep = motion.keep[1:]
    white, first = motion.white**-2, motion.slow[0] ** -2
    walk = 1.0 / ((1.0 - keep * keep) * motion.slow[1:] ** 2)
    known = np.isfinite(motion.odometry[1:]).all(1, keepdims=True)
    odometry = np.where(known, motion.odometry[1:], 0.0)
    weight = np.where(known, motion.odometry_sigma[1:], np.inf) ** -2
    band = np.zeros((len(white), STATE, REACH + 1))
    on = band[:, :, 0]
    on[:, :3] = on[:, 3:] = white
    band[:, :3, 3] = white
    on[0, 3:] += first
    on[1:, 3:] += walk
    on[:-1, 3:] += keep * keep * walk
    band[:-1, 3:, STATE] = -keep * walk
    on[:-1, 2] += weight[:, 2]
    on[1:, 2] += weight[:, 2]
    band[:-1, 2, STATE] = -weight[:, 2]
    rows = np.ascontiguousarray(np.stack([odometry, weight]).swapaxes(1, 2))
    return _Fixed(white, walk, first, rows[0], rows[1], band)


@dataclass(frozen=True)
class MotionTerms:
    """Normal equations of a drive without a map, `STATE` unknowns a frame.

    ``band`` (T, STATE, `REACH` + 1): element [t, i, d] is that of unknown i of frame t and the
    d-th unknown after it, as LAPACK wants its lower bands; ``gradient`` (T, STATE).
    """

    band: Array
    gradient: Array

    def add(self, information: Array, gradient: Array) -> None:
        """Add what else is known of every pose: (T, 3, 3) and (T, 3)."""
        for i in range(3):
            self.band[:, i, : 3 - i] += information[:, i, i:]
        self.gradient[:, :3] += gradient

    def solve(self) -> Array:
        """(T, STATE) the step to the minimum; the band is factored in place and thus used up."""
        step = solveh_banded(
            self.band.reshape(-1, REACH + 1).T,
            -self.gradient.ravel(),
            overwrite_ab=True,
            overwrite_b=True,
            lower=True,
            check_finite=False,
        )
        return np.asarray(step, np.float64).reshape(self.gradient.shape)

    @property
    def own(self) -> Array:
        """(T, STATE, STATE) of each frame with itself; read-only."""
        out = np.zeros((len(self.band), STATE, STATE))
        for i in range(STATE):
            out[:, i, i:] = out[:, i:, i] = self.band[:, i, : STATE - i]
        out.flags.writeable = False
        return out

    @property
    def below(self) -> Array:
        """(T, STATE, STATE) of each frame with the one before (the first is zero); read-only."""
        out = np.zeros((len(self.band), STATE, STATE))
        for i in range(STATE):
            rows = min(i + REACH - STATE + 1, STATE)
            out[1:, :rows, i] = self.band[:-1, i, STATE - i : STATE - i + rows]
        out.flags.writeable = False
        return out


def motion_terms(motion: Motion, pose: Array, bias: Array) -> MotionTerms:
    """GNSS, bias and odometry factors at poses and biases (T, 3)."""
    fixed = motion.fixed
    terms = MotionTerms(fixed.band.copy(), np.empty((len(pose), STATE)))
    gradient = terms.gradient
    # gnss = pose + bias + white; the first bias has the sigma of all.
    error = pose + bias - motion.gnss
    error[:, 2] = wrap_angle(error[:, 2])
    error *= fixed.white
    gradient[:, :3] = gradient[:, 3:] = error
    gradient[0, 3:] += fixed.first * bias[0]
    # The bias decays towards zero as it walks.
    keep = motion.keep[1:]
    error = fixed.walk * (bias[1:] - keep * bias[:-1])
    gradient[1:, 3:] += error
    gradient[:-1, 3:] -= keep * error
    _add_odometry(terms, fixed, pose)
    return terms


def _add_odometry(terms: MotionTerms, fixed: _Fixed, pose: Array) -> None:
    """The motion is what odometry says: `step_error` and its Jacobian J, multiplied out.

    With R the turn of the frame before and W the weights, the weighted square of J by both poses
    consists of M = R W Rᵀ, of h = R W g with g = (moved y, -moved x), and of gᵀ W g.
    """
    c, s = np.cos(pose[:-1, 2]), np.sin(pose[:-1, 2])
    dx, dy, turned = (pose[1:] - pose[:-1]).T
    mx, my = c * dx + s * dy, c * dy - s * dx
    wx, wy, wa = fixed.weight
    ox, oy, oa = fixed.odometry
    ex, ey, ea = wx * (mx - ox), wy * (my - oy), wa * wrap_angle(turned - oa)
    gx, gy = wx * my, wy * mx
    xx, yy, xy = c * c * wx + s * s * wy, s * s * wx + c * c * wy, c * s * (wx - wy)
    hx, hy = c * gx + s * gy, s * gx - c * gy
    before, after = terms.band[:-1], terms.band[1:]
    for end in (before, after):
        end[:, 0, 0] += xx
        end[:, 1, 0] += yy
        end[:, 0, 1] += xy
    before[:, 2, 0] += gx * my + gy * mx
    before[:, 0, 2] -= hx
    before[:, 1, 1] -= hy
    # From here on the second index counts from the frame before to this one.
    np.negative(xx, out=before[:, 0, STATE])
    np.negative(yy, out=before[:, 1, STATE])
    np.negative(xy, out=before[:, 0, STATE + 1])
    np.negative(xy, out=before[:, 1, STATE - 1])
    before[:, 2, STATE - 2] = hx
    before[:, 2, STATE - 1] = hy
    fx, fy = c * ex - s * ey, s * ex + c * ey
    before, after = terms.gradient[:-1], terms.gradient[1:]
    before[:, 0] -= fx
    before[:, 1] -= fy
    before[:, 2] += ex * my - ey * mx - ea
    after[:, 0] += fx
    after[:, 1] += fy
    after[:, 2] += ea


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
