"""Runs and a map of different places: one warning with numbers, and the exit code stays."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fusion_scene import drive, line, save, street

from rtmap_cli.formats.changes import read_change_table
from rtmap_cli.logs.agreement import Agreement, agreement
from rtmap_cli.logs.run_files import read_run
from rtmap_cli.logs.traversal import traversal_of
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import read_map, write_new_map

Call = Callable[..., Any]


def _turned(vector_map: VectorMap) -> VectorMap:
    """The same street across: one of another town at the same place."""
    middle = vector_map.elements[0].xy.mean(axis=0)
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    return VectorMap(
        [e.with_points((e.xy - middle) @ turn.T + middle) for e in vector_map], vector_map.crs
    )


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for k in range(2):
        save(drive(street(), f"d{k}", seed=k), tmp_path / "runs" / f"d{k}")
    return tmp_path / "runs"


def _warnings(result: Any) -> list[str]:
    return [text for text in result.err.splitlines() if text.startswith("warning: ")]


def test_a_map_of_another_street_is_doubted(rtmap: Call, tmp_path: Path, runs: Path) -> None:
    write_new_map(_turned(street()), tmp_path / "other", "test")
    run, other = runs / "d0", ("--map", tmp_path / "other")
    out = ("-o", tmp_path / "c.geojson")
    results = [
        rtmap("detect-changes", run, runs / "d1", *other, *out),
        rtmap("crowdsource", runs, *other, "--dry-run"),
        rtmap("localize", run, *other, code=None),
    ]
    assert results[2].code in (0, 4)
    for result in results[: 3 if results[2].code == 0 else 2]:
        (told,) = _warnings(result)
        assert (
            "only " in told and " detections lie within 1.5 m" in told and "of this place" in told
        )
    assert "2 of 2 runs" in _warnings(results[0])[0]


def test_the_map_of_this_street_is_not_doubted(rtmap: Call, tmp_path: Path, runs: Path) -> None:
    # With changes, a piece that is missing, and an offset of half a metre.
    prior = street(line("old", "divider", -4.0), without=["lane", "east"])
    moved = [e.with_points(e.xy + [0.3, 0.4]) for e in prior]
    write_new_map(VectorMap(moved, prior.crs), tmp_path / "map", "test")
    own = ("--map", tmp_path / "map")
    assert not _warnings(rtmap("localize", runs / "d0", *own))
    assert not _warnings(rtmap("detect-changes", runs / "d0", *own, "-o", tmp_path / "c.geojson"))
    assert not _warnings(rtmap("crowdsource", runs, *own))


def test_frames_without_a_prior_element_are_counted(
    rtmap: Call, tmp_path: Path, runs: Path
) -> None:
    # The map ends 10 m into a street that is driven for 100 m, and is seen 36 m ahead.
    short = [
        line(n, c, y, -40.0, -30.0) for n, c, y in (("a", "divider", 0.0), ("b", "boundary", 7))
    ]
    write_new_map(VectorMap(short, street().crs), tmp_path / "map", "test")
    found = agreement(traversal_of(read_run(runs / "d0")), read_map(tmp_path / "map"))
    # x = 0, 2.5 and 5 m lie within 36 m of x = -30 m.
    assert (found.frames, found.in_range) == (40, 3)
    (told,) = _warnings(rtmap("crowdsource", runs / "d0", "--map", tmp_path / "map", "--dry-run"))
    assert "37 of 40 frames have no element in range" in told


def test_what_agreement_counts(tmp_path: Path, runs: Path) -> None:
    run = read_run(runs / "d0")
    lines = [Element(e.element_id, "divider", e.points) for e in street()]
    all_dividers = agreement(traversal_of(run), VectorMap(lines, street().crs))
    own = agreement(traversal_of(run), street())
    sure = int((run.observations.score >= 0.3).sum())
    assert own == Agreement(40, 40, sure, sure)
    # Only dividers lie on elements of their class now.
    dividers = int((run.observations.class_name == "divider").sum())
    assert all_dividers.found == dividers and 0 < dividers < sure
    doubtful = run.observations.score.copy()
    doubtful[:] = 0.1
    faint = replace(run, observations=replace(run.observations, score=doubtful))
    assert agreement(traversal_of(faint), street()) == Agreement(40, 40, 0, 0)


def test_a_run_that_found_something_had_it_in_view(rtmap: Call, tmp_path: Path) -> None:
    # A line that only the last frame sees, far ahead: too little to count as looked at.
    run = drive(street(line("far", "divider", -3.5, 125.0, 140.0)), "d", span=(0.0, 104.0))
    write_new_map(street(), tmp_path / "map", "test")
    folder = save(run, tmp_path / "run")
    out = ("-o", tmp_path / "c.geojson")
    call = ("detect-changes", folder, "--map", tmp_path / "map", *out, "--min-probability", 0)
    result = rtmap(*call, "--write-runs")
    changes = read_change_table(folder / "changes.parquet")[0]
    assert changes and all(c.counts.traversals_seen <= c.counts.traversals_in_view for c in changes)
    told = json.loads((tmp_path / "c.geojson").read_text())["features"]
    assert all(f["properties"]["traversals_in_view"] == 1 for f in told)
    assert "found by" in result.out and "1 of 1 runs" in result.out
