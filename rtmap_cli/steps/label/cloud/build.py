"""From a log to its cloud folder: odometry, graph, loops, the dense map."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput, NoAnswer
from rtmap_cli.geometry import lie
from rtmap_cli.geometry.polylines import arc_length
from rtmap_cli.geometry.poses import invert, transform
from rtmap_cli.logs.cloud import Trajectory, Voxels, write_info, write_tile, write_trajectory
from rtmap_cli.logs.log import Frame, Log
from rtmap_cli.steps.label.cloud.georeference import Reference, place_in_map
from rtmap_cli.steps.label.cloud.mapping import TILE, VoxelMap
from rtmap_cli.steps.label.cloud.odometry import DEGENERATE, LOST, Odometry, Step
from rtmap_cli.steps.label.cloud.points import Sweep, cleaned, deskewed, thinned
from rtmap_cli.steps.label.cloud.track import Settings, Track

Array = NDArray[np.float64]
Progress = Callable[[Iterator[Any], str, int], Iterator[Any]]

NOTHING: Array = np.zeros((0, 3))
FEWEST = 100
"""A sweep of fewer points is not looked at."""
MOST_WEAK = 0.5
"""With nothing but the sweeps to go by, a drive of which more is degenerate has no answer."""


def sweep_of(log: Log, frame: Frame) -> Sweep | None:
    """The sweep of a frame as it was recorded, None without one."""
    reader: Any = log
    if frame.lidar is None:
        return None
    raw = getattr(reader, "read_raw_sweep", reader.read_sweep)(frame)
    if raw is None:
        return None
    time = raw[:, 4] if raw.shape[1] > 4 and raw[:, 4].any() else None
    return Sweep(raw[:, :3], raw[:, 3], time)


class Builder:
    """Registers the sweeps of a log and writes the cloud folder; BadInput for a log without
    sweeps, NoAnswer when their geometry leaves the drive undetermined."""

    def __init__(self, log: Log, settings: Settings) -> None:
        self.log, self.settings = log, settings
        self.frames = [f for f in log.frames() if f.lidar is not None]
        if not self.frames:
            raise BadInput(log.path, "no frame has a LiDAR sweep", "record LiDAR, or simulate it")
        self.notes: list[str] = []
        self._dropped = 0

    def write(self, folder: Path, progress: Progress) -> dict[str, Any]:
        """Write the folder; returns what cloud.json says."""
        keys = folder / ".keyframes"
        keys.mkdir()
        track = self._odometry(keys, progress)
        reference = self._reference(track, keys)
        trajectory = self._trajectory(track, reference)
        voxels, points = self._map(folder, track, trajectory, progress)
        write_trajectory(trajectory, folder, self.log.crs)
        for path in keys.iterdir():
            path.unlink()
        keys.rmdir()
        said = self._said(track, reference, trajectory) | {"voxels": voxels, "points": points}
        write_info(folder, said)
        return said

    def _odometry(self, keys: Path, progress: Progress) -> Track:
        """Register every sweep; clouds of keyframes go to ``keys``."""
        settings = self.settings
        odometry = Odometry(settings.method, settings.leaf)
        steps: list[Step] = []
        frames: list[Frame] = []
        untimed = 0
        for frame in progress(iter(self.frames), "sweeps", len(self.frames)):
            raw = sweep_of(self.log, frame)
            motion = frame.odometry if settings.odometry else None
            if raw is None:
                continue
            sweep = cleaned(raw)
            self._dropped += len(raw) - len(sweep)
            untimed += sweep.time is None
            if len(sweep) < FEWEST:
                if not steps:
                    continue
                sweep = Sweep(np.zeros((0, 3)), np.zeros(0))
            step = odometry.add(sweep, frame.timestamp_ns / 1e9, motion)
            if step.keyframe:
                thin = thinned(step.points, odometry.matcher_leaf / 2).astype(np.float32)
                np.save(keys / f"{len(steps)}.npy", thin)
            # The points are as large as the log: they are on disk, or not needed any more.
            steps.append(replace(step, points=NOTHING))
            frames.append(frame)
        if not steps:
            raise BadInput(self.log.path, f"no sweep holds {FEWEST} points within range")
        self.leaf = odometry.matcher_leaf
        if untimed:
            self.notes.append(
                f"points of {untimed} sweeps have no times: motion within a turn is left in"
            )
        nothing = np.full(3, np.nan)
        return Track(
            frames,
            np.stack([s.pose for s in steps]),
            np.stack([s.information for s in steps]),
            np.array([s.status for s in steps], object),
            np.stack([nothing if s.weak is None else s.weak for s in steps]),
            np.array([s.keyframe for s in steps]),
            np.array([s.cost for s in steps]),
            np.array([s.turn for s in steps]),
        )

    def _reference(self, track: Track, keys: Path) -> Reference:
        """Place the keyframes in the map frame."""
        rows = np.flatnonzero(track.keyframe)
        weak = float((track.status != "ok").mean())
        known = self.settings.gnss and np.isfinite(track.frames[0].sigma).all()
        drives = any(f.odometry is not None for f in track.frames) and self.settings.odometry
        if weak > MOST_WEAK and not known and not drives:
            raise NoAnswer(
                f"the surroundings of {weak:.0%} of the sweeps do not tell the {track.open()} "
                "(a tunnel, a round hall, or too few returns), and neither GNSS nor odometry does"
            )

        def cloud(k: int) -> Array:
            return np.load(keys / f"{rows[k]}.npy", allow_pickle=False).astype(np.float64)

        return place_in_map(track, rows, cloud, self.settings, self.leaf, bool(known))

    def _trajectory(self, track: Track, reference: Reference) -> Trajectory:
        """Every sweep's pose: the correction of the keyframes, linear in between."""
        rows = np.flatnonzero(track.keyframe)
        correction = reference.pose @ invert(track.local[rows])
        at = np.arange(len(track.local))
        k = np.clip(np.searchsorted(rows, at, "right") - 1, 0, max(len(rows) - 2, 0))
        if len(rows) > 1:
            share = np.clip((at - rows[k]) / (rows[k + 1] - rows[k]), 0.0, 1.0)
            step = lie.log(invert(correction[k]) @ correction[k + 1])
            pose = correction[k] @ lie.exp(share[:, None] * step) @ track.local
        else:
            share = np.zeros(len(at))
            pose = correction[k] @ track.local
        near = np.where(share < 0.5, k, np.minimum(k + 1, len(rows) - 1))
        ground = np.full(len(at), np.nan)
        if np.isfinite(self.log.ground_z):
            ground = (pose @ np.array([0.0, 0.0, self.log.ground_z, 1.0]))[:, 2]
        return Trajectory(
            frame=np.array([f.index for f in track.frames], np.int32),
            timestamp_ns=np.array([f.timestamp_ns for f in track.frames], np.int64),
            pose=pose,
            covariance=reference.covariance[near],
            ground_z=ground,
            keyframe=track.keyframe,
            status=track.status,
            weak=np.einsum("nij,nj->ni", pose[:, :3, :3], track.weak),
        )

    def _map(
        self, folder: Path, track: Track, trajectory: Trajectory, progress: Progress
    ) -> tuple[int, int]:
        """Read the sweeps again and put them where they belong; (voxels, points)."""
        settings = self.settings
        parked = folder / ".parked"
        dense = VoxelMap(settings.voxel, parked, settings.reach)
        frames = track.frames
        pose = trajectory.pose
        for k in progress(iter(range(len(frames))), "map", len(frames)):
            raw = sweep_of(self.log, frames[k])
            if raw is None or track.status[k] == LOST:
                continue
            sweep = cleaned(raw, settings.reach)
            xyz = deskewed(sweep, self._twist(frames, pose, k))
            dense.add(transform(pose[k], xyz), sweep.intensity)
            dense.leave(pose[k, :2, 3])

        def write(at: tuple[int, int], voxels: Voxels) -> None:
            write_tile(voxels, folder, at, self.log.crs)

        count = dense.finish(write)
        if parked.exists():
            for path in parked.iterdir():
                path.unlink()
            parked.rmdir()
        return count, dense.points

    @staticmethod
    def _twist(frames: list[Frame], pose: Array, k: int) -> Array:
        """(6,) motion per second about sweep k."""
        a, b = max(k - 1, 0), k if k else min(1, len(frames) - 1)
        elapsed = (frames[b].timestamp_ns - frames[a].timestamp_ns) / 1e9
        if elapsed <= 0:
            return np.zeros(6)
        return np.asarray(lie.log(invert(pose[a]) @ pose[b]) / elapsed)

    def _said(self, track: Track, reference: Reference, path: Trajectory) -> dict[str, Any]:
        """What cloud.json says."""
        status = track.status
        counts = {
            "degenerate": int((status == DEGENERATE).sum()),
            "lost": int((status == LOST).sum()),
        }
        if counts["degenerate"]:
            self.notes.append(
                f"{counts['degenerate']} sweeps do not tell the {track.open()}: held by what was "
                "expected there (status degenerate, weak direction in trajectory.parquet)"
            )
        if counts["lost"]:
            self.notes.append(f"{counts['lost']} sweeps met nothing known (status lost)")
        if reference.rejected:
            self.notes.append(f"{reference.rejected} GNSS fixes were rejected: they jump")
        return {
            "crs": self.log.crs, "voxel_m": self.settings.voxel, "tile_m": TILE,
            "log": {"path": str(self.log.path), "log_id": self.log.log_id},
            "method": self.settings.method, "options": asdict(self.settings) | {"leaf": self.leaf},
            "frames": len(track.frames), "keyframes": int(track.keyframe.sum()),
            "loops": reference.loops, "loops_rejected": reference.loops_rejected,
            "gnss_rejected": reference.rejected, "gnss": reference.georeferenced,
            "returns_dropped": self._dropped, "notes": self.notes, **counts,
            "length_m": float(arc_length(path.pose[:, :3, 3])[-1]) if len(path) > 1 else 0.0,
        }  # fmt: skip
