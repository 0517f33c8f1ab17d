"""Traces: where vehicles drove, from clouds, logs and runs; stops, jumps and gaps taken out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import solveh_banded

from rtmap_cli.errors import BadInput, NoAnswer
from rtmap_cli.geometry.polylines import arc_length
from rtmap_cli.geometry.poses import xyyaw_of
from rtmap_cli.maps.crs import check_same_crs

Array = NDArray[np.float64]

STEP = 0.5
"""Metres between the samples of a trace."""
STILL = 0.3
"""Metres that a vehicle must have moved for the next pose to count: less is a stop."""
GAP = (30.0, 10.0)
"""Metres and seconds without a pose that end a trace."""
FASTEST, HARDEST = 70.0, 15.0
"""m/s and m/s² that no vehicle reaches: a step beyond is a jump of its positions."""
SHORTEST = 10.0
"""Metres below which a trace says nothing."""


@dataclass(frozen=True)
class Track:
    """Poses of one drive: x, y, yaw (n, 3) in the map frame, times (n,) ns, standard deviations
    of the positions (n,) m, motion since the previous pose (n, 3) and its sigma (n,), NaN where
    unknown, and what may be used."""

    name: str
    crs: str
    pose: Array
    timestamp_ns: NDArray[np.int64]
    sigma: Array
    odometry: Array
    odometry_sigma: Array
    usable: NDArray[np.bool_]


@dataclass(frozen=True)
class Trace:
    """A stretch that was driven: ``xy`` (n, 2) every STEP metres, m/s there, name of its drive."""

    name: str
    xy: Array
    speed: Array


def read_track(path: Path) -> Track:
    """The poses of a cloud folder, a run (its localized poses where it has any) or a log.

    BadInput for anything else, without a pose, with one that is no number, or out of order.
    """
    if (path / "cloud.json").exists():
        track = _of_cloud(path)
    elif (path / "run.json").exists():
        track = _of_run(path)
    else:
        track = _of_log(path)
    if not len(track.pose):
        raise BadInput(path, "holds no poses", "lanes need a drive that knows where it was")
    bad = np.flatnonzero(~np.isfinite(track.pose).all(axis=1) & track.usable)
    if len(bad):
        raise BadInput(path, f"pose {bad[0]} is not a number")
    late = np.flatnonzero(np.diff(track.timestamp_ns) <= 0)
    if len(late):
        raise BadInput(path, f"frame {late[0] + 1} is not later than frame {late[0]}", "sort it")
    return track


def _of_cloud(path: Path) -> Track:
    from rtmap_cli.logs.cloud import CloudFolder

    cloud = CloudFolder(path)
    t = cloud.trajectory()
    sigma = np.sqrt(np.maximum(t.covariance[:, [0, 1], [0, 1]].max(axis=1), 0.0))
    known = np.array([s != "lost" for s in t.status], dtype=bool)
    none = np.full((len(t), 3), np.nan)
    pose = xyyaw_of(t.pose)
    return Track(path.name, cloud.crs, pose, t.timestamp_ns, sigma, none, none[:, 0], known)


def _of_run(path: Path) -> Track:
    from rtmap_cli.logs.run_files import read_run

    run = read_run(path)
    f = run.frames
    sigma, odometry, usable = f.sigma[:, :2].max(axis=1), f.odometry, np.ones(len(f), bool)
    if run.poses is not None:
        row = {int(n): k for k, n in enumerate(run.poses.frame)}
        at = [row.get(int(n), -1) for n in f.frame]
        usable = np.array([k >= 0 and run.poses.status[k] != "no-match" for k in at], bool)
        variance = run.poses.covariance[:, [0, 1], [0, 1]].max(axis=1)
        sigma = np.where(usable, np.sqrt(np.maximum(variance[at], 0.0)), np.inf)
        odometry = np.full((len(f), 3), np.nan)
    spread = f.odometry_sigma[:, :2].max(axis=1)
    return Track(
        run.log_id, run.crs, xyyaw_of(run.best_poses()), f.timestamp_ns, sigma, odometry, spread,
        usable,
    )  # fmt: skip


def _of_log(path: Path) -> Track:
    from rtmap_cli.logs.open import open_log

    log = open_log(path)
    frames = list(log.frames())
    none = np.full(3, np.nan)
    pose = np.array([f.map_SE3_ego for f in frames]).reshape(-1, 4, 4)
    sigma = np.array([f.sigma for f in frames]).reshape(-1, 3)[:, :2]
    odometry = [none if f.odometry is None else f.odometry for f in frames]
    spread = [none if f.odometry_sigma is None else f.odometry_sigma for f in frames]
    return Track(
        log.log_id, log.crs, xyyaw_of(pose), np.array([f.timestamp_ns for f in frames], np.int64),
        sigma.max(axis=1, initial=0.0), np.array(odometry).reshape(-1, 3),
        np.array(spread).reshape(-1, 3)[:, :2].max(axis=1, initial=0.0),
        np.ones(len(frames), bool),
    )  # fmt: skip


def read_traces(paths: Sequence[Path]) -> tuple[list[Trace], str, Counter[str]]:
    """The traces of several sources, their CRS, and how often what was taken out.

    BadInput for sources in different CRSs; NoAnswer when nobody drove anywhere.
    """
    traces: list[Trace] = []
    notes: Counter[str] = Counter()
    crs = ""
    for path in paths:
        track = read_track(path)
        check_same_crs(track.crs, crs or track.crs, path)
        crs = crs or track.crs
        traces += traces_of(track, notes)
    if not traces:
        raise NoAnswer(f"{paths[0]}: nothing was driven: no stretch of {SHORTEST:.0f} m")
    return traces, crs, notes


def traces_of(track: Track, notes: Counter[str]) -> list[Trace]:
    """The stretches of one drive: without stops and reversing, cut at jumps and gaps."""
    keep = _moving(track, notes)
    if len(keep) < 4:
        return []
    out = []
    for part in np.split(keep, np.flatnonzero(_breaks(track, keep, notes)) + 1):
        if len(part) < 4:
            continue
        xy = smoothed(track, part)
        s = arc_length(xy)
        if s[-1] < SHORTEST:
            continue
        at = np.linspace(0.0, s[-1], int(np.ceil(s[-1] / STEP)) + 1)
        seconds = np.diff(track.timestamp_ns[part]) / 1e9
        speed = np.diff(s) / np.maximum(seconds, 1e-3)
        out.append(
            Trace(track.name, CubicSpline(s, xy)(at), np.interp(at, (s[1:] + s[:-1]) / 2, speed))
        )
    return out


def _moving(track: Track, notes: Counter[str]) -> NDArray[np.int64]:
    """Indices of the poses at which the vehicle had moved on, forwards."""
    kept: list[int] = []
    for k in np.flatnonzero(track.usable):
        if kept:
            x, y, yaw = track.pose[kept[-1]]
            dx, dy = track.pose[k, 0] - x, track.pose[k, 1] - y
            ahead = dx * np.cos(yaw) + dy * np.sin(yaw)
            # With positions of a metre noise looks like motion: what counts is the odometry.
            told = track.odometry[kept[-1] + 1 : k + 1, 0]
            if np.isfinite(told).all():
                ahead = float(told.sum())
            if ahead < STILL:
                notes["poses of stops"] += 1
                if ahead < -STILL:
                    notes["poses of reversing"] += 1
                continue
        kept.append(int(k))
    notes["poses that are lost"] += int((~track.usable).sum())
    return np.array(kept, np.int64)


def _breaks(track: Track, keep: NDArray[np.int64], notes: Counter[str]) -> NDArray[np.bool_]:
    """(n - 1,) where a drive is cut: between which kept poses it jumped or nobody knows."""
    d = np.diff(track.pose[keep, :2], axis=0)
    step = np.hypot(*d.T)
    seconds = np.diff(track.timestamp_ns[keep]) / 1e9
    gap = (step > GAP[0]) | ((seconds > GAP[1]) & (step > 4 * STILL))
    # A stop may have been long: what was driven then is short.
    sigma = track.sigma[keep]
    doubt = 1.0 + 4.0 * np.hypot(sigma[1:], sigma[:-1])
    pace = np.minimum(np.median(step / seconds) * 3 + 5, FASTEST)
    velocity = d / seconds[:, None]
    change = np.zeros(len(step))
    change[1:] = np.hypot(*np.diff(velocity, axis=0).T) * seconds[1:]
    turn = np.abs(_across(track, keep, d))
    bound = HARDEST * seconds * np.maximum(seconds, 0.1)
    jump = (step > pace * seconds + doubt) | ((change > bound + doubt) & (turn > doubt))
    jump &= ~gap
    notes["jumps of positions"] += int(jump.sum())
    notes["gaps"] += int(gap.sum())
    out: NDArray[np.bool_] = gap | jump
    return out


def _across(track: Track, keep: NDArray[np.int64], d: Array) -> Array:
    """Metres by which steps go aside of the mean heading of both poses: vehicles do not."""
    yaw = track.pose[keep, 2]
    middle = yaw[:-1] + (np.angle(np.exp(1j * (yaw[1:] - yaw[:-1])))) / 2
    return d[:, 1] * np.cos(middle) - d[:, 0] * np.sin(middle)


def smoothed(track: Track, part: NDArray[np.int64]) -> Array:
    """(n, 2) positions of least squares: poses with their sigmas, steps with those of odometry.

    Where odometry is unknown poses stay as they are: those of a registered or localized drive are
    smooth already.
    """
    xy, sigma = track.pose[part, :2], np.maximum(track.sigma[part], 0.01)
    steps = np.full((len(part) - 1, 2), np.nan)
    spread = np.full(len(part) - 1, np.nan)
    for k, (a, b) in enumerate(pairwise(part)):
        told = track.odometry[a + 1 : b + 1]
        if np.isfinite(told).all():
            steps[k] = _moved(track.pose[a, 2], told)
            spread[k] = np.sqrt((np.nan_to_num(track.odometry_sigma[a + 1 : b + 1]) ** 2).sum())
    known = np.isfinite(steps).all(axis=1)
    if not known.any():
        return xy
    # The heading that turns a step is as sure as a degree or two.
    spread = np.hypot(np.maximum(np.nan_to_num(spread), 0.01), 0.02 * np.hypot(*steps.T))
    weight = np.where(known, 1 / np.where(known, spread, 1.0) ** 2, 0.0)
    own = 1 / sigma**2
    diagonal = own.copy()
    diagonal[:-1] += weight
    diagonal[1:] += weight
    pull = np.where(known[:, None], steps, 0.0) * weight[:, None]
    middle = xy.mean(axis=0)
    right = own[:, None] * (xy - middle)
    right[:-1] -= pull
    right[1:] += pull
    upper = np.concatenate([[0.0], -weight])
    out: Array = solveh_banded(np.stack([upper, diagonal]), right) + middle
    return out


def _moved(yaw: float, odometry: Array) -> Array:
    """(2,) metres of the map frame that a chain of odometry moved from a heading."""
    out = np.zeros(2)
    for dx, dy, dyaw in odometry:
        c, s = np.cos(yaw), np.sin(yaw)
        out += (c * dx - s * dy, s * dx + c * dy)
        yaw += dyaw
    return out
