"""What stands behind a change: rivals side by side, evidence per drive, policies, false alarms."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fusion_scene import CRS, ORIGIN, drive, line, save, shifted, street

from rtmap_cli.formats.changes import ChangeEvent
from rtmap_cli.logs.run import MATCHED, NEW, Observations, Run
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.evidence import Counts, DriveEvidence, Policy, prior_log_odds
from rtmap_cli.maps.policy import read_policy
from rtmap_cli.maps.store import read_map, write_new_map
from rtmap_cli.steps.detect_changes.events import within_budget

Call = Callable[..., Any]

DAY = 86_400 * 10**9


def _told(
    rtmap: Call, tmp_path: Path, prior: VectorMap, runs: list[Any], *options: object, code: int = 0
) -> Any:
    write_new_map(prior, tmp_path / "map", "prior")
    folders = [save(r, tmp_path / "runs" / r.log_id) for r in runs]
    out = tmp_path / "changes.geojson"
    result = rtmap(
        "detect-changes", *folders, "--map", tmp_path / "map", "-o", out, *options, code=code
    )
    return json.loads(out.read_text())["features"] if code == 0 else result


def test_a_new_line_beside_one_of_the_map_is_told(rtmap: Call, tmp_path: Path) -> None:
    world = street(line("bike", "divider", 1.2, 30, 60))
    runs = [drive(world, f"d{k}", seed=k) for k in range(2)]
    (found,) = _told(rtmap, tmp_path, street(), runs)
    assert found["properties"]["kind"] == "insert" and found["properties"]["class"] == "divider"
    assert found["properties"]["traversals_seen"] == 2


def test_a_line_that_is_gone_beside_one_that_stays_is_told(rtmap: Call, tmp_path: Path) -> None:
    prior = street(line("bike", "divider", 1.2, 30, 60))
    runs = [drive(street(), f"d{k}", seed=k) for k in range(2)]
    (found,) = _told(rtmap, tmp_path, prior, runs)
    assert found["properties"]["kind"] == "delete"
    assert found["properties"]["element_id"] == "bike"


def test_two_lines_that_both_stay_are_no_change(rtmap: Call, tmp_path: Path) -> None:
    world = street(line("bike", "divider", 1.2, 30, 60))
    runs = [drive(world, f"d{k}", seed=k, noise=0.25) for k in range(2)]
    assert _told(rtmap, tmp_path, world, runs) == []


def test_every_change_carries_its_frames_runs_and_scores(rtmap: Call, tmp_path: Path) -> None:
    prior = street(without=["lane"])
    runs = [drive(street(), f"d{k}", seed=k) for k in range(2)]
    (found,) = _told(rtmap, tmp_path, prior, runs)
    evidence = found["properties"]["evidence"]
    assert [e["run"] for e in evidence] == ["d0", "d1"]
    for e, run in zip(evidence, runs, strict=True):
        assert 0 < e["frames_seen"] == len(e["seen_ns"]) <= e["frames_in_view"]
        assert set(e["seen_ns"]) <= set(run.frames.timestamp_ns.tolist())
        assert 0.6 <= e["score"] <= 0.9 and e["log_odds"] > 0 and e["found"]
    assert sum(e["frames_seen"] for e in evidence) == found["properties"]["frames_seen"]


def test_what_misses_says_so_drive_by_drive(rtmap: Call, tmp_path: Path) -> None:
    runs = [drive(street(without=["west"]), f"d{k}", seed=k) for k in range(2)]
    (found,) = _told(rtmap, tmp_path, street(), runs)
    for e in found["properties"]["evidence"]:
        assert e["frames_in_view"] > 5 and e["frames_seen"] == 0 and e["score"] is None
        assert e["log_odds"] < 0 and not e["found"]


def _deceived(run: Run, name: str, every: int) -> Run:
    """The run with the answer "it is there" about an element in every so many frames."""
    o = run.observations
    fooled = (o.element_id == name) & (o.frame % every == 0)
    return replace(
        run,
        observations=replace(
            o,
            state=np.where(fooled, MATCHED, o.state).astype(np.int8),
            score=np.where(fooled, 0.9, o.score).astype(np.float32),
            existence=np.where(fooled, 0.9, o.existence).astype(np.float32),
        ),
    )


def test_a_network_that_the_map_deceives_now_and_then_is_not_believed(
    rtmap: Call, tmp_path: Path
) -> None:
    # It finds what it is asked about nearly always; once in five frames is no sign of worn paint.
    prior, world = street(), street(without=["west", "lane"])
    runs = [drive(world, f"d{k}", seed=k, prior=prior) for k in range(2)]
    runs = [_deceived(_deceived(r, "lane", 5), "west", 5) for r in runs]
    found = _told(rtmap, tmp_path, prior, runs)
    assert {(c["properties"]["kind"], c["properties"]["element_id"]) for c in found} == {
        ("delete", "west"), ("delete", "lane"),
    }  # fmt: skip
    for c in found:
        # "It is gone" is no find, "it is there" is.
        share = c["properties"]["frames_seen"] / c["properties"]["frames_in_view"]
        assert 0.1 < share < 0.4 and c["properties"]["probability"] > 0.8


def test_what_a_network_sees_that_was_not_asked_is_found_less_often(
    rtmap: Call, tmp_path: Path
) -> None:
    # What it is asked about it finds in all frames, what is new in half of them.
    prior = street(without=["west"])
    runs = [drive(street(), f"d{k}", seed=k, prior=prior, found=0.45) for k in range(2)]
    (found,) = _told(rtmap, tmp_path, prior, runs)
    assert (found["properties"]["kind"], found["properties"]["class"]) == ("insert", "ped_crossing")


def test_an_answer_about_a_line_is_no_line_of_its_own(rtmap: Call, tmp_path: Path) -> None:
    # The map is off by 0.6 m: what the network says of a line must not make a second one beside it.
    prior = shifted(street(), 0.0, 0.6)
    runs = [drive(street(), f"d{k}", seed=k, prior=prior) for k in range(2)]
    for k, run in enumerate(runs):
        # Answers lie where the lines are, and a doubtful second find lies on the map's line.
        o = run.observations
        answers = o.select(np.isfinite(o.existence) & (o.class_name == "divider"))
        doubtful = replace(
            answers,
            state=np.full(len(answers), NEW, np.int8),
            score=np.full(len(answers), 0.25, np.float32),
            existence=np.full(len(answers), np.nan, np.float32),
            element_id=np.full(len(answers), None),
            prior_points=np.full_like(answers.prior_points, np.nan),
        )
        moved = np.where(
            o.existence[:, None, None] > 0, o.points - np.float32([0.0, 0.6]), o.points
        )
        joined = Observations.concatenate([replace(o, points=moved.astype(np.float32)), doubtful])
        runs[k] = replace(run, observations=joined)
    assert _told(rtmap, tmp_path, prior, runs) == []


def test_a_drive_that_never_looks_leaves_existence_as_it_is(rtmap: Call, tmp_path: Path) -> None:
    write_new_map(street(), tmp_path / "map", "prior")
    base = ("crowdsource", tmp_path / "runs", "--map", tmp_path / "map")
    save(drive(street(), "d0"), tmp_path / "runs" / "d0")
    rtmap(*base)
    before = read_map(tmp_path / "map").by_id()["east"]
    # 40 m of street, the crossing lies 20 m beyond the range of its last frame.
    save(drive(street(), "d1", seed=1, span=(0.0, 25.0)), tmp_path / "runs" / "d1")
    rtmap(*base)
    after = read_map(tmp_path / "map").by_id()
    assert after["east"].existence == before.existence
    assert (after["east"].in_view, after["east"].traversals) == (before.in_view, 1)
    assert after["west"].traversals == 2 and after["west"].existence > before.existence


def test_a_stretch_goes_from_a_line_that_was_sure_drive_by_drive(
    rtmap: Call, tmp_path: Path
) -> None:
    write_new_map(street(), tmp_path / "map", "prior")
    base = ("crowdsource", tmp_path / "runs", "--map", tmp_path / "map")
    for k in range(4):
        save(drive(street(), f"d{k}", seed=k), tmp_path / "runs" / f"d{k}")
    rtmap(*base)
    sure = read_map(tmp_path / "map").by_id()["lane"]
    assert sure.existence > 8
    world = street(
        line("lane-a", "divider", 3.5, -20, 40), line("lane-b", "divider", 3.5, 60, 120),
        without=["lane"],
    )  # fmt: skip
    for k in (4, 5):
        save(drive(world, f"d{k}", seed=k), tmp_path / "runs" / f"d{k}")
        rtmap(*base)
    rest = read_map(tmp_path / "map").of_class("divider")
    x = np.concatenate([e.xy[:, 0] - ORIGIN[0] for e in rest if e.xy[0, 1] - ORIGIN[1] > 2])
    assert len(x) and not ((x > 44) & (x < 56)).any()
    assert x.min() < -15 and x.max() > 115


def _event(name: str, p: float) -> ChangeEvent:
    return ChangeEvent(name, "insert", "divider", None, np.zeros((2, 2)), p, 0.0, Counts())


def test_as_many_changes_as_the_expected_false_alarms_allow() -> None:
    events = [_event("a", 0.99), _event("b", 0.9), _event("c", 0.6), _event("d", 0.9)]

    def told(per_km: float) -> list[str]:
        return [e.change_id for e in within_budget(events, 2.0, per_km)]

    assert told(0.005) == ["a"] and told(0.0) == []
    # b and d are equally probable: 0.01 + 0.1 allows one of them, which says nothing.
    assert told(0.06) == ["a"]
    assert told(0.11) == ["a", "b", "d"] and told(1.0) == ["a", "b", "d", "c"]


def test_the_budget_of_false_alarms_on_the_command_line(rtmap: Call, tmp_path: Path) -> None:
    runs = [drive(street(without=["west"]), f"d{k}", seed=k) for k in range(3)]
    assert len(_told(rtmap, tmp_path / "a", street(), runs, "--max-false-alarms-per-km", 1)) == 1
    assert _told(rtmap, tmp_path / "b", street(), runs, "--max-false-alarms-per-km", 0) == []


def test_a_policy_file_decides_and_the_command_line_above_it(rtmap: Call, tmp_path: Path) -> None:
    policy = tmp_path / "policy.toml"
    policy.write_text("[tell]\nmin_probability = 1.0\n[evidence]\nprior_log_odds = 1.0\n")
    runs = [drive(street(without=["west"]), f"d{k}", seed=k) for k in range(2)]
    assert _told(rtmap, tmp_path / "a", street(), runs, "--policy", policy) == []
    options = ("--policy", policy, "--min-probability", 0.5)
    (found,) = _told(rtmap, tmp_path / "b", street(), runs, *options)
    (usual,) = _told(rtmap, tmp_path / "c", street(), runs)
    difference = usual["properties"]["log_odds"] - found["properties"]["log_odds"]
    assert difference == pytest.approx(1.0 - Policy().prior_log_odds, abs=1e-3)


def test_what_a_policy_file_leaves_out_is_the_default(tmp_path: Path) -> None:
    path = tmp_path / "policy.toml"
    path.write_text("")
    assert read_policy(path) == Policy()
    path.write_text("[delete]\ntraversals = 3\nof = 4\n[age]\nhalf_life_days = 30\n")
    policy = read_policy(path)
    assert (policy.delete_traversals, policy.delete_of, policy.half_life_days) == (3, 4, 30.0)
    assert policy.insert_above == Policy().insert_above


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("[delete", "TOML"),
        ("[remove]\nbelow = 0.1", "remove"),
        ("delete = 3", "table"),
        ("[delete]\nunder = 0.1", "under"),
        ("[delete]\nbelow = 1.5", "below"),
        ("[delete]\nbelow = nan", "below"),
        ("[delete]\nbelow = true", "below"),
        ("[delete]\ntraversals = 1.5", "whole"),
        ("[delete]\ntraversals = 6", "exceed"),
        ("[delete]\nbelow = 0.9", "insert"),
    ],
)
def test_a_bad_policy_is_one_line(rtmap: Call, tmp_path: Path, text: str, word: str) -> None:
    path = tmp_path / "policy.toml"
    path.write_text(text)
    runs = [drive(street(), "d0")]
    result = _told(rtmap, tmp_path, street(), runs, "--policy", path, code=3)
    assert word in result.err and len(result.err.strip().splitlines()) == 1
    assert not (tmp_path / "changes.geojson").exists()


def _vote(time: int, seen: bool, looked: bool = True) -> DriveEvidence:
    return DriveEvidence(f"r{time}", time, 9, 9 * seen, (), None, 0.0, looked, seen)


def test_the_newest_drives_that_looked_are_counted() -> None:
    drives = (_vote(1, True), _vote(2, True), _vote(3, False), _vote(4, False, False))
    counts = Counts(drives=(*drives, _vote(5, False)))
    assert counts.newest(2) == (0, 2)
    assert counts.newest(3) == (1, 3)
    assert counts.newest(0) == (2, 4)


def test_what_a_map_says_fades_with_age() -> None:
    old = Element(
        "e", "divider", np.zeros((2, 2)), existence=6.0, traversals=3, last_seen_ns=100 * DAY
    )
    lasting, fading = Policy(vanish=0.0), Policy(vanish=0.0, half_life_days=30.0)
    assert prior_log_odds(old, lasting, 130 * DAY) == pytest.approx(6.0)
    assert prior_log_odds(old, fading, 130 * DAY) == pytest.approx(3.0)
    assert prior_log_odds(old, fading, 100 * DAY) == pytest.approx(6.0)
    # The surest element may have gone with a chance of 1 %.
    assert prior_log_odds(old, Policy(), 130 * DAY) < np.log(99) < 6.0
    fresh = Element("e", "divider", np.zeros((2, 2)))
    assert prior_log_odds(fresh, fading, 130 * DAY) == Policy().prior_log_odds


def test_runs_in_another_crs_are_still_refused(rtmap: Call, tmp_path: Path) -> None:
    other = drive(street(), "d0", crs="EPSG:32618")
    assert other.crs != CRS
    assert "EPSG" in _told(rtmap, tmp_path, street(), [other], code=3).err
