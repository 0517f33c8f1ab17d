"""The files of an Argoverse 2 log as they lie on disk: feather and JSON into arrays.

Coordinates are those of the files: city frame for poses, ego frame for cuboids and sweeps, metres.
``rtmap_cli.formats.av2.log`` brings them together in the UTM frame of the city.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.poses import se3_from_quaternion
from rtmap_cli.logs.log import Camera, Rig
from rtmap_cli.maps.crs import city_code

Array = NDArray[np.float64]
Times = NDArray[np.int64]

RING_CAMERAS = (
    "ring_front_center",
    "ring_front_left",
    "ring_front_right",
    "ring_side_left",
    "ring_side_right",
    "ring_rear_left",
    "ring_rear_right",
)
"""The seven ring cameras, front to rear: the order in which a network sees them."""

POSES_FILE = "city_SE3_egovehicle.feather"
ANNOTATION_FILES = ("annotations.feather", "annotations_with_ego.feather")

OCCLUDING = frozenset(
    {
        "ARTICULATED_BUS",
        "BOX_TRUCK",
        "BUS",
        "LARGE_VEHICLE",
        "MESSAGE_BOARD_TRAILER",
        "RAILED_VEHICLE",
        "REGULAR_VEHICLE",
        "SCHOOL_BUS",
        "TRAFFIC_LIGHT_TRAILER",
        "TRUCK",
        "TRUCK_CAB",
        "VEHICULAR_TRAILER",
    }
)
"""Categories large and dense enough to hide the road behind them."""

_QUATERNION = ["qw", "qx", "qy", "qz"]
_TRANSLATION = ["tx_m", "ty_m", "tz_m"]


@dataclass(frozen=True)
class Cuboids:
    """Boxes at annotated moments, rows sorted by time.

    ``ego_SE3_object`` (n, 4, 4) is the pose of the box centre; ``size`` (n, 3) length, width,
    height in metres; ``points`` (n,) LiDAR points inside.
    """

    timestamp_ns: Times
    track: NDArray[Any]
    category: NDArray[Any]
    size: Array
    ego_SE3_object: Array
    points: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.timestamp_ns)

    def select(self, index: Any) -> Cuboids:
        """The rows of a mask, a slice or an index array."""
        return Cuboids(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Sweep:
    """One LiDAR sweep: ``xyz`` (n, 3) float32 in the ego frame of ``timestamp_ns``, metres (float16
    in the file: steps of 0.06 m beyond 64 m), ``intensity`` (n,) 0 … 255, ``offset_ns`` (n,) of
    each point after the start of the sweep, ``laser`` (n,) its laser."""

    timestamp_ns: int
    xyz: NDArray[np.float32]
    intensity: NDArray[np.uint8]
    offset_ns: NDArray[np.int32]
    laser: NDArray[np.uint8]


def read_feather(path: Path, columns: list[str]) -> pa.Table:
    """A feather file with at least these columns; BadInput when it cannot be trusted."""
    if not path.exists():
        raise BadInput(path, "no such file")
    try:
        table = feather.read_table(path, memory_map=False)
    except (pa.ArrowException, OSError) as error:
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadInput(
            path, f"cannot be read as feather ({text})", "it may be truncated; copy it again"
        ) from None
    missing = [name for name in columns if name not in table.schema.names]
    if missing:
        raise BadInput(path, f"column {', '.join(missing)} is missing")
    for name in columns:
        if table[name].null_count:
            raise BadInput(path, f"column {name} has missing values")
    return table


def _numbers(table: pa.Table, names: list[str], path: Path) -> Array:
    try:
        columns = [table[n].to_numpy(zero_copy_only=False).astype(np.float64) for n in names]
    except (ValueError, TypeError):
        raise BadInput(path, f"one of {', '.join(names)} is not a number column") from None
    return np.stack(columns, axis=-1)


def _transforms(table: pa.Table, path: Path) -> Array:
    """(n, 4, 4) from quaternion and translation columns; BadInput unless finite and unit."""
    q, t = _numbers(table, _QUATERNION, path), _numbers(table, _TRANSLATION, path)
    bad = ~(np.isfinite(q).all(axis=1) & np.isfinite(t).all(axis=1))
    if bad.any():
        raise BadInput(path, f"the pose of row {int(np.flatnonzero(bad)[0])} is not a number")
    bad = np.abs(np.linalg.norm(q, axis=1) - 1) > 1e-3
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise BadInput(path, f"the quaternion of row {row} is not of length 1")
    return se3_from_quaternion(q, t)


def _pose_table(folder: Path) -> tuple[pa.Table, Times]:
    path = folder / POSES_FILE
    table = read_feather(path, ["timestamp_ns", *_QUATERNION, *_TRANSLATION])
    return table, table["timestamp_ns"].to_numpy(zero_copy_only=False).astype(np.int64)


def read_poses_raw(folder: Path) -> tuple[Times, Array, Array]:
    """Times (n,), quaternions (n, 4) and city positions (n, 3) as they are, for a checker."""
    path = folder / POSES_FILE
    table, times = _pose_table(folder)
    return times, _numbers(table, _QUATERNION, path), _numbers(table, _TRANSLATION, path)


def read_poses(folder: Path) -> tuple[Times, Array]:
    """Times (n,) and city_SE3_ego (n, 4, 4) of a log; BadInput unless times rise strictly."""
    path = folder / POSES_FILE
    table, times = _pose_table(folder)
    if not len(times):
        raise BadInput(path, "holds no pose")
    step = np.diff(times)
    for bad, what, todo in (
        (step < 0, "is earlier than the row before", "sort it by time"),
        (step == 0, "repeats the time of the row before", "drop duplicates"),
    ):
        if bad.any():
            raise BadInput(path, f"row {int(np.flatnonzero(bad)[0]) + 1} {what}", todo)
    return times, _transforms(table, path)


def read_rig(folder: Path, cameras: tuple[str, ...] = RING_CAMERAS) -> Rig | None:
    """Those of ``cameras`` that the log's calibration knows, in that order; None without one."""
    intrinsics = folder / "calibration" / "intrinsics.feather"
    extrinsics = folder / "calibration" / "egovehicle_SE3_sensor.feather"
    if not intrinsics.exists() and not extrinsics.exists():
        return None
    names = ["fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "width_px", "height_px"]
    table = read_feather(intrinsics, ["sensor_name", *names])
    sensors = read_feather(extrinsics, ["sensor_name", *_QUATERNION, *_TRANSLATION])
    poses = dict(
        zip(sensors["sensor_name"].to_pylist(), _transforms(sensors, extrinsics), strict=True)
    )
    values = _numbers(table, names, intrinsics)
    if not np.isfinite(values).all():
        raise BadInput(intrinsics, "a value is not a number")
    rows = dict(zip(table["sensor_name"].to_pylist(), values, strict=True))
    found = []
    for name in cameras:
        if name not in rows:
            continue
        if name not in poses:
            raise BadInput(extrinsics, f"camera {name} has no pose")
        fx, fy, cx, cy, k1, k2, k3, width, height = rows[name].tolist()
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        found.append(
            Camera(name, int(width), int(height), matrix, poses[name], (k1, k2, k3)),
        )
    return Rig(tuple(found)) if found else None


def read_cuboids(folder: Path) -> Cuboids | None:
    """The cuboids of a log without the ego vehicle's own, sorted by time; None without any."""
    path = next((folder / n for n in ANNOTATION_FILES if (folder / n).exists()), None)
    if path is None:
        return None
    sizes = ["length_m", "width_m", "height_m"]
    table = read_feather(
        path, ["timestamp_ns", "track_uuid", "category", *sizes, *_QUATERNION, *_TRANSLATION]
    )
    times = table["timestamp_ns"].to_numpy(zero_copy_only=False).astype(np.int64)
    has_points = "num_interior_pts" in table.schema.names
    cuboids = Cuboids(
        timestamp_ns=times,
        track=np.array(table["track_uuid"].to_pylist(), object),
        category=np.array(table["category"].to_pylist(), object),
        size=_numbers(table, sizes, path),
        ego_SE3_object=_transforms(table, path) if len(table) else np.zeros((0, 4, 4)),
        points=table["num_interior_pts"].to_numpy(zero_copy_only=False).astype(np.int64)
        if has_points
        else np.full(len(times), -1, np.int64),
    )
    others = np.flatnonzero(cuboids.category != "EGO_VEHICLE")
    return cuboids.select(others[np.argsort(times[others], kind="stable")])


def read_sweep(path: Path) -> Sweep:
    """One LiDAR sweep; points that are not numbers are left out."""
    table = read_feather(path, ["x", "y", "z", "intensity", "offset_ns", "laser_number"])
    xyz = np.stack(
        [table[n].to_numpy(zero_copy_only=False).astype(np.float32) for n in "xyz"], axis=-1
    )
    keep = np.isfinite(xyz).all(axis=1)
    rest = [
        table[n].to_numpy(zero_copy_only=False)[keep]
        for n in ("intensity", "offset_ns", "laser_number")
    ]
    if not path.stem.isdigit():
        raise BadInput(path, "the name of a sweep is its time in nanoseconds")
    return Sweep(int(path.stem), xyz[keep], rest[0], rest[1], rest[2])


def timed_files(folder: Path, suffix: str) -> dict[int, Path]:
    """Files named by their time in nanoseconds, in time order; others are ignored."""
    files = folder.glob(f"*{suffix}") if folder.is_dir() else ()
    return {int(p.stem): p for p in sorted(files) if p.stem.isdigit()}


def find_city(folder: Path) -> str | None:
    """The city code in the names of the map files of a log (``…____PIT_city_47896.json``)."""
    for path in sorted((folder / "map").glob("*")) if (folder / "map").is_dir() else ():
        found = re.search(r"____([A-Za-z]{3})(?=[_.])", path.name)
        if found:
            return city_code(found.group(1), path)
    return None
