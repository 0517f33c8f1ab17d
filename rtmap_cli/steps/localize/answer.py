"""From planar solutions to the poses of a run: SE(2) lifted to SE(3), covariance, status."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import yaw_of
from rtmap_cli.logs.run import Poses, RunFrames
from rtmap_cli.steps.localize.frame.single import Solution
from rtmap_cli.steps.localize.model import ErrorModel, Settings

Array = NDArray[np.float64]

YAW_LEVER_M = 10.0
"""Yaw counts as metres at this distance where directions are compared."""

WHOLE = ("smooth", "fixed-lag")
"""Methods by which a frame is known from its neighbours too."""

# What nothing here measures: height, roll and pitch of the initial pose (m, rad).
_UNMEASURED = (1.0, 0.05, 0.05)


def poses_of(
    frames: RunFrames,
    solution: Solution,
    origin: Array,
    method: str,
    model: ErrorModel,
    settings: Settings,
) -> Poses:
    """The localized poses of a run.

    The information whose spectrum tells what is observable is that of the map residuals of each
    frame, without GNSS (``smooth``: what the whole log knows, without the GNSS of this frame).
    """
    information = _information(frames, solution, method)
    scale = np.array([1.0, 1.0, 1.0 / YAW_LEVER_M])
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
    values = np.maximum(values, 0.0)
    matched = solution.residuals >= settings.min_residuals
    weak = values[:, 0] < settings.degenerate_m**-2
    status = np.where(weak, "degenerate", "ok").astype(object)
    if method in WHOLE:
        # A frame between others is known from them even if it matched nothing itself.
        matched = np.full(len(frames), matched.any())
    status[~matched] = "no-match"
    return Poses(
        frame=frames.frame,
        timestamp_ns=frames.timestamp_ns,
        method=method,
        pose=lift(frames.initial, solution.pose, origin),
        covariance=_covariance(solution, model),
        eigenvalues=values,
        weakest_direction=_signed(vectors[:, :, 0]),
        residual_count=solution.residuals.astype(np.int32),
        chi2=solution.chi2,
        status=status,
    )


def lift(initial: Array, planar: Array, origin: Array) -> Array:
    """(T, 4, 4) poses with x, y, yaw of (T, 3) ``planar`` (relative to ``origin``) and the height,
    roll and pitch of ``initial`` (T, 4, 4)."""
    turn = planar[:, 2] - yaw_of(initial)
    c, s = np.cos(turn), np.sin(turn)
    out = initial.copy()
    out[:, 0, :3] = c[:, None] * initial[:, 0, :3] - s[:, None] * initial[:, 1, :3]
    out[:, 1, :3] = s[:, None] * initial[:, 0, :3] + c[:, None] * initial[:, 1, :3]
    out[:, :2, 3] = planar[:, :2] + origin
    return out


def _information(frames: RunFrames, solution: Solution, method: str) -> Array:
    if method not in WHOLE:
        return solution.information
    gnss = np.zeros_like(solution.covariance)
    gnss[:, [0, 1, 2], [0, 1, 2]] = frames.sigma**-2
    return np.linalg.inv(solution.covariance) - gnss


def _covariance(solution: Solution, model: ErrorModel) -> Array:
    """(T, 6, 6) of x, y, z, roll, pitch, yaw; the calibration of the rig is added."""
    count = len(solution.pose)
    c, s = np.cos(solution.pose[:, 2]), np.sin(solution.pose[:, 2])
    rig = np.zeros((count, 3, 3))
    rig[:, :2, 0], rig[:, :2, 1] = np.stack([c, s], -1), np.stack([-s, c], -1)
    rig[:, 2, 2] = 1.0
    rig *= np.array([*model.rig_sigma_m, model.rig_sigma_rad])
    out = np.zeros((count, 6, 6))
    out[:, [2, 3, 4], [2, 3, 4]] = np.square(_UNMEASURED)
    planar = solution.covariance + rig @ np.swapaxes(rig, -1, -2)
    out[np.ix_(range(count), (0, 1, 5), (0, 1, 5))] = planar
    return out


def _signed(vectors: Array) -> Array:
    """Eigenvectors with a sign that does not depend on the solver: the largest part positive."""
    largest = np.abs(vectors).argmax(axis=1)
    sign = np.sign(vectors[np.arange(len(vectors)), largest])
    return vectors * np.where(sign == 0, 1.0, sign)[:, None]
