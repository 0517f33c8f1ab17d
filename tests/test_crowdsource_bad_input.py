"""crowdsource and bad input: corrupt, doubled and stray runs, other models, versions and clocks."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fusion_scene import ORIGIN, drive, line, save, street

from rtmap_cli.logs.run import Run, RunFrames
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import fused_runs, read_map, write_new_map

Call = Callable[..., Any]


def _moved(run: Run, x: float, y: float) -> Run:
    """The run with all its poses elsewhere: what it saw moves with it."""
    initial = run.frames.initial.copy()
    initial[:, :2, 3] += [x, y]
    poses = run.poses
    if poses is not None:
        pose = poses.pose.copy()
        pose[:, :2, 3] += [x, y]
        poses = replace(poses, pose=pose)
    return replace(run, frames=replace(run.frames, initial=initial), poses=poses)


def _some(run: Run, rows: Any) -> Run:
    """The first frames of a run."""
    f, o = run.frames, run.observations
    frames = RunFrames(*(getattr(f, n)[rows] for n in RunFrames.__dataclass_fields__))
    return replace(run, frames=frames, observations=o.select(np.isin(o.frame, frames.frame)))


def _shaken(path: Path) -> None:
    """Bytes in the middle of a file turned around: its head and foot are whole."""
    data = bytearray(path.read_bytes())
    middle = slice(len(data) // 4, len(data) // 2)
    data[middle] = bytes(b ^ 0x5A for b in data[middle])
    path.write_bytes(bytes(data))


@pytest.mark.parametrize("how", ["cut off", "shaken", "no frames", "no json"])
def test_one_corrupt_run_among_a_hundred(rtmap: Call, tmp_path: Path, how: str) -> None:
    base = drive(street(), "d", span=(0.0, 25.0))
    count = 100 if how == "shaken" else 50
    for k in range(count):
        times = base.frames.timestamp_ns + k * 10**12
        run = replace(base, info=base.info | {"log_id": f"d{k:02d}"}, poses=None)
        save(replace(run, frames=replace(base.frames, timestamp_ns=times)), tmp_path / f"r/{k:02d}")
    broken = tmp_path / "r/41"
    if how == "cut off":
        data = (broken / "observations.parquet").read_bytes()
        (broken / "observations.parquet").write_bytes(data[: len(data) // 2])
    if how == "shaken":
        _shaken(broken / "observations.parquet")
    if how == "no frames":
        (broken / "frames.parquet").unlink()
    if how == "no json":
        (broken / "run.json").write_text("{")
    told = rtmap("crowdsource", tmp_path / "r", "--map", tmp_path / "map", code=3).err
    assert "r/41" in told and len([x for x in told.splitlines() if x.startswith("rtmap:")]) == 1
    assert not (tmp_path / "map").exists()
    if how == "shaken":
        skip = ["--skip-bad-runs", "--json"]
        told = rtmap("crowdsource", tmp_path / "r", "--map", tmp_path / "map", *skip)
        result = json.loads(told.out)
        assert len(result["runs"]) == 99 and "d41" not in result["runs"]
        assert len(result["bad_runs"]) == 1 and "r/41" in told.err
        assert fused_runs(tmp_path / "map") == {f"d{k:02d}" for k in range(100) if k != 41}


def test_a_copied_run_counts_once(rtmap: Call, tmp_path: Path) -> None:
    run = drive(street(), "d0")
    save(run, tmp_path / "runs/a")
    save(replace(run, info=run.info | {"log_id": "renamed"}), tmp_path / "runs/b")
    told = rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map", code=3).err
    assert "runs/b" in told and "runs/a" in told
    skip = rtmap(
        "crowdsource", tmp_path / "runs", "--map", tmp_path / "map", "--skip-bad-runs", "--json"
    )
    assert json.loads(skip.out)["runs"] == ["d0"]
    assert all(e.traversals == 1 for e in read_map(tmp_path / "map"))


@pytest.mark.parametrize("localized", [True, False])
def test_a_traversal_that_is_20_m_off_a_map_is_left_out(
    rtmap: Call, tmp_path: Path, localized: bool
) -> None:
    for name in ("with", "without"):
        write_new_map(street(), tmp_path / name, "prior")
    for k in range(2):
        run = drive(street(), f"d{k}", seed=k, localized=localized)
        for folder in ("all", "good"):
            save(run, tmp_path / folder / run.log_id)
    off = _moved(drive(street(), "stray", seed=5, localized=localized), 0.0, 20.0)
    save(off, tmp_path / "all/stray")
    told = rtmap("crowdsource", tmp_path / "all", "--map", tmp_path / "with", "--json")
    result = json.loads(told.out)
    assert result["astray_runs"] == ["stray"] and result["runs"] == ["d0", "d1"]
    metres = re.search(r"stray: what it saw lies (\d+) m off", told.err)
    assert metres is not None and abs(int(metres[1]) - 20) <= 2
    rtmap("crowdsource", tmp_path / "good", "--map", tmp_path / "without")
    good, same = read_map(tmp_path / "without").by_id(), read_map(tmp_path / "with").by_id()
    assert set(good) == set(same)
    assert all(np.array_equal(e.points, same[n].points, equal_nan=True) for n, e in good.items())
    # Localized again it can be fused: it is not among the runs that the map knows.
    assert fused_runs(tmp_path / "with") == {"d0", "d1"}


def test_a_stray_traversal_of_a_first_map_is_found_by_the_others(
    rtmap: Call, tmp_path: Path
) -> None:
    for k in range(3):
        save(drive(street(), f"d{k}", seed=k), tmp_path / "runs" / f"d{k}")
    save(_moved(drive(street(), "stray", seed=5), 0.0, -20.0), tmp_path / "runs/stray")
    told = rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map", "--json")
    assert json.loads(told.out)["astray_runs"] == ["stray"]
    lines = [e for e in read_map(tmp_path / "map") if e.class_name != "ped_crossing"]
    y = sorted(round(float(np.median(e.xy[:, 1] - ORIGIN[1])) * 2) / 2 for e in lines)
    assert y == [-7.0, 0.0, 3.5, 7.0]


def test_two_that_contradict_each_other_are_told_and_both_count(
    rtmap: Call, tmp_path: Path
) -> None:
    save(drive(street(), "d0"), tmp_path / "runs/d0")
    save(_moved(drive(street(), "d1", seed=1), 0.0, 20.0), tmp_path / "runs/d1")
    told = rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map", "--json")
    result = json.loads(told.out)
    assert result["astray_runs"] == result["runs"] == ["d0", "d1"]
    assert told.err.count("it counts") == 2


def test_a_new_road_beside_an_old_one_is_no_error_of_two_runs(rtmap: Call, tmp_path: Path) -> None:
    write_new_map(street(), tmp_path / "map", "prior")
    for k in range(2):
        save(_moved(drive(street(), f"d{k}", seed=k), 0.0, 22.0), tmp_path / f"runs/d{k}")
    told = rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map", "--json")
    result = json.loads(told.out)
    assert result["astray_runs"] == result["runs"] == ["d0", "d1"]
    assert result["counts"]["inserted"] > 0 and told.err.count("it counts") == 2


def test_when_all_runs_are_astray_there_is_no_answer(rtmap: Call, tmp_path: Path) -> None:
    write_new_map(street(), tmp_path / "map", "prior")
    save(_moved(drive(street(), "d0"), 0.0, 20.0), tmp_path / "runs/d0")
    told = rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map", code=4).err
    assert "elsewhere" in told and read_map(tmp_path / "map").version == 0


def test_clocks_that_jump(rtmap: Call, tmp_path: Path) -> None:
    run = drive(street(), "d0")
    times = run.frames.timestamp_ns.copy()
    times[20:] += 3600 * 10**9
    save(replace(run, frames=replace(run.frames, timestamp_ns=times)), tmp_path / "ahead/d0")
    rtmap("crowdsource", tmp_path / "ahead", "--map", tmp_path / "map")
    assert len(read_map(tmp_path / "map")) == 6
    times[30:] -= 7200 * 10**9
    save(replace(run, frames=replace(run.frames, timestamp_ns=times)), tmp_path / "back/d0")
    told = rtmap("crowdsource", tmp_path / "back", "--map", tmp_path / "other", code=3).err
    assert "sorted by time" in told and not (tmp_path / "other").exists()


@pytest.mark.parametrize("how", ["none", "nan", "lost"])
def test_a_run_without_any_pose(rtmap: Call, tmp_path: Path, how: str) -> None:
    run = drive(street(), "d0")
    if how == "none":
        run = _some(replace(run, poses=None), np.zeros(len(run.frames), bool))
    if how == "nan":
        bad = np.full_like(run.frames.initial, np.nan)
        run = replace(run, frames=replace(run.frames, initial=bad))
    if how == "lost":
        assert run.poses is not None
        status = np.full(len(run.poses), "no-match", object)
        run = replace(run, poses=replace(run.poses, status=status))
    save(run, tmp_path / "runs/d0")
    told = rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map", code=3).err
    assert "pose" in told and len(told.strip().splitlines()) == 1


def test_other_models_and_versions_are_told(rtmap: Call, tmp_path: Path) -> None:
    write_new_map(street(), tmp_path / "map", "prior")
    for k, sha in enumerate(("ab", "cd")):
        run = drive(street(), f"d{k}", seed=k, prior=street() if k else None)
        more = {"model_sha256": sha * 32, "map_version": 7 * k}
        save(replace(run, info=run.info | more), tmp_path / f"runs/d{k}")
    told = rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map").err
    assert "2 models" in told and "version 7" in told
    after = read_map(tmp_path / "map")
    assert {e.model_sha256 for e in after} == {"cd" * 32}


def test_a_model_that_does_not_know_a_class_says_nothing_of_it(rtmap: Call, tmp_path: Path) -> None:
    world = street(without=["west", "east"])
    write_new_map(street(), tmp_path / "map", "prior")
    for k in range(3):
        run = drive(world, f"d{k}", seed=k)
        lines = run.info | {"classes": ["divider", "boundary"]}
        save(replace(run, info=lines), tmp_path / f"runs/d{k}")
    rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map")
    after = read_map(tmp_path / "map").by_id()
    assert len(after) == 6 and after["west"].in_view == 0 and after["left"].in_view > 0
    # One that knows it has looked, and alone is not enough to delete.
    save(drive(world, "able", seed=7), tmp_path / "runs/able")
    rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map")
    seen = read_map(tmp_path / "map").by_id()["west"]
    assert seen.traversals == 1 and seen.existence < 2.5


def test_maps_of_two_vendors_that_overlap(rtmap: Call, tmp_path: Path) -> None:
    """Every line twice, 0.4 m apart, under other ids: nothing breaks, nothing new is invented."""
    other = [
        e.with_points(e.points + [0.0, 0.4, 0.0]) for e in street() if e.class_name == "boundary"
    ]
    twice = [replace(e, element_id=f"vendor-{e.element_id}") for e in other]
    write_new_map(street(*twice), tmp_path / "map", "two vendors")
    for k in range(3):
        save(drive(street(), f"d{k}", seed=k), tmp_path / f"runs/d{k}")
    told = json.loads(
        rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map", "--json").out
    )
    assert told["counts"]["inserted"] == 0
    after = read_map(tmp_path / "map").by_id()
    assert set(street().by_id()) <= set(after)


def test_an_area_that_the_prior_does_not_cover_is_mapped(rtmap: Call, tmp_path: Path) -> None:
    """The prior ends halfway: it stays, and what is beyond comes from the first drives."""
    half = [
        line("left", "boundary", 7.0, -20, 40),
        line("right", "boundary", -7.0, -20, 40),
    ]
    write_new_map(VectorMap(half, street().crs), tmp_path / "map", "half")
    for k in range(2):
        save(drive(street(), f"d{k}", seed=k), tmp_path / f"runs/d{k}")
    rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map")
    after = read_map(tmp_path / "map")
    assert {"left", "right"} <= set(after.by_id()) and len(after.of_class("divider")) == 2
    far = max(float(e.xy[:, 0].max()) for e in after.of_class("boundary")) - ORIGIN[0]
    assert far > 110


@pytest.mark.parametrize("wrong", [["--engine", "dask"], ["--scheduler", "tcp://a:1"]])
def test_options_that_cannot_be_meant(rtmap: Call, tmp_path: Path, wrong: list[str]) -> None:
    save(drive(street(), "d0", span=(0.0, 10.0)), tmp_path / "runs/d0")
    told = rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map", *wrong, code=2).err
    assert len(told.strip().splitlines()) == 1 and not (tmp_path / "map").exists()
