"""The fleet benchmark's table: its figures, its verdicts, and that it goes on."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.fleet import poses as fleet_print
from benchmarks.fleet import tables as fleet_tables

ONE = ["--maps", "adcf7d18", "--parts", "poses", "--jobs", "1", "--drives", "2"]


@pytest.fixture
def golden(tmp_path: Path) -> Path:
    (tmp_path / "golden" / "fleet").mkdir(parents=True)
    return tmp_path / "golden"


def frames(lateral: float, square: float) -> dict[str, Any]:
    """Ten frames: longitudinal, lateral, yaw errors and χ² of the pose, one χ² far too large."""
    errors = np.tile([0.1, lateral, 0.05], (10, 1))
    return {
        "errors": errors.tolist(),
        "square": [square] * 9 + [50.0],
        "answered": [True] * 10,
    }


def kept(options: list[str], lateral: float = 0.08, square: float = 1.0) -> None:
    """Figures of every unit, as an earlier run would have left them."""
    parsed = fleet_tables.parse(options)
    for unit in fleet_tables.units_of(parsed):
        folder = parsed.keep[unit.part]
        folder.mkdir(parents=True, exist_ok=True)
        after = frames(lateral, square)
        result = {"start": frames(0.7, 1.0), "after": after, "seconds": {}, "cpu_s": 1.0}
        (folder / unit.name).write_text(json.dumps(result))


def test_figures_are_those_of_all_frames_together() -> None:
    one, two = frames(0.1, 1.0), frames(0.4, 1.0)
    two["answered"] = [False] * 10
    got = fleet_print.figures([one, two])
    assert got["mean"] == pytest.approx([0.25, 0.1, 0.05])
    assert got["p90"] == pytest.approx([0.4, 0.1, 0.05])
    # A χ² of 1 is inside the 50 % region of three dimensions (2.37), 50 is outside both.
    assert got["inside"] == {"50": 0.9, "90": 0.9}
    assert got["answered"] == 0.5 and got["frames"] == 20


def test_kept_figures_are_judged_and_not_measured_again(
    golden: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = [*ONE, "--golden", str(golden), "--work", str(tmp_path / "work")]

    def never(*_: object) -> dict[str, Any]:
        raise AssertionError("measured again")

    kept(words)
    monkeypatch.setattr(fleet_tables, "poses_of", never)
    report = tmp_path / "figures.json"
    assert fleet_tables.main([*words, "--json", str(report)]) == 0
    said = capsys.readouterr().out
    assert "| lateral (m) | 0.700 · 0.700 | 0.18 · 0.30 | 0.080 · 0.080 | ≤ 0.15 · 0.24" in said
    assert "PASS  smooth, turning: mean lateral (m): 0.08 (bar ≤ 0.12)" in said
    assert "FAIL" not in said
    assert json.loads(report.read_text())["poses"]["adcf7d18/turning/smooth"]["frames"] == 20
    # Too far off for smoothing alone, and every χ² but one outside the region.
    kept(words, lateral=0.11, square=7.0)
    assert fleet_tables.main(words) == 1
    failed = [x for x in capsys.readouterr().out.splitlines() if x.startswith("FAIL")]
    assert failed == [
        "FAIL  single, straight: share inside the 90 % region: 0 (bar 0.85 to 0.95)",
        "FAIL  single, turning: share inside the 90 % region: 0 (bar 0.85 to 0.95)",
        "FAIL  smooth, straight: mean lateral (m): 0.11 (bar ≤ 0.09)",
        "FAIL  smooth, straight: share inside the 90 % region: 0 (bar 0.85 to 0.95)",
        "FAIL  smooth, turning: share inside the 90 % region: 0 (bar 0.85 to 0.95)",
    ]


def test_other_options_are_another_measurement(golden: Path, tmp_path: Path) -> None:
    words = [*ONE, "--golden", str(golden)]
    plain, lag = (
        fleet_tables.units_of(fleet_tables.parse([*words, *more]))
        for more in ([], ["--localize", "--method geometry"])
    )
    assert len({u.name for u in [*plain, *lag]}) == len(plain) + len(lag) == 16


@pytest.mark.parametrize("value", ["", "somewhere"])
def test_without_the_benchmark_one_line_says_so(value: str) -> None:
    result = subprocess.run(
        [sys.executable, "-m", "benchmarks.fleet.tables"],
        env=os.environ | {"RTMAP_GOLDEN": value},
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
    )
    assert result.returncode == 1 and not result.stdout
    assert len(result.stderr.strip().splitlines()) == 1 and "set RTMAP_GOLDEN" in result.stderr


def test_a_drive_is_measured_and_kept(
    rtmap_golden: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One drive over a real map (simulated detections)."""
    if not (rtmap_golden / "fleet" / "adcf7d18").is_dir():
        pytest.skip("no fleet benchmark in RTMAP_GOLDEN")
    words = [*ONE, "--golden", str(rtmap_golden), "--work", str(tmp_path / "work")]
    words += ["--drives", "1", "--scenarios", "straight", "--modes", "single"]
    fleet_tables.main(words)
    first = capsys.readouterr().out
    files = list((tmp_path / "work").rglob("*.json"))
    assert [f.name.rsplit("-", 1)[0] for f in files] == ["adcf7d18-straight-single-00"]
    result = json.loads(files[0].read_text())
    before, after = (np.asarray(result[k]["errors"]).mean(axis=0) for k in ("start", "after"))
    assert after[1] < 0.5 * before[1]
    fleet_tables.main(words)
    assert capsys.readouterr().out == first
