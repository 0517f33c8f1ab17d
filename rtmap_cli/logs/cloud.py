"""The cloud folder: what ``rtmap label cloud`` writes and the other label commands read.

cloud.json             CRS, voxel and tile size, the log, how it was made
trajectory.parquet     where the vehicle was, how sure that is, what was weak
tiles/<i>_<j>.parquet  voxels of the tile [i, i + 1) × [j, j + 1) tile sizes of the map frame
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli import __version__
from rtmap_cli.errors import BadInput
from rtmap_cli.logs.tables import POSE, TIME, numbers, pose_columns, poses_of_table
from rtmap_cli.tables import (
    TableSchema,
    check_schema,
    read_json,
    read_table,
    taken_for,
    write_json,
    write_table,
)

Array = NDArray[np.float64]

CLOUD_SCHEMA, CLOUD_VERSION = "rtmap.cloud", "1.0"
STATUS = ("ok", "degenerate", "lost")
WEAK = ("weak_x", "weak_y", "weak_z")

TRAJECTORY = TableSchema(
    name="rtmap.cloud.trajectory",
    version="1.0",
    frame="map (CRS in rtmap.crs); covariance: x, y, z, then rotation about the map's axes",
    units=f"metres, radians, {TIME}; unit quaternions w, x, y, z",
    description="One row per registered sweep in time order.",
    columns=pa.schema(
        [("frame", pa.int32()), ("timestamp_ns", pa.int64())]
        + [(n, pa.float64()) for n in POSE]
        + [("covariance", pa.list_(pa.float64())), ("ground_z", pa.float64())]
        + [("keyframe", pa.bool_()), ("status", pa.string())]
        + [(n, pa.float32()) for n in WEAK]
    ),
)

TILE = TableSchema(
    name="rtmap.cloud.tile",
    version="1.0",
    frame="map (CRS in rtmap.crs)",
    units="metres; intensity in [0, 1]",
    description="One row per voxel that was hit: the mean of its points.",
    columns=pa.schema(
        [(n, pa.float64()) for n in ("x", "y", "z")]
        + [("intensity", pa.float32()), ("count", pa.int32()), ("sweeps", pa.int32())]
        + [("spread", pa.float32())]
    ),
)


@dataclass
class Trajectory:
    """Poses ``map_SE3_ego`` (n, 4, 4) of frames (n,) at times (n,) ns, with covariances (n, 6, 6),
    heights of the road (n,), keyframe flags, statuses and weak directions (n, 3), NaN if none."""

    frame: NDArray[np.int32]
    timestamp_ns: NDArray[np.int64]
    pose: Array
    covariance: Array
    ground_z: Array
    keyframe: NDArray[np.bool_]
    status: NDArray[np.object_]
    weak: Array

    def __len__(self) -> int:
        return len(self.frame)


@dataclass
class Voxels:
    """Voxels: ``xyz`` (n, 3), ``intensity``, ``count``, ``sweeps`` and ``spread`` (n,)."""

    xyz: Array
    intensity: Array
    count: Array
    sweeps: Array
    spread: Array

    def __len__(self) -> int:
        return len(self.xyz)

    def table(self) -> pa.Table:
        """As the table TILE."""
        columns: dict[str, Any] = {n: self.xyz[:, k] for k, n in enumerate(("x", "y", "z"))}
        rest = ("intensity", "count", "sweeps", "spread")
        return pa.table(columns | {n: getattr(self, n) for n in rest})


def write_trajectory(trajectory: Trajectory, folder: Path, crs: str) -> None:
    """Write trajectory.parquet."""
    n = len(trajectory)
    columns: dict[str, Any] = {
        "frame": trajectory.frame, "timestamp_ns": trajectory.timestamp_ns,
        **pose_columns(trajectory.pose),
        "covariance": list(trajectory.covariance.reshape(n, 36)),
        "ground_z": pa.array(trajectory.ground_z, from_pandas=True),
        "keyframe": trajectory.keyframe, "status": list(trajectory.status),
    }  # fmt: skip
    columns |= {m: pa.array(trajectory.weak[:, k], from_pandas=True) for k, m in enumerate(WEAK)}
    write_table(pa.table(columns), folder / "trajectory.parquet", TRAJECTORY, {"rtmap.crs": crs})


def write_tile(voxels: Voxels, folder: Path, tile: tuple[int, int], crs: str) -> None:
    """Write one tile of a cloud folder."""
    path = folder / "tiles" / f"{tile[0]}_{tile[1]}.parquet"
    path.parent.mkdir(exist_ok=True)
    write_table(voxels.table(), path, TILE, {"rtmap.crs": crs})


def write_info(folder: Path, said: dict[str, Any]) -> None:
    """Write cloud.json."""
    head = {"schema": CLOUD_SCHEMA, "schema_version": CLOUD_VERSION, "rtmap_version": __version__}
    write_json(head | said, folder / "cloud.json")


def read_columns(path: Path, schema: TableSchema, names: tuple[str, ...]) -> pa.Table:
    """Some columns of a table of ``schema``; BadInput when it cannot be trusted."""
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path) as file:
            check_schema(file.schema_arrow.metadata, path, schema)
            return file.read(columns=list(names), use_threads=False)
    except FileNotFoundError:
        raise BadInput(path, "no such file") from None
    except (pa.ArrowException, OSError) as error:
        raise BadInput(path, f"cannot be read as Parquet ({str(error).splitlines()[0]})") from None


class CloudFolder:
    """Reads a cloud folder, tile by tile; BadInput for one that cannot be trusted."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        file = self.path / "cloud.json"
        if not file.exists():
            todo = taken_for(self.path) or "make it with rtmap label cloud"
            raise BadInput(self.path, "not a cloud folder (cloud.json is missing)", todo)
        self.info = read_json(file)
        if not isinstance(self.info, dict) or self.info.get("schema") != CLOUD_SCHEMA:
            raise BadInput(file, f"not the cloud.json of a cloud (schema is not {CLOUD_SCHEMA})")
        version = str(self.info.get("schema_version", "?"))
        if version.split(".")[0] != CLOUD_VERSION.split(".")[0]:
            raise BadInput(file, f"version {version} is unknown (this rtmap reads {CLOUD_VERSION})")
        for key in ("crs", "voxel_m", "tile_m"):
            if key not in self.info:
                raise BadInput(file, f"{key} is missing")
        self.crs = str(self.info["crs"])
        self.voxel, self.tile = float(self.info["voxel_m"]), float(self.info["tile_m"])

    def trajectory(self) -> Trajectory:
        """Where the vehicle was."""
        path = self.path / "trajectory.parquet"
        table = read_table(path, TRAJECTORY)
        n = len(table)
        flat = table["covariance"].combine_chunks().flatten().to_numpy()
        if len(flat) != 36 * n:
            raise BadInput(path, "a covariance is not 6 × 6 numbers")
        return Trajectory(
            table["frame"].to_numpy(), table["timestamp_ns"].to_numpy(),
            poses_of_table(table, path), flat.reshape(n, 6, 6),
            numbers(table, ["ground_z"])[:, 0], table["keyframe"].to_numpy(zero_copy_only=False),
            np.array(table["status"].to_pylist(), object), numbers(table, WEAK),
        )  # fmt: skip

    def tiles(self) -> list[tuple[int, int]]:
        """The tiles that hold something, sorted."""
        out = []
        for path in (self.path / "tiles").glob("*.parquet"):
            i, _, j = path.stem.partition("_")
            try:
                out.append((int(i), int(j)))
            except ValueError:
                raise BadInput(path, "is not named as a tile") from None
        return sorted(out)

    def read_tile(self, i: int, j: int) -> Voxels:
        """The voxels of a tile; none where there is no file."""
        path = self.path / "tiles" / f"{i}_{j}.parquet"
        if not path.exists():
            return Voxels(np.zeros((0, 3)), *(np.zeros(0) for _ in range(4)))
        table = read_table(path, TILE)
        rest = numbers(table, ["intensity", "count", "sweeps", "spread"])
        return Voxels(numbers(table, ["x", "y", "z"]), *rest.T)

    def read_xyz(self, i: int, j: int) -> Array:
        """(n, 3) the voxels of a tile alone: a third of the bytes."""
        path = self.path / "tiles" / f"{i}_{j}.parquet"
        return numbers(read_columns(path, TILE, ("x", "y", "z")), ("x", "y", "z"))

    def near(self, low: Array, high: Array) -> Voxels:
        """The voxels in a box of the map frame: corners (2,) in x and y."""
        first = np.floor(np.asarray(low) / self.tile).astype(int)
        last = np.floor(np.asarray(high) / self.tile).astype(int)
        parts = [
            self.read_tile(i, j)
            for i in range(first[0], last[0] + 1)
            for j in range(first[1], last[1] + 1)
        ]
        names = ("xyz", "intensity", "count", "sweeps", "spread")
        columns = [np.concatenate([getattr(p, n) for p in parts]) for n in names]
        xy = columns[0][:, :2]
        inside = ((xy >= low) & (xy <= high)).all(axis=1)
        return Voxels(*(c[inside] for c in columns))
