"""The tables of the native log folder (docs/log-format.md), and rigs and poses as columns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.poses import quaternion_from_se3, se3_from_quaternion
from rtmap_cli.logs.log import Camera, Rig
from rtmap_cli.tables import TableSchema, read_table

Array = NDArray[np.float64]

LOG_SCHEMA = "rtmap.log"
LOG_VERSION = "1.0"

TIME = "nanoseconds since 1970-01-01T00:00:00Z"
POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
SIGMAS = ("sigma_x", "sigma_y", "sigma_yaw")
DELTAS = ("dx", "dy", "dyaw")
ODOMETRY = tuple(f"odometry_{n}" for n in DELTAS)
ODOMETRY_SIGMA = tuple(f"odometry_sigma_{n}" for n in DELTAS)
RADIAL = tuple(f"k{i}" for i in range(1, 7))
LATER_LENS = ("k4", "k5", "k6", "p1", "p2")
"""Lens columns that rigs of version 1.0 lack."""

RIG = TableSchema(
    name="rtmap.log.rig",
    version="1.1",
    frame="ego_SE3_camera: camera (x right, y down, z forward) to ego (x forward, y left, z up)",
    units="pixels (centres at integers), metres; unit quaternions w, x, y, z",
    description="One row per camera, in the order in which a network sees them.",
    columns=pa.schema(
        [("camera", pa.string()), ("width", pa.int32()), ("height", pa.int32())]
        + [(n, pa.float64()) for n in ("fx", "fy", "cx", "cy", "k1", "k2", "k3")]
        + [(n, pa.float64()) for n in POSE]
        + [("model", pa.string())]
        + [(n, pa.float64()) for n in LATER_LENS]
    ),
    defaults={"model": "pinhole"} | dict.fromkeys(LATER_LENS, 0.0),
)

FRAMES = TableSchema(
    name="rtmap.log.frames",
    version="1.0",
    frame="map_SE3_ego: ego (x forward, y left, z up) to map (CRS in rtmap.crs)",
    units=f"metres, radians, {TIME}; unit quaternions w, x, y, z",
    description=(
        "One row per frame in time order: initial pose T⁰ (metre level) with its standard "
        "deviations, and the motion since the previous frame in the previous ego frame, null "
        "where unknown."
    ),
    columns=pa.schema(
        [("frame", pa.int32()), ("timestamp_ns", pa.int64())]
        + [(n, pa.float64()) for n in POSE]
        + [(n, pa.float64()) for n in SIGMAS + ODOMETRY + ODOMETRY_SIGMA]
    ),
)

IMAGES = TableSchema(
    name="rtmap.log.images",
    version="1.0",
    units=TIME,
    description=(
        "One row per image: a frame may lack cameras; path is relative to the folder of the log."
    ),
    columns=pa.schema(
        [
            ("frame", pa.int32()),
            ("camera", pa.string()),
            ("timestamp_ns", pa.int64()),
            ("path", pa.string()),
        ]
    ),
)

LIDAR = TableSchema(
    name="rtmap.log.lidar",
    version="1.0",
    units=TIME,
    description="One row per sweep; path is relative to the folder of the log.",
    columns=pa.schema([("frame", pa.int32()), ("timestamp_ns", pa.int64()), ("path", pa.string())]),
)

SWEEP = TableSchema(
    name="rtmap.log.sweep",
    version="1.1",
    frame="ego (x forward, y left, z up) at the time of the sweep, or of the point: see time",
    units="metres; intensity in [0, 1]; seconds",
    description=(
        "One row per point of one LiDAR sweep. Where time is 0 everywhere the points are motion "
        "compensated; otherwise each is in the ego frame of its own time."
    ),
    columns=pa.schema([(n, pa.float32()) for n in ("x", "y", "z", "intensity", "time")]),
    defaults={"time": 0.0},
)


def load(path: Path, schema: TableSchema, may_be_null: Sequence[str] = ()) -> pa.Table:
    """A table of ``schema`` in its column types; BadInput for other types or missing values."""
    table = read_table(path, schema).select(schema.columns.names)
    try:
        table = table.cast(schema.columns)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise BadInput(path, f"a column has another type ({str(error).splitlines()[0]})") from None
    for name in schema.columns.names:
        if table[name].null_count and name not in may_be_null:
            raise BadInput(path, f"column {name} has missing values")
    return table


def rig_table(rig: Rig) -> pa.Table:
    """A rig as the table RIG."""
    cameras = list(rig)
    poses = np.array([c.ego_SE3_camera for c in cameras], np.float64).reshape(-1, 4, 4)
    k = np.array([c.intrinsics for c in cameras], np.float64).reshape(-1, 3, 3)
    columns: dict[str, Any] = {
        "camera": pa.array([c.name for c in cameras], pa.string()),
        "width": [c.width for c in cameras],
        "height": [c.height for c in cameras],
        "fx": k[:, 0, 0],
        "fy": k[:, 1, 1],
        "cx": k[:, 0, 2],
        "cy": k[:, 1, 2],
    }
    radial = [(*map(float, c.distortion), *[0.0] * 6)[:6] for c in cameras]
    columns |= {name: [row[i] for row in radial] for i, name in enumerate(RADIAL)}
    columns |= {n: [float(c.tangential[i]) for c in cameras] for i, n in enumerate(("p1", "p2"))}
    columns["model"] = pa.array([c.model for c in cameras], pa.string())
    return pa.table(columns | pose_columns(poses))


def rig_of_table(table: pa.Table, path: Path) -> Rig:
    """The rig of a table RIG; BadInput when a number is not finite or a name comes twice."""
    rows = table.to_pylist()
    names = [row["camera"] for row in rows]
    if len(set(names)) != len(names):
        raise BadInput(path, "a camera is listed twice")
    cameras = []
    for row in rows:
        values = [v for key, v in row.items() if key not in ("camera", "model")]
        if any(not np.isfinite(v) for v in values):
            raise BadInput(path, f"camera {row['camera']} has a value that is not a number")
        q = np.array([row[n] for n in POSE[3:]])
        if abs(np.linalg.norm(q) - 1) > 1e-3:
            raise BadInput(path, f"the quaternion of camera {row['camera']} is not of length 1")
        k = np.array([[row["fx"], 0, row["cx"]], [0, row["fy"], row["cy"]], [0, 0, 1.0]])
        try:
            camera = Camera(
                name=row["camera"],
                width=int(row["width"]),
                height=int(row["height"]),
                intrinsics=k,
                ego_SE3_camera=se3_from_quaternion(q, np.array([row[n] for n in POSE[:3]])),
                distortion=_radial(row),
                model=row["model"],
                tangential=(row["p1"], row["p2"]),
            )
        except ValueError as error:
            raise BadInput(path, f"camera {row['camera']}: {error}") from None
        cameras.append(camera)
    return Rig(tuple(cameras))


def _radial(row: dict[str, Any]) -> tuple[float, ...]:
    """The radial terms of one camera, as many as its model has."""
    k = tuple(row[n] for n in RADIAL)
    if row["model"] == "fisheye":
        if any(k[4:]):
            raise ValueError("a fisheye lens has k1 to k4: k5 and k6 must be 0")
        return k[:4]
    return k if any(k[3:]) else k[:3]


def pose_columns(pose: Array) -> dict[str, Any]:
    """(n, 4, 4) transforms as the columns x, y, z, qw, qx, qy, qz."""
    if not len(pose):
        return {name: np.zeros(0) for name in POSE}
    values = np.concatenate([pose[:, :3, 3], quaternion_from_se3(pose)], axis=1)
    return {name: values[:, k] for k, name in enumerate(POSE)}


def numbers(table: pa.Table, names: Sequence[str]) -> Array:
    """(n, k) float64 of columns; nulls become NaN."""
    return np.stack(
        [table[n].to_numpy(zero_copy_only=False).astype(np.float64) for n in names], axis=-1
    )


def poses_of_table(table: pa.Table, path: Path) -> Array:
    """(n, 4, 4) of a table with pose columns; BadInput unless finite with unit quaternions."""
    values = numbers(table, POSE)
    bad = ~np.isfinite(values).all(axis=1)
    if bad.any():
        raise BadInput(path, f"the pose of row {int(np.flatnonzero(bad)[0])} is not a number")
    bad = np.abs(np.linalg.norm(values[:, 3:], axis=1) - 1) > 1e-3
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise BadInput(path, f"the quaternion of row {row} is not of length 1", "normalise it")
    return se3_from_quaternion(values[:, 3:], values[:, :3])
