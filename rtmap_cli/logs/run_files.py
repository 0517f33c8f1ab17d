"""Runs read and written: the tables of the run folder, whole and checked, or some of their rows."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.run import (
    POSE_STATUS,
    RUN_SCHEMA,
    RUN_VERSION,
    STATES,
    Observations,
    Poses,
    Run,
    RunFrames,
)
from rtmap_cli.tables import (
    Only,
    TableSchema,
    read_json,
    read_table,
    taken_for,
    write_json,
    write_table,
)

Array = NDArray[np.float64]

GROUP = 4096
"""Rows of a row group: a few hundred frames of observations, so that a stretch of a long run is
read without the rest."""

_POSE = [("x", pa.float64()), ("y", pa.float64()), ("z", pa.float64())] + [
    (name, pa.float64()) for name in ("qw", "qx", "qy", "qz")
]

FRAMES = TableSchema(
    name="rtmap.run.frames",
    version="1.0",
    frame="map (CRS in rtmap.crs)",
    units="metres, radians, nanoseconds since 1970-01-01T00:00:00Z",
    description="One row per frame: initial pose T⁰ with sigmas, odometry, end-to-end pose T^E.",
    columns=pa.schema(
        [("frame", pa.int32()), ("timestamp_ns", pa.int64())]
        + _POSE
        + [("sigma_x", pa.float64()), ("sigma_y", pa.float64()), ("sigma_yaw", pa.float64())]
        + [(f"odometry_{name}", pa.float64()) for name in ("dx", "dy", "dyaw")]
        + [(f"odometry_sigma_{name}", pa.float64()) for name in ("dx", "dy", "dyaw")]
        + [(f"te_{name}", pa.float64()) for name in ("x", "y", "yaw")]
        + [("te_covariance", pa.list_(pa.float64())), ("camera_count", pa.int32())]
    ),
)

OBSERVATIONS = TableSchema(
    name="rtmap.run.observations",
    version="1.0",
    frame="points and sigma: ego; prior_points: map (CRS in rtmap.crs)",
    units="metres; sigma is a standard deviation",
    description="One row per detected element and frame; (points[i], prior_points[i]) is D.",
    columns=pa.schema(
        [
            ("frame", pa.int32()),
            ("query", pa.int32()),
            ("state", pa.string()),
            ("class_name", pa.string()),
            ("score", pa.float32()),
            ("existence", pa.float32()),
            ("element_id", pa.string()),
            ("vertex_count", pa.int32()),
            ("points", pa.list_(pa.float32())),
            ("sigma", pa.list_(pa.float32())),
            ("prior_points", pa.list_(pa.float64())),
        ]
    ),
)

OCCLUDERS = TableSchema(
    name="rtmap.run.occluders",
    version="1.0",
    frame="ego",
    units="metres, radians",
    description="Boxes that hide what stands behind them.",
    columns=pa.schema(
        [("frame", pa.int32())]
        + [(n, pa.float32()) for n in ("x", "y", "yaw", "length", "width", "height", "z")]
    ),
)

POSES = TableSchema(
    name="rtmap.run.poses",
    version="1.0",
    frame="map (CRS in rtmap.crs); covariance: x, y, z, roll, pitch, yaw",
    units="metres, radians",
    description="One row per frame: the localized pose, how sure it is, and along which axis not.",
    columns=pa.schema(
        [("frame", pa.int32()), ("timestamp_ns", pa.int64()), ("method", pa.string())]
        + _POSE
        + [
            ("covariance", pa.list_(pa.float64())),
            ("eigenvalues", pa.list_(pa.float64())),
            ("weakest_direction", pa.list_(pa.float64())),
            ("residual_count", pa.int32()),
            ("chi2", pa.float64()),
            ("status", pa.string()),
        ]
    ),
)

CHANGES = TableSchema(
    name="rtmap.run.changes",
    version="1.0",
    frame="map (CRS in rtmap.crs)",
    units="metres, nanoseconds since 1970-01-01T00:00:00Z",
    description="One row per change of the map with the evidence behind it.",
    columns=pa.schema(
        [
            ("change_id", pa.string()),
            ("kind", pa.string()),
            ("class_name", pa.string()),
            ("element_id", pa.string()),
            ("geometry", pa.binary()),
            ("probability", pa.float64()),
            ("log_odds", pa.float64()),
            ("frames_seen", pa.int32()),
            ("frames_in_view", pa.int32()),
            ("traversals_seen", pa.int32()),
            ("traversals_in_view", pa.int32()),
            ("first_seen_ns", pa.int64()),
            ("last_seen_ns", pa.int64()),
            ("runs", pa.list_(pa.string())),
        ]
    ),
)


def _pose_columns(pose: Array) -> dict[str, Any]:
    from rtmap_cli.geometry.poses import quaternion_from_se3

    q = quaternion_from_se3(pose)
    columns = {name: pose[:, k, 3] for k, name in enumerate("xyz")}
    return columns | {name: q[:, k] for k, name in enumerate(("qw", "qx", "qy", "qz"))}


def _column(table: pa.Table, name: str) -> Any:
    return table[name].to_numpy(zero_copy_only=False)


def _columns(table: pa.Table, names: list[str]) -> Array:
    return np.stack([_column(table, n).astype(np.float64) for n in names], axis=-1)


def _pose_of(table: pa.Table, path: Path) -> Array:
    from rtmap_cli.geometry.poses import se3_from_quaternion

    q = _columns(table, ["qw", "qx", "qy", "qz"])
    t = _columns(table, ["x", "y", "z"])
    bad = ~(np.isfinite(q).all(1) & np.isfinite(t[:, :2]).all(1)) | (np.abs(q).sum(1) == 0)
    if bad.any():
        raise BadInput(path, f"the pose of frame {_column(table, 'frame')[bad][0]} is not finite")
    t = np.where(np.isnan(t), 0.0, t)
    return se3_from_quaternion(q, t)


def _rows(lists: Any, shape: tuple[int, ...], dtype: Any) -> Any:
    """A list column with rows of equal length → (n, *shape); null rows become NaN."""
    array = lists.combine_chunks() if isinstance(lists, pa.ChunkedArray) else lists
    size = int(np.prod(shape))
    out = np.full((len(array), size), np.nan, dtype)
    valid = np.asarray(array.is_valid())
    if valid.any():
        flat = array.drop_null().flatten().to_numpy(zero_copy_only=False)
        if len(flat) != size * int(valid.sum()):
            raise BadInput("list column", f"a row does not hold {size} numbers")
        out[valid] = flat.reshape(-1, size)
    return out.reshape(len(array), *shape)


def _lists(array: Any, value_type: pa.DataType) -> pa.Array:
    """(n, ...) → a list column; rows that are entirely NaN become null."""
    flat = np.asarray(array).reshape(len(array), -1) if len(array) else np.zeros((0, 1))
    null = np.isnan(flat).all(axis=1)
    offsets = np.concatenate([[0], np.cumsum(np.where(null, 0, flat.shape[1]))]).astype(np.int32)
    values = pa.array(flat[~null].ravel(), value_type)
    return pa.ListArray.from_arrays(
        pa.array(offsets, pa.int32()), values, mask=pa.array(null) if null.any() else None
    )


def write_frames(frames: RunFrames, folder: Path, crs: str) -> None:
    """Write frames.parquet."""
    columns: dict[str, Any] = {"frame": frames.frame, "timestamp_ns": frames.timestamp_ns}
    columns |= _pose_columns(frames.initial)
    columns |= {f"sigma_{n}": frames.sigma[:, k] for k, n in enumerate(("x", "y", "yaw"))}
    for k, n in enumerate(("dx", "dy", "dyaw")):
        columns[f"odometry_{n}"] = frames.odometry[:, k]
        columns[f"odometry_sigma_{n}"] = frames.odometry_sigma[:, k]
    columns |= {f"te_{n}": frames.end_to_end[:, k] for k, n in enumerate(("x", "y", "yaw"))}
    columns["te_covariance"] = _lists(frames.end_to_end_covariance, pa.float64())
    columns["camera_count"] = frames.camera_count
    write_table(pa.table(columns), folder / "frames.parquet", FRAMES, {"rtmap.crs": crs}, GROUP)


def read_frames(folder: Path, only: Only | None = None) -> RunFrames:
    """Read frames.parquet, or ``only`` some of its rows."""
    path = folder / "frames.parquet"
    table = read_table(path, FRAMES, only)
    times = _column(table, "timestamp_ns").astype(np.int64)
    if (np.diff(times) < 0).any():
        raise BadInput(path, "frames are not sorted by time", "sort them and write it again")
    deltas = ["dx", "dy", "dyaw"]
    return RunFrames(
        frame=_column(table, "frame").astype(np.int32),
        timestamp_ns=times,
        initial=_pose_of(table, path),
        sigma=_columns(table, ["sigma_x", "sigma_y", "sigma_yaw"]),
        odometry=_columns(table, [f"odometry_{n}" for n in deltas]),
        odometry_sigma=_columns(table, [f"odometry_sigma_{n}" for n in deltas]),
        end_to_end=_columns(table, ["te_x", "te_y", "te_yaw"]),
        end_to_end_covariance=_rows(table["te_covariance"], (3, 3), np.float64),
        camera_count=_column(table, "camera_count").astype(np.int32),
    )


def write_observations(observations: Observations, folder: Path, crs: str) -> None:
    """Write observations.parquet."""
    o = observations
    states = np.array(STATES, dtype=object)
    columns = {
        "frame": o.frame,
        "query": o.query,
        "state": pa.array(states[o.state] if len(o) else [], pa.string()),
        "class_name": pa.array(list(o.class_name), pa.string()),
        "score": o.score,
        "existence": pa.array(o.existence, pa.float32(), from_pandas=True),
        "element_id": pa.array(list(o.element_id), pa.string()),
        "vertex_count": np.full(len(o), o.points.shape[1], np.int32),
        "points": _lists(o.points, pa.float32()),
        "sigma": _lists(o.sigma, pa.float32()),
        "prior_points": _lists(o.prior_points, pa.float64()),
    }
    path = folder / "observations.parquet"
    write_table(pa.table(columns), path, OBSERVATIONS, {"rtmap.crs": crs}, GROUP)


def read_observations(folder: Path, only: Only | None = None) -> Observations:
    """Read observations.parquet, or ``only`` some of its rows; BadInput when rows have different
    vertex counts or NaN."""
    path = folder / "observations.parquet"
    table = read_table(path, OBSERVATIONS, only)
    if not len(table):
        return Observations.empty()
    counts = np.unique(_column(table, "vertex_count"))
    if len(counts) != 1:
        raise BadInput(path, "elements have different vertex counts", "write them with one V")
    v = int(counts[0])
    try:
        points = _rows(table["points"], (v, 2), np.float32)
        sigma = _rows(table["sigma"], (v, 2), np.float32)
        prior_points = _rows(table["prior_points"], (v, 2), np.float64)
    except BadInput:
        raise BadInput(path, f"a row does not hold {v} vertices") from None
    if not np.isfinite(points).all() or not (np.isfinite(sigma) & (sigma > 0)).all():
        raise BadInput(path, "points must be finite and sigma above zero")
    codes = {name: k for k, name in enumerate(STATES)}
    states = table["state"].to_pylist()
    unknown = set(states) - set(codes)
    if unknown:
        raise BadInput(path, f"unknown state {sorted(map(str, unknown))[0]}")
    return Observations(
        frame=_column(table, "frame").astype(np.int32),
        query=_column(table, "query").astype(np.int32),
        state=np.array([codes[s] for s in states], np.int8),
        class_name=np.array(table["class_name"].to_pylist(), object),
        score=_column(table, "score").astype(np.float32),
        existence=_column(table, "existence").astype(np.float32),
        element_id=np.array(table["element_id"].to_pylist(), object),
        points=points,
        sigma=sigma,
        prior_points=prior_points,
    )


def write_poses(poses: Poses, folder: Path, crs: str) -> None:
    """Write poses.parquet (into an existing run: localize adds it)."""
    columns: dict[str, Any] = {
        "frame": poses.frame,
        "timestamp_ns": poses.timestamp_ns,
        "method": pa.array([poses.method] * len(poses), pa.string()),
    }
    columns |= _pose_columns(poses.pose)
    columns |= {
        "covariance": _lists(poses.covariance, pa.float64()),
        "eigenvalues": _lists(poses.eigenvalues, pa.float64()),
        "weakest_direction": _lists(poses.weakest_direction, pa.float64()),
        "residual_count": poses.residual_count,
        "chi2": poses.chi2,
        "status": pa.array(list(poses.status), pa.string()),
    }
    write_table(pa.table(columns), folder / "poses.parquet", POSES, {"rtmap.crs": crs}, GROUP)


def read_poses(path: Path, only: Only | None = None) -> Poses:
    """Read a poses.parquet file (of a run, or true poses of a simulated log), or some rows."""
    table = read_table(path, POSES, only)
    methods = table["method"].to_pylist()
    covariance = _rows(table["covariance"], (6, 6), np.float64)
    spread = covariance[:, range(6), range(6)]
    if not ((spread >= 0) | np.isnan(spread)).all():
        raise BadInput(path, "a covariance has a negative or infinite variance")
    states = set(table["status"].to_pylist())
    if not states <= set(POSE_STATUS):
        raise BadInput(path, f"unknown status {sorted(map(str, states - set(POSE_STATUS)))[0]}")
    return Poses(
        frame=_column(table, "frame").astype(np.int32),
        timestamp_ns=_column(table, "timestamp_ns").astype(np.int64),
        method=methods[0] if methods else "none",
        pose=_pose_of(table, path),
        covariance=covariance,
        eigenvalues=_rows(table["eigenvalues"], (3,), np.float64),
        weakest_direction=_rows(table["weakest_direction"], (3,), np.float64),
        residual_count=_column(table, "residual_count").astype(np.int32),
        chi2=_column(table, "chi2").astype(np.float64),
        status=np.array(table["status"].to_pylist(), object),
    )


def write_run(run: Run, folder: Path) -> None:
    """Write every part of a run into an existing empty folder (wrap it in ``whole_folder``)."""
    write_json(run.info, folder / "run.json")
    write_frames(run.frames, folder, run.crs)
    write_observations(run.observations, folder, run.crs)
    if run.occluders is not None:
        path = folder / "occluders.parquet"
        write_table(run.occluders, path, OCCLUDERS, {"rtmap.crs": run.crs}, GROUP)
    if run.poses is not None:
        write_poses(run.poses, folder, run.crs)


def _rising(pair: Any) -> bool:
    """True for two finite numbers, the second one larger."""
    return (
        isinstance(pair, list)
        and len(pair) == 2
        and all(isinstance(v, int | float) and abs(v) < 1e6 for v in pair)
        and pair[0] < pair[1]
    )


def _instead_of_run(folder: Path) -> str:
    """What to do with a folder that was taken for a run."""
    if (folder / "log.json").exists():
        return "it is a log: make a run of it with rtmap infer"
    inside = sorted(path.parent.name for path in folder.glob("*/run.json"))
    if inside:
        return f"it holds runs ({', '.join(inside[:3])}): name them"
    return taken_for(folder) or "make one with rtmap infer"


def read_run_info(folder: str | Path) -> dict[str, Any]:
    """run.json of a run folder, checked."""
    folder = Path(folder)
    if not folder.is_dir():
        raise BadInput(folder, "no such run folder")
    if not (folder / "run.json").exists():
        raise BadInput(folder, "is no run (run.json is missing)", _instead_of_run(folder))
    info = read_json(folder / "run.json")
    if not isinstance(info, dict) or info.get("schema") != RUN_SCHEMA:
        raise BadInput(folder / "run.json", "not the run.json of an rtmap run")
    if str(info.get("schema_version", "?")).split(".")[0] != RUN_VERSION.split(".")[0]:
        raise BadInput(
            folder / "run.json",
            f"run version {info.get('schema_version')} is unknown (this rtmap reads {RUN_VERSION})",
        )
    for key in ("log_id", "crs", "classes", "range_m"):
        if key not in info:
            raise BadInput(folder / "run.json", f"{key} is missing")
    for key in ("log_id", "crs"):
        if not isinstance(info[key], str) or not info[key]:
            raise BadInput(folder / "run.json", f"{key} must be a text")
    names, box = info["classes"], info["range_m"]
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
        raise BadInput(folder / "run.json", "classes must be a list of texts")
    if not isinstance(box, dict) or not all(_rising(box.get(axis)) for axis in "xy"):
        raise BadInput(folder / "run.json", "range_m must hold x and y, each two rising metres")
    return info


def read_run(folder: str | Path, frames: NDArray[Any] | None = None) -> Run:
    """Read a run folder; poses and occluders are None when absent.

    ``frames``: sorted frame numbers, when only those are wanted.
    """
    folder = Path(folder)
    info = read_run_info(folder)
    only = None if frames is None else Only("frame", frames)
    occluders, poses = folder / "occluders.parquet", folder / "poses.parquet"
    return Run(
        info=info,
        frames=read_frames(folder, only),
        observations=read_observations(folder, only),
        occluders=read_table(occluders, OCCLUDERS, only) if occluders.exists() else None,
        poses=read_poses(poses, only) if poses.exists() else None,
        path=folder,
    )


def copy_run(source: Path, target: Path) -> None:
    """Copy the files of a run into ``target`` (an existing folder)."""
    for path in sorted(source.iterdir()):
        if path.is_file():
            shutil.copy2(path, target / path.name)
