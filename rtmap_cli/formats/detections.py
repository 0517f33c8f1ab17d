"""Detections of any model as one JSON file per drive (the fleet benchmark's format).

    {"meta": {"log_id", "class_names", "range_m": {"x", "y"}, "crs_of_poses"},
     "results": [{"frame", "timestamp_ns",
       "vectors": [{"pts": [[x, y], …], "cls_name", "confidence_level", "sigma": [[sx, sy], …]}],
       "initial_pose": {"easting", "northing", "yaw_rad"}, "initial_sigma": {…the same keys},
       "odometry": {"dx", "dy", "dyaw"}, "occluders": [{"x", "y", "yaw", "length", "width"}]}]}

``pts`` and ``sigma`` (a standard deviation) are metres in the ego frame, yaw is counter-clockwise
from grid east, ``odometry`` is the motion since the previous frame in that frame's ego frame.
``odometry`` (with its own ``odometry_sigma``) and ``occluders`` may be absent.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.polylines import resample
from rtmap_cli.geometry.poses import se3_from_xyyaw
from rtmap_cli.logs.run import NEW, Observations, Poses, Run, RunFrames, run_info, true_poses
from rtmap_cli.logs.run_files import OCCLUDERS
from rtmap_cli.maps.crs import check_map_crs
from rtmap_cli.tables import read_json

Array = NDArray[np.float64]

VERTEX_COUNT = 20
"""Every detection of a run has this many vertices; others are resampled by arc length."""

ODOMETRY_STEP = 0.01
"""Assumed standard deviation of odometry per metre driven, on both axes (metres per metre)."""
ODOMETRY_YAW = float(np.radians(0.05))
"""Assumed standard deviation of the odometry's yaw (radians per metre driven)."""
ODOMETRY_FLOOR = (0.002, 0.002, float(np.radians(0.005)))
"""Smallest odometry sigma (m, m, rad): a vehicle that stands is not infinitely well known."""

POSE_KEYS = ("easting", "northing", "yaw_rad")
BOX_KEYS = ("x", "y", "yaw", "length", "width")


@dataclass(frozen=True)
class FleetPoses:
    """True poses of several drives: ``traversals`` maps "00", "01", … to Poses in ``crs``."""

    crs: str
    traversals: dict[str, Poses]


def read_detections(path: str | Path, default_sigma: float | None = None) -> Run:
    """Read one drive as a Run without a map: every observation is ``new``, there is no D.

    ``default_sigma`` (m) stands in where a detection brings no sigma. BadInput names the first
    frame and detection that is wrong.
    """
    path = Path(path)
    data = read_json(path)
    meta, results = _parts(path, data)
    classes = [str(c) for c in meta["class_names"]]
    frames = _frames(path, results)
    info = run_info(
        log_id=str(meta["log_id"]),
        crs=_projected(path, meta["crs_of_poses"]),
        classes=classes,
        range_m=_range(path, meta["range_m"]),
        vertex_count=VERTEX_COUNT,
        model=meta.get("model"),
        source={"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()},
        options={"default_sigma": default_sigma},
    )
    parts = [
        _observations(path, int(frames.frame[i]), result, classes, default_sigma)
        for i, result in enumerate(results)
    ]
    return Run(info, frames, Observations.concatenate(parts), _occluders(path, frames, results))


def read_fleet_poses(path: str | Path) -> FleetPoses:
    """Read ``{"crs", "traversals": {"00": [{"frame", "timestamp_ns", "easting", …}]}}``."""
    path = Path(path)
    data = read_json(path)
    if not isinstance(data, dict) or not isinstance(data.get("traversals"), dict):
        raise BadInput(path, "holds no fleet poses (no traversals)")
    out = {}
    for name, rows in data["traversals"].items():
        where = f"traversal {name}"
        if not isinstance(rows, list) or not all(isinstance(r, dict) for r in rows):
            raise BadInput(path, f"{where} is not a list of poses")
        poses = [_numbers(path, f"{where}, row {k}", r, POSE_KEYS) for k, r in enumerate(rows)]
        frame, times = _index(path, rows, where)
        xyyaw = np.array(poses).reshape(-1, 3)
        out[str(name)] = true_poses(frame, times, se3_from_xyyaw(*xyyaw.T))
    return FleetPoses(_projected(path, data.get("crs")), out)


def _parts(path: Path, data: Any) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    if not isinstance(data, dict) or not isinstance(data.get("meta"), dict):
        raise BadInput(path, "meta is missing", "see docs/import.md for the format")
    meta, results = data["meta"], data.get("results")
    for key in ("log_id", "class_names", "range_m", "crs_of_poses"):
        if key not in meta:
            raise BadInput(path, f"meta.{key} is missing")
    if not isinstance(meta["class_names"], list):
        raise BadInput(path, "meta.class_names is not a list")
    if not isinstance(results, list) or not all(isinstance(r, dict) for r in results):
        raise BadInput(path, "results is not a list of frames")
    if not results:
        raise BadInput(path, "has no frames")
    return meta, results


def _range(path: Path, range_m: Any) -> dict[str, list[float]]:
    out = {}
    for axis in ("x", "y"):
        ends = range_m.get(axis) if isinstance(range_m, dict) else None
        if not isinstance(ends, list) or len(ends) != 2 or not np.isfinite(ends).all():
            raise BadInput(path, f"meta.range_m.{axis} is not [lowest, highest] in metres")
        out[axis] = [float(v) for v in ends]
    return out


def _projected(path: Path, crs: Any) -> str:
    """The CRS as given, if it can carry a map frame."""
    if not isinstance(crs, str):
        raise BadInput(path, "its CRS is missing", "name one like EPSG:32617")
    return check_map_crs(crs, path)


def _numbers(path: Path, where: str, row: Any, keys: tuple[str, ...]) -> list[float]:
    if not isinstance(row, dict):
        raise BadInput(path, f"{where} is missing")
    out = []
    for key in keys:
        value = row.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise BadInput(path, f"{where}: {key} is missing or not a number")
        if not np.isfinite(value):
            raise BadInput(path, f"{where}: {key} is not finite")
        out.append(float(value))
    return out


def _index(
    path: Path, rows: list[dict[str, Any]], where: str = "results"
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Frame numbers and times: integers, each frame once, times not falling."""
    for key in ("frame", "timestamp_ns"):
        for k, row in enumerate(rows):
            if isinstance(row.get(key), bool) or not isinstance(row.get(key), int):
                raise BadInput(path, f"{where}, row {k}: {key} is missing or not an integer")
    frame = np.array([r["frame"] for r in rows], np.int32)
    times = np.array([r["timestamp_ns"] for r in rows], np.int64)
    if len(np.unique(frame)) != len(frame):
        raise BadInput(path, f"{where}: a frame number appears twice")
    if (np.diff(times) < 0).any():
        late = int(frame[1:][np.diff(times) < 0][0])
        raise BadInput(path, f"{where}: frame {late} is earlier than the one before it")
    return frame, times


def _frames(path: Path, results: list[dict[str, Any]]) -> RunFrames:
    frame, times = _index(path, results)
    n = len(frame)
    pose, sigma = np.zeros((n, 3)), np.zeros((n, 3))
    odometry, odometry_sigma = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    for i, result in enumerate(results):
        where = f"frame {frame[i]}"
        pose[i] = _numbers(path, f"{where}, initial_pose", result.get("initial_pose"), POSE_KEYS)
        sigma[i] = _numbers(path, f"{where}, initial_sigma", result.get("initial_sigma"), POSE_KEYS)
        if (sigma[i] <= 0).any():
            raise BadInput(path, f"{where}: initial_sigma must be above zero")
        # Nothing comes before the first frame, whatever stands there.
        if i and result.get("odometry") is not None:
            keys = ("dx", "dy", "dyaw")
            odometry[i] = _numbers(path, f"{where}, odometry", result["odometry"], keys)
            given = result.get("odometry_sigma")
            odometry_sigma[i] = (
                assumed_odometry_sigma(odometry[i])
                if given is None
                else _numbers(path, f"{where}, odometry_sigma", given, keys)
            )
            if (odometry_sigma[i] <= 0).any():
                raise BadInput(path, f"{where}: odometry_sigma must be above zero")
    return RunFrames(
        frame=frame,
        timestamp_ns=times,
        initial=se3_from_xyyaw(*pose.T),
        sigma=sigma,
        odometry=odometry,
        odometry_sigma=odometry_sigma,
        end_to_end=np.full((n, 3), np.nan),
        end_to_end_covariance=np.full((n, 3, 3), np.nan),
        camera_count=np.zeros(n, np.int32),
    )


def assumed_odometry_sigma(odometry: Array) -> Array:
    """Sigmas (3,) of a motion dx, dy, dyaw: 1 % of the step, 0.05° per metre, with a floor."""
    step = float(np.hypot(odometry[0], odometry[1]))
    return np.maximum(np.array([ODOMETRY_STEP, ODOMETRY_STEP, ODOMETRY_YAW]) * step, ODOMETRY_FLOOR)


def _points(path: Path, where: str, value: Any, what: str) -> Array:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise BadInput(path, f"{where}: {what} is not a list of [x, y]") from None
    if array.ndim != 2 or array.shape[1] < 2:
        raise BadInput(path, f"{where}: {what} is not a list of [x, y]")
    if not np.isfinite(array).all():
        raise BadInput(path, f"{where}: {what} is not finite")
    return array[:, :2]


def _vector(
    path: Path, where: str, vector: Any, classes: list[str], default_sigma: float | None
) -> tuple[str, float, Array, Array]:
    """Class, score, points (V, 2) and sigma (V, 2) of one detection."""
    if not isinstance(vector, dict):
        raise BadInput(path, f"{where} is not an object")
    for key in ("pts", "cls_name", "confidence_level"):
        if key not in vector:
            raise BadInput(path, f"{where}: {key} is missing")
    if vector["cls_name"] not in classes:
        raise BadInput(path, f"{where}: class {vector['cls_name']} is not in meta.class_names")
    score = _numbers(path, where, vector, ("confidence_level",))[0]
    if not 0 <= score <= 1:
        raise BadInput(path, f"{where}: confidence_level {score} is outside [0, 1]")
    points = _points(path, where, vector["pts"], "pts")
    if len(points) < 2:
        raise BadInput(path, f"{where}: pts has fewer than 2 vertices")
    if vector.get("sigma") is not None:
        sigma = _points(path, where, vector["sigma"], "sigma")
    elif default_sigma is not None:
        sigma = np.full_like(points, default_sigma)
    else:
        raise BadInput(path, f"{where}: sigma is missing", "pass --sigma METRES to assume one")
    if len(sigma) != len(points) or not (sigma > 0).all():
        raise BadInput(path, f"{where}: sigma needs one pair above zero per vertex")
    if len(points) != VERTEX_COUNT:
        both = resample(np.column_stack([points, sigma]), VERTEX_COUNT)
        points, sigma = both[:, :2], both[:, 2:]
    return str(vector["cls_name"]), score, points, sigma


def _observations(
    path: Path,
    frame: int,
    result: dict[str, Any],
    classes: list[str],
    default_sigma: float | None,
) -> Observations:
    vectors = result.get("vectors")
    if not isinstance(vectors, list):
        raise BadInput(path, f"frame {frame}: vectors is missing or not a list")
    rows = [
        _vector(path, f"frame {frame}, vector {k}", vector, classes, default_sigma)
        for k, vector in enumerate(vectors)
    ]
    n = len(rows)
    if not n:
        return Observations.empty(VERTEX_COUNT)
    return Observations(
        frame=np.full(n, frame, np.int32),
        query=np.arange(n, dtype=np.int32),
        state=np.full(n, NEW, np.int8),
        class_name=np.array([r[0] for r in rows], object),
        score=np.array([r[1] for r in rows], np.float32),
        existence=np.full(n, np.nan, np.float32),
        element_id=np.full(n, None, object),
        points=np.stack([r[2] for r in rows]).astype(np.float32),
        sigma=np.stack([r[3] for r in rows]).astype(np.float32),
        prior_points=np.full((n, VERTEX_COUNT, 2), np.nan),
    )


def _occluders(path: Path, frames: RunFrames, results: list[dict[str, Any]]) -> pa.Table | None:
    """The boxes of all frames; None when no frame says anything about occluders."""
    if all(r.get("occluders") is None for r in results):
        return None
    rows: list[tuple[float, ...]] = []
    for frame, result in zip(frames.frame, results, strict=True):
        for k, box in enumerate(result.get("occluders") or []):
            where = f"frame {frame}, occluder {k}"
            values = _numbers(path, where, box, BOX_KEYS)
            extra = _numbers(path, where, {"height": 1.6, "z": 0.0} | box, ("height", "z"))
            rows.append((float(frame), *values, *extra))
    array = np.array(rows, np.float64).reshape(-1, 8)
    names = OCCLUDERS.columns.names
    columns = {name: array[:, i].astype(np.float32) for i, name in enumerate(names) if i}
    return pa.table({"frame": array[:, 0].astype(np.int32)} | columns, schema=OCCLUDERS.columns)
