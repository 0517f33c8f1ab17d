"""Traversal: one run as the map sees it, everything in the map frame, as arrays.

A traversal is the unit of independent evidence: its frames share pose errors, light and much of
the network's error, so that n frames are not n votes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.poses import wrap_angle, xyyaw_of
from rtmap_cli.logs.motion import Motion, MotionModel, motion_of
from rtmap_cli.logs.run import OUTDATED, Run
from rtmap_cli.maps.outlook import Outlook, outlook
from rtmap_cli.maps.stations import Samples, samples_of

Array = NDArray[np.float64]
Int = NDArray[np.int64]

FOUND_SCORE = 0.05
"""Detections below this score carry no information and are not read."""
SAME_SIGMA = 0.5
"""Standard deviation (m, each axis) of every vertex of a network that states none."""


@dataclass(frozen=True)
class Traversal:
    """The frames (m) and detected elements (n, with V vertices) of one run in the map frame.

    ``pose`` (m, 3) x, y, yaw of map_SE3_ego with ``pose_covariance`` (m, 3, 3); ``range_m`` the
    ego-frame box x_min, y_min, x_max, y_max; ``occluders`` per frame (k, 5): x, y, yaw, length,
    width in the ego frame. Of each element: ``frame`` (n,) row of its frame, ``class_name``,
    ``score``, ``points`` (n, V, 2) in the map frame and ``covariance`` (n, V, 2, 2) = R Σ Rᵀ of
    the network's own scales (the pose's part is kept apart: it is common to a frame).
    ``asked``: prior elements that the network was asked about, see ``Questions``. ``cut`` (n,):
    reaches the border of the range; ``localized``: the poses come from localization; ``classes``
    that its model knows: of others its silence says nothing; ``motion``: what GNSS and odometry
    say of a drive that was not localized; ``answer`` (n,): id of the prior element that the network
    says an element is, None for new ones (empty: no questions).
    """

    run_id: str
    timestamp_ns: Int
    pose: Array
    pose_covariance: Array
    range_m: tuple[float, float, float, float]
    occluders: list[Array]
    frame: Int
    class_name: NDArray[Any]
    score: Array
    points: Array
    covariance: Array
    cut: NDArray[np.bool_]
    asked: Questions
    localized: bool = True
    model_sha256: str | None = None
    classes: tuple[str, ...] = ()
    motion: Motion | None = None
    answer: NDArray[Any] = field(default_factory=lambda: np.zeros(0, object))
    sampled: dict[str, Samples] = field(default_factory=dict, repr=False, compare=False, init=False)

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def kilometres(self) -> float:
        """Distance driven between its frames."""
        return float(self.way[-1]) / 1000 if len(self.way) else 0.0

    @cached_property
    def way(self) -> Array:
        """(m,) metres driven until each frame."""
        step = np.hypot(*np.diff(self.pose[:, :2], axis=0).T)
        return np.concatenate([[0.0], np.cumsum(step)])

    @cached_property
    def outlook(self) -> Outlook:
        """What its frames could see."""
        return outlook(self.pose, self.range_m, self.occluders)

    def samples(self, class_name: str) -> Samples:
        """Points along its detections of a class, in the map frame."""
        if class_name not in self.sampled:
            k = np.flatnonzero(self.class_name == class_name)
            self.sampled[class_name] = samples_of(
                self.points[k], self.covariance[k], self.score[k], self.frame[k]
            )
        return self.sampled[class_name]

    def answered(self, class_name: str, ids: Sequence[str]) -> Int:
        """(samples of the class,) index in ``ids`` of the prior element that the network says each
        is, -1 for others."""
        row = {name: k for k, name in enumerate(ids) if name}
        said = self.answer[self.class_name == class_name] if len(self.answer) else ()
        codes = np.array([row.get(name, -1) for name in said], np.int64)
        return np.repeat(codes, 2 * self.points.shape[1] - 1)

    def windows(self, frame: Int) -> Array:
        """(n, 4, 2) counter-clockwise corners of the range of frames (n,) in the map frame."""
        x0, y0, x1, y1 = self.range_m
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        pose = self.pose[frame]
        c, s = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])
        return _turned(np.tile(corners, (len(frame), 1, 1)), c, s) + pose[:, None, :2]

    def moved(self, pose: Array, pose_covariance: Array) -> Traversal:
        """The drive at other poses (m, 3) with other covariances (m, 3, 3), and what it saw."""
        turn = wrap_angle(pose[:, 2] - self.pose[:, 2])
        c, s = np.cos(turn), np.sin(turn)
        f = self.frame
        local = self.points - self.pose[f, None, :2]
        xx, xy, yy = (self.covariance[..., i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
        c, s = c[f, None], s[f, None]
        covariance = _turned_variance(np.stack([xx, yy], axis=-1), c, s)
        covariance[..., 0, 0] -= 2 * c * s * xy
        covariance[..., 1, 1] += 2 * c * s * xy
        covariance[..., 0, 1] += (c * c - s * s) * xy
        covariance[..., 1, 0] = covariance[..., 0, 1]
        return replace(
            self,
            pose=pose,
            pose_covariance=pose_covariance,
            points=_turned(local, c, s) + pose[f, None, :2],
            covariance=covariance,
        )


@dataclass(frozen=True)
class Questions:
    """What the network said about prior elements that it was given (R10, R11 of the paper).

    ``frame`` (q,) row, ``element_id`` (q,), ``existence`` (q,) in [0, 1] and ``points``
    (q, V, 2): the prior's own vertices in the map frame, i.e. the stretch that was asked about.
    """

    frame: Int
    element_id: NDArray[Any]
    existence: Array
    points: Array


def _occluders(run: Run, rows: dict[int, int], count: int) -> list[Array]:
    out: list[Array] = [np.zeros((0, 5))] * count
    if run.occluders is None or not len(run.occluders):
        return out
    names = ("x", "y", "yaw", "length", "width")
    boxes = np.stack([run.occluders[n].to_numpy().astype(np.float64) for n in names], axis=1)
    frames = run.occluders["frame"].to_numpy()
    order = np.argsort(frames, kind="stable")
    values, starts = np.unique(frames[order], return_index=True)
    for value, part in zip(values, np.split(order, starts[1:]), strict=True):
        if int(value) in rows:
            out[rows[int(value)]] = boxes[part]
    return out


def usable_poses(run: Run) -> tuple[NDArray[np.bool_], Array, Array]:
    """Which frames have a usable pose, x, y, yaw (m, 3) and its covariance (m, 3, 3)."""
    frames = run.frames
    pose = xyyaw_of(frames.initial)
    covariance = np.zeros((len(frames), 3, 3))
    covariance[:, range(3), range(3)] = np.nan_to_num(frames.sigma, nan=1.0) ** 2
    usable = np.ones(len(frames), bool)
    if run.poses is None:
        return usable, pose, covariance
    placed = run.poses.status != "no-match"
    # A frame lost among localized ones would smear what they agree on.
    order = np.flatnonzero(placed)[np.argsort(run.poses.frame[placed], kind="stable")]
    known = run.poses.frame[order]
    at = np.minimum(np.searchsorted(known, frames.frame), max(len(known) - 1, 0))
    usable = known[at] == frames.frame if len(known) else np.zeros(len(frames), bool)
    j = order[at[usable]] if len(known) else order
    pose[usable] = xyyaw_of(run.poses.pose[j])
    axes = np.array([0, 1, 5])
    covariance[usable] = np.nan_to_num(run.poses.covariance[j][:, axes[:, None], axes])
    return usable, pose, covariance


def _turned(points: Array, c: Array, s: Array) -> Array:
    """Points (..., 2) turned by angles of cosine ``c`` and sine ``s``."""
    x, y = points[..., 0], points[..., 1]
    out = np.empty(points.shape)
    out[..., 0], out[..., 1] = c * x - s * y, s * x + c * y
    return out


def _turned_variance(variance: Array, c: Array, s: Array) -> Array:
    """(..., 2, 2) = R diag(v) Rᵀ of variances (..., 2) along the axes before the turn R."""
    x, y = variance[..., 0], variance[..., 1]
    out = np.empty((*variance.shape, 2))
    out[..., 0, 0] = c * c * x + s * s * y
    out[..., 1, 1] = s * s * x + c * c * y
    out[..., 0, 1] = out[..., 1, 0] = c * s * (x - y)
    return out


def _cut(points: Array, box: tuple[float, float, float, float], margin: float) -> Any:
    """(n,) True where an element reaches the border of the range: it may go on beyond."""
    x, y = points[..., 0], points[..., 1]
    beyond = (x < box[0] + margin) | (x > box[2] - margin)
    beyond |= (y < box[1] + margin) | (y > box[3] - margin)
    return beyond.any(axis=1)


def range_box(run: Run) -> tuple[float, float, float, float]:
    """The range of a run as x_min, y_min, x_max, y_max; BadInput when run.json has none."""
    try:
        x, y = run.info["range_m"]["x"], run.info["range_m"]["y"]
        box = (float(x[0]), float(y[0]), float(x[1]), float(y[1]))
    except (KeyError, TypeError, ValueError, IndexError):
        where = (run.path / "run.json") if run.path else "run.json"
        raise BadInput(where, "range_m must hold x and y, each [min, max] in metres") from None
    return box


def traversal_of(run: Run, min_score: float = FOUND_SCORE) -> Traversal:
    """A run in the map frame: localized poses where there are any, else the initial ones.

    Frames that localization could not place are left out when others were placed. Elements in
    state ``outdated`` are answers about the prior, not detections: they appear in ``asked`` only.
    """
    o = run.observations
    usable, pose, pose_covariance = usable_poses(run)
    row = np.full(int(run.frames.frame.max(initial=0)) + 2, -1)
    row[run.frames.frame[usable]] = np.arange(int(usable.sum()))
    known = np.isin(o.frame, run.frames.frame)
    if not known.all():
        where = (run.path / "observations.parquet") if run.path else "observations"
        raise BadInput(where, f"frame {int(o.frame[~known][0])} is not in frames.parquet")
    frame = row[o.frame] if len(o) else np.zeros(0, np.int64)
    pose, pose_covariance = pose[usable], pose_covariance[usable]
    box = range_box(run)
    detected = (frame >= 0) & (o.state != OUTDATED) & (o.score >= min_score)
    asked = (frame >= 0) & np.isfinite(o.existence) & np.isfinite(o.prior_points).all((1, 2))
    f = frame[detected]
    c, s = np.cos(pose[f, 2]), np.sin(pose[f, 2])
    local = o.points[detected].astype(np.float64)
    variance = o.sigma[detected].astype(np.float64) ** 2
    points = _turned(local, c[:, None], s[:, None])
    points += pose[f, None, :2]
    covariance = _turned_variance(variance, c[:, None], s[:, None])
    rows = {int(k): int(v) for k, v in enumerate(row) if v >= 0}
    return Traversal(
        run_id=run.log_id,
        timestamp_ns=run.frames.timestamp_ns[usable],
        pose=pose,
        pose_covariance=pose_covariance,
        range_m=box,
        occluders=_occluders(run, rows, len(pose)),
        frame=f,
        class_name=o.class_name[detected],
        score=o.score[detected].astype(np.float64),
        points=points,
        covariance=covariance,
        cut=_cut(local, box, 0.6) if len(local) else np.zeros(0, bool),
        asked=Questions(
            frame[asked],
            o.element_id[asked],
            o.existence[asked].astype(np.float64),
            o.prior_points[asked],
        ),
        localized=run.poses is not None,
        model_sha256=run.info.get("model_sha256"),
        classes=tuple(str(c) for c in run.info["classes"]),
        motion=None if run.poses is not None else motion_of(run.frames, pose, MotionModel()),
        answer=o.element_id[detected] if asked.any() else np.zeros(0, object),
    )


def same_sigma(traversal: Traversal) -> Traversal:
    """The traversal as a network without U reports it: ``SAME_SIGMA`` for every vertex."""
    same = np.broadcast_to(np.eye(2) * SAME_SIGMA**2, traversal.covariance.shape)
    return replace(traversal, covariance=same)


def pose_variance(traversal: Traversal, frame: Int, xy: Array, normal: Array) -> Array:
    """(n,) variance (m²) that the frames' poses add at map points ``xy`` along unit ``normal``.

    First-order: δp = δt + δyaw · J (p − t) with J the quarter turn.
    """
    dx, dy = (xy[:, k] - traversal.pose[:, k][frame] for k in (0, 1))
    nx, ny = normal.T
    jacobian = nx, ny, ny * dx - nx * dy
    out = np.zeros(len(frame))
    for i in range(3):
        for j in range(i, 3):
            share = traversal.pose_covariance[:, i, j][frame] * jacobian[i] * jacobian[j]
            out += share if i == j else 2 * share
    return out


def find_runs(folder: str | Path) -> list[Path]:
    """The run folders of a folder: itself, or those directly in it, by name.

    BadInput when there is no such folder or no run in it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise BadInput(folder, "no such folder")
    if (folder / "run.json").exists():
        return [folder]
    runs = sorted(p.parent for p in folder.glob("*/run.json"))
    if not runs:
        raise BadInput(folder, "holds no runs", "give a run folder or a folder of run folders")
    return runs


def read_traversals(paths: Sequence[Path], crs: str | None = None) -> tuple[list[Traversal], str]:
    """Runs as traversals in one CRS (that of the map, or of the first run), which is returned.

    BadInput names the run that is broken, lies in another CRS, has no frame that can be used, or
    is there twice.
    """
    from rtmap_cli.logs.run_files import read_run
    from rtmap_cli.maps.crs import check_map_crs, check_same_crs

    out: list[Traversal] = []
    seen: dict[str, Path] = {}
    for path in paths:
        run = read_run(path)
        if crs is None:
            crs = check_map_crs(run.crs, path / "run.json")
        check_same_crs(run.crs, crs, path / "run.json")
        if run.log_id in seen:
            raise BadInput(
                path, f"is the run of {run.log_id}, as {seen[run.log_id]} is", "drop one"
            )
        seen[run.log_id] = path
        traversal = traversal_of(run)
        if not len(traversal.pose):
            raise BadInput(path, "has no frame with a usable pose", "localize it again")
        out.append(traversal)
    return out, crs or ""


def classes_of(paths: Sequence[Path]) -> list[str]:
    """The classes that the models of the runs know, in the order in which they appear."""
    from rtmap_cli.logs.run_files import read_run_info

    return list(dict.fromkeys(str(c) for p in paths for c in read_run_info(p)["classes"]))
