"""crowdsource every night over an imported prior: what versions keep of the nights before."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fusion_scene import ORIGIN, drive, line, save, shifted, street

from rtmap_cli.logs.run import Run
from rtmap_cli.maps.existence import (
    VoteModel,
    drive_log_likelihoods,
    log_odds_of,
    probability,
    remembered,
)
from rtmap_cli.maps.store import read_map, write_new_map

Call = Callable[..., Any]


def _night(rtmap: Call, run: Run, folder: Path, *more: str | Path) -> dict[str, Any]:
    """One run more, fused into the map of the folder."""
    save(run, folder / "runs" / run.log_id)
    told = rtmap("crowdsource", folder / "runs", "--map", folder / "map", "--json", *more).out
    return dict(json.loads(told))


def test_lines_that_meet_stay_together_when_one_was_out_of_view(
    rtmap: Call, tmp_path: Path
) -> None:
    prior = street(
        line("near", "divider", 3.5, -20, 50), line("far", "divider", 3.5, 50, 120),
        without=["lane"],
    )  # fmt: skip
    write_new_map(shifted(prior, 0.0, 0.3), tmp_path / "map", "prior")
    joint = read_map(tmp_path / "map").by_id()["far"].xy[0]
    # 36 m ahead of the last frame is x = 51: of the far line less than anybody reports.
    for k in range(2):
        _night(rtmap, drive(street(), f"d{k}", seed=k, span=(0.0, 16.0)), tmp_path)
        after = read_map(tmp_path / "map").by_id()
        assert after["far"].traversals == 0
        assert np.array_equal(after["far"].xy[0], joint)
        assert np.array_equal(after["near"].xy[-1], joint)
    seen = after["near"].xy[after["near"].xy[:, 0] < ORIGIN[0] + 40]
    assert np.abs(seen[4:, 1] - ORIGIN[1] - 3.5).max() < 0.15
    # A drive that sees both moves both.
    _night(rtmap, drive(street(), "d2", seed=2), tmp_path)
    after = read_map(tmp_path / "map").by_id()
    assert after["far"].traversals == 1
    assert np.array_equal(after["near"].xy[-1], after["far"].xy[0])
    assert not np.array_equal(after["far"].xy[0], joint)


def test_one_night_takes_nothing_that_many_have_seen(rtmap: Call, tmp_path: Path) -> None:
    write_new_map(street(), tmp_path / "map", "prior")
    for k in range(3):
        _night(rtmap, drive(street(), f"d{k}", seed=k), tmp_path)
    gone, hasty = street(without=["west"]), tmp_path / "policy.toml"
    hasty.write_text("[delete]\nbelow = 0.5\n")
    told = _night(rtmap, drive(gone, "d3", seed=3), tmp_path, "--policy", hasty)
    doubt = read_map(tmp_path / "map").by_id()["west"]
    assert probability(doubt.existence) < 0.5 and len(doubt.runs) == 3 and doubt.traversals == 4
    assert told["deleted"] == []
    told = _night(rtmap, drive(gone, "d4", seed=4), tmp_path, "--policy", hasty)
    assert told["deleted"] == ["west"]


def _seldom(run: Run, share: float, seed: int) -> Run:
    """The run with the divider at y = 3.5 found in that share of the frames that found it."""
    o = run.observations
    own = (o.class_name == "divider") & (o.points[..., 1].mean(axis=1) > 3.0)
    keep = ~own | (np.random.default_rng(seed).random(len(o)) < share)
    return replace(run, observations=o.select(keep))


def test_what_is_hard_to_see_is_remembered(rtmap: Call, tmp_path: Path) -> None:
    """A worn line is found in a fifth of the frames, and one night not at all."""
    write_new_map(street(), tmp_path / "map", "prior")
    for k in range(5):
        share = 0.0 if k == 4 else 0.2
        _night(rtmap, _seldom(drive(street(), f"d{k}", seed=k), share, k), tmp_path)
        worn = read_map(tmp_path / "map").by_id()["lane"]
    assert worn.traversals == 5 and probability(worn.existence) > 0.5
    # A line that was seen well and then not at all is in doubt.
    assert probability(_well_seen_once(rtmap, tmp_path / "well")) < 0.4


def _well_seen_once(rtmap: Call, folder: Path) -> float:
    write_new_map(street(), folder / "map", "prior")
    for k in range(3):
        _night(rtmap, _seldom(drive(street(), f"d{k}", seed=k), float(k < 2), k), folder)
    return float(read_map(folder / "map").by_id()["lane"].existence)


@pytest.mark.parametrize("seen", [2.0, 4.0, 12.0])
def test_nights_add_up_to_what_all_drives_say_at_once(seen: float) -> None:
    """Four drives like each other and a fifth: existence after both steps is that of one."""
    model = VoteModel()
    first = drive_log_likelihoods(np.array([seen]), np.array([20.0]), model)
    last = drive_log_likelihoods(np.array([1.0]), np.array([15.0]), model)
    at_once = log_odds_of(4 * first + last, model)
    memory = remembered(np.array([4 * seen]), np.array([80.0]), np.array([4]), model)
    nightly = log_odds_of(4 * first, model) + log_odds_of(last + memory, model)
    easy = log_odds_of(4 * first, model) + log_odds_of(last, model)
    if seen < 12:
        assert nightly == pytest.approx(at_once, abs=1e-6) and nightly > easy + 0.5
    else:
        # Parts of a line that is seen well may be hard to see: the usual share stays.
        assert nightly == pytest.approx(easy) and nightly >= at_once


def test_versions_become_surer_as_one_batch_does(rtmap: Call, tmp_path: Path) -> None:
    for folder in ("nightly", "batch"):
        write_new_map(shifted(street(), 0.0, 0.2), tmp_path / folder / "map", "prior")
    for k in range(6):
        run = drive(street(), f"d{k}", seed=k)
        save(run, tmp_path / "batch" / "runs" / run.log_id)
        _night(rtmap, run, tmp_path / "nightly")
    rtmap("crowdsource", tmp_path / "batch" / "runs", "--map", tmp_path / "batch" / "map")
    sigma, error = {}, {}
    for folder in ("nightly", "batch"):
        e = read_map(tmp_path / folder / "map").by_id()["middle"]
        assert e.covariance is not None
        inner = (e.xy[:, 0] > ORIGIN[0]) & (e.xy[:, 0] < ORIGIN[0] + 100)
        sigma[folder] = float(np.sqrt(e.covariance[inner, 2]).mean())
        error[folder] = float(np.abs(e.xy[inner, 1] - ORIGIN[1]).mean())
    assert 0.05 <= sigma["nightly"] < 1.25 * sigma["batch"]
    # If the newest night counted as much as all before it, it would be 0.044 m off.
    assert error["batch"] < 0.02 and error["nightly"] < 0.035


def test_runs_that_are_missing_are_told(rtmap: Call, tmp_path: Path) -> None:
    """A map from runs alone wants all of them; one with a prior those that saw what waits."""
    world = street(line("new", "divider", -3.5, 20, 80))
    write_new_map(street(), tmp_path / "map", "prior")
    for k in range(4):
        run = drive(world if k == 1 else street(), f"d{k}", seed=k)
        save(run, tmp_path / "each" / f"{k}" / run.log_id)
    said = []
    for name in ("map", "alone"):
        for k in range(3):
            each = tmp_path / "each" / f"{k}"
            said.append(rtmap("crowdsource", each, "--map", tmp_path / name).err)
    told = [s.splitlines() for s in said]
    assert told[0] == told[1] == told[3] == []
    assert len(told[2]) == 1 and "1 new elements that wait" in told[2][0]
    assert len(told[4]) == len(told[5]) == 1 and "2 runs that" in told[5][0]
    assert "fused anew from all of them" in told[5][0] and "first: d0" in told[5][0]
