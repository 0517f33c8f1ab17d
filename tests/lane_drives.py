"""Drives without cameras for tests of lanes: native logs along lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import resample_step, tangents
from rtmap_cli.geometry.poses import se3_from_xyyaw
from rtmap_cli.logs.log import Frame
from rtmap_cli.logs.native import NativeLogWriter
from rtmap_cli.logs.run import true_poses
from rtmap_cli.tables import whole_folder

Array = NDArray[np.float64]
CRS = "EPSG:32632"
PLACE = np.array([500_000.0, 5_400_000.0])


def write_drive(folder: Path, line: Array, crs: str = CRS, sigma: float = 0.05) -> Path:
    """A log along a line (n, 2), a vertex every 0.25 s; vertices may repeat (stops)."""
    pose = np.column_stack([line, np.arctan2(*tangents(line).T[::-1])])
    still = np.hypot(*np.diff(line, axis=0, prepend=line[:1] - 1).T) < 1e-6
    for k in np.flatnonzero(still):
        pose[k, 2] = pose[k - 1, 2]
    with whole_folder(folder) as made:
        writer = NativeLogWriter(made, folder.name, crs, None)
        for k, (x, y, yaw) in enumerate(pose):
            at = se3_from_xyyaw(x + PLACE[0], y + PLACE[1], yaw)
            writer.add(Frame(k, k * 250_000_000, at, np.array([sigma, sigma, 0.01])), {})
        at = se3_from_xyyaw(*(pose + [*PLACE, 0.0]).T)
        frame = np.arange(len(pose))
        writer.write_truth(true_poses(frame.astype(np.int32), frame * 250_000_000, at))
        writer.close()
    return folder


def way(*corners: tuple[float, float], radius: float = 8.0) -> Array:
    """A line through corners, rounded, at steps of 2 m."""
    points = [np.array(corners[0], float)]
    for a, b, c in zip(corners[:-2], corners[1:-1], corners[2:], strict=True):
        p, q, r = np.array(a, float), np.array(b, float), np.array(c, float)
        enter = q + radius * (p - q) / np.hypot(*(p - q))
        leave = q + radius * (r - q) / np.hypot(*(r - q))
        t = np.linspace(0, 1, 12)[:, None]
        points += list((1 - t) ** 2 * enter + 2 * t * (1 - t) * q + t**2 * leave)
    points.append(np.array(corners[-1], float))
    return resample_step(np.array(points), 2.0)


def circle(radius: float, laps: float, step: float = 2.0) -> Array:
    """Laps around 0, 0, counter-clockwise."""
    angle = np.arange(0, laps * 2 * np.pi, step / radius)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
