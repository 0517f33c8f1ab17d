"""The native log folder: Parquet tables and JPEG images (docs/log-format.md).

log.json            log id, CRS, height of the road in the ego frame, who made it
rig.parquet         the cameras (absent: no calibration)
frames.parquet      initial poses T⁰ with sigmas, odometry
images.parquet      which image belongs to which frame and camera
images/<camera>/<frame>.jpg
lidar.parquet, lidar/<frame>.parquet    sweeps (optional)
masks/labels.json, masks/<camera>/<frame>.png   what each pixel shows (optional)
occluders.parquet   boxes that hide something (optional)
truth/poses.parquet, truth/changes.json what a simulator knows (optional, kept apart)
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli import __version__
from rtmap_cli.errors import BadInput
from rtmap_cli.logs.log import Frame, Occluder, Rig
from rtmap_cli.logs.run import Poses
from rtmap_cli.logs.run_files import OCCLUDERS, read_poses, write_poses
from rtmap_cli.logs.tables import (
    FRAMES,
    IMAGES,
    LIDAR,
    LOG_SCHEMA,
    LOG_VERSION,
    ODOMETRY,
    ODOMETRY_SIGMA,
    RIG,
    SIGMAS,
    SWEEP,
    load,
    numbers,
    pose_columns,
    poses_of_table,
    rig_of_table,
    rig_table,
)
from rtmap_cli.maps.crs import check_log_crs
from rtmap_cli.tables import TableSchema, read_json, taken_for, write_json, write_table

Array = NDArray[np.float64]

FRAME_STATEMENTS = {
    "ego_frame": "x forward, y left, z up, metres",
    "map_frame": "the CRS above: x east, y north, z up, metres",
    "camera_frame": "x right, y down, z forward, metres; pixel centres at integers",
    "time": "nanoseconds since 1970-01-01T00:00:00Z",
}

_SAFE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")


def paths_inside(folder: Path, relative: Sequence[str], table: Path) -> list[Path]:
    """``folder / name`` of each name; BadInput (naming ``table``) when one leads out of it.

    Absolute paths, ``..`` and links to places outside are refused: a log that came from elsewhere
    must not name files of this machine.
    """
    root = folder.resolve()
    parents: dict[Path, bool] = {}
    out = []
    for name in relative:
        path = Path(name or "/")
        if path.is_absolute() or ".." in path.parts or "\\" in name:
            raise BadInput(table, f"the path {name!r} leads out of the log", "use relative paths")
        full = folder / path
        if full.parent not in parents:
            parents[full.parent] = full.parent.resolve().is_relative_to(root)
        linked_out = full.is_symlink() and not full.resolve().is_relative_to(root)
        if linked_out or not parents[full.parent]:
            raise BadInput(table, f"the path {name!r} is a link that leads out of the log")
        out.append(full)
    return out


def decode_image(path: Path, at_least: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB of an image file; BadInput when it is missing, broken or truncated.

    With ``at_least`` = (height, width) a JPEG may be decoded at 1/2, 1/4 or 1/8 of its size, as
    long as it stays at least that large (two to four times faster): the caller scales intrinsics.
    """
    from PIL import Image

    try:
        with Image.open(path) as image:
            if at_least is not None:
                image.draft("RGB", (at_least[1], at_least[0]))
            return np.asarray(image.convert("RGB"))
    except FileNotFoundError:
        raise BadInput(path, "no such image") from None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadInput(
            path, f"cannot be read as an image ({text})", "copy it again or drop the frame"
        ) from None


class NativeLog:
    """Reads a native log folder: tables at once, images and sweeps when asked for.

    Satisfies ``Log``. Raises BadInput for a folder that cannot be trusted; ``rtmap check-log``
    names everything that is wrong with it.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.info = read_log_info(self.path)
        self.log_id = str(self.info["log_id"])
        self.crs = check_log_crs(str(self.info["crs"]), self.path / "log.json")
        self.ground_z = float(self.info["ground_z"])
        self.rig = self._read_rig()
        self._frames_file = self.path / "frames.parquet"
        self._table = load(self._frames_file, FRAMES, ODOMETRY + ODOMETRY_SIGMA)
        self.index = self._table["frame"].to_numpy(zero_copy_only=False).astype(np.int64)
        self.timestamp_ns = self._table["timestamp_ns"].to_numpy(zero_copy_only=False)
        self._check_frames()
        self.map_SE3_ego = poses_of_table(self._table, self._frames_file)
        self._image_times: dict[int, dict[str, int]] = {}
        self._sweep_times: dict[int, int] = {}
        self._images = self._read_images()
        self._sweeps = self._read_sweeps()
        self._occluders = self._read_occluders()

    def __len__(self) -> int:
        return len(self.index)

    def frames(self) -> Iterator[Frame]:
        """The frames in time order."""
        sigma = numbers(self._table, SIGMAS)
        odometry = numbers(self._table, ODOMETRY)
        odometry_sigma = numbers(self._table, ODOMETRY_SIGMA)
        for row, index in enumerate(self.index):
            known = np.isfinite(odometry[row]).all()
            yield Frame(
                index=int(index),
                timestamp_ns=int(self.timestamp_ns[row]),
                map_SE3_ego=self.map_SE3_ego[row],
                sigma=sigma[row],
                odometry=odometry[row] if known else None,
                odometry_sigma=odometry_sigma[row] if known else None,
                images=self._images.get(int(index), {}),
                lidar=self._sweeps.get(int(index)),
                image_time_ns=self._image_times.get(int(index), {}),
                lidar_time_ns=self._sweep_times.get(int(index)),
                occluders=tuple(self._occluders.get(int(index), ())),
            )

    def read_image(
        self, frame: Frame, camera: str, at_least: tuple[int, int] | None = None
    ) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB of one camera of one frame (see ``decode_image``)."""
        if camera not in frame.images:
            raise BadInput(
                self.path / "images.parquet", f"frame {frame.index} has no image of {camera}"
            )
        return decode_image(frame.images[camera], at_least)

    def read_sweep(self, frame: Frame) -> Array | None:
        """(n, 4) x, y, z (ego, metres) and intensity of the frame's sweep, or None; points with
        times of their own are moved to the sweep's along the odometry."""
        raw = self.read_raw_sweep(frame)
        if raw is None or not raw[:, 4].any():
            return None if raw is None else raw[:, :4]
        return compensated(raw, self._step_before(frame))

    def read_raw_sweep(self, frame: Frame) -> Array | None:
        """(n, 5) x, y, z, intensity and time (s from the sweep's) as they were recorded."""
        if frame.lidar is None:
            return None
        return numbers(load(frame.lidar, SWEEP), SWEEP.columns.names)

    def _step_before(self, frame: Frame) -> Array:
        """(3,) dx, dy, dyaw per second before a frame, zero where odometry is unknown."""
        row = int(np.flatnonzero(self.index == frame.index)[0])
        if frame.odometry is None or row == 0:
            return np.zeros(3)
        elapsed = float(self.timestamp_ns[row] - self.timestamp_ns[row - 1]) / 1e9
        return np.asarray(frame.odometry / elapsed, np.float64)

    def truth_poses(self) -> Poses | None:
        """True poses that a simulator or a survey laid beside the log, or None."""
        path = self.path / "truth" / "poses.parquet"
        return read_poses(path) if path.exists() else None

    def truth_changes(self) -> Any | None:
        """True changes (prior → world) laid beside the log, or None."""
        path = self.path / "truth" / "changes.json"
        return read_json(path) if path.exists() else None

    def _check_frames(self) -> None:
        if not len(self.index):
            raise BadInput(self._frames_file, "holds no frame")
        if not (np.diff(self.timestamp_ns.astype(np.int64)) > 0).all():
            raise BadInput(
                self._frames_file,
                "timestamps do not rise from frame to frame",
                "sort the frames by time and drop duplicates",
            )
        if len(np.unique(self.index)) != len(self.index):
            raise BadInput(self._frames_file, "a frame number comes twice")

    def _read_rig(self) -> Rig | None:
        path = self.path / "rig.parquet"
        return rig_of_table(load(path, RIG), path) if path.exists() else None

    def _read_images(self) -> dict[int, dict[str, Path]]:
        path = self.path / "images.parquet"
        out: dict[int, dict[str, Path]] = {}
        if not path.exists():
            return out
        order = {c.name: k for k, c in enumerate(self.rig or ())}
        rows = load(path, IMAGES).to_pylist()
        if unknown := {row["camera"] for row in rows} - set(order):
            raise BadInput(
                path, f"camera {min(unknown)} is not in rig.parquet", "add its calibration"
            )
        rows.sort(key=lambda row: order[row["camera"]])
        files = paths_inside(self.path, [row["path"] for row in rows], path)
        for row, file in zip(rows, files, strict=True):
            out.setdefault(row["frame"], {})[row["camera"]] = file
            self._image_times.setdefault(row["frame"], {})[row["camera"]] = row["timestamp_ns"]
        self._known_frames(out, path)
        return out

    def _read_sweeps(self) -> dict[int, Path]:
        path = self.path / "lidar.parquet"
        if not path.exists():
            return {}
        rows = load(path, LIDAR).to_pylist()
        files = paths_inside(self.path, [row["path"] for row in rows], path)
        out = {row["frame"]: file for row, file in zip(rows, files, strict=True)}
        self._sweep_times = {row["frame"]: row["timestamp_ns"] for row in rows}
        self._known_frames(out, path)
        return out

    def _read_occluders(self) -> dict[int, list[Occluder]]:
        path = self.path / "occluders.parquet"
        out: dict[int, list[Occluder]] = {}
        if path.exists():
            for row in load(path, OCCLUDERS).to_pylist():
                out.setdefault(int(row.pop("frame")), []).append(Occluder(**row))
            self._known_frames(out, path)
        return out

    def _known_frames(self, found: Mapping[int, Any], path: Path) -> None:
        unknown = set(found) - set(self.index.tolist())
        if unknown:
            raise BadInput(path, f"frame {min(unknown)} is not in frames.parquet")


def compensated(raw: Array, rate: Array) -> Array:
    """(n, 4) points of a raw sweep (n, 5) in the ego frame of its time, the vehicle moving at the
    planar ``rate`` (3,) per second: half of a turn's bend is taken as its chord."""
    yaw = rate[2] * raw[:, 4]
    c, s = np.cos(yaw), np.sin(yaw)
    # The chord of the arc driven so far points half of its turn to the side.
    along, h = raw[:, 4], yaw / 2
    dx = along * (np.cos(h) * rate[0] - np.sin(h) * rate[1])
    dy = along * (np.sin(h) * rate[0] + np.cos(h) * rate[1])
    x, y = raw[:, 0], raw[:, 1]
    return np.stack([c * x - s * y + dx, s * x + c * y + dy, raw[:, 2], raw[:, 3]], axis=-1)


def read_log_info(folder: Path) -> dict[str, Any]:
    """log.json of a native log folder, checked (BadInput says what is missing)."""
    if not folder.is_dir():
        raise BadInput(folder, "no such log folder")
    path = folder / "log.json"
    if not path.exists():
        todo = taken_for(folder) or "see docs/log-format.md"
        raise BadInput(folder, "not a log (log.json is missing)", todo)
    info = read_json(path)
    if not isinstance(info, dict) or info.get("schema") != LOG_SCHEMA:
        raise BadInput(path, f"not the log.json of an rtmap log (schema is not {LOG_SCHEMA})")
    version = str(info.get("schema_version", "?"))
    if version.split(".")[0] != LOG_VERSION.split(".")[0]:
        raise BadInput(path, f"log version {version} is unknown (this rtmap reads {LOG_VERSION})")
    for key in ("log_id", "crs", "ground_z"):
        if key not in info:
            raise BadInput(path, f"{key} is missing")
    if not isinstance(info["ground_z"], int | float) or not np.isfinite(info["ground_z"]):
        raise BadInput(path, "ground_z is not a number", "give the road's height in the ego frame")
    return info


class NativeLogWriter:
    """Writes a native log into an existing empty folder (wrap it in ``whole_folder``).

    Call ``add`` for each frame in time order, then ``write_truth`` (optional), then ``close``,
    which writes the tables. The same content gives the same bytes.
    """

    def __init__(
        self,
        folder: Path,
        log_id: str,
        crs: str,
        rig: Rig | None,
        ground_z: float = 0.0,
        creation: Mapping[str, Any] | None = None,
    ) -> None:
        """``creation`` (seed, source, options …) is kept in log.json as it is."""
        self.folder, self.log_id, self.crs, self.rig = Path(folder), log_id, crs, rig
        self.ground_z, self.creation = float(ground_z), dict(creation or {})
        self._rows: list[Frame] = []
        self._images: list[tuple[int, str, int, str]] = []
        self._sweeps: list[tuple[int, int, str]] = []
        self._names = {c.name for c in rig or ()}
        for name in self._names:
            if not _SAFE_NAME.fullmatch(name):
                raise ValueError(f"camera name {name!r} cannot be a folder name")

    def add(
        self,
        frame: Frame,
        images: Mapping[str, bytes],
        image_times_ns: Mapping[str, int] | None = None,
        sweep: Array | None = None,
        masks: Mapping[str, bytes] | None = None,
        sweep_time_ns: int | None = None,
    ) -> None:
        """Add one frame with its JPEG files by camera name (any subset of the rig's cameras).

        ``image_times_ns`` gives exposure times where they differ from the frame's; ``sweep``
        (n, 4) holds x, y, z in the ego frame (of ``sweep_time_ns``, by default the frame's) and
        intensity, or (n, 5) with the time of each point from it (s), in whose ego frame it is;
        ``masks`` are PNG files of label numbers by camera name. ``frame.images`` and
        ``frame.lidar`` are ignored. ValueError when frames do not rise or a camera is unknown.
        """
        if self._rows and (
            frame.timestamp_ns <= self._rows[-1].timestamp_ns or frame.index <= self._rows[-1].index
        ):
            raise ValueError(f"frame {frame.index}: numbers and timestamps must rise")
        if unknown := set(images) - self._names:
            raise ValueError(f"frame {frame.index}: camera {min(unknown)} is not in the rig")
        self._rows.append(frame)
        for camera, data in images.items():
            relative = f"images/{camera}/{frame.index:06d}.jpg"
            path = self.folder / relative
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            time = (image_times_ns or {}).get(camera, frame.timestamp_ns)
            self._images.append((frame.index, camera, time, relative))
        for camera, data in (masks or {}).items():
            path = self.folder / "masks" / camera / f"{frame.index:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        if sweep is not None:
            relative = f"lidar/{frame.index:06d}.parquet"
            if sweep.shape[1] == 4:
                sweep = np.column_stack([sweep, np.zeros(len(sweep))])
            columns = {n: sweep[:, k] for k, n in enumerate(SWEEP.columns.names)}
            write_table(pa.table(columns), self.folder / relative, SWEEP)
            time = frame.timestamp_ns if sweep_time_ns is None else sweep_time_ns
            self._sweeps.append((frame.index, time, relative))

    def write_truth(self, poses: Poses, changes: Any | None = None) -> None:
        """Lay true poses (and changes, prior → world) apart, in ``truth/``."""
        (self.folder / "truth").mkdir(exist_ok=True)
        write_poses(poses, self.folder / "truth", self.crs)
        if changes is not None:
            write_json(changes, self.folder / "truth" / "changes.json")

    def close(self) -> None:
        """Write log.json and the tables; ValueError when no frame was added."""
        if not self._rows:
            raise ValueError("a log needs at least one frame")
        self._write("frames.parquet", self._frame_columns(), FRAMES)
        if self.rig is not None:
            write_table(rig_table(self.rig), self.folder / "rig.parquet", RIG)
        if self._images:
            self._write("images.parquet", _columns(self._images, IMAGES), IMAGES)
        if self._sweeps:
            self._write("lidar.parquet", _columns(self._sweeps, LIDAR), LIDAR)
        names = OCCLUDERS.columns.names[1:]
        boxes = [
            (f.index, *(getattr(o, n) for n in names)) for f in self._rows for o in f.occluders
        ]
        if boxes:
            self._write("occluders.parquet", _columns(boxes, OCCLUDERS), OCCLUDERS)
        write_json(
            {
                "schema": LOG_SCHEMA,
                "schema_version": LOG_VERSION,
                "log_id": self.log_id,
                "crs": self.crs,
                "ground_z": self.ground_z,
                **FRAME_STATEMENTS,
                "creation": {"rtmap_version": __version__, **self.creation},
            },
            self.folder / "log.json",
        )

    def _write(self, name: str, columns: dict[str, Any], schema: TableSchema) -> None:
        write_table(pa.table(columns), self.folder / name, schema, {"rtmap.crs": self.crs})

    def _frame_columns(self) -> dict[str, Any]:
        rows = self._rows
        unknown = np.full(3, np.nan)
        sigma = np.array([f.sigma for f in rows], np.float64)
        columns: dict[str, Any] = {
            "frame": [f.index for f in rows],
            "timestamp_ns": [f.timestamp_ns for f in rows],
        }
        columns |= pose_columns(np.array([f.map_SE3_ego for f in rows], np.float64))
        columns |= {n: sigma[:, k] for k, n in enumerate(SIGMAS)}
        for name, targets in (("odometry", ODOMETRY), ("odometry_sigma", ODOMETRY_SIGMA)):
            found = [getattr(f, name) for f in rows]
            values = np.array([unknown if v is None else v for v in found], np.float64)
            for k, target in enumerate(targets):
                columns[target] = pa.array(values[:, k], from_pandas=True)
        return columns


def _columns(rows: list[Any], schema: TableSchema) -> dict[str, Any]:
    names = schema.columns.names
    return {name: [row[k] for row in rows] for k, name in enumerate(names)}
