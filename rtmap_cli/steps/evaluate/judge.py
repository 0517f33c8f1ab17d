"""Poses and changes of files against their truth: reading, matching by time, figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput, UsageError
from rtmap_cli.formats.changes_json import ChangeFile, read_changes
from rtmap_cli.geometry.poses import se3_from_quaternion, se3_from_xyyaw
from rtmap_cli.logs.run import Run
from rtmap_cli.maps.crs import check_same_crs, lonlat_to, utm_crs
from rtmap_cli.steps.evaluate.changes.detection_time import time_to_detection
from rtmap_cli.steps.evaluate.changes.elements import (
    FRAME_RANGE,
    Change,
    ChangeScore,
    changed_frames,
    frame_accuracy,
    score_changes,
)
from rtmap_cli.steps.evaluate.changes.sight import STEP, Sight, in_view
from rtmap_cli.steps.evaluate.drives import Drive, drive_of, read_drives
from rtmap_cli.steps.evaluate.poses import (
    UPRIGHT,
    PoseScore,
    chi_squares,
    pose_errors,
    summarize,
    upright_errors,
    whitened_errors,
)
from rtmap_cli.tables import read_json

Array = NDArray[np.float64]

PLANAR = [0, 1, 5]
"""Rows of x, y and yaw in a 6 × 6 pose covariance."""

KINDS = ("insert", "delete", "modify")
"""Changes that can be seen from geometry; others (paint) are not judged."""


@dataclass(frozen=True)
class PosePairs:
    """True and estimated poses (n, 4, 4) of the frames of a run with their planar covariances
    (n, 3, 3: x, y in map axes, yaw) and status (n,); ``upright`` as in ``upright_errors``."""

    true: Array
    estimate: Array
    covariance: Array
    status: NDArray[Any]
    upright: Array


def judge_poses(
    run: Run, truth: str | Path, traversal: str | None = None, initial: bool = False
) -> PoseScore:
    """Errors of a run's poses against POSES; ``initial`` judges T⁰ and its sigmas instead."""
    drive = drive_of(read_drives(truth, traversal), run.log_id, truth)
    p = pose_pairs(run, drive, truth, initial)
    squares = chi_squares(p.true, p.estimate, p.covariance)
    whitened = whitened_errors(p.true, p.estimate, p.covariance)
    return PoseScore(pose_errors(p.true, p.estimate), p.status, squares, whitened, p.upright)


def pose_pairs(run: Run, drive: Drive, truth: str | Path, initial: bool = False) -> PosePairs:
    """The poses of a run beside those of its drive, by time; ``initial``: T⁰ and its sigmas.

    ``truth`` is named in errors. BadInput when the run has no poses, a frame has no true one, or
    the CRS differ.
    """
    where = run.path or run.log_id
    if run.poses is None and not initial:
        raise BadInput(where, "has no poses yet", "run rtmap localize first, or pass --initial")
    true = true_poses_of(run, drive, truth)
    estimate, covariance, status = _estimates(run, initial)
    upright = upright_errors(true, estimate)
    if not initial:
        # What the poses took over from the initial ones was not estimated.
        taken = np.abs(estimate - run.frames.initial)[:, 2] <= 1e-7
        upright[:, 0] = np.nan if taken[:, 3].all() else upright[:, 0]
        upright[:, 1:] = np.nan if taken[:, :3].all() else upright[:, 1:]
    return PosePairs(true, estimate, covariance, status, upright)


def true_poses_of(run: Run, drive: Drive, truth: str | Path) -> Array:
    """(n, 4, 4) poses of a drive at the frames of a run; BadInput when one has none."""
    check_same_crs(run.crs, drive.crs, run.path or run.log_id)
    true, known = drive.at(run.frames.timestamp_ns)
    if not known.all():
        first = int(run.frames.timestamp_ns[~known][0])
        raise BadInput(
            truth,
            f"no pose at {first} ns ({int((~known).sum())} of {len(known)} frames have none)",
            f"is it the truth of {run.log_id}?",
        )
    return true


def _estimates(run: Run, initial: bool) -> tuple[Array, Array, NDArray[Any]]:
    """Pose (n, 4, 4), planar covariance (n, 3, 3) and status of every frame of the run."""
    n = len(run.frames)
    covariance = np.zeros((n, 3, 3))
    covariance[:, range(3), range(3)] = run.frames.sigma**2
    if initial or run.poses is None:
        return run.frames.initial, covariance, np.full(n, "ok")
    status = np.full(n, "no-match", dtype="<U16")
    row = {int(f): i for i, f in enumerate(run.frames.frame)}
    for k, frame in enumerate(run.poses.frame.tolist()):
        if frame in row:
            status[row[frame]] = run.poses.status[k]
            covariance[row[frame]] = run.poses.covariance[k][np.ix_(PLANAR, PLANAR)]
    return run.best_poses(), covariance, status


def judge_pairs(path: Path, truth: str | Path) -> dict[str, dict[str, Any]]:
    """Cases of ``{"cases": [{"name", "frames": [{"true", "est"}]}]}``, each summarized.

    Poses are {"x", "y", "yaw"} (m, rad) or {"t", "q"} (m, unit quaternion w, x, y, z). The true
    poses are those of the file ``truth``, case by case.
    """
    estimates, truths = _cases(path), _cases(Path(truth))
    out = {}
    for name, frames in estimates.items():
        if name not in truths or len(truths[name]) != len(frames):
            raise BadInput(truth, f"case {name} is missing or has another number of frames")
        estimated = np.array([_pose(path, name, f, "est") for f in frames])
        true = np.array([_pose(Path(truth), name, f, "true") for f in truths[name]])
        upright = summarize(upright_errors(true, estimated), UPRIGHT)
        out[name] = upright | summarize(pose_errors(true, estimated))
    return out


def _cases(path: Path) -> dict[str, list[Any]]:
    data = read_json(path)
    cases = data.get("cases") if isinstance(data, dict) else None
    if not isinstance(cases, list) or not all(isinstance(c, dict) for c in cases):
        raise BadInput(path, "holds no cases of pose pairs", "see docs/evaluate.md")
    if not all(isinstance(c.get("frames"), list) and c["frames"] for c in cases):
        raise BadInput(path, "a case has no frames")
    return {str(c.get("name", k)): c["frames"] for k, c in enumerate(cases)}


def _pose(path: Path, case: str, frame: Any, key: str) -> Array:
    try:
        p = frame[key]
        if "yaw" in p:
            pose = se3_from_xyyaw(p["x"], p["y"], p["yaw"])
        else:
            pose = se3_from_quaternion(np.array(p["q"], float), np.array(p["t"], float))
    except (KeyError, TypeError, ValueError):
        raise BadInput(path, f"case {case}: a frame has no pose {key}") from None
    if not np.isfinite(pose).all():
        raise BadInput(path, f"case {case}: a pose is not finite")
    return pose


def judge_changes(
    predicted: str | Path | Sequence[Path],
    truth: str | Path,
    min_probability: float = 0.0,
    drives: Sequence[Drive] = (),
    km: float | None = None,
    sight: Sight | None = None,
) -> dict[str, Any]:
    """Element-level precision and recall; with ``drives`` also per km and frame by frame.

    Several ``predicted`` files are what was told after ever more traversals: the last one is
    judged, all of them give the time to detection. ``sight`` adds TbV's visible-only protocol.
    """
    paths = [predicted] if isinstance(predicted, str | Path) else list(predicted)
    files, true_file = [read_changes(path) for path in paths], read_changes(truth)
    sides, crs = in_metres([*files, true_file], drives[0].crs if drives else None)
    *told, true = ([c for c in side if c.kind in KINDS] for side in sides)
    told = [[c for c in side if c.probability >= min_probability] for side in told]
    area = _area(true_file, crs)
    scores = [score_changes(side, true, area) for side in told]
    score = scores[-1]
    km = km if km is not None else (sum(d.kilometres for d in drives) or None)
    result = score.as_json(km) | score.precision_recall()
    result["not_judged"] = len(sides[-1]) - len(true)
    result["by_kind_and_class"] = _breakdown(score)
    result["changes"] = _listing(score)
    if len(paths) > 1:
        mode, counts = traversals_of(paths, files)
        result["time_to_detection"] = {"files": mode, **time_to_detection(scores, true, counts)}
    if drives:
        lines = [[c.points for c in side] for side in (true, told[-1])]
        result |= _frame_level(drives, lines[0], lines[1], sight)
    return result


def _frame_level(
    drives: Sequence[Drive], true: list[Array], told: list[Array], sight: Sight | None
) -> dict[str, Any]:
    """TbV's accuracies over all frames and, with ``sight``, by what was visible."""
    times, pose = _frames_of(drives, sight)
    near = [changed_frames(pose[:, :2, 3], events) for events in (true, told)]
    rule = f"TbV, {{}}, changes nearer than {FRAME_RANGE:g} m"
    out = {"frame_level": {"protocol": rule.format("all frames"), **frame_accuracy(*near)}}
    if sight is not None:
        seen = [in_view(times, pose, events, sight) for events in (true, told)]
        out["frame_level_visible"] = {
            "protocol": rule.format("visible only"),
            "visible": f"some point of the change (every {STEP:g} m of it) {sight.told}",
            **frame_accuracy(*seen),
        }
    return out


def _frames_of(drives: Sequence[Drive], sight: Sight | None) -> tuple[list[int], Array]:
    """Times and poses (n, 4, 4) of the frames of drives: of a log its frames, else all poses."""
    if sight is None or sight.frame_times is None:
        times = np.concatenate([d.timestamp_ns for d in drives])
        return times.tolist(), np.concatenate([d.pose for d in drives])
    pose, known = drives[0].at(sight.frame_times)
    return sight.frame_times[known].tolist(), pose[known]


CUMULATIVE, ALONE = "cumulative", "each run alone"


def traversals_of(
    paths: Sequence[str | Path], files: Sequence[ChangeFile]
) -> tuple[str, list[int]]:
    """What files in order mean, and how many traversals there had been at each.

    Run folders with what each run says alone (``changes.parquet``) are one traversal each. Other
    files are told from all runs so far: their own list of runs says how many, else each is one
    more. BadInput where a file was not told from the runs of the file before it.
    """
    alone = [p.is_dir() and not (p / "changes.geojson").exists() for p in map(Path, paths)]
    if all(alone):
        return ALONE, list(range(1, len(paths) + 1))
    if any(alone):
        raise UsageError(
            f"{paths[alone.index(True)]} is what a run says alone, "
            f"{paths[alone.index(False)]} is told from all runs so far: give one kind"
        )
    counts: list[int] = []
    for k, file in enumerate(files):
        before = files[k - 1].runs if k else None
        if file.runs is not None and before is not None and not set(before) < set(file.runs):
            lacking = sorted(set(before) - set(file.runs))
            what = f"lacks run {lacking[0]} of" if lacking else "has no run more than"
            raise BadInput(paths[k], f"{what} {paths[k - 1]}", "give the files in order")
        counts.append(counts[-1] + 1 if counts else 1)
        if file.runs:
            counts[-1] = len(set(file.runs))
    return CUMULATIVE, counts


def in_metres(files: list[ChangeFile], crs: str | None) -> tuple[list[list[Change]], str | None]:
    """The changes of files in one projected CRS (default: the UTM zone of the first change)."""
    lonlat = [c.lonlat for file in files for c in file.changes]
    if crs is None and lonlat:
        crs = utm_crs(*np.concatenate(lonlat).mean(axis=0).tolist())
    out = []
    for file in files:
        changes = []
        for c in file.changes:
            points = lonlat_to(str(crs), c.lonlat)
            changes.append(
                Change(c.kind, c.class_name, points, c.probability, c.change_id, c.element_id)
            )
        out.append(changes)
    return out, crs


def _area(file: ChangeFile, crs: str | None) -> Any | None:
    import shapely

    if file.area is None or crs is None:
        return None
    # Rings of one polygon and of many alike: holes are what is covered an even number of times.
    area = shapely.Polygon()
    for ring in file.area:
        area = area.symmetric_difference(shapely.Polygon(lonlat_to(crs, ring)).buffer(0))
    return area


def _breakdown(score: ChangeScore) -> dict[str, dict[str, int]]:
    out: dict[str, dict[str, int]] = {}
    rows = [(t, "found") for _, t in score.found]
    rows += [(c, "missed") for c in score.missed] + [(c, "false") for c in score.false]
    for change, verdict in rows:
        name = f"{change.kind} {change.class_name}"
        out.setdefault(name, {"found": 0, "missed": 0, "false": 0})[verdict] += 1
    return dict(sorted(out.items()))


def _listing(score: ChangeScore) -> list[dict[str, Any]]:
    rows: list[tuple[str, Change | None, Change | None]] = []
    rows += [("found", p, t) for p, t in score.found]
    rows += [("false", p, None) for p in score.false]
    rows += [("missed", None, t) for t in score.missed]
    out = []
    for verdict, p, t in rows:
        either = p or t
        assert either is not None
        out.append(
            {
                "verdict": verdict,
                "kind": either.kind,
                "class": either.class_name,
                "change_id": p.change_id if p else None,
                "element_id": (t or either).element_id or None,
                "probability": p.probability if p else None,
            }
        )
    return out


def judge_scenes(predicted: str | Path, truth: str | Path) -> dict[str, Any]:
    """TbV's accuracies of ``{"scenes": [{"events", "frames"}]}``: answers from one file, truth
    (events and ego positions) from the other; all frames of all scenes are pooled."""
    answers, scenes = read_scenes(predicted), read_scenes(truth)
    if [len(s["frames"]) for s in answers] != [len(s["frames"]) for s in scenes]:
        raise BadInput(predicted, f"its scenes or frames are not those of {truth}")
    truly, said = [np.zeros(0, bool)], [np.zeros(0, bool)]
    try:
        for scene, answer in zip(scenes, answers, strict=True):
            xy, events = scene_truth(scene)
            truly.append(changed_frames(xy, events))
            said.append(np.array([bool(f["predicted_changed"]) for f in answer["frames"]]))
    except (KeyError, TypeError, ValueError) as error:
        raise BadInput(
            truth, f"a scene lacks something ({error})", "see docs/evaluate.md"
        ) from None
    protocol = f"TbV, all frames, changes nearer than {FRAME_RANGE:g} m"
    return {"protocol": protocol, **frame_accuracy(np.concatenate(truly), np.concatenate(said))}


def read_scenes(path: str | Path) -> list[dict[str, Any]]:
    """The scenes of a file; BadInput when it has none."""
    data = read_json(path)
    scenes = data.get("scenes") if isinstance(data, dict) else None
    if not isinstance(scenes, list):
        raise BadInput(path, "holds no scenes", "see docs/evaluate.md")
    if not all(isinstance(s, dict) and isinstance(s.get("frames"), list) for s in scenes):
        raise BadInput(path, "a scene has no frames")
    return scenes


def scene_truth(scene: dict[str, Any]) -> tuple[Array, list[Array]]:
    """Ego positions (n, 2) and outlines or lines of the change events of a scene, metres."""
    xy = np.array([f["ego_xy"] for f in scene["frames"]], float).reshape(-1, 2)
    return xy, [_event(e) for e in scene["events"]]


def _event(event: dict[str, Any]) -> Array:
    points = np.array(event["points"], float)
    closed = event["kind"] == "polygon" and (points[0] != points[-1]).any()
    return np.concatenate([points, points[:1]]) if closed else points
