"""What the frames of a drive had in view: TbV's visible-only protocol asks for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import resample_step
from rtmap_cli.geometry.poses import invert, transform, xyyaw_of
from rtmap_cli.logs.log import Log, Rig
from rtmap_cli.logs.open import READERS, open_log
from rtmap_cli.maps.crop import DEFAULT_RANGE, Range
from rtmap_cli.maps.visibility import hidden
from rtmap_cli.steps.evaluate.changes.elements import FRAME_RANGE, distances_to_events

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STEP = 0.1
"""TbV: a changed entity is sampled so densely, metres."""


@dataclass(frozen=True)
class Sight:
    """What a vehicle sees. ``told`` says by which rule; ``sees(time, points)`` which of (n, 2)
    ego-frame points (m) the frame of that time (ns) has in view, as (n,) mask. ``frame_times``
    (ns) of a log that has more poses than frames."""

    told: str
    sees: Callable[[int, Array], Mask]
    frame_times: NDArray[np.int64] | None = None


def in_view(
    timestamp_ns: Sequence[int],
    pose: Array,
    events: Sequence[Array],
    sight: Sight,
    within: float = FRAME_RANGE,
) -> Mask:
    """(n,) True where an event is strictly nearer than ``within`` metres and seen.

    TbV's rule: of an event in reach some point, sampled every 10 cm along all of it, is in view.
    ``pose`` (n, 4, 4) map_SE3_ego; ``events`` lines or rings (k, 2) in the map frame.
    """
    out = np.zeros(len(pose), dtype=bool)
    if not len(events):
        return out
    near = distances_to_events(pose[:, :2, 3], events) < within
    samples = [resample_step(event, STEP) for event in events]
    flat = xyyaw_of(pose)
    for i in np.flatnonzero(near.any(axis=1)).tolist():
        x, y, yaw = flat[i]
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        out[i] = any(
            sight.sees(timestamp_ns[i], (samples[j] - [x, y]) @ turn).any()
            for j in np.flatnonzero(near[i])
        )
    return out


def sight_of(spec: str | Path) -> Sight | None:
    """What the frames of a run or log see; None where POSES are poses alone.

    A log with cameras: what projects into an image, as in TbV, whatever hides it. A run, or a log
    without cameras: what lies in range and is not hidden by an occluder of the frame.
    """
    path = Path(spec)
    if (path / "run.json").exists():
        return _of_run(path)
    marks = ("log.json", "city_SE3_egovehicle.feather")
    if str(spec).partition(":")[0] not in READERS and not any((path / m).exists() for m in marks):
        return None
    log = open_log(spec)
    if log.rig is not None and len(log.rig):
        names = ", ".join(c.name for c in log.rig)
        sees = _cameras(log.rig, log.ground_z)
        # Argoverse 2 states the pose a hundred times a second.
        return Sight(f"projects into a camera ({names})", sees, getattr(log, "frame_times", None))
    return _boxes(DEFAULT_RANGE, _log_occluders(log), "log")


def _cameras(rig: Rig, ground_z: float) -> Callable[[int, Array], Mask]:
    frames = [(camera, invert(camera.ego_SE3_camera)) for camera in rig]

    def sees(_: int, points: Array) -> Mask:
        # Changes have no height: they lie on a level road under the vehicle.
        local = np.column_stack([points, np.full(len(points), ground_z)])
        out = np.zeros(len(points), dtype=bool)
        for camera, camera_SE3_ego in frames:
            pixels = camera.project(transform(camera_SE3_ego, local))
            edge = np.array([camera.width, camera.height]) - 0.5
            # Pixel centres lie at integers; NaN compares as False.
            out |= ((pixels >= -0.5) & (pixels < edge)).all(axis=1)
        return out

    return sees


def _boxes(box: Range, occluders: dict[int, Array], whose: str) -> Sight:
    low, high = np.array(box[:2]), np.array(box[2:])

    def sees(time: int, points: Array) -> Mask:
        inside = ((points >= low) & (points <= high)).all(axis=1)
        if time in occluders:
            inside &= ~hidden(points, occluders[time])
        return np.asarray(inside, dtype=bool)

    size = f"{high[0] - low[0]:g} x {high[1] - low[1]:g} m"
    return Sight(f"in range ({size}) and not hidden by the {whose}'s occluders", sees)


def _of_run(path: Path) -> Sight:
    from rtmap_cli.logs.run_files import read_run
    from rtmap_cli.logs.traversal import range_box, traversal_of

    run = read_run(path)
    traversal = traversal_of(run)
    times = traversal.timestamp_ns.tolist()
    return _boxes(range_box(run), dict(zip(times, traversal.occluders, strict=True)), "run")


def _log_occluders(log: Log) -> dict[int, Array]:
    return {
        frame.timestamp_ns: np.array(
            [[o.x, o.y, o.yaw, o.length, o.width] for o in frame.occluders], np.float64
        ).reshape(-1, 5)
        for frame in log.frames()
    }
