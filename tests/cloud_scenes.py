"""A small yard with walls and poles, sweeps of it, and logs of drives through it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry import lie
from rtmap_cli.geometry.poses import invert, se3_from_xyyaw, transform
from rtmap_cli.logs.log import Frame
from rtmap_cli.logs.native import NativeLogWriter
from rtmap_cli.logs.run import true_poses
from rtmap_cli.tables import whole_folder

Array = NDArray[np.float64]

CRS = "EPSG:32632"
ZERO = np.array([500_000.0, 5_400_000.0, 100.0])
PERIOD_NS = 200_000_000


def yard(seed: int = 0) -> Array:
    """(n, 3) points of a ground of 160 × 120 m with house walls and poles, about its middle."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-80, 80, 60_000), rng.uniform(-60, 60, 60_000)])
    parts = [np.column_stack([ground, np.zeros(len(ground))])]
    for _ in range(26):
        x, y, yaw = rng.uniform(-75, 75), rng.uniform(-55, 55), rng.uniform(0, np.pi)
        n, size = 1600, rng.uniform(6, 14)
        along = rng.uniform(-size / 2, size / 2, n)
        wall = np.column_stack([x + along * np.cos(yaw), y + along * np.sin(yaw)])
        parts.append(np.column_stack([wall, rng.uniform(0, 5, n)]))
    for _ in range(40):
        a = rng.uniform(0, 2 * np.pi, 120)
        pole = rng.uniform([-75, -55], [75, 55]) + 0.12 * np.column_stack([np.cos(a), np.sin(a)])
        parts.append(np.column_stack([pole, rng.uniform(0, 4, 120)]))
    return np.concatenate(parts)


def circle(count: int, radius: float = 25.0, turns: float = 1.15) -> Array:
    """(n, 4, 4) true poses on a circle, map frame; the ego origin lies on the road."""
    a = np.linspace(0, 2 * np.pi * turns, count)
    x, y = radius * np.cos(a), 0.8 * radius * np.sin(a)
    yaw = np.arctan2(np.gradient(y), np.gradient(x))
    pose = se3_from_xyyaw(x, y, yaw)
    pose[:, :3, 3] += ZERO
    return pose


def seen(world: Array, pose: Array, rng: np.random.Generator, most: int = 9000) -> Array:
    """(n, 3) points of the world from a pose, ego frame: within 45 m, with 2 cm of noise."""
    local = transform(invert(pose), world + ZERO)
    near = np.flatnonzero(np.linalg.norm(local, axis=1) < 45)
    near = rng.permutation(near)[:most]
    return np.asarray(local[near] + rng.normal(0, 0.02, (len(near), 3)))


def write_log(
    folder: Path,
    poses: Array,
    world: Array,
    sigma: float = 0.5,
    jump: slice | None = None,
    skew: bool = False,
    odometry: bool = False,
) -> Path:
    """A native log of a drive: GNSS with noise ``sigma`` and a ``jump`` of 20 m; with ``skew`` the
    points of a turn have times of their own."""
    rng = np.random.default_rng(5)
    times = np.arange(len(poses)) * PERIOD_NS + 10**18
    steps = lie.log(invert(poses[:-1]) @ poses[1:]) / (PERIOD_NS / 1e9)
    with whole_folder(folder) as temporary:
        writer = NativeLogWriter(temporary, "yard", CRS, None, 0.0)
        for k, pose in enumerate(poses):
            gnss = pose.copy()
            gnss[:2, 3] += rng.normal(0, sigma, 2)
            if jump is not None and jump.start <= k < jump.stop:
                gnss[:2, 3] += (20.0, -8.0)
            known = odometry and k > 0
            move = invert(poses[k - 1]) @ pose if known else np.eye(4)
            motion = np.array([move[0, 3], move[1, 3], np.arctan2(move[1, 0], move[0, 0])])
            frame = Frame(
                k, int(times[k]), gnss, np.array([sigma, sigma, 0.02]),
                motion if known else None, np.full(3, 0.02) if known else None,
            )  # fmt: skip
            xyz = seen(world, pose, rng)
            sweep = np.column_stack([xyz, np.full(len(xyz), 0.3)])
            if skew:
                t = rng.uniform(-0.1, 0.0, len(xyz))
                then = lie.exp(t[:, None] * steps[max(k - 1, 0)])
                moved = np.einsum("nji,nj->ni", then[:, :3, :3], xyz - then[:, :3, 3])
                sweep = np.column_stack([moved, sweep[:, 3], t])
            writer.add(frame, {}, sweep=sweep)
        writer.write_truth(true_poses(np.arange(len(poses), dtype=np.int32), times, poses))
        writer.close()
    return folder


def write_bins(folder: Path, sweeps: list[Array]) -> Path:
    """A plain folder of KITTI-like .bin files."""
    folder.mkdir(parents=True)
    for k, xyz in enumerate(sweeps):
        rows = np.column_stack([xyz, np.full(len(xyz), 0.4)])
        (folder / f"{k:06d}.bin").write_bytes(rows.astype("<f4").tobytes())
    return folder
