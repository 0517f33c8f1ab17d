"""The run folder: what infer, localize and detect-changes wrote about one log.

    run.json             how it was made: enough to run it again
    frames.parquet       initial poses T⁰, end-to-end poses T^E, odometry
    observations.parquet detected elements with their scales, states and prior vertices (M, U, D)
    occluders.parquet    boxes that hid something (optional)
    poses.parquet        localized poses with covariance (written by localize)
    changes.parquet      changes seen by this run (written by detect-changes)

All ego-frame geometry is x forward, y left, metres; poses and prior points are in the map frame,
whose CRS stands in run.json and in the metadata of every table.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli import __version__

Array = NDArray[np.float64]

STATES = ("matched", "outdated", "new")
"""The paper's Q_map, Q_fake and Q_new, in the order of their codes."""
MATCHED, OUTDATED, NEW = range(3)

RUN_SCHEMA = "rtmap.run"
RUN_VERSION = "1.0"

POSE_STATUS = ("ok", "degenerate", "no-match")


@dataclass(frozen=True)
class RunFrames:
    """The frames of a run, one row each, in time order.

    ``initial`` (n, 4, 4) is T⁰ as map_SE3_ego with ``sigma`` (n, 3) for x, y (m) and yaw (rad);
    ``odometry`` (n, 3) dx, dy, dyaw since the previous frame in its ego frame, NaN where unknown;
    ``end_to_end`` (n, 3) x, y, yaw of T^E with ``end_to_end_covariance`` (n, 3, 3), NaN if none.
    """

    frame: NDArray[np.int32]
    timestamp_ns: NDArray[np.int64]
    initial: Array
    sigma: Array
    odometry: Array
    odometry_sigma: Array
    end_to_end: Array
    end_to_end_covariance: Array
    camera_count: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True)
class Observations:
    """Detected elements of a run as arrays, sorted by frame, then query.

    ``frame``, ``query`` (n,); ``state`` (n,) codes into STATES; ``class_name`` (n,) text;
    ``score`` (n,) in [0, 1]: that the element is real and of this class; ``existence`` (n,): that
    the prior element of this query still exists, NaN without one; ``element_id`` (n,) text or
    None; ``points``, ``sigma`` (n, V, 2) in the ego frame, metres, standard deviations;
    ``prior_points`` (n, V, 2) in the map frame, NaN where there is no prior.
    """

    frame: NDArray[np.int32]
    query: NDArray[np.int32]
    state: NDArray[np.int8]
    class_name: NDArray[Any]
    score: NDArray[np.float32]
    existence: NDArray[np.float32]
    element_id: NDArray[Any]
    points: NDArray[np.float32]
    sigma: NDArray[np.float32]
    prior_points: Array

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, index: Any) -> Observations:
        """The rows of a mask or an index array."""
        return Observations(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    @staticmethod
    def empty(vertex_count: int = 20) -> Observations:
        """No rows."""
        v = vertex_count
        return Observations(
            np.zeros(0, np.int32),
            np.zeros(0, np.int32),
            np.zeros(0, np.int8),
            np.zeros(0, object),
            np.zeros(0, np.float32),
            np.zeros(0, np.float32),
            np.zeros(0, object),
            np.zeros((0, v, 2), np.float32),
            np.zeros((0, v, 2), np.float32),
            np.zeros((0, v, 2)),
        )

    @staticmethod
    def concatenate(parts: list[Observations]) -> Observations:
        """Rows of several parts below each other (same V)."""
        if not parts:
            return Observations.empty()
        names = Observations.__dataclass_fields__
        return Observations(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


@dataclass(frozen=True)
class Poses:
    """Localized poses: map_SE3_ego (n, 4, 4), covariance (n, 6, 6) of x, y, z, roll, pitch, yaw
    (m, rad; left perturbation in the map frame: position in map axes, rotation about them),
    ``eigenvalues`` (n, 3) of the information matrix of x, y, yaw (yaw scaled by 10 m),
    ``weakest_direction`` (n, 3) its eigenvector of the smallest one, ``status`` in POSE_STATUS."""

    frame: NDArray[np.int32]
    timestamp_ns: NDArray[np.int64]
    method: str
    pose: Array
    covariance: Array
    eigenvalues: Array
    weakest_direction: Array
    residual_count: NDArray[np.int32]
    chi2: Array
    status: NDArray[Any]

    def __len__(self) -> int:
        return len(self.frame)


@dataclass
class Run:
    """A run in memory. ``info`` is run.json: log_id, crs, classes, range_m, model, options …"""

    info: dict[str, Any]
    frames: RunFrames
    observations: Observations
    occluders: pa.Table | None = None
    poses: Poses | None = None
    path: Path | None = field(default=None, compare=False)

    @property
    def log_id(self) -> str:
        """Identity of the traversal."""
        return str(self.info["log_id"])

    @property
    def crs(self) -> str:
        """CRS of every map-frame quantity of the run."""
        return str(self.info["crs"])

    def best_poses(self) -> Array:
        """(n, 4, 4) localized poses where there are any with status ok, else the initial ones."""
        best = self.frames.initial.copy()
        if self.poses is not None:
            row = {int(f): i for i, f in enumerate(self.frames.frame)}
            for i, f in enumerate(self.poses.frame):
                if self.poses.status[i] != "no-match" and int(f) in row:
                    best[row[int(f)]] = self.poses.pose[i]
        return best


def run_info(
    log_id: str,
    crs: str,
    classes: list[str],
    range_m: dict[str, list[float]],
    **more: Any,
) -> dict[str, Any]:
    """The content of run.json; ``more`` holds model, model_sha256, map, map_version, options …"""
    return {
        "schema": RUN_SCHEMA,
        "schema_version": RUN_VERSION,
        "rtmap_version": __version__,
        "log_id": log_id,
        "crs": crs,
        "classes": classes,
        "range_m": range_m,
        "ego_frame": "x forward, y left, z up, metres",
        **more,
    }


def true_poses(frame: NDArray[np.int32], timestamp_ns: NDArray[np.int64], pose: Array) -> Poses:
    """Poses that are the truth: zero covariance, method ``truth``, status ok."""
    n = len(frame)
    return Poses(
        frame=np.asarray(frame, np.int32),
        timestamp_ns=np.asarray(timestamp_ns, np.int64),
        method="truth",
        pose=pose,
        covariance=np.zeros((n, 6, 6)),
        eigenvalues=np.full((n, 3), np.nan),
        weakest_direction=np.full((n, 3), np.nan),
        residual_count=np.zeros(n, np.int32),
        chi2=np.zeros(n),
        status=np.array(["ok"] * n, object),
    )
