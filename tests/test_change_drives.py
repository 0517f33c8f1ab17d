"""The benchmark of change detection: its figures from answers with known counts."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.changes import drives as bench


def _answer(*rows: tuple[str, float | None]) -> dict[str, Any]:
    named = [[verdict, p, "insert divider"] for verdict, p in rows]
    return {"rows": named, "km": 0.5, "changed": [8, 10], "unchanged": [30, 30]}


def test_counts_operating_point_and_calibration() -> None:
    answers = [
        _answer(("found", 0.9), ("found", 0.4), ("false", 0.6), ("false", 0.1)),
        _answer(("found", 0.8), ("missed", None), ("false", 0.3)),
    ]
    got = bench.figures(answers)
    # The change told with 0.4 is missed at the usual threshold.
    assert (got["found"], got["missed"], got["false"]) == (2, 2, 1)
    assert got["F1"] == pytest.approx(2 * 2 / (3 + 4))
    assert got["false_per_km"] == 1.0
    assert (got["acc_c"], got["acc_r"], got["mAcc"]) == (0.8, 1.0, 0.9)
    # One change is never told: no threshold reaches a recall of 0.95.
    assert got["point"] is None and got["false_at_recall"] is None
    assert got["brier"] == pytest.approx((0.01 + 0.36 + 0.36 + 0.01 + 0.04 + 0.09) / 6)
    told = {(b["from"], b["to"]): (b["count"], b["real"]) for b in got["reliability"]}
    assert told[(0.4, 0.6)] == (1, 1.0) and told[(0.6, 0.8)] == (1, 0.0)
    assert got["kinds"] == {"insert divider": {"found": 2, "missed": 2, "false": 1}}


def test_false_alarms_are_counted_where_recall_is_reached() -> None:
    answers = [_answer(("found", 0.9), ("found", 0.7), ("false", 0.8), ("false", 0.2))]
    got = bench.figures(answers)
    assert got["point"] == 0.7 and got["false_at_recall"] == 2.0
    words = {v.text: v.word for v in bench.verdicts({"one": got, "three": got})}
    assert words["element F1 after one traversal"] == "FAIL"
    assert words["mAcc (TbV, all frames) after three traversals"] == "PASS"
    assert words["false alarms per km at recall 0.95 after one traversal"] == "FAIL"


def test_without_data_it_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RTMAP_DATA", raising=False)
    with pytest.raises(SystemExit, match="RTMAP_DATA"):
        bench.parse([])
