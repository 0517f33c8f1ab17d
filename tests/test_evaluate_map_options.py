"""``rtmap evaluate map``: intervals, processes, shape, properties, input that cannot be judged."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtmap_cli.maps.element import CLASSES, Element, VectorMap
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.steps.evaluate.maps.intervals import blocks_of, bootstrap
from rtmap_cli.steps.evaluate.maps.precision import Detection, Ranking, Scorer, evaluate_frames
from rtmap_cli.steps.evaluate.maps.shape import Shape, joints, measure, turning

Frame = list[Detection]
STRICT = (0.2, 0.5, 1.0, 2.0)


def bent(rng: np.random.Generator) -> np.ndarray:
    """A line of 4 to 12 vertices that bends gently through the range."""
    n = int(rng.integers(4, 13))
    turn = np.cumsum(rng.normal(0, 0.2, n)) + rng.uniform(-3, 3)
    step = rng.uniform(1, 6, n)[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    return rng.uniform((-30, -15), (30, 15)) + np.cumsum(step, axis=0)


def ring(rng: np.random.Generator) -> np.ndarray:
    corners = np.array([[0, 0], [4, 0], [4, 12], [0, 12], [0, 0.0]])
    return corners + rng.uniform((-30, -15), (26, 3))


def frames_of(seed: int, count: int = 40) -> tuple[list[Frame], list[Frame]]:
    """Predictions with errors, misses and inventions, and their truth; no two scores are alike."""
    rng = np.random.default_rng(seed)
    scores = iter(rng.permutation(100_000) / 100_000)
    pred, truth = [], []
    for _ in range(count):
        true: Frame = [
            (name, ring(rng) if name == "ped_crossing" else bent(rng), 1.0)
            for name in rng.choice(CLASSES, 6)
        ]
        seen = [e for e in true if rng.random() < 0.85]
        frame = [(e[0], e[1] + rng.normal(0, 0.5, 2), float(next(scores))) for e in seen]
        frame += [("divider", bent(rng), float(next(scores))) for _ in range(2)]
        truth.append(true)
        pred.append(frame)
    return pred, truth


def denser(line: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The same line with 1 to 3 vertices more on every segment."""
    parts = [line[:1]]
    for a, b in pairwise(line):
        share = np.sort(rng.uniform(0, 1, int(rng.integers(1, 4))))
        parts += [a + share[:, None] * (b - a), b[None]]
    return np.concatenate(parts)


# --- properties --------------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", ["maptr", "streammapnet"])
@pytest.mark.parametrize("seed", [1, 2])
def test_vertices_on_the_line_change_nothing(protocol: str, seed: int) -> None:
    pred, truth = frames_of(seed, 15)
    rng = np.random.default_rng(seed)
    score = evaluate_frames(pred, truth, CLASSES, STRICT, protocol)
    dense = [[[(c, denser(p, rng), s) for c, p, s in f] for f in side] for side in (pred, truth)]
    assert all(len(e[1]) != 100 for side in dense for f in side for e in f)
    assert evaluate_frames(*dense, CLASSES, STRICT, protocol).as_json() == score.as_json()
    for name, (_, p, _s) in zip("ab", [pred[0][0], truth[0][0]], strict=True):
        np.testing.assert_allclose(turning(denser(p, rng)), turning(p), atol=1e-6, err_msg=name)


@pytest.mark.parametrize("seed", [3, 4])
def test_order_perfection_and_thresholds(seed: int) -> None:
    pred, truth = frames_of(seed, 15)
    score = evaluate_frames(pred, truth, CLASSES, STRICT)
    order = np.random.default_rng(seed).permutation(len(pred))
    mixed = evaluate_frames([pred[k] for k in order], [truth[k] for k in order], CLASSES, STRICT)
    assert mixed.as_json() == score.as_json()
    for c in score.classes.values():
        assert list(c.ap.values()) == sorted(c.ap.values())
        assert list(c.tp.values()) == sorted(c.tp.values())
        assert 0 < c.mean < 1
    assert evaluate_frames(truth, truth, CLASSES, STRICT).mAP == pytest.approx(1.0, abs=1e-12)


# --- intervals ---------------------------------------------------------------------------------


def scored(pred: list[Frame], truth: list[Frame]) -> Scorer:
    scorer = Scorer(CLASSES)
    for p, t in zip(pred, truth, strict=True):
        scorer.add(p, t)
    return scorer


def test_bootstrap_is_the_score_of_frames_drawn_again() -> None:
    pred, truth = frames_of(5, 12)
    scorer = scored(pred, truth)
    blocks = blocks_of([f"a_{k}" for k in range(12)], 3)
    assert blocks.tolist() == [k // 3 for k in range(12)]
    drawn = np.random.default_rng([7, 31]).multinomial(4, np.full(4, 0.25), size=40)
    want = []
    for counts in drawn:
        rows = [k for k in range(12) for _ in range(counts[blocks[k]])]
        again = evaluate_frames([pred[k] for k in rows], [truth[k] for k in rows], CLASSES)
        want.append([again.mAP, *(c.mean for c in again.classes.values())])
    low, high = np.quantile(want, [0.025, 0.975], axis=0)
    got = bootstrap(scorer.rankings(), blocks, 40, 7)
    pairs = [got.mean, *got.classes.values()]
    np.testing.assert_allclose(pairs, np.column_stack([low, high]), atol=1e-12)
    mask = np.arange(12) < 6
    part = bootstrap(scorer.rankings(), blocks, 40, 7, mask)
    alone = bootstrap(scored(pred[:6], truth[:6]).rankings(), blocks[:6], 40, 7)
    assert part == alone and part.blocks == 2


def test_blocks_are_consecutive_frames_of_a_log() -> None:
    keys = ["b_3", "a_1", "b_1", "a_2", "b_2"]
    assert blocks_of(keys, 2).tolist() == [2, 0, 1, 0, 1]
    assert blocks_of(["x", "y", "z"], 2).tolist() == [0, 0, 1], "names without a time: their order"


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    held, n = 0, 200
    ones, rows = np.ones(n), np.arange(n, dtype=np.int32)
    blocks = blocks_of([str(k) for k in range(n)], 1)
    for seed in range(60):
        # One prediction of one element per frame, right in 70 %, none surer than another: recall
        # and precision are 0.7 each, and AP is about 0.7².
        hits = np.random.default_rng(seed).random((n, 1)) < 0.7
        ranking = Ranking(0.5 * ones, hits, rows, ones.astype(np.int32))
        low, high = bootstrap({"divider": ranking}, blocks, 100, 0).mean
        held += low <= 0.49 <= high
    assert 50 <= held <= 60


# --- files and the command line ----------------------------------------------------------------


def save(path: Path, frames: dict[str, Frame], scores: bool, **more: Any) -> Path:
    rows = {
        key: [
            {"class": c, "points": p.tolist()} | ({"score": s} if scores else {})
            for c, p, s in elements
        ]
        for key, elements in frames.items()
    }
    path.write_text(json.dumps({"classes": list(CLASSES), "frames": rows} | more))
    return path


def keyed(frames: list[Frame]) -> dict[str, Frame]:
    return {f"log{k // 20}_{k}": f for k, f in enumerate(frames)}


@pytest.fixture
def command(tmp_path: Path) -> list[Any]:
    """The evaluation of 40 frames."""
    pred, truth = frames_of(6)
    save(tmp_path / "pred.json", keyed(pred), True)
    save(tmp_path / "truth.json", keyed(truth), False)
    return ["evaluate", "map", tmp_path / "pred.json", "--truth", tmp_path / "truth.json"]


def test_jobs_change_nothing(rtmap: Any, command: list[Any], tmp_path: Path) -> None:
    more = ["--json", "--bootstrap", "30", "--block", "4", "--shape"]
    alone = rtmap(*command, *more).out
    assert rtmap(*command, *more, "--jobs", "2").out == alone
    # The first bad frame is named, not the one that another process found first.
    pred, _ = frames_of(6)
    pred[17][0] = ("divider", pred[17][0][1][:1], 0.5)
    pred[39][0] = ("divider", pred[39][0][1][:1], 0.5)
    save(tmp_path / "pred.json", keyed(pred), True)
    bad = [*command, "--protocol", "streammapnet"]
    error = rtmap(*bad, "--jobs", "2", code=3).err
    assert "log0_17" in error and error == rtmap(*bad, code=3).err


def test_intervals_on_the_command_line(rtmap: Any, command: list[Any]) -> None:
    few = rtmap(*command, "--bootstrap", "50", "--json")
    assert "say little" in few.err
    result = json.loads(rtmap(*command, "--bootstrap", "50", "--block", "2", "--json").out)
    told = result["intervals"]
    assert told["blocks"] == 20 and told["draws"] == 50 and told["level"] == 0.95
    for name, c in result["classes"].items():
        low, high = told["classes"][name]
        assert low < np.mean(list(c["ap"].values())) < high
    assert told["mAP"][0] < result["mAP"] < told["mAP"][1]
    again = ["--bootstrap", "50", "--block", "2", "--json", "--seed"]
    assert json.loads(rtmap(*command, *again, "0").out)["intervals"] == told
    assert json.loads(rtmap(*command, *again, "1").out)["intervals"] != told
    assert "97.5 %" in rtmap(*command, "--bootstrap", "5").out


def test_shape_on_the_command_line(rtmap: Any, command: list[Any]) -> None:
    result = json.loads(rtmap(*command, "--shape", "--json").out)
    # Predictions are displaced whole: they turn as the truth does.
    assert abs(result["smoothness"]["boundary"]["excess_deg_per_m"]) < 1e-6
    assert set(result["topology"]) == {"divider", "boundary"}
    text = rtmap(*command, "--shape").out
    assert "not part of mAP" in text
    assert "smoothness" not in json.loads(rtmap(*command, "--json").out)


# --- shape -------------------------------------------------------------------------------------


def test_turning_of_known_lines() -> None:
    line = np.array([[0, 0], [10, 0], [10, 10], [20, 10.0]])
    total, way, zigzags = turning(line)
    assert (np.degrees(total), way, zigzags) == (pytest.approx(180), 30, 1)
    square = np.array([[0, 0], [8, 0], [8, 8], [0, 8], [0, 0.0]])
    assert np.degrees(turning(square)[0]) == pytest.approx(360)
    angle = np.linspace(0, np.pi, 400)
    bow = 20 * np.column_stack([np.cos(angle), np.sin(angle)])
    assert np.degrees(turning(bow)[:2] @ [1, 0]) == pytest.approx(180, abs=4)
    assert not turning(np.zeros((2, 2))).any()
    x = np.arange(0.0, 31.0)
    saw = np.column_stack([x, 0.3 * (np.arange(31) % 2)])
    flat = np.column_stack([x, np.zeros(31)])
    sums = measure([saw, flat + [0, 9]], [flat], np.array([0, -1]))
    told = Shape(sums).smoothness()
    assert told["true_deg_per_m"] == 0 and (told["excess_deg_per_m"] or 0) > 10
    assert (told["zigzags_per_100_m"] or 0) > 60
    assert Shape(measure([flat], [flat], np.array([-1]))).smoothness()["deg_per_m"] is None


def test_joints_of_known_lines() -> None:
    main = np.array([[0, 0], [20, 0.0]])
    merge = np.array([[0, 6], [10, 0.1]])
    on, beyond = np.array([[20.2, 0], [40, 0.0]]), np.array([[20, 0.1], [40, 6.0]])
    places, arms = joints([main, merge])
    np.testing.assert_allclose(places, [[10, 0.1]])
    assert arms.tolist() == [3], "an end and a line that passes"
    assert joints([main, on])[1].tolist() == [2]
    assert joints([main, on, beyond])[1].tolist() == [3]
    assert len(joints([main, main + [0, 3]])[0]) == 0
    closed = np.array([[0, 0], [5, 0], [5, 5], [0, 0.0]])
    assert len(joints([closed])[0]) == 0
    none = np.full(2, -1)
    told = Shape(measure([main, merge + [0.8, 0]], [main, merge], none)).topology()
    assert told["joints"]["f1"] == told["forks"]["f1"] == 1.0
    apart = Shape(measure([main, merge + [0, 2.0]], [main, merge], none)).topology()["joints"]
    assert (apart["true"], apart["predicted"], apart["recall"]) == (1, 0, 0.0)
    assert apart["precision"] is None
    split = [main[:1] * 0 + [[0, 0], [10, 0.0]], np.array([[10, 0], [20, 0.0]])]
    torn = Shape(measure(split, [main], np.full(2, -1))).topology()["joints"]
    assert (torn["true"], torn["predicted"], torn["precision"]) == (0, 1, 0.0)


# --- input that cannot be judged ---------------------------------------------------------------

LINE = np.array([[0, 0], [10, 0.0]])


def sides() -> dict[str, dict[str, Any]]:
    element = {"class": "divider", "points": LINE.tolist()}
    return {
        "pred": {
            "classes": list(CLASSES),
            "frames": {"a_1": [element | {"score": 0.5}], "a_2": []},
        },
        "truth": {
            "classes": list(CLASSES),
            "frames": {"a_1": [element | {"points": LINE.tolist()}], "a_2": []},
        },
    }


def first(side: dict[str, Any]) -> Any:
    return side["frames"]["a_1"][0]


BAD: dict[str, tuple[str, Callable[[Any], Any], str]] = {
    "another log": (
        "pred",
        lambda s: s.update(frames={"b_9": s["frames"]["a_1"]}),
        "b_9 is not in",
    ),
    "another frame": ("pred", lambda s: s["frames"].update(a_3=[]), "a_3 is not in"),
    "no frame": ("pred", lambda s: s.update(frames={}), "pred.json: holds no frame"),
    "no true frame": ("truth", lambda s: s.update(frames={}), "truth.json: holds no frame"),
    "an empty truth": ("truth", lambda s: s.update(frames={"a_1": [], "a_2": []}), "empty truth"),
    "another class": ("pred", lambda s: first(s).update({"class": "kerb"}), "a_1 holds a kerb"),
    "other classes": ("pred", lambda s: s.update(classes=["kerb"]), "not know the class ped_cro"),
    "a class of its own": ("truth", lambda s: first(s).update({"class": "x"}), "a_1 holds a x"),
    "NaN": ("pred", lambda s: first(s)["points"].append([float("nan"), 0]), "a_1, element 0"),
    "NaN in the truth": ("truth", lambda s: first(s)["points"].append([1, float("inf")]), "a_1"),
    "one true vertex": ("truth", lambda s: first(s).update(points=[[1, 1]]), "fewer than 2"),
    "no vertex": ("pred", lambda s: first(s).update(points=[]), "a_1, element 0"),
    "no score": ("pred", lambda s: first(s).pop("score"), "score is missing"),
    "a low score": ("pred", lambda s: first(s).update(score=-0.1), "outside [0, 1]"),
    "a score that is text": ("pred", lambda s: first(s).update(score="high"), "not a number"),
    "a score of NaN": ("pred", lambda s: first(s).update(score=float("nan")), "a_1, element 0"),
}


@pytest.mark.parametrize("name", list(BAD))
def test_bad_input_is_named_in_one_line(rtmap: Any, tmp_path: Path, name: str) -> None:
    both = sides()
    which, change, words = BAD[name]
    change(both[which])
    for side, value in both.items():
        (tmp_path / f"{side}.json").write_text(json.dumps(value))
    command = ["evaluate", "map", tmp_path / "pred.json", "--truth", tmp_path / "truth.json"]
    error = rtmap(*command, code=3).err
    assert words in error and len(error.splitlines()) == 1
    assert f"{which}.json" in error


def test_one_predicted_vertex_follows_the_protocol(rtmap: Any, tmp_path: Path) -> None:
    both = sides()
    first(both["pred"])["points"] = [[1, 1]]
    for side, value in both.items():
        (tmp_path / f"{side}.json").write_text(json.dumps(value))
    command = ["evaluate", "map", tmp_path / "pred.json", "--truth", tmp_path / "truth.json"]
    assert "1 predictions of one vertex are left out" in rtmap(*command).err
    error = rtmap(*command, "--protocol", "streammapnet", code=3).err
    assert "frame a_1" in error and "fewer than 2 vertices" in error


def test_a_class_without_truth_is_flagged(rtmap: Any, tmp_path: Path) -> None:
    for side, value in sides().items():
        (tmp_path / f"{side}.json").write_text(json.dumps(value))
    command = ["evaluate", "map", tmp_path / "pred.json", "--truth", tmp_path / "truth.json"]
    got = rtmap(*command, "--json")
    result = json.loads(got.out)
    assert result["without_truth"] == ["ped_crossing", "boundary"]
    assert result["mAP"] == pytest.approx(1 / 3)
    assert "no true element of ped_crossing, boundary" in got.err
    # Of one class alone this is the protocol's case, not an empty truth.
    alone = json.loads(rtmap(*command, "--classes", "boundary", "--json").out)
    assert alone["mAP"] == 0 and alone["without_truth"] == ["boundary"]
    common = json.loads(rtmap(*command, "--classes", "divider", "--json").out)
    assert common["mAP"] == 1 and "without_truth" not in common


def test_logs_of_other_names_are_found_by_time_and_told(rtmap: Any, tmp_path: Path) -> None:
    both = sides()
    both["pred"]["frames"] = {k.replace("a", "b"): v for k, v in both["pred"]["frames"].items()}
    for side, value in both.items():
        (tmp_path / f"{side}.json").write_text(json.dumps(value))
    command = ["evaluate", "map", tmp_path / "pred.json", "--truth", tmp_path / "truth.json"]
    got = rtmap(*command, "--classes", "divider", "--json")
    assert json.loads(got.out)["mAP"] == 1 and "b_1, a_1" in got.err


def test_maps_of_other_crs_or_without_elements(rtmap: Any, tmp_path: Path) -> None:
    from rtmap_cli.geometry.poses import se3_from_xyyaw
    from rtmap_cli.logs.run import true_poses
    from rtmap_cli.logs.run_files import write_poses

    xy = np.column_stack([np.linspace(0, 60, 7) + 500_000, np.full(7, 5_000_000.0)])
    write_new_map(VectorMap([Element("a", "divider", xy)], "EPSG:32632"), tmp_path / "map", "test")
    write_new_map(VectorMap([], "EPSG:32632"), tmp_path / "none", "test")
    times = np.arange(7, dtype=np.int64) * 10**9
    poses = true_poses(
        np.arange(7, dtype=np.int32), times, se3_from_xyyaw(xy[:, 0], xy[:, 1], np.zeros(7))
    )
    crs = {"here": "EPSG:32632", "local": 'LOCAL_CS["a car park",UNIT["metre",1]]'}
    for name in crs:
        (tmp_path / name / "truth").mkdir(parents=True)
        write_poses(poses, tmp_path / name / "truth", crs[name])
    command = ["evaluate", "map", tmp_path / "map", "--truth", tmp_path / "map", "--json"]
    got = json.loads(rtmap(*command, "--poses", tmp_path / "here").out)
    assert got["classes"]["divider"]["num_gt"] == 7
    error = rtmap(*command, "--poses", tmp_path / "local", code=3).err
    assert "car park" in error and len(error.splitlines()) == 1
    command[4] = tmp_path / "none"
    assert "empty truth" in rtmap(*command, "--poses", tmp_path / "here", code=3).err
