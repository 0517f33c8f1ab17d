"""A plain folder of sweeps: .bin, .ply or .pcd files, with or without poses.

    DIR/*.bin | *.ply | *.pcd, or DIR/velodyne/…, or DIR/<number>/points.bin
    DIR/times.txt        seconds, one a sweep                          (optional; else 10 a second)
    DIR/poses.txt        12 numbers a sweep (KITTI), or time x y z qx qy qz qw (TUM)     (optional)
    DIR/graph.txt        name x y z qx qy qz qw                                  (instead of poses)
    DIR/times_<n>.bin    float32 seconds of every point of the sweep whose name ends in n (optional)

``sweeps:DIR#raw_*.bin`` takes the files of a pattern. The ego frame is the sensor's.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.clouds import read_cloud
from rtmap_cli.geometry.poses import se3_from_quaternion
from rtmap_cli.logs.frames import POSE_SIGMA, FrameLog
from rtmap_cli.logs.log import Frame
from rtmap_cli.maps.crs import local_crs

Array = NDArray[np.float64]

KINDS = ("*.bin", "*.ply", "*.pcd")
PLACES = ("", "velodyne/", "velodyne_points/data/", "lidar/", "points/", "*/")
RATE_HZ = 10.0
_TIME_NAMES = ("time", "t", "timestamp", "offset_time")


class SweepFolder(FrameLog):
    """Satisfies ``Log``: a frame per file, in the order of the numbers in their names. Without
    poses every frame stands at the origin with an infinite sigma: nothing is known of it."""

    def __init__(self, path: str | Path) -> None:
        text = str(path)
        folder, _, pattern = text.rpartition("#") if "#" in text else (text, "", "")
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise BadInput(self.folder, "no such folder of sweeps")
        files = _files(self.folder, pattern)
        if not files:
            what = f"no file {pattern} in it" if pattern else "no .bin, .ply or .pcd file in it"
            raise BadInput(self.folder, what, "name the folder that holds the sweeps")
        seconds = _seconds(self.folder, len(files))
        poses = _poses(self.folder, len(files))
        notes = ["a folder of sweeps without a place on earth", "no cameras"]
        if poses is None:
            notes.append("no poses")
        frames = [
            Frame(
                index=k,
                timestamp_ns=round(float(seconds[k]) * 1e9),
                map_SE3_ego=np.eye(4) if poses is None else poses[k],
                sigma=np.full(3, np.inf) if poses is None else POSE_SIGMA.copy(),
                lidar=file,
            )
            for k, file in enumerate(files)
        ]
        name = self.folder.resolve().name
        super().__init__(self.folder, name, local_crs(f"sweeps {name}"), None, frames, notes=notes)

    def read_sweep(self, frame: Frame) -> Array | None:
        """(n, 4) x, y, z (sensor frame, metres) and intensity in [0, 1]; not compensated."""
        raw = self.read_raw_sweep(frame)
        return None if raw is None else raw[:, :4]

    def read_raw_sweep(self, frame: Frame) -> Array | None:
        """(n, 5) x, y, z, intensity and time (s from the sweep's; 0 where unknown)."""
        if frame.lidar is None:
            return None
        columns = read_cloud(frame.lidar)
        xyz = np.stack([columns["x"], columns["y"], columns["z"]], axis=-1)
        light = columns.get("intensity", columns.get("i", np.zeros(len(xyz))))
        if len(light) and np.nanmax(light) > 1.0:
            light = light / 255.0
        time = next((columns[n] for n in _TIME_NAMES if n in columns), None)
        if time is None:
            time = _point_times(frame.lidar, len(xyz))
        return np.column_stack([xyz, np.clip(light, 0, 1), time])


def _number(path: Path) -> tuple[list[int], str]:
    """Sorts 2 before 10."""
    return [int(n) for n in re.findall(r"\d+", path.parent.name + "/" + path.stem)], path.name


def _files(folder: Path, pattern: str) -> list[Path]:
    if pattern:
        return sorted(folder.glob(pattern), key=_number)
    for place in PLACES:
        for kind in KINDS:
            found = [p for p in folder.glob(place + kind) if not p.name.startswith("times_")]
            if found:
                return sorted(found, key=_number)
    return []


def _rows(path: Path, widths: tuple[int, ...]) -> Array:
    """Numbers of a text file; a first word that is no number is dropped."""
    rows = []
    for k, line in enumerate(path.read_text(encoding="utf-8").splitlines()):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        if not re.fullmatch(r"[-+.\deE]+", words[0]):
            words = words[1:]
        try:
            rows.append([float(w) for w in words])
        except ValueError:
            raise BadInput(path, f"line {k + 1} is not numbers") from None
        if len(rows[-1]) not in widths or len(rows[-1]) != len(rows[0]):
            raise BadInput(path, f"line {k + 1} has {len(rows[-1])} numbers")
    out = np.array(rows, np.float64)
    if not np.isfinite(out).all():
        raise BadInput(path, "holds a value that is not a number")
    return out


def _seconds(folder: Path, count: int) -> Array:
    path = folder / "times.txt"
    if not path.exists():
        return np.arange(count) / RATE_HZ
    out = _rows(path, (1,))[:, 0]
    if len(out) != count:
        raise BadInput(path, f"has {len(out)} times for {count} sweeps")
    if not (np.diff(out) > 0).all():
        raise BadInput(path, "sweeps are out of order", "sort them by time and drop duplicates")
    return out


def _poses(folder: Path, count: int) -> Array | None:
    for name in ("poses.txt", "graph.txt"):
        path = folder / name
        if not path.exists():
            continue
        rows = _rows(path, (7, 8, 12))
        if len(rows) != count:
            raise BadInput(path, f"has {len(rows)} poses for {count} sweeps")
        if rows.shape[1] == 12:
            out = np.tile(np.eye(4), (count, 1, 1))
            out[:, :3] = rows.reshape(-1, 3, 4)
            return out
        t, q = rows[:, -7:-4], rows[:, -4:]
        return se3_from_quaternion(q[:, [3, 0, 1, 2]], t)
    return None


def _point_times(sweep: Path, count: int) -> Array:
    """Times in a file ``times_<n>.bin`` beside the sweep; zeros without it."""
    number = re.search(r"(\d+)$", sweep.stem)
    path = sweep.with_name(f"times_{number.group(1)}.bin") if number else sweep
    if number is None or not path.exists() or sweep.stem.startswith("deskewed"):
        return np.zeros(count)
    out = np.fromfile(path, "<f4").astype(np.float64)
    if len(out) != count:
        raise BadInput(path, f"has {len(out)} times for {count} points")
    return out
