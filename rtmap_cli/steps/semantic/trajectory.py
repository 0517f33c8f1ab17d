"""Along which poses the frames of a log are laid down."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.poses import se3_from_xyyaw, wrap_angle, yaw_of
from rtmap_cli.logs.log import Frame
from rtmap_cli.logs.run_files import read_poses

Array = NDArray[np.float64]

SMOOTH_M = 25.0
"""Over this distance (standard deviation, m) rough positions are averaged along the odometry."""


def given_poses(path: Path, frames: Sequence[Frame]) -> Array:
    """(n, 4, 4) the poses of a run folder, a ``poses.parquet`` or a log's ``truth``, for every
    frame. BadInput when frames are missing there or have other times: another log's."""
    file = path / "poses.parquet" if path.is_dir() else path
    if not file.exists():
        raise BadInput(file, "no such poses", "rtmap localize writes them")
    poses = read_poses(file)
    rows = {int(f): k for k, f in enumerate(poses.frame)}
    out = []
    for frame in frames:
        row = rows.get(frame.index)
        if row is None or not np.isfinite(poses.pose[row]).all():
            raise BadInput(file, f"has no pose of frame {frame.index}", "localize the whole log")
        if int(poses.timestamp_ns[row]) != frame.timestamp_ns:
            raise BadInput(file, f"frame {frame.index} has another time there", "another log's?")
        out.append(poses.pose[row])
    return np.stack(out)


def initial_trajectory(frames: Sequence[Frame]) -> tuple[Array, str]:
    """(n, 4, 4) poses of a log and what they are: its initial poses, smoothed along the odometry
    where every frame has one.

    Odometry is exact from frame to frame and drifts; initial poses are rough and do not drift.
    Their differences in heading, then in position, are averaged over `SMOOTH_M` by a Gaussian.
    """
    initial = np.stack([f.map_SE3_ego for f in frames])
    if len(frames) < 3 or any(f.odometry is None for f in frames[1:]):
        return initial, "initial poses"
    steps = np.array([np.asarray(f.odometry, np.float64) for f in frames[1:]])
    length = np.hypot(steps[:, 0], steps[:, 1])
    sigma = SMOOTH_M / max(float(length.mean()), 0.05)
    turned = np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    known = yaw_of(initial)
    off = np.unwrap(wrap_angle(known - turned))
    yaw = turned + gaussian_filter1d(off, sigma, mode="nearest")
    c, s = np.cos(yaw[:-1]), np.sin(yaw[:-1])
    moves = np.stack(
        [c * steps[:, 0] - s * steps[:, 1], s * steps[:, 0] + c * steps[:, 1]], axis=-1
    )
    chain = np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)])
    xy = chain + gaussian_filter1d(initial[:, :2, 3] - chain, sigma, axis=0, mode="nearest")
    turn = se3_from_xyyaw(np.zeros(len(yaw)), np.zeros(len(yaw)), yaw - known)
    out = initial.copy()
    out[:, :3, :3] = turn[:, :3, :3] @ initial[:, :3, :3]
    out[:, :2, 3] = xy
    return out, "initial poses, smoothed along the odometry"
