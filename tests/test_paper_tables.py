"""The benchmark of the paper's tables: its figures, its verdicts, and that it goes on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fusion_scene import ORIGIN, drive, street

from benchmarks.common import places as paper_places
from benchmarks.common import worlds as paper_worlds
from benchmarks.paper import printing as paper_print
from benchmarks.paper import tables as paper_tables
from rtmap_cli.logs.run import MATCHED, OUTDATED
from rtmap_cli.logs.run_files import read_run
from rtmap_cli.steps.simulate.driving.routes import Lane
from rtmap_cli.steps.simulate.worlds.changes import parse_spec

CLASSES = ("ped_crossing", "divider", "boundary")


def ap(value: float) -> dict[str, float]:
    return dict.fromkeys((*CLASSES, "mAP"), value)


def world(one: float, with_u: float, without: float, last: float) -> dict[str, Any]:
    names = {"one frame": one, "cycle 2": with_u, "cycle 2 w/o U": without, "cycle 3": last}
    return {"ap": {name: ap(value) for name, value in names.items()}}


def found(worlds: list[dict[str, Any]]) -> list[tuple[Any, dict[str, Any]]]:
    return [(paper_tables.Unit("mapping", "p", "straight", k), w) for k, w in enumerate(worlds)]


def test_claims_are_paired_over_worlds() -> None:
    claims = paper_print.claims_1(found([world(30, 50, 45, 60), world(40, 62, 61, 66)]))
    by_text = {c.text: c for c in claims}
    up = by_text["straight: cycle 3 over cycle 2, divider"]
    assert up.gain == pytest.approx(7) and up.error == pytest.approx(3) and up.count == 2
    u = by_text["straight: U over none at cycle 2, mAP"]
    assert u.gain == pytest.approx(3) and u.line.startswith("PASS")
    gain = next(c for c in claims if "over the paper's 20.5" in c.text)
    assert gain.gain == pytest.approx(28 - 20.5)


def test_a_claim_that_fails_says_so() -> None:
    claims = paper_print.claims_1(found([world(30, 50, 52, 49)]))
    failed = [c.text for c in claims if not c.holds]
    assert len(failed) == 6 and all("cycle" in text for text in failed)
    assert claims[-1].line.startswith("FAIL  straight: gain of 19.0")


def test_cycles_that_some_worlds_lack_are_compared_where_they_are() -> None:
    one, two = world(30, 50, 45, 60), world(40, 62, 61, 66)
    two["ap"]["cycle 10"] = ap(70.0)
    lines = paper_print.table_1(found([one, two]))
    assert any("cycle 10 (in 1; 66.0 at cycle 3)" in line for line in lines)
    assert any("40.9 / 84.3 / 47.6 | 57.6" in line for line in lines if "cycle 3 |" in line)


def test_accuracies_are_those_of_tbv() -> None:
    sums = {"changed": 10, "changed_right": 4, "unchanged": 20, "unchanged_right": 15}
    assert paper_print.accuracies(sums) == pytest.approx((0.4, 0.75, 0.575))
    assert paper_print.accuracies(sums | {"changed": 0})[2] is None


def test_what_a_frame_alone_says() -> None:
    prior = street(without=("east",))
    run = drive(street(without=("west",)), "one", prior=prior)
    said = paper_worlds.frame_answers(run, {"ped_crossing"})
    x = run.frames.initial[:, 0, 3] - ORIGIN[0]
    # "west" (x 20 to 24) is gone, "east" (x 80 to 84) is new; 20 m from both there is neither.
    assert said[(x > 10) & (x < 35)].mean() > 0.9 and said[(x > 65) & (x < 95)].mean() > 0.6
    assert not said[(x > 46) & (x < 58)].any()


def test_q_prior_is_the_run_that_tells_nothing_outdated(tmp_path: Path) -> None:
    run = drive(street(without=("west",)), "one", prior=street())
    o = run.observations
    assert (o.state == OUTDATED).any()
    blind = read_run(paper_worlds.credulous(run, tmp_path / "blind")).observations
    assert not (blind.state == OUTDATED).any()
    assert (blind.state == MATCHED).sum() == ((o.state == OUTDATED) | (o.state == MATCHED)).sum()
    assert np.array_equal(blind.points, o.points)
    assert (blind.existence[np.isfinite(o.existence)] == 1).all()


@pytest.fixture
def short_street(monkeypatch: pytest.MonkeyPatch) -> paper_places.Place:
    monkeypatch.setattr(paper_places, "ROUTE_LENGTH", 45.0)
    x = np.arange(0.0, 101.0, 2.0)
    y = np.full(len(x), -2.0)
    points = np.column_stack([ORIGIN[0] + x, ORIGIN[1] + y, np.zeros(len(x))])
    return paper_places.Place("street", street(), [Lane("one", points, ())])


def test_a_world_is_mapped(short_street: paper_places.Place, tmp_path: Path) -> None:
    what = paper_worlds.Mapping(cycles=(1, 2))
    got = paper_worlds.map_world(short_street, "straight", 0, 1, tmp_path, what)
    assert list(got["ap"]) == [
        "one frame", "cycle 1", "cycle 1 w/o U", "cycle 2", "cycle 2 w/o U",
    ]  # fmt: skip
    assert 0 < got["ap"]["one frame"]["mAP"] < got["ap"]["cycle 2"]["mAP"] <= 100
    assert got["poses"]["smooth"]["lateral_m_mean"] < got["poses"]["initial"]["lateral_m_mean"]


def test_changes_and_poses_of_a_world(short_street: paper_places.Place, tmp_path: Path) -> None:
    specs = [parse_spec("insert:ped_crossing")]
    got = paper_worlds.changes_of(short_street, "straight", 0, 1, tmp_path / "a", specs)
    assert got["changes"] == 1
    for way in ("a frame alone", "one drive", "three drives"):
        assert got[way]["changed"] > 0 and got[way]["changed_right"] <= got[way]["changed"]
    assert got["three drives"]["found"] + got["three drives"]["missed"] == 1
    assert got["one drive"]["found"] + got["one drive"]["missed"] == 3
    poses = paper_worlds.localized_on(short_street, "straight", 0, 1, tmp_path / "b", specs)
    sizes = {len(v) for v in poses.values() if isinstance(v, list)}
    assert len(sizes) == 1 and sizes.pop() >= 2 * 18


def test_a_change_without_a_place_is_left_out(short_street: paper_places.Place) -> None:
    specs = [parse_spec("delete:ped_crossing*9")]
    old, changes, keys = paper_worlds.outdated(short_street, "straight", 0, 1, specs, 1)
    assert not changes and old is short_street.world and len(keys) == 1


def kept(folder: Path, words: list[str], change: float = 0.0) -> list[paper_tables.Unit]:
    """Figures of every unit of a command, as an earlier run would have left them."""
    options = paper_tables.parse([*words, "--work", str(folder)])
    units = paper_tables.units_of(options)
    options.work.mkdir(parents=True, exist_ok=True)
    for unit in units:
        result = world(30, 55 + change, 45, 60)
        result["ap"]["cycle 3 w/o U"] = ap(50.0)
        if unit.what == "poses":
            result = {"changes": 2} | {
                f"{q}, {how}": [[0.3 * k, 0.2 * k, 0.1 * k]] * 4
                for q, k in (("Q_prior", 1.2), ("Q_map", 1.0))
                for how in ("a frame alone", "whole drive")
            }
        (options.work / unit.name).write_text(json.dumps(result))
    return units


def test_what_was_measured_is_not_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--towns", "--tables", "1", "3", "--kinds", "straight", "--worlds", "2", "--jobs", "1"]
    units = kept(tmp_path, words)
    assert len({u.name for u in units}) == len(units) == 3 * 2 + 3

    def never(*_: object) -> dict[str, Any]:
        raise AssertionError("measured again")

    monkeypatch.setattr(paper_tables, "_measured", never)
    assert paper_tables.main([*words, "--work", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "## Tab. 1" in said and "## Tab. 3" in said and "## Tab. 2" not in said
    assert "PASS  straight: cycle 3 over cycle 2, crossing: +5" in said
    assert "0.163 / 0.318" in said and "simulated towns" in said
    kept(tmp_path, words, change=6.0)
    assert paper_tables.main([*words, "--work", str(tmp_path)]) == 1
    assert "FAIL  straight: cycle 3 over cycle 2, crossing: -1" in capsys.readouterr().out


def test_other_cycles_are_another_measurement() -> None:
    unit = paper_tables.Unit("mapping", "p", "straight", 0, (1, 2, 3))
    assert unit.name != replace(unit, cycles=(1, 2, 3, 5)).name


def test_ablations_are_read_or_said_not_to_be_there() -> None:
    lines = paper_print.table_4(None, None)
    assert any("not run" in line and "T^E" in line for line in lines)
    assert any("benchmarks.paper.ablations" in line for line in lines)
    pose = [[0.6, 0.1, 0.3], [1.2, 0.2, 0.6]]
    made = {"config": "c", "steps": 9, "encoder steps": 5, "batch": 4, "frames": 8}
    row = {"figures": {"mAP": 0.25}, "cpu_minutes": 3.0, "poses": {"start": pose}}
    gaps = {"mAP": [-0.1, -0.2, -0.05], "only Q_map 0": [0.1, -0.1, 0.3]}
    gaps |= {f"only Q_map {k}": [0.2, 0.1, 0.3] for k in (1, 2)}
    variants = {
        "full": row | {"poses": {"start": pose, "only Q_map": pose}},
        "without L_nll": row | {"against full": gaps},
    }
    made |= {"test frames": 16, "test towns": 2, "encoder CPU minutes": 1.5}
    lines = paper_print.table_4(None, {"made": made, "variants": variants})
    assert any("9 steps of 4 out of 8 frames" in line and "2 other towns" in line for line in lines)
    assert "| without L_nll | 0.250 | 3.0 |" in lines
    row_of_full = (
        "| full, only Q_map | 0.100 / 0.200 | 0.600 / 1.200 | 0.300 / 0.600 | Tab. 4: .121"
    )
    assert any(line.startswith(row_of_full) for line in lines)
    assert "| without L_nll, mAP | -0.100 [-0.200, -0.050]* |  |  |" in lines
    told = "+0.200 [+0.100, +0.300]* | +0.100 [-0.100, +0.300] | +0.200 [+0.100, +0.300]* |"
    assert f"| without L_nll, only Q_map | {told}" in lines
