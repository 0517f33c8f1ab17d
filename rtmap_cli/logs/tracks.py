"""Tracks: where runs drove, without what they saw; what tiles are planned by."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.run import Observations, Run
from rtmap_cli.logs.run_files import OBSERVATIONS, read_frames, read_poses, read_run, read_run_info
from rtmap_cli.logs.traversal import Traversal, range_box, traversal_of, usable_poses
from rtmap_cli.tables import check_schema

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Track:
    """The frames of a run that have a usable pose: numbers ``frame`` (m,) and places ``xy`` (m, 2)
    in the map frame. ``reach`` (m): no detection is farther from its frame; ``digest`` of times and
    initial poses tells copies of a run; ``model`` and ``map_version`` are what run.json states."""

    path: Path
    run_id: str
    crs: str
    classes: tuple[str, ...]
    frame: NDArray[np.int32]
    xy: Array
    reach: float
    localized: bool
    digest: str = ""
    model: str | None = None
    map_version: int | None = None

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def kilometres(self) -> float:
        """Distance driven between its frames."""
        return float(np.hypot(*np.diff(self.xy, axis=0).T).sum()) / 1000


def read_track(path: Path) -> Track:
    """The track of a run folder; BadInput when the run is broken as far as can be told without
    reading its observations, or has no frame that can be used."""
    info = read_run_info(path)
    poses = path / "poses.parquet"
    run = Run(
        info,
        read_frames(path),
        Observations.empty(),
        poses=read_poses(poses) if poses.exists() else None,
        path=path,
    )
    _check_head(path / "observations.parquet")
    usable, pose, _ = usable_poses(run)
    if not usable.any():
        raise BadInput(path, "has no frame with a usable pose", "localize it again")
    box = np.array(range_box(run)).reshape(2, 2)
    reach = float(np.hypot(*np.abs(box).max(axis=0)))
    return Track(
        path,
        run.log_id,
        run.crs,
        tuple(str(c) for c in info["classes"]),
        run.frames.frame[usable],
        pose[usable, :2],
        reach,
        run.poses is not None,
        _digest(run),
        info.get("model_sha256"),
        info["map_version"] if isinstance(info.get("map_version"), int) else None,
    )


def _digest(run: Run) -> str:
    """No two drives share all their times and initial poses."""
    state = run.frames.timestamp_ns.tobytes() + run.frames.initial.tobytes()
    return hashlib.sha256(state).hexdigest()


def _check_head(path: Path) -> None:
    """BadInput when a table of observations is missing, cut off, or none."""
    import pyarrow.parquet as pq

    if not path.exists():
        raise BadInput(path, "no such file")
    try:
        schema = pq.read_schema(path)
    except (pa.ArrowException, OSError) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadInput(
            path, f"cannot be read as Parquet ({first})", "it may be truncated; copy it again"
        ) from None
    check_schema(schema.metadata, path, OBSERVATIONS)


def read_tracks(
    paths: Sequence[Path], crs: str | None = None, skip_bad: bool = False
) -> tuple[list[Track], str, list[str]]:
    """Tracks in one CRS (that of the map, or of the first run), the CRS, and a line for each run
    that was left out.

    BadInput names the run that is broken, lies in another CRS, or is there twice; with
    ``skip_bad`` such runs are left out, unless none is left.
    """
    from rtmap_cli.maps.crs import check_map_crs, check_same_crs

    out: list[Track] = []
    bad: list[str] = []
    seen: dict[str, Path] = {}
    for path in paths:
        try:
            track = read_track(path)
            where = path / "run.json"
            check_same_crs(track.crs, crs or check_map_crs(track.crs, where), where)
            for name in (track.run_id, track.digest):
                if name in seen:
                    twin = f"is the run of {track.run_id}, as {seen[name]} is"
                    raise BadInput(path, twin, "drop one")
        except BadInput as error:
            if not skip_bad:
                raise
            bad.append(str(error))
            continue
        crs = crs or track.crs
        seen |= {track.run_id: path, track.digest: path}
        out.append(track)
    if not out and bad:
        raise BadInput(Path(paths[0]).parent, "none of its runs can be used", bad[0])
    return out, crs or "", bad


def read_stretch(path: Path, frames: NDArray[Any] | None = None) -> Traversal:
    """The traversal of a run, or only its sorted ``frames``: the rest is not read.

    Where a frame was left out nothing is known of the motion to the next one.
    """
    run = read_run(path, frames)
    if frames is not None:
        gap = np.diff(run.frames.frame, prepend=run.frames.frame[:1])
        usual = np.median(gap[1:]) if len(gap) > 1 else 1
        broken = (gap > 1.5 * usual) | (np.arange(len(gap)) == 0)
        run.frames.odometry[broken] = np.nan
        run.frames.odometry_sigma[broken] = np.nan
    return traversal_of(run)
