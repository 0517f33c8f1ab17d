"""Where poses come from: runs, native logs, Argoverse 2 logs, fleet poses, poses tables."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.poses import interpolate
from rtmap_cli.logs.open import READERS
from rtmap_cli.logs.run import Poses
from rtmap_cli.logs.run_files import read_poses, read_run_info

Array = NDArray[np.float64]

MAX_GAP_NS = 300_000_000
"""Poses are interpolated between neighbours that are at most this far apart."""


@dataclass(frozen=True)
class Drive:
    """The poses of one drive: ``pose`` (n, 4, 4) map_SE3_ego at rising ``timestamp_ns`` (n,)."""

    name: str
    crs: str
    timestamp_ns: NDArray[np.int64]
    pose: Array

    def __len__(self) -> int:
        return len(self.timestamp_ns)

    @property
    def kilometres(self) -> float:
        """Distance driven."""
        steps = np.diff(self.pose[:, :2, 3], axis=0)
        return float(np.hypot(steps[:, 0], steps[:, 1]).sum() / 1000)

    def at(self, timestamp_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        """Poses (n, 4, 4) at some times and which of them (n,) are known.

        Exact times are taken as they are; others are interpolated between neighbours at most
        ``MAX_GAP_NS`` apart. Unknown poses are NaN.
        """
        at = np.asarray(timestamp_ns, np.int64)
        after = np.clip(np.searchsorted(self.timestamp_ns, at), 0, len(self) - 1)
        before = np.maximum(after - 1, 0)
        exact = self.timestamp_ns[after] == at
        inside = (self.timestamp_ns[before] <= at) & (at <= self.timestamp_ns[after])
        gap = self.timestamp_ns[after] - self.timestamp_ns[before]
        known = exact | (inside & (gap <= MAX_GAP_NS))
        out = np.full((len(at), 4, 4), np.nan)
        if known.any():
            out[known] = interpolate(self.timestamp_ns, self.pose, at[known])
        out[exact] = self.pose[after[exact]]
        return out, np.asarray(known, dtype=bool)


def read_drives(spec: str | Path, traversal: str | None = None) -> list[Drive]:
    """The drives of POSES, several only for fleet poses (``traversal`` picks one of them).

    A folder with ``truth/poses.parquet`` (a simulated log) gives its true poses, a run its
    localized ones, an Argoverse 2 log or a scene of another format (``av2:DIR``,
    ``nuscenes:DIR#SCENE``) the vehicle's own. BadInput when there is no drive ``traversal``.
    """
    path = Path(spec)
    if str(spec).startswith("av2:") or (path / "city_SE3_egovehicle.feather").exists():
        drives = [_av2(spec)]
    elif str(spec).partition(":")[0] in READERS:
        drives = [_frames_of(spec)]
    elif path.is_dir():
        drives = [_folder(path)]
    elif path.name.endswith((".json", ".json.gz")):
        drives = _fleet(path, traversal)
    else:
        drives = [_drive(read_poses(path), _crs_of(path), path.stem)]
    if traversal is not None and traversal not in [d.name for d in drives]:
        names = ", ".join(d.name for d in drives)
        raise BadInput(spec, f"has no traversal {traversal} (it has {names})")
    for drive in drives:
        if not len(drive):
            raise BadInput(spec, f"drive {drive.name} has no poses")
        if (np.diff(drive.timestamp_ns) <= 0).any():
            raise BadInput(spec, f"the times of drive {drive.name} do not rise")
    return drives


def drive_of(drives: list[Drive], log_id: str, where: str | Path) -> Drive:
    """The drive that belongs to a run: the only one, or the one named like the run.

    Fleet traversals are called "00", "01", …; a run ``fleet-<map>-<scenario>-NN`` drove ``NN``.
    """
    if len(drives) == 1:
        return drives[0]
    ending = re.search(r"([^-_]+)$", log_id)
    for drive in drives:
        if drive.name == log_id or (ending and drive.name == ending.group(1)):
            return drive
    names = ", ".join(d.name for d in drives)
    raise BadInput(where, f"has no drive for {log_id} (it has {names})", "pass --traversal NAME")


def _drive(poses: Poses, crs: str, name: str) -> Drive:
    kept = np.asarray(poses.status != "no-match", dtype=bool)
    return Drive(name, crs, poses.timestamp_ns[kept], poses.pose[kept])


def _crs_of(path: Path) -> str:
    import pyarrow.parquet as pq

    metadata = pq.read_schema(path).metadata or {}
    crs: bytes | None = metadata.get(b"rtmap.crs")
    if crs is None:
        raise BadInput(path, "does not state its CRS (no rtmap.crs in its metadata)")
    return crs.decode()


def _folder(path: Path) -> Drive:
    truth = path / "truth" / "poses.parquet"
    if truth.exists():
        return _drive(read_poses(truth), _crs_of(truth), path.name)
    if (path / "run.json").exists():
        info = read_run_info(path)
        if not (path / "poses.parquet").exists():
            raise BadInput(path, "has no poses yet", "run rtmap localize first")
        return _drive(read_poses(path / "poses.parquet"), str(info["crs"]), str(info["log_id"]))
    if (path / "poses.parquet").exists():
        return _drive(read_poses(path / "poses.parquet"), _crs_of(path / "poses.parquet"), "drive")
    if not path.is_dir() or not any(path.iterdir()):
        raise BadInput(path, "is an empty folder")
    raise BadInput(
        path,
        "holds no poses (no truth/poses.parquet, poses.parquet or city_SE3_egovehicle.feather)",
    )


def _fleet(path: Path, traversal: str | None) -> list[Drive]:
    from rtmap_cli.formats.detections import read_fleet_poses

    fleet = read_fleet_poses(path)
    if traversal not in (None, *fleet.traversals):
        traversal = None  # The caller says which there are.
    return [
        _drive(poses, fleet.crs, name)
        for name, poses in fleet.traversals.items()
        if traversal in (None, name)
    ]


def _frames_of(spec: str | Path) -> Drive:
    """The poses of the frames of a log of another format."""
    from rtmap_cli.logs.open import open_log

    log = open_log(spec)
    frames = list(log.frames())
    times = np.array([f.timestamp_ns for f in frames], np.int64)
    return Drive(log.log_id, log.crs, times, np.stack([f.map_SE3_ego for f in frames]))


def _av2(spec: str | Path) -> Drive:
    from rtmap_cli.formats.av2.log import Av2Log

    log = Av2Log(Path(str(spec).removeprefix("av2:")))
    return Drive(log.log_id, log.crs, log.pose_times, log.poses)
