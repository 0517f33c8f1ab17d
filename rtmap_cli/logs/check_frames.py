"""Checks of logs of other formats, through what their readers make of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.poses import quaternion_from_se3
from rtmap_cli.logs.check_parts import (
    Limited,
    Report,
    check_camera,
    check_image,
    check_place,
    check_trajectory,
)
from rtmap_cli.logs.frames import FrameLog
from rtmap_cli.logs.open import open_log


def check_opened(spec: str, folder: Path, fast: bool = False) -> Report:
    """Check a log whose reader gives a ``FrameLog``; ``fast`` does not decode images.

    What the reader refuses is one error: nothing behind it can be looked at.
    """
    report = Report(folder)
    try:
        log = open_log(spec)
    except BadInput as error:
        report.bad(error)
        return report
    assert isinstance(log, FrameLog)
    for note in log.notes:
        report.warning(log.path, note)
    for camera in log.rig or ():
        check_camera(report, log.path, camera)
    frames = list(log.frames())
    poses = np.stack([f.map_SE3_ego for f in frames])
    times = np.array([f.timestamp_ns for f in frames], np.int64)
    check_trajectory(report, log.path, times, quaternion_from_se3(poses), poses[:, :3, 3])
    check_place(report, log.path, log.crs, poses[:, :2, 3])
    _check_files(report, log, fast)
    return report


def _check_files(report: Report, log: FrameLog, fast: bool) -> None:
    """The images and sweeps of every frame."""
    limited = Limited(report)
    cameras = {c.name: c for c in log.rig or ()}
    for frame in log.frames():
        if cameras and len(frame.images) < len(cameras):
            lacks = ", ".join(n for n in cameras if n not in frame.images)
            limited.add(
                "frames lack a camera", "warning", log.path, f"frame {frame.index} lacks {lacks}"
            )
        for name, path in frame.images.items():
            found = check_image(path, cameras.get(name), fast)
            if found is not None:
                limited.add(found[0], "error", path, found[1], found[2])
        if frame.lidar is None:
            continue
        try:
            log.read_sweep(frame)
        except BadInput as error:
            limited.add("unreadable sweeps", "error", frame.lidar, error.what, error.todo)
    limited.close(log.path)
