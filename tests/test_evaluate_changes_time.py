"""``rtmap evaluate changes``: thresholds, what was visible, and how many drives a change takes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from sample_logs import write_av2_log, write_native_log

from rtmap_cli.formats.changes import ChangeEvent, write_change_table
from rtmap_cli.geometry.poses import se3_from_xyyaw
from rtmap_cli.logs.run import Observations, Run, RunFrames, run_info, true_poses
from rtmap_cli.logs.run_files import OCCLUDERS, write_poses, write_run
from rtmap_cli.maps.crs import to_lonlat
from rtmap_cli.maps.evidence import Counts
from rtmap_cli.steps.evaluate.changes.elements import Change, score_changes
from rtmap_cli.steps.evaluate.changes.sight import Sight, in_view

CRS = "EPSG:32617"
ORIGIN = np.array([583_000.0, 4_477_000.0])


def line(x0: float, x1: float, y: float = 0.0) -> np.ndarray:
    return np.column_stack([np.linspace(x0, x1, 20), np.full(20, y)])


PLACES = {"a": line(0, 20), "b": line(100, 120), "c": line(200, 220), "ghost": line(300, 320)}


def write_truth(path: Path, places: dict[str, np.ndarray]) -> Path:
    changes = [
        {"element_id": name, "kind": "delete", "class": "divider", "geometry": geometry(points)}
        for name, points in places.items()
    ]
    path.write_text(json.dumps({"changes": changes}))
    return path


def geometry(points: np.ndarray) -> dict[str, Any]:
    return {"type": "LineString", "coordinates": to_lonlat(CRS, points + ORIGIN).tolist()}


def write_claims(path: Path, found: dict[str, float], runs: list[str] | None = None) -> Path:
    """A file that tells some of PLACES, each with a probability."""
    features = [
        {"type": "Feature", "geometry": geometry(PLACES[name]),
         "properties": {"kind": "delete", "class": "divider", "probability": p}}
        for name, p in found.items()
    ]  # fmt: skip
    told = {} if runs is None else {"rtmap": {"runs": runs}}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features} | told))
    return path


def three(folder: Path, runs: bool = True) -> tuple[list[Path], Path]:
    """c is told by the first file, lost by the second, there again in the third; b never."""
    names = [["r1"], ["r2", "r1"], ["r1", "r2", "r3", "r4", "r5"]]
    found = [{"c": 0.6, "ghost": 0.7}, {"a": 0.8, "ghost": 0.9}, {"a": 0.9, "c": 0.7}]
    files = [
        write_claims(folder / f"{k}.geojson", told, ids if runs else None)
        for k, (told, ids) in enumerate(zip(found, names, strict=True))
    ]
    return files, write_truth(folder / "truth.json", {k: PLACES[k] for k in "abc"})


def test_time_to_detection(rtmap: Any, tmp_path: Path) -> None:
    files, truth = three(tmp_path)
    command = ["evaluate", "changes", *files, "--truth", truth]
    got = json.loads(rtmap(*command, "--json").out)
    assert (got["found"], got["missed"], got["false"]) == (2, 1, 0)
    times = got["time_to_detection"]
    assert times["files"] == "cumulative"
    want = {"a": (2, 2), "b": (None, None), "c": (1, 5)}
    assert {c["element_id"]: (c["first"], c["stays"]) for c in times["changes"]} == want
    assert times["first"] == {"mean": 1.5, "median": 2.0, "never": 1}
    assert times["stays"] == {"mean": 3.5, "median": 5.0, "never": 1}
    after = [(a["traversals"], a["found"], a["false"], a["ever_found"]) for a in times["after"]]
    assert after == [(1, 1, 1, 1), (2, 1, 1, 2), (5, 2, 0, 2)]
    told = rtmap(*command).out
    assert "found after" in told and "never" in told
    rtmap(*command, "--fail-over", "stays.mean=3", code=1)
    # The operating point is that of every file.
    sure = json.loads(rtmap(*command, "--min-probability", "0.65", "--json").out)
    assert [c["first"] for c in sure["time_to_detection"]["changes"]] == [2, None, 5]


def test_files_that_do_not_say_their_runs_are_one_drive_each(rtmap: Any, tmp_path: Path) -> None:
    files, truth = three(tmp_path, runs=False)
    got = json.loads(rtmap("evaluate", "changes", *files, "--truth", truth, "--json").out)
    assert [a["traversals"] for a in got["time_to_detection"]["after"]] == [1, 2, 3]


def test_what_each_run_says_alone(rtmap: Any, tmp_path: Path) -> None:
    files, truth = three(tmp_path)
    runs = []
    for name, places in (("r1", "b"), ("r2", "ab")):
        (tmp_path / name).mkdir()
        counts = Counts(3, 4, 1, 1, 1, 2, (name,))
        events = [
            ChangeEvent(p, "delete", "divider", p, PLACES[p] + ORIGIN, 0.9, 2.2, counts)
            for p in places
        ]
        write_change_table(events, tmp_path / name / "changes.parquet", CRS)
        runs.append(tmp_path / name)
    got = json.loads(rtmap("evaluate", "changes", *runs, "--truth", truth, "--json").out)
    times = got["time_to_detection"]
    assert times["files"] == "each run alone"
    assert [c["first"] for c in times["changes"]] == [2, 1, None]
    error = rtmap("evaluate", "changes", runs[0], files[0], "--truth", truth, code=2).err
    assert "one kind" in error and len(error.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("order", "words"), [([1, 0], "lacks run r2"), ([0, 0], "no run more than")]
)
def test_files_out_of_order(rtmap: Any, tmp_path: Path, order: list[int], words: str) -> None:
    files, truth = three(tmp_path)
    picked = [files[k] for k in order]
    error = rtmap("evaluate", "changes", *picked, "--truth", truth, code=3).err
    assert words in error and "in order" in error and len(error.strip().splitlines()) == 1


def test_precision_and_recall_over_the_threshold(rtmap: Any, tmp_path: Path) -> None:
    files, truth = three(tmp_path)
    write_claims(files[0], {"a": 0.9, "ghost": 0.8, "b": 0.6})
    got = json.loads(rtmap("evaluate", "changes", files[0], "--truth", truth, "--json").out)
    assert [p["threshold"] for p in got["curve"]] == [0.9, 0.8, 0.6]
    assert [p["precision"] for p in got["curve"]] == pytest.approx([1, 1 / 2, 2 / 3])
    assert [p["recall"] for p in got["curve"]] == pytest.approx([1 / 3, 1 / 3, 2 / 3])
    assert got["ap"] == pytest.approx(1 / 3 * 1 + 1 / 3 * 2 / 3)
    # A point of the curve is the evaluation at that threshold.
    for point in got["curve"]:
        limit = ["--min-probability", point["threshold"], "--json"]
        alone = json.loads(rtmap("evaluate", "changes", files[0], "--truth", truth, *limit).out)
        assert alone["precision"] == point["precision"] and alone["recall"] == point["recall"]


def test_equal_probabilities_are_one_step() -> None:
    true = [Change("delete", "divider", PLACES[k]) for k in "ab"]
    told = [Change("delete", "divider", PLACES[k], 0.5) for k in ("a", "ghost", "b", "c")]
    for order in ([0, 1, 2, 3], [3, 1, 0, 2]):
        found = score_changes([told[k] for k in order], true).precision_recall()
        assert found["ap"] == 0.5 and len(found["curve"]) == 1
    assert score_changes(told, []).precision_recall() == {"ap": None, "curve": []}
    assert score_changes([], true).precision_recall() == {"ap": 0.0, "curve": []}


def test_visible_in_the_cameras_of_a_log(rtmap: Any, tmp_path: Path) -> None:
    log = write_native_log(tmp_path / "log", frames=4)
    yaw = 0.1
    ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    n = 9
    pose = se3_from_xyyaw(ORIGIN[0] + 5.0 * np.arange(n), np.full(n, ORIGIN[1]), yaw)
    times = np.arange(n, dtype=np.int64) * 10**9
    (log / "truth").mkdir(exist_ok=True)
    write_poses(true_poses(np.arange(n, dtype=np.int32), times, pose), log / "truth", CRS)
    # Across the road, 22 m ahead of the start: in reach between x = 2 and 42.
    across = np.array([22 * ahead - 3 * left, 22 * ahead + 3 * left])
    truth = write_truth(tmp_path / "truth.json", {"a": across})
    claims = write_claims(tmp_path / "claims.geojson", {})
    command = ["evaluate", "changes", claims, "--truth", truth, "--poses", log, "--json"]
    got = json.loads(rtmap(*command).out)
    near, seen = got["frame_level"], got["frame_level_visible"]
    assert "all frames" in near["protocol"] and "visible only" in seen["protocol"]
    assert "cam_0" in seen["visible"] and "camera" in seen["visible"]
    # x = 5 … 40 are near; from x = 20 on the line is behind the cameras or below the image.
    assert (near["changed_frames"], seen["changed_frames"]) == (8, 3)
    assert seen["frames"] == n and seen["acc_changed"] == 0.0 and seen["macc"] == 0.5


def test_a_line_longer_than_the_reach_is_seen_anywhere_along_it() -> None:
    """TbV samples the whole entity, also where it is farther than 20 m."""
    pose = se3_from_xyyaw(np.zeros(1), np.zeros(1), np.zeros(1))
    far = Sight("far", lambda _, points: np.asarray(points[:, 0] > 30))
    assert in_view([0], pose, [line(10, 40)], far).tolist() == [True]
    assert in_view([0], pose, [line(10, 29)], far).tolist() == [False]
    assert in_view([0], pose, [line(25, 40)], far).tolist() == [False]
    gap = Sight("gap", lambda _, points: np.asarray(np.abs(points[:, 0] - 15) < 0.06))
    assert in_view([0], pose, [np.array([[10.0, 0], [20.0, 0]])], gap).tolist() == [True]
    assert in_view([0], pose, [], far).tolist() == [False]


def test_visible_to_a_run(rtmap: Any, tmp_path: Path) -> None:
    n = 5
    pose = se3_from_xyyaw(ORIGIN[0] + 10.0 * np.arange(n), np.full(n, ORIGIN[1]), np.zeros(n))
    index, times = np.arange(n, dtype=np.int32), np.arange(n, dtype=np.int64) * 10**9
    nan = np.full((n, 3), np.nan)
    frames = RunFrames(
        index, times, pose, np.ones((n, 3)), nan, nan, nan, np.full((n, 3, 3), np.nan), index
    )
    box = {"x": [-5.0, 36.0], "y": [-18.0, 18.0]}
    # A wall 5 m ahead in frame 0, as wide as the range.
    wall = pa.table(
        dict(
            zip(OCCLUDERS.columns.names, [[0], [5.0], [0], [0], [1], [40], [2], [0]], strict=True)
        ),
        schema=OCCLUDERS.columns,
    )
    poses = true_poses(index, times, pose)
    info = run_info("r", CRS, ["divider"], box)
    (tmp_path / "run").mkdir()
    write_run(Run(info, frames, Observations.empty(), wall, poses), tmp_path / "run")
    truth = write_truth(tmp_path / "truth.json", {"a": line(18, 19)})
    claims = write_claims(tmp_path / "claims.geojson", {})
    command = ["evaluate", "changes", claims, "--truth", truth, "--poses", tmp_path / "run"]
    got = json.loads(rtmap(*command, "--json").out)
    # Near at x = 0, 10, 20, 30; hidden at 0, behind the range's 5 m at 30.
    assert got["frame_level"]["changed_frames"] == 4
    assert got["frame_level_visible"]["changed_frames"] == 2
    assert "occluders" in got["frame_level_visible"]["visible"]
    table = ["evaluate", "changes", claims, "--truth", truth, "--poses"]
    assert "is not known" in rtmap(*table, tmp_path / "run" / "poses.parquet").out


def test_frames_of_an_argoverse_log_are_not_its_poses(rtmap: Any, tmp_path: Path) -> None:
    from rtmap_cli.formats.av2.log import Av2Log

    write_av2_log(tmp_path / "log-1")
    truth = write_truth(tmp_path / "truth.json", {"a": PLACES["a"]})
    claims = write_claims(tmp_path / "claims.geojson", {})
    command = ["evaluate", "changes", claims, "--truth", truth, "--poses", tmp_path / "log-1"]
    got = json.loads(rtmap(*command, "--json").out)
    log = Av2Log(tmp_path / "log-1")
    assert got["frame_level"]["frames"] == len(log) < len(log.pose_times)
    assert got["frame_level_visible"]["frames"] == len(log)
