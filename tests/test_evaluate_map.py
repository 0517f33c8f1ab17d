"""``rtmap evaluate map``: reference numbers, hand-checkable cases, runs, maps and result files."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from rtmap_cli.errors import BadInput, NoAnswer, UsageError
from rtmap_cli.geometry.chamfer import (
    bands,
    beside,
    chamfer,
    chamfer_pairs,
    close_pairs,
    sample_lines,
)
from rtmap_cli.geometry.polylines import resample
from rtmap_cli.geometry.poses import se3_from_xyyaw
from rtmap_cli.logs.run import MATCHED, OUTDATED, Observations, Run, RunFrames, run_info, true_poses
from rtmap_cli.logs.run_files import write_poses, write_run
from rtmap_cli.maps.element import CLASSES, Element, VectorMap
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.steps.evaluate.drives import Drive
from rtmap_cli.steps.evaluate.maps.compare import FrameSet, Settings, compare
from rtmap_cli.steps.evaluate.maps.precision import average_precision, evaluate_frames

CRS = "EPSG:32632"
EAST, NORTH = 500_000.0, 5_000_000.0


def line(x0: float, x1: float, y: float, n: int = 20) -> np.ndarray:
    return np.column_stack([np.linspace(x0, x1, n), np.full(n, y)])


def one(points: np.ndarray, score: float = 0.9, name: str = "divider") -> tuple:
    return name, np.asarray(points, float), score


# --- reference numbers -------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", ["maptr", "streammapnet"])
def test_reference_files(rtmap: Any, rtmap_golden: Path, protocol: str) -> None:
    folder = rtmap_golden / "evaluate"
    expected = json.loads((folder / "expected.json").read_text())[protocol]
    arguments = ["--protocol", protocol, "--thresholds", "0.2,0.5,1.0,1.5,2.0", "--json"]
    pred, truth = folder / "pred.json.gz", folder / "gt.json.gz"
    got = json.loads(rtmap("evaluate", "map", pred, "--truth", truth, *arguments).out)
    assert set(got) >= {"protocol", "mAP", "classes"} and got["protocol"] == protocol
    for name, want in expected["classes"].items():
        have = got["classes"][name]
        assert set(have) == {"ap", "tp", "num_gt", "num_pred"}
        assert have["tp"] == want["tp"]
        assert (have["num_gt"], have["num_pred"]) == (want["num_gt"], want["num_pred"])
        assert have["ap"] == pytest.approx(want["ap"], abs=1e-5)


def test_rtmap_is_the_algorithm_of_maptr(rtmap: Any, rtmap_golden: Path) -> None:
    folder = rtmap_golden / "evaluate"
    (usual,) = [
        g
        for g in json.loads((folder / "expected.json").read_text())["maptr"]["groups"]
        if g["thresholds"] == [0.5, 1.0, 1.5]
    ]
    command = ["evaluate", "map", folder / "pred.json.gz", "--truth", folder / "gt.json.gz"]
    got = json.loads(rtmap(*command, "--json").out)
    assert got["protocol"] == "rtmap"
    assert got["mAP"] == pytest.approx(usual["mAP"], abs=1e-5)


def test_hand_checkable_cases(rtmap: Any, rtmap_golden: Path, tmp_path: Path) -> None:
    data = json.loads((rtmap_golden / "evaluate" / "cases.json").read_text())
    thresholds = ",".join(str(t) for t in data["thresholds"])
    assert len(data["cases"]) == 36
    for case in data["cases"]:
        for side in ("gt", "pred"):
            # Truth and prediction list the same frames, empty ones too.
            keys = dict.fromkeys([*case["gt"], *case["pred"]])
            value = {"classes": case["classes"], "frames": {k: case[side].get(k, []) for k in keys}}
            (tmp_path / f"{side}.json").write_text(json.dumps(value))
        for protocol in ("maptr", "streammapnet"):
            want = case["expected"][protocol]
            command = ["evaluate", "map", tmp_path / "pred.json", "--truth", tmp_path / "gt.json"]
            command += ["--protocol", protocol, "--thresholds", thresholds, "--json"]
            if want is None:
                assert "fewer than 2" in rtmap(*command, code=3).err
                continue
            got = json.loads(rtmap(*command).out)
            assert got["mAP"] == pytest.approx(want["mAP"], abs=1e-6), case["name"]
            for name, ap in want["ap"].items():
                assert got["classes"][name]["ap"] == pytest.approx(ap, abs=1e-6), case["name"]
            for count in ("num_gt", "num_pred"):
                for name, number in want.get(count, {}).items():
                    assert got["classes"][name][count] == number, case["name"]


def test_crop_of_a_real_map_is_the_reference_truth(rtmap_golden: Path, av2_log: Path) -> None:
    from rtmap_cli.formats.av2.log import read_av2_map
    from rtmap_cli.formats.map_frames import read_map_frames
    from rtmap_cli.steps.evaluate.drives import read_drives

    reference = read_map_frames(rtmap_golden / "evaluate" / "gt.json.gz", scored=False)
    log = av2_log.name
    frames = {k: v for k, v in reference.frames.items() if k.startswith(log) and v}
    truth = FrameSet(frames, reference.classes, reference.range_m, "reference")
    vector_map = read_av2_map(av2_log)
    vector_map = vector_map[0] if isinstance(vector_map, tuple) else vector_map
    score = compare(vector_map, truth, read_drives(av2_log), Settings(thresholds=(0.1, 0.5)))
    for name, result in score.classes.items():
        assert result.num_pred == result.num_gt, name
        assert result.tp[0.5] == result.num_gt, name
    # Rings may start elsewhere, which moves their sample points; lines agree sharply.
    assert score.classes["divider"].ap[0.1] == score.classes["boundary"].ap[0.1] == 1.0


# --- mathematics -------------------------------------------------------------------------------


def plain_chamfer(a: np.ndarray, b: np.ndarray) -> float:
    d = np.sqrt(((a[:, None] - b[None]) ** 2).sum(-1))
    return (d.min(1).mean() + d.min(0).mean()) / 2


def test_chamfer_against_the_definition() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(0, 5, (6, 100, 2)), rng.normal(3, 5, (7, 100, 2))
    i, j = (k.ravel() for k in np.indices((6, 7)))
    want = np.array([plain_chamfer(a[x], b[y]) for x, y in zip(i, j, strict=True)])
    np.testing.assert_allclose(chamfer_pairs(a, b, i, j), want, rtol=1e-12)
    limit = float(np.median(want))
    got = chamfer_pairs(a, b, i, j, limit)
    np.testing.assert_array_equal(np.isfinite(got), want <= limit)
    assert chamfer(line(0, 10, 0.0), line(0, 10, 0.5)) == 0.5


def wiggly(rng: np.random.Generator, n: int) -> np.ndarray:
    """Smooth random lines near each other, sampled."""
    turn = np.cumsum(rng.normal(0, 0.25, (n, 30)), axis=1) + rng.uniform(-3, 3, (n, 1))
    step = np.stack([np.cos(turn), np.sin(turn)], axis=-1) * rng.uniform(0.05, 1.0, (n, 1, 1))
    lines = np.cumsum(step, axis=1) + rng.normal(0, 3, (n, 1, 2))
    return sample_lines(list(lines), 100)


def test_lines_beside_each_other_have_bands_that_touch() -> None:
    rng = np.random.default_rng(2)
    a, b = wiggly(rng, 40), wiggly(rng, 40)
    i, j = (k.ravel() for k in np.indices((40, 40)))
    picks = np.linspace(0, 99, 12).round().astype(int)
    which, _, feet = close_pairs(a, b, i, j, np.inf, picks)
    assert len(which) == len(i)
    near = beside(a[i][:, picks], b[j], feet, 1.9)
    touch = shapely.intersects(bands(a, 2.0)[i], bands(b, 2.0)[j])
    assert touch[near].all() and near.sum() > 300


def test_sampling_all_lines_at_once() -> None:
    rng = np.random.default_rng(4)
    lines = [rng.normal(0, 20, (k, 2)) for k in (2, 5, 2, 40)]
    lines += [np.array([[1.0, 2.0], [1.0, 2.0]]), np.repeat(lines[1], 2, axis=0)]
    for count in (2, 100):
        want = np.stack([resample(line, count) for line in lines])
        np.testing.assert_allclose(sample_lines(lines, count), want, atol=1e-12)
    assert sample_lines([], 7).shape == (0, 7, 2)


def test_average_precision_by_hand() -> None:
    hits = np.array([True, False, True])
    assert average_precision(hits, 2) == pytest.approx(0.5 + 0.5 * 2 / 3)
    assert average_precision(hits, 0) == 0.0
    assert average_precision(np.zeros(0, bool), 3) == 0.0


def random_frames(seed: int, count: int = 8) -> tuple[list, list]:
    rng = np.random.default_rng(seed)
    pred, truth = [], []
    for _ in range(count):
        true = [one(line(-20, 20, y), 1.0) for y in rng.uniform(-15, 15, 4)]
        pred.append(
            [
                one(t[1] + rng.normal(0, 0.6, 2), float(rng.uniform()))
                for t in true
                if rng.random() < 0.8
            ]
            + [one(line(0, 8, float(rng.uniform(-15, 15))), float(rng.uniform()))]
        )
        truth.append(true)
    return pred, truth


@pytest.mark.parametrize("protocol", ["maptr", "streammapnet", "rtmap"])
def test_properties(protocol: str) -> None:
    pred, truth = random_frames(3)
    thresholds = (0.25, 0.5, 1.0, 2.0)
    score = evaluate_frames(pred, truth, CLASSES, thresholds, protocol)
    ap = list(score.classes["divider"].ap.values())
    assert ap[0] > 0 and ap == sorted(ap)
    order = np.random.default_rng(1).permutation(len(pred))
    shuffled = evaluate_frames(
        [pred[k] for k in order], [truth[k] for k in order], CLASSES, thresholds, protocol
    )
    assert shuffled.as_json() == score.as_json()
    dense = [[one(np.repeat(p, 3, axis=0), s) for _, p, s in frame] for frame in pred]
    again = evaluate_frames(dense, truth, CLASSES, thresholds, protocol)
    assert again.classes["divider"].tp == score.classes["divider"].tp
    perfect = evaluate_frames(truth, truth, ["divider"], thresholds, protocol)
    assert perfect.mAP == pytest.approx(1.0)
    assert score.without_truth == ["ped_crossing", "boundary"]


def test_bad_geometry_names_the_frame() -> None:
    truth = [[], [one(line(0, 5, 0))]]
    with pytest.raises(BadInput, match="frame 1: a vertex"):
        evaluate_frames([[], [one(line(0, 5, np.nan))]], truth, CLASSES)
    with pytest.raises(BadInput, match="frame 1: a predicted divider"):
        evaluate_frames([[], [one(line(0, 5, 0), float("nan"))]], truth, CLASSES)
    with pytest.raises(BadInput, match="frame 1: an element has fewer than 2"):
        evaluate_frames([[], []], [[], [one(line(0, 5, 0)[:1])]], CLASSES)


# --- runs and maps -----------------------------------------------------------------------------


def town() -> VectorMap:
    """Two lines along a straight road, one of them in pieces, and a crossing."""
    ring = np.array([[30, -4], [34, -4], [34, 4], [30, 4], [30, -4]], float)
    parts = [
        Element("a", "divider", line(-50, 20, 0.0) + [EAST, NORTH], existence=3.0),
        Element("b", "divider", line(20, 100, 0.0) + [EAST, NORTH], existence=1.0),
        Element("c", "boundary", line(-50, 100, 5.0) + [EAST, NORTH], existence=2.0),
        Element("d", "ped_crossing", ring + [EAST, NORTH], existence=2.0),
    ]
    return VectorMap(parts, CRS)


def drive(step: float = 5.0, n: int = 10) -> Drive:
    times = 1_000_000_000 + np.arange(n, dtype=np.int64) * 500_000_000
    pose = se3_from_xyyaw(EAST + step * np.arange(n), np.full(n, NORTH - 2.0), np.zeros(n))
    return Drive("drive", CRS, times, pose)


def seen(vector_map: VectorMap, along: Drive, shift: float = 0.0) -> Run:
    """A run that sees the map's crop as it is, shifted sideways."""
    from rtmap_cli.maps.crop import MapIndex

    index, n = MapIndex(vector_map, join=True), len(along)
    rows = [
        (k, e.class_name, resample(e.points[:, :2] + [0.0, shift], 20))
        for k in range(n)
        for e in index.crop(along.pose[k])
    ]
    m = len(rows)
    observations = Observations(
        frame=np.array([r[0] for r in rows], np.int32),
        query=np.arange(m, dtype=np.int32),
        state=np.full(m, MATCHED, np.int8),
        class_name=np.array([r[1] for r in rows], object),
        score=np.linspace(0.9, 0.5, m).astype(np.float32),
        existence=np.full(m, np.nan, np.float32),
        element_id=np.full(m, None, object),
        points=np.array([r[2] for r in rows], np.float32),
        sigma=np.full((m, 20, 2), 0.2, np.float32),
        prior_points=np.full((m, 20, 2), np.nan),
    )
    nan = np.full((n, 3), np.nan)
    frames = RunFrames(
        frame=np.arange(n, dtype=np.int32),
        timestamp_ns=along.timestamp_ns,
        initial=along.pose @ se3_from_xyyaw(0.5, -0.3, 0.01),
        sigma=np.tile([0.5, 0.5, 0.01], (n, 1)),
        odometry=nan,
        odometry_sigma=nan,
        end_to_end=nan,
        end_to_end_covariance=np.full((n, 3, 3), np.nan),
        camera_count=np.zeros(n, np.int32),
    )
    box = {"x": [-36.0, 36.0], "y": [-18.0, 18.0]}
    return Run(run_info("drive", CRS, list(CLASSES), box), frames, observations)


@pytest.fixture
def world(tmp_path: Path) -> Path:
    """A folder with the map ``town``, true poses and a run that sees everything."""
    write_new_map(town(), tmp_path / "town", "test")
    along = drive()
    (tmp_path / "truth").mkdir()
    truth = true_poses(np.arange(len(along), dtype=np.int32), along.timestamp_ns, along.pose)
    write_poses(truth, tmp_path / "truth", CRS)
    (tmp_path / "run").mkdir()
    write_run(seen(town(), along), tmp_path / "run")
    return tmp_path


def test_run_against_map(rtmap: Any, world: Path) -> None:
    command = ["evaluate", "map", world / "run", "--truth", world / "town"]
    for poses in (world / "truth" / "poses.parquet", world):
        got = json.loads(rtmap(*command, "--poses", poses, "--json").out)
        assert got["mAP"] == pytest.approx(1.0)
        assert got["classes"]["divider"]["num_gt"] == 10
    assert "mAP 1.0000 (rtmap, 10 frames)" in rtmap(*command, "--poses", world).out
    assert "--poses" in rtmap(*command, code=2).err


def test_outdated_elements_are_no_predictions(world: Path) -> None:
    run = seen(town(), drive())
    run.observations.state[:] = OUTDATED
    from rtmap_cli.steps.evaluate.maps.frames import run_frames

    assert not any(run_frames(run, "run").frames.values())


def test_map_against_map(rtmap: Any, world: Path) -> None:
    command = ["evaluate", "map", world / "town", "--truth", world / "town", "--poses", world]
    for more in ([], ["--every", "3"], ["--cells", "18"], ["--range", "60", "30"]):
        got = json.loads(rtmap(*command, *more, "--json").out)
        for name, result in got["classes"].items():
            assert set(result["ap"].values()) == {1.0 if result["num_gt"] else 0.0}, (more, name)
        divider = got["classes"]["divider"]
        assert divider["num_pred"] == divider["num_gt"], "pieces must be joined on both sides"
    assert (
        json.loads(rtmap(*command, "--every", "3", "--json").out)["classes"]["divider"]["num_gt"]
        == 4
    )


def test_scores_of_map_elements_are_probabilities() -> None:
    from rtmap_cli.steps.evaluate.maps.frames import MapSide

    local = MapSide(town(), True).crop(drive().pose[4], (-36, -18, 36, 18))
    (divider,) = [e for e in local if e[0] == "divider"]
    a, b = 1 / (1 + np.exp(-3.0)), 1 / (1 + np.exp(-1.0))
    # In range from x = -16 to 56 with the seam at 20.
    assert divider[2] == pytest.approx((36 * a + 36 * b) / 72, abs=0.02)


def test_other_crs_is_converted(world: Path) -> None:
    from rtmap_cli.steps.evaluate.maps.frames import in_crs

    other = in_crs(town(), "EPSG:32631")
    score = compare(other, town(), [drive()])
    assert score.mAP == pytest.approx(1.0)


def test_nothing_corresponds(rtmap: Any, world: Path) -> None:
    far = drive()
    far.pose[:, 0, 3] += 5000
    with pytest.raises(NoAnswer):
        compare(town(), town(), [far])
    with pytest.raises(UsageError):
        compare(town(), town(), [])
    late = Drive("late", CRS, drive().timestamp_ns + 10**12, drive().pose)
    run = world / "run"
    write_poses(true_poses(np.arange(10), late.timestamp_ns, late.pose), world / "truth", CRS)
    error = rtmap("evaluate", "map", run, "--truth", world / "town", "--poses", world, code=3).err
    assert "no pose at the time of frame drive_1000000000 (10 of 10" in error


# --- result files ------------------------------------------------------------------------------


def frames_json(score: bool, key: str = "drive_1000000000") -> dict[str, Any]:
    element = {"class": "divider", "points": [[0, 0], [10, 0]]} | ({"score": 0.7} if score else {})
    return {"classes": list(CLASSES), "frames": {key: [element]}}


def save(path: Path, value: Any) -> Path:
    if path.suffix == ".gz":
        with gzip.open(path, "wt") as file:
            json.dump(value, file)
    else:
        path.write_text(json.dumps(value))
    return path


def test_results_of_other_networks(rtmap: Any, tmp_path: Path) -> None:
    truth = save(tmp_path / "truth.json.gz", frames_json(False, "t1"))
    vector = {"pts": [[0, 0.1], [10, 0.1]], "cls_name": "divider", "confidence_level": 0.8}
    maptr = {"meta": {}, "results": [{"sample_token": "t1", "vectors": [vector]}]}
    stream = {"results": {"t1": {"vectors": [vector["pts"]], "labels": [1], "scores": [0.8]}}}
    annotations = {
        "GTs": [{"sample_token": "t1", "vectors": [{k: vector[k] for k in ("pts", "cls_name")}]}]
    }
    for value in (maptr, stream):
        pred = save(tmp_path / "pred.json", value)
        for other in (truth, save(tmp_path / "gts.json", annotations)):
            got = json.loads(rtmap("evaluate", "map", pred, "--truth", other, "--json").out)
            assert got["classes"]["divider"]["tp"] == {"0.5": 1, "1.0": 1, "1.5": 1}
    fleet = {
        "meta": {"log_id": "drive", "class_names": list(CLASSES)},
        "results": [{"frame": 0, "timestamp_ns": 1_000_000_000, "vectors": [vector]}],
    }
    pred = save(tmp_path / "pred.json", fleet)
    truth = save(tmp_path / "truth.json", frames_json(False, "another-name_1000000000"))
    got = json.loads(rtmap("evaluate", "map", pred, "--truth", truth, "--json").out)
    assert got["classes"]["divider"]["ap"]["0.5"] == 1.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda e: e.pop("score"), "element 0: score is missing"),
        (lambda e: e.update(score=1.2), "outside [0, 1]"),
        (lambda e: e.update(points=[[0, 0], [float("nan"), 1]]), "points is not finite"),
        (lambda e: e.update(points=[1, 2]), "not a list of [x, y]"),
        (lambda e: e.pop("class"), "class is missing"),
    ],
)
def test_bad_results_name_the_place(rtmap: Any, tmp_path: Path, change: Any, words: str) -> None:
    value = frames_json(True)
    change(value["frames"]["drive_1000000000"][0])
    pred = save(tmp_path / "pred.json", value)
    truth = save(tmp_path / "truth.json", frames_json(False))
    error = rtmap("evaluate", "map", pred, "--truth", truth, code=3).err
    assert words in error and "drive_1000000000" in error and len(error.splitlines()) == 1


def test_frames_that_do_not_correspond(rtmap: Any, tmp_path: Path) -> None:
    pred = save(tmp_path / "pred.json", frames_json(True, "other_5"))
    truth = save(tmp_path / "truth.json", frames_json(False))
    assert "nor is any other" in rtmap("evaluate", "map", pred, "--truth", truth, code=3).err
    missing = tmp_path / "none.json"
    assert "no such file" in rtmap("evaluate", "map", missing, "--truth", truth, code=3).err
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "is no run" in rtmap("evaluate", "map", empty, "--truth", truth, code=3).err


def test_missing_frames_count_as_empty(rtmap: Any, tmp_path: Path) -> None:
    pred = save(tmp_path / "pred.json", frames_json(True))
    value = frames_json(False)
    value["frames"]["drive_2000000000"] = value["frames"]["drive_1000000000"]
    truth = save(tmp_path / "truth.json", value)
    result = rtmap("evaluate", "map", pred, "--truth", truth, "--json")
    assert json.loads(result.out)["classes"]["divider"]["ap"]["0.5"] == 0.5
    assert "lacks 1 frames" in result.err


def test_fleet_benchmark_runs(
    rtmap_golden: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import runpy

    script = Path(__file__).parents[1] / "benchmarks" / "fleet" / "chain.py"
    words = f"frames --golden {rtmap_golden} --maps 7fab2350 --scenarios straight --drives 1"
    monkeypatch.setattr("sys.argv", [str(script), *words.split()])
    runpy.run_path(str(script), run_name="__main__")
    row = next(r for r in capsys.readouterr().out.splitlines() if "7fab2350/straight" in r)
    assert 10 < float(row.split()[-1]) < 60


def test_limits(rtmap: Any, tmp_path: Path) -> None:
    pred = save(tmp_path / "pred.json", frames_json(True))
    truth = save(tmp_path / "truth.json", frames_json(False))
    command = ["evaluate", "map", pred, "--truth", truth, "--classes", "divider", "--json"]
    rtmap(*command, "--fail-under", "mAP=0.9", "--fail-under", "AP.divider=1")
    low = rtmap(*command, "--fail-under", "mAP=1.1", code=1)
    assert json.loads(low.out)["mAP"] == 1.0 and "under 1.1" in low.err
    rtmap(*command, "--fail-under", "AP.tree=0.5", code=2)
    rtmap(*command, "--fail-under", "mAP", code=2)
    rtmap(*command, "--thresholds", "0,1", code=2)
    whole = rtmap("evaluate", "map", pred, "--truth", truth)
    assert "no true element of ped_crossing, boundary" in whole.err
