"""What every ``rtmap evaluate`` offers CI: limits, an earlier report as baseline, Markdown."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtmap_cli.errors import UsageError
from rtmap_cli.steps.evaluate.gates.baseline import Baseline, Drops, parse_drops
from rtmap_cli.steps.evaluate.gates.limits import Figure, past_limits

Write = Callable[..., Path]


@pytest.fixture
def frames(tmp_path: Path) -> Write:
    """``frames("a", 0.3)`` writes three frames, each with a divider moved sideways by 0.3 m."""

    def write(name: str, shift: float, count: int = 3, classes: tuple[str, ...] = ()) -> Path:
        line = {"class": "divider", "points": [[-20, shift], [20, shift]], "score": 0.9}
        edge = {"class": "boundary", "points": [[-20, 6], [20, 6]], "score": 0.8}
        value = {
            "classes": list(classes or ("divider", "boundary")),
            "range_m": {"x": [-36, 36], "y": [-18, 18]},
            "frames": {f"log_{k}": [line, edge] for k in range(1, count + 1)},
        }
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps(value))
        return path

    return write


@pytest.fixture
def pairs(tmp_path: Path) -> Write:
    """``pairs("a", 0.1)`` writes one case of poses that are 0.1 m to the left of the truth."""

    def write(name: str, lateral: float) -> Path:
        frame = {"true": {"x": 0, "y": 0, "yaw": 0}, "est": {"x": 0, "y": lateral, "yaw": 0.01}}
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps({"cases": [{"name": "one", "frames": [frame, frame]}]}))
        return path

    return write


@pytest.fixture
def scenes(tmp_path: Path) -> Write:
    """``scenes("a", True, False)`` writes what was answered at two frames, one near a change."""

    def write(name: str, *answers: bool) -> Path:
        at = [[5.0, 0.0], [500.0, 0.0]]
        rows = [{"ego_xy": xy, "predicted_changed": a} for xy, a in zip(at, answers, strict=True)]
        event = {"kind": "line", "points": [[0, 0], [10, 0]]}
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps({"scenes": [{"events": [event], "frames": rows}]}))
        return path

    return write


def report(rtmap: Any, path: Path, *arguments: object) -> Path:
    """Write what ``--json`` prints."""
    path.write_text(rtmap("evaluate", *arguments, "--json").out)
    return path


# --- limits --------------------------------------------------------------------------------------


def test_limits_of_a_map(rtmap: Any, frames: Write) -> None:
    call = ("evaluate", "map", frames("pred", 0.7), "--truth", frames("truth", 0.0))
    assert "mAP" in rtmap(*call, "--fail-under", "mAP=0.5", "--fail-under", "AP.boundary=1").out
    low = rtmap(*call, "--fail-under", "AP.divider=0.9", "--fail-under", "mAP=0.1", code=1)
    assert "AP.divider is 0.6667, under 0.9" in low.err and "mAP" not in low.err
    assert "AP" in low.out, "the result is printed all the same"
    assert "unknown figure" in rtmap(*call, "--fail-under", "AP.none=0.9", code=2).err
    assert "use --fail-under" in rtmap(*call, "--fail-over", "mAP=0.9", code=2).err
    for wrong in ("mAP", "mAP=", "=0.5", "mAP=high", "mAP=nan", "mAP=inf"):
        assert "NAME=VALUE" in rtmap(*call, "--fail-under", wrong, code=2).err


def test_limits_of_poses_and_changes(rtmap: Any, pairs: Write, scenes: Write) -> None:
    path = pairs("poses", 0.3)
    call = ("evaluate", "poses", path, "--truth", path)
    rtmap(*call, "--fail-over", "one.lateral_m.mean=0.31", "--fail-over", "one.yaw_deg.p90=1")
    high = rtmap(*call, "--fail-over", "one.lateral_m.mean=0.2", code=1)
    assert "one.lateral_m.mean is 0.3000, over 0.2" in high.err
    assert "use --fail-over" in rtmap(*call, "--fail-under", "one.lateral_m.mean=1", code=2).err
    call = (
        "evaluate",
        "changes",
        scenes("said", True, True),
        "--truth",
        scenes("true", True, True),
    )
    rtmap(*call, "--fail-under", "acc_changed=1")
    assert "macc is 0.5000" in rtmap(*call, "--fail-under", "macc=0.6", code=1).err
    # Precision is no figure of answers frame by frame: whoever relies on it must hear of it.
    assert "precision" in rtmap(*call, "--fail-under", "precision=0.6", code=2).err


def test_a_figure_without_a_value_is_past_any_limit() -> None:
    figures = {"a": Figure(None), "b": Figure(None, "lower"), "c": Figure(0.5, "neither")}
    assert past_limits({"a": 0.0}, {"b": 9.0}, figures) == [
        "a is unknown, under 0.0", "b is unknown, over 9.0",
    ]  # fmt: skip
    assert not past_limits({"c": 0.4}, {"c": 0.6}, figures)
    assert len(past_limits({"c": 0.6}, {"c": 0.4}, figures)) == 2


# --- baseline ------------------------------------------------------------------------------------


def test_what_fell_is_named_with_both_values(rtmap: Any, frames: Write, tmp_path: Path) -> None:
    truth = frames("truth", 0.0)
    good, bad = frames("good", 0.3), frames("bad", 0.7)
    earlier = report(rtmap, tmp_path / "report.json", "map", good, "--truth", truth)
    again = ("evaluate", "map", good, "--truth", truth, "--baseline", earlier)
    compared = json.loads(rtmap(*again, "--json").out)["baseline"]
    assert compared["fell"] == []
    assert compared["figures"]["mAP"] == {"baseline": 1.0, "now": 1.0, "difference": 0.0}
    worse = ("evaluate", "map", bad, "--truth", truth, "--baseline", earlier)
    fell = rtmap(*worse, "--max-drop", "0.01", code=1)
    assert "AP.divider fell from 1.0000 to 0.6667" in fell.err
    assert "mAP fell from 1.0000 to 0.8333" in fell.err and "boundary" not in fell.err
    assert "-0.3333" in fell.out and "difference" in fell.out
    one = rtmap(*worse, "--max-drop", "0.2", code=1).err
    assert "AP.divider" in one and "mAP" not in one
    rtmap(*worse, "--max-drop", "0.5")
    rtmap(*worse, "--max-drop", "0.01", "--max-drop", "AP=0.4", "--max-drop", "mAP=0.4")
    # What got better is no reason to stop, and the file may be read by the next comparison.
    later = report(rtmap, tmp_path / "later.json", "map", bad, "--truth", truth)
    rtmap("evaluate", "map", good, "--truth", truth, "--baseline", later, "--max-drop", "0")


def test_errors_are_worse_when_they_rise(rtmap: Any, pairs: Write, tmp_path: Path) -> None:
    small, large = pairs("small", 0.1), pairs("large", 0.3)
    earlier = report(rtmap, tmp_path / "report.json", "poses", small, "--truth", small)
    call = ("evaluate", "poses", large, "--truth", large, "--baseline", earlier)
    rose = rtmap(*call, "--max-drop", "0.01", code=1)
    assert "one.lateral_m.mean rose from 0.1000 to 0.3000" in rose.err
    assert "yaw" not in rose.err and "longitudinal" not in rose.err
    rtmap(*call, "--max-drop", "one.lateral_m=0.25")
    later = report(rtmap, tmp_path / "later.json", "poses", large, "--truth", large)
    rtmap("evaluate", "poses", small, "--truth", small, "--baseline", later)


def test_changes_against_a_baseline(rtmap: Any, scenes: Write, tmp_path: Path) -> None:
    truth, right, wrong = scenes("t", True, True), scenes("r", True, False), scenes("w", True, True)
    earlier = report(rtmap, tmp_path / "report.json", "changes", right, "--truth", truth)
    call = ("evaluate", "changes", wrong, "--truth", truth, "--baseline", earlier)
    assert "macc fell from 1.0000 to 0.5000" in rtmap(*call, code=1).err


def test_a_baseline_of_something_else_is_refused(rtmap: Any, frames: Write, tmp_path: Path) -> None:
    truth, pred = frames("truth", 0.0), frames("pred", 0.3)
    earlier = report(rtmap, tmp_path / "report.json", "map", pred, "--truth", truth)
    call = ("evaluate", "map", pred, "--truth", truth, "--baseline", earlier)
    cases = {
        ("--protocol", "maptr"): "(protocol: rtmap there, maptr here)",
        ("--thresholds", "0.2,0.5"): "(thresholds: 0.5, 1.0, 1.5 there, 0.2, 0.5 here)",
        ("--classes", "divider"): "(classes: divider, boundary there, divider here)",
        ("--every", "2"): "(frames: 3 there, 2 here)",
    }
    for options, what in cases.items():
        told = rtmap(*call, *options, code=3)
        assert what in told.err and str(earlier) in told.err and told.err.count("\n") == 1
        assert not told.out
    fewer = ("evaluate", "map", frames("p", 0.3, 2), "--truth", frames("t", 0.0, 2))
    assert "(frames: 3 there, 2 here)" in rtmap(*fewer, "--baseline", earlier, code=3).err


def test_a_baseline_of_another_verb_or_of_none(
    rtmap: Any, frames: Write, pairs: Write, tmp_path: Path
) -> None:
    poses = pairs("poses", 0.1)
    other = report(rtmap, tmp_path / "report.json", "poses", poses, "--truth", poses)
    call = ("evaluate", "map", frames("p", 0.3), "--truth", frames("t", 0.0), "--baseline")
    assert "(verb: poses there, map here)" in rtmap(*call, other, code=3).err
    broken = {
        "[1, 2]": "no report", '{"mAP": 0.5}': "no settings", "{": "JSON",
        '{"settings": {}, "figures": {"mAP": "high"}}': "not a number",
    }  # fmt: skip
    for text, what in broken.items():
        (tmp_path / "odd.json").write_text(text)
        told = rtmap(*call, tmp_path / "odd.json", code=3)
        assert what in told.err and told.err.count("\n") == 1
    rtmap(*call, tmp_path / "none.json", code=3)


def test_drops_by_name_and_group() -> None:
    drops = parse_drops(("0.02", "yaw_deg=0.5", "yaw_deg.p90=inf"))
    assert drops.allowed("mAP") == 0.02 and drops.allowed("yaw_deg.mean") == 0.5
    assert drops.allowed("yaw_deg.p90") == float("inf")
    for wrong in ("-1", "mAP=", "=0.1", "a lot", "mAP=nan"):
        with pytest.raises(UsageError, match="--max-drop"):
            parse_drops((wrong,))


def test_figures_that_come_and_go() -> None:
    baseline = Baseline(Path("r.json"), {}, {"a": 0.5, "gone": 0.5, "unknown": None, "near": 0.5})
    figures = {
        "a": Figure(0.5), "new": Figure(0.1), "unknown": Figure(0.1), "near": Figure(0.1, "neither")
    }  # fmt: skip
    changes = {c.name: c for c in baseline.changes(figures, Drops(0.0))}
    assert [n for n, c in changes.items() if c.fell] == ["gone"]
    assert "now it is unknown" in changes["gone"].sentence(0.0)
    with pytest.raises(UsageError, match="unknown figure"):
        baseline.changes(figures, Drops(0.0, {"other": 1.0}))


def test_what_should_lie_near_something() -> None:
    baseline = Baseline(Path("r.json"), {}, {"inside.50": 0.45, "nees": 1.4})

    def fell(inside: float, nees: float) -> list[str]:
        figures = {
            "inside.50": Figure(inside, "neither", target=0.5),
            "nees": Figure(nees, "neither", target=1.0),
        }
        return [c.name for c in baseline.changes(figures, Drops(0.01)) if c.fell]

    assert fell(0.55, 0.6) == [] and fell(0.5, 1.0) == []
    assert fell(0.6, 1.4) == ["inside.50"] and fell(0.3, 0.5) == ["inside.50", "nees"]


def test_options_that_go_together(rtmap: Any, frames: Write) -> None:
    call = ("evaluate", "map", frames("p", 0.3), "--truth", frames("t", 0.0))
    assert "--baseline" in rtmap(*call, "--max-drop", "0.1", code=2).err
    assert "give one" in rtmap(*call, "--json", "--markdown", code=2).err


# --- output --------------------------------------------------------------------------------------


def test_json_says_what_makes_it_comparable(rtmap: Any, frames: Write, pairs: Write) -> None:
    call = ("evaluate", "map", frames("p", 0.7), "--truth", frames("t", 0.0), "--json")
    got = json.loads(rtmap(*call).out)
    stated = got["settings"]
    assert stated["verb"] == "map" and stated["protocol"] == got["protocol"] == "rtmap"
    assert stated["thresholds"] == [0.5, 1.0, 1.5] and stated["frames"] == 3
    assert stated["classes"] == ["divider", "boundary"]
    assert stated["range_m"] == {"x": [-36, 36], "y": [-18, 18]}
    assert got["figures"]["mAP"] == got["mAP"]
    means = got["classes"]["divider"]["ap"].values()
    assert got["figures"]["AP.divider"] == pytest.approx(sum(means) / 3)
    poses = pairs("poses", 0.1)
    figures = json.loads(rtmap("evaluate", "poses", poses, "--truth", poses, "--json").out)
    assert figures["figures"]["one.lateral_m.mean"] == pytest.approx(0.1)


def test_markdown_can_be_pasted(rtmap: Any, frames: Write, tmp_path: Path) -> None:
    truth, good, bad = frames("t", 0.0), frames("g", 0.3), frames("b", 0.7)
    text = rtmap("evaluate", "map", good, "--truth", truth, "--markdown").out
    lines = text.splitlines()
    assert lines[0].startswith("**rtmap evaluate map**") and "protocol rtmap" in lines[0]
    assert "range_m x -36 … 36, y -18 … 18" in lines[0]
    assert lines[1:4] == ["", "| figure | value |", "| --- | ---: |"]
    assert "| mAP | 1.0000 |" in lines and "| AP.divider | 1.0000 |" in lines
    earlier = report(rtmap, tmp_path / "report.json", "map", good, "--truth", truth)
    call = ("evaluate", "map", bad, "--truth", truth, "--baseline", earlier, "--markdown")
    lines = rtmap(*call, "--fail-under", "mAP=0.9", code=1).out.splitlines()
    assert "| figure | baseline | now | difference |" in lines
    assert "| mAP | 1.0000 | 0.8333 | -0.1667 |" in lines
    assert "| AP.boundary | 1.0000 | 1.0000 | +0.0000 |" in lines
    assert "* mAP is 0.8333, under 0.9" in lines
    assert {len(line.split("|")) for line in lines if line.startswith("|")} == {6}
