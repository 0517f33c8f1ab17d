"""``rtmap evaluate changes`` and the figures of a map as a whole."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from rtmap_cli.geometry.poses import se3_from_xyyaw
from rtmap_cli.logs.run import true_poses
from rtmap_cli.logs.run_files import write_poses
from rtmap_cli.maps.crs import to_lonlat
from rtmap_cli.maps.element import CLASSES, Element, VectorMap
from rtmap_cli.steps.evaluate.changes.elements import Change, same_place, score_changes
from rtmap_cli.steps.evaluate.maps.whole import cells_in, coverage, honesty, region_in_range

CRS = "EPSG:32632"
ORIGIN = np.array([500_000.0, 5_000_000.0])
RING = np.array([[0, 0], [4, 0], [4, 10], [0, 10], [0, 0]], float)


def line(x0: float, x1: float, y: float = 0.0) -> np.ndarray:
    return np.column_stack([np.linspace(x0, x1, 20), np.full(20, y)])


def test_reference_scenes(rtmap: Any, rtmap_golden: Path) -> None:
    path = rtmap_golden / "evaluate" / "changes.json"
    data = json.loads(path.read_text())
    got = json.loads(rtmap("evaluate", "changes", path, "--truth", path, "--json").out)
    assert "all frames" in got["protocol"]
    assert {k: got[k] for k in data["expected"]} == pytest.approx(data["expected"])
    from rtmap_cli.steps.evaluate.changes.elements import distances_to_events
    from rtmap_cli.steps.evaluate.judge import scene_truth

    for scene in data["scenes"]:
        xy, events = scene_truth(scene)
        want = [f["distances"] for f in scene["frames"]]
        if events:
            np.testing.assert_allclose(distances_to_events(xy, events), want, atol=1e-8)


def test_rule_of_lines() -> None:
    true = line(0, 20)
    assert same_place(line(0, 20, 0.9), true, "divider") == pytest.approx(1.0)
    assert same_place(line(0, 20, 1.1), true, "divider") == 0.0
    # 8 m and the metre beyond its end: less than half of the true stretch.
    assert same_place(line(0, 8), true, "divider") == 0.0
    assert same_place(line(0, 10), true, "divider") >= 0.5
    assert same_place(line(0, 50), true, "divider") == 0.0


def test_rule_of_crossings() -> None:
    assert same_place(RING, RING[::-1], "ped_crossing") == pytest.approx(1.0)
    # Half an overlap is a third of the union.
    assert same_place(RING + [2, 0], RING, "ped_crossing") == pytest.approx(1 / 3)
    assert same_place(RING + [2.3, 0], RING, "ped_crossing") == 0.0


def test_each_true_change_counts_once() -> None:
    true = [Change("insert", "divider", line(0, 20)), Change("delete", "ped_crossing", RING)]
    predicted = [
        Change("insert", "divider", line(0, 20, 0.5), 0.9),
        Change("insert", "divider", line(0, 20, 0.1), 0.8),
        Change("insert", "ped_crossing", RING, 0.7),
        Change("insert", "boundary", line(0, 20), 0.6),
    ]
    score = score_changes(predicted, true)
    assert [p.probability for p, _ in score.found] == [0.9]
    assert (len(score.missed), len(score.false)) == (1, 3)
    assert score.precision == 0.25 and score.recall == 0.5
    assert score.as_json(km=2.0)["false_per_km"] == 1.5
    area = shapely.box(-100, -100, 100, -50)
    assert len(score_changes(predicted, [], area).outside) == 4
    nothing = score_changes([], [])
    assert nothing.precision is None and nothing.recall is None


def geometry(points: np.ndarray) -> dict[str, Any]:
    lonlat = to_lonlat(CRS, points + ORIGIN).tolist()
    if (points[0] == points[-1]).all():
        return {"type": "Polygon", "coordinates": [lonlat]}
    return {"type": "LineString", "coordinates": lonlat}


def write_changes(folder: Path) -> tuple[Path, Path]:
    """Two true changes and a repainting; one is found, one claim is false and improbable."""
    rows = [("insert", "divider", line(0, 20)), ("delete", "ped_crossing", RING + [200, 0])]
    truth = {
        "changes": [
            {"element_id": f"t{k}", "kind": kind, "class": name, "geometry": geometry(p)}
            for k, (kind, name, p) in enumerate([*rows, ("paint", "divider", line(50, 70))])
        ]
    }
    (folder / "truth.json").write_text(json.dumps(truth))
    claims = [
        ("insert", "divider", line(1, 20, 0.3), 0.9),
        ("delete", "divider", line(80, 99), 0.2),
    ]
    features = [
        {"type": "Feature", "geometry": geometry(p),
         "properties": {"change_id": f"c{k}", "kind": kind, "class": name, "probability": q}}
        for k, (kind, name, p, q) in enumerate(claims)
    ]  # fmt: skip
    path = folder / "changes.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path, folder / "truth.json"


def test_a_move_may_be_told_as_one_change() -> None:
    gone = Change("delete", "divider", line(0, 20), element_id="lane")
    there = Change("insert", "divider", line(0, 20, 2.0), element_id="lane-new")
    told = Change("modify", "divider", line(0, 20, 2.3), 0.9, element_id="lane")
    score = score_changes([told], [gone, there])
    assert (len(score.found), score.missed, score.false) == (2, [], [])
    # Of another element, or elsewhere, it is no answer to these.
    for other in (
        replace(told, element_id="kerb"),
        replace(told, points=line(0, 20, 5.0)),
        replace(told, class_name="boundary"),
    ):
        score = score_changes([other], [gone, there])
        assert (len(score.found), len(score.missed), len(score.false)) == (0, 2, 1)
    assert len(score_changes([told], [gone]).false) == 1


def test_command(rtmap: Any, tmp_path: Path) -> None:
    path, truth = write_changes(tmp_path)
    command = ["evaluate", "changes", path, "--truth", truth]
    got = json.loads(rtmap(*command, "--km", "2", "--json").out)
    assert [got[k] for k in ("found", "missed", "false", "not_judged")] == [1, 1, 1, 1]
    assert (got["precision"], got["recall"], got["false_per_km"]) == (0.5, 0.5, 0.5)
    assert got["by_kind_and_class"]["delete ped_crossing"] == {"found": 0, "missed": 1, "false": 0}
    sure = json.loads(rtmap(*command, "--min-probability", "0.5", "--json").out)
    assert sure["false"] == 0 and sure["precision"] == 1.0 and "km" not in sure
    assert "precision 0.500, recall 0.500" in rtmap(*command).out
    rtmap(*command, "--fail-under", "recall=0.6", code=1)
    rtmap(*command, "--fail-under", "recall=0.5")
    rtmap(*command, "--fail-under", "speed=1", code=2)


def test_changes_of_a_run(rtmap: Any, tmp_path: Path) -> None:
    from rtmap_cli.formats.changes import ChangeEvent, write_change_table
    from rtmap_cli.maps.evidence import Counts

    _, truth = write_changes(tmp_path)
    counts = Counts(3, 4, 1, 1, 1, 2, ("r",))
    event = ChangeEvent("c", "insert", "divider", None, line(0, 19) + ORIGIN, 0.9, 2.2, counts)
    (tmp_path / "run").mkdir()
    write_change_table([event], tmp_path / "run" / "changes.parquet", CRS)
    got = json.loads(rtmap("evaluate", "changes", tmp_path / "run", "--truth", truth, "--json").out)
    assert (got["found"], got["false"]) == (1, 0)


def test_frame_level_along_poses(rtmap: Any, tmp_path: Path) -> None:
    path, truth = write_changes(tmp_path)
    n = 31
    pose = se3_from_xyyaw(ORIGIN[0] + 1 + 10.0 * np.arange(n), np.full(n, ORIGIN[1]), np.zeros(n))
    times = np.arange(n, dtype=np.int64) * 10**9
    (tmp_path / "truth").mkdir()
    write_poses(true_poses(np.arange(n), times, pose), tmp_path / "truth", CRS)
    got = json.loads(
        rtmap("evaluate", "changes", path, "--truth", truth, "--poses", tmp_path, "--json").out
    )
    frame = got["frame_level"]
    # True: x 1 … 31 and 181 … 221; claimed: 1 … 31 and 61 … 111.
    assert (frame["frames"], frame["changed_frames"]) == (31, 9)
    assert frame["acc_changed"] == pytest.approx(4 / 9)
    assert frame["acc_unchanged"] == pytest.approx(16 / 22)
    assert got["km"] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f["properties"].pop("kind"), "change 0: kind is missing"),
        (lambda f: f["properties"].update(probability=2), "outside [0, 1]"),
        (lambda f: f.update(geometry=None), "change 0: geometry"),
        (lambda f: f["geometry"].update(coordinates=[[500000.0, 5e6], [1.0, 2.0]]), "degrees"),
        (lambda f: f.pop("properties"), "no properties"),
    ],
)
def test_bad_changes(rtmap: Any, tmp_path: Path, change: Any, words: str) -> None:
    path, truth = write_changes(tmp_path)
    data = json.loads(path.read_text())
    change(data["features"][0])
    path.write_text(json.dumps(data))
    error = rtmap("evaluate", "changes", path, "--truth", truth, code=3).err
    assert words in error and len(error.strip().splitlines()) == 1


def dividers(*lines: np.ndarray, covariance: np.ndarray | None = None) -> VectorMap:
    parts = [Element(str(k), "divider", p, covariance) for k, p in enumerate(lines)]
    return VectorMap(parts, CRS)


def test_cells_and_coverage() -> None:
    region = region_in_range(se3_from_xyyaw(*np.array([[0.0], [0.0], [0.0]])), (-36, -18, 36, 18))
    cells = cells_in(region)
    assert len(cells) == 8
    truth = VectorMap([Element("a", "divider", line(-30, 30))], CRS)
    fused = VectorMap(
        [Element("b", "divider", line(0, 60, 0.5)), Element("c", "divider", line(0, 10, 9))], CRS
    )
    found = coverage(fused, truth, region, ["divider"])["divider"].as_json()
    assert found["true_m"] == pytest.approx(60) and found["fused_m"] == pytest.approx(46)
    assert found["covered"] == pytest.approx((30 + np.sqrt(0.75)) / 60, abs=1e-3)
    assert found["extra"] == pytest.approx((10 + 6 - np.sqrt(0.75)) / 46, abs=1e-3)


def test_honesty_of_sigma() -> None:
    rng = np.random.default_rng(0)
    x = np.linspace(0, 1000, 4000)
    truth = dividers(np.column_stack([x, 0 * x]))
    y = rng.normal(0, 0.1, len(x))
    # Straight pieces, so that the normals are those of the road.
    pieces = [np.array([[x[k], y[k]], [x[k + 1], y[k]]]) for k in range(len(x) - 1)]
    fused = dividers(*pieces, covariance=np.tile([4.0, 0.0, 0.01, np.nan], (2, 1)))
    region = shapely.box(-1, -9, 1001, 9)
    told = honesty(fused, truth, region, list(CLASSES)).as_json()
    assert told["within"]["1"] == pytest.approx(0.683, abs=0.02)
    assert told["within"]["2"] == pytest.approx(0.954, abs=0.02)
    assert told["rms_error_m"] == pytest.approx(0.1, abs=0.01)
    far = dividers(line(0, 10, 5.0), covariance=np.tile([1.0, 0.0, 1.0, np.nan], (20, 1)))
    assert honesty(far, truth, region, list(CLASSES)).unmatched == 20
    assert honesty(truth, truth, region, list(CLASSES)).silent == len(x)
