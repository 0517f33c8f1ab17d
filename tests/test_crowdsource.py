"""crowdsource through the command line: first maps, maintenance, recursion, bad input."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from fusion_scene import CRS, ORIGIN, crossing, drive, line, save, shifted, street

from rtmap_cli.geometry.polylines import resample_step
from rtmap_cli.logs.run import Run
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import fused_runs, history, read_map, write_new_map

Call = Callable[..., Any]

LINES = (7.0, -7.0, 0.0, 3.5)
"""Where the lines of the street lie."""


def _runs(world: VectorMap, folder: Path, seeds: Sequence[int], **how: Any) -> list[Run]:
    runs = [drive(world, f"d{k}", seed=k, **how) for k in seeds]
    for run in runs:
        save(run, folder / run.log_id)
    return runs


def _digest(folder: Path) -> str:
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return hashlib.sha256(b"".join(str(p).encode() + p.read_bytes() for p in files)).hexdigest()


def _across(vector_map: VectorMap, class_name: str) -> dict[float, float]:
    """Of every line of a class its mean y on the street, and its largest error from it."""
    out = {}
    for e in vector_map.of_class(class_name):
        y = e.xy[:, 1] - ORIGIN[1]
        out[round(float(np.median(y)) * 2) / 2] = float(
            np.abs(y - np.round(np.median(y) * 2) / 2).max()
        )
    return out


def test_the_first_map_comes_from_one_drive_alone(rtmap: Call, tmp_path: Path) -> None:
    _runs(street(), tmp_path / "runs", [0])
    told = json.loads(
        rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map", "--json").out
    )
    assert told["version"] == 0 and told["counts"]["inserted"] == 6
    made = read_map(tmp_path / "map")
    assert made.crs == CRS
    for name, expected in (("divider", [0.0, 3.5]), ("boundary", [-7.0, 7.0])):
        errors = _across(made, name)
        assert sorted(errors) == expected, name
        assert max(errors.values()) < 0.25
    centres = sorted((e.xy[:-1].mean(axis=0) - ORIGIN)[0] for e in made.of_class("ped_crossing"))
    assert np.allclose(centres, [22, 82], atol=0.4)
    for e in made:
        assert e.covariance is not None and np.isfinite(e.covariance[:, :3]).all()
        assert (e.covariance[:, 0] > 0).all() and np.isnan(e.points[:, 2]).all()
        assert e.seen > 0 and e.in_view >= e.seen and e.traversals == 1 and e.runs == ("d0",)
        assert e.model_sha256 == "ab" * 32 and e.existence > 0


def test_one_line_that_no_frame_sees_whole_becomes_one_element(rtmap: Call, tmp_path: Path) -> None:
    world = VectorMap([line("long", "divider", 3.0, -30, 260)], CRS)
    _runs(world, tmp_path / "runs", [0], span=(0.0, 230.0))
    rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map")
    (only,) = read_map(tmp_path / "map")
    x = only.xy[:, 0] - ORIGIN[0]
    assert x.min() < -20 and x.max() > 250
    # No zig-zag: the line never turns back.
    assert (np.diff(np.sort(x)) > 0).all() and (np.all(np.diff(x) > 0) or np.all(np.diff(x) < 0))


def test_drives_pull_a_displaced_prior_to_the_truth(rtmap: Call, tmp_path: Path) -> None:
    prior = shifted(street(), 0.2, 0.3)
    write_new_map(prior, tmp_path / "map", "prior")
    _runs(street(), tmp_path / "runs", range(3))
    rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map")
    after = read_map(tmp_path / "map").by_id()
    assert set(after) == {e.element_id for e in prior}
    for name, y in (("left", 7.0), ("right", -7.0), ("middle", 0.0), ("lane", 3.5)):
        e = after[name]
        assert len(e.points) == len(prior.by_id()[name].points)
        seen = (e.xy[:, 0] > ORIGIN[0] - 10) & (e.xy[:, 0] < ORIGIN[0] + 110)
        error = np.abs(e.xy[seen, 1] - ORIGIN[1] - y)
        assert error.max() < 0.15
        # Across the line the vertex became surer, along it nothing was learnt.
        assert e.covariance is not None
        assert (e.covariance[seen, 2] < 0.3**2 / 4).all()
        assert np.allclose(e.covariance[seen, 0], 0.3**2, rtol=0.1)
        assert np.allclose(e.xy[seen, 0], prior.by_id()[name].xy[seen, 0], atol=0.02)
    # A crossing is fixed in both directions.
    ring = after["west"].xy[:-1] - ORIGIN
    assert np.hypot(*(ring.mean(axis=0) - [22, 0]).T) < 0.12


def test_a_new_element_waits_for_a_second_drive_and_comes_by_recursion(
    rtmap: Call, tmp_path: Path
) -> None:
    world = street(crossing("new", 50.0))
    write_new_map(street(), tmp_path / "map", "prior")
    runs = tmp_path / "runs"
    base = ("crowdsource", runs, "--map", tmp_path / "map", "--json")
    _runs(world, runs, [0])
    first = json.loads(rtmap(*base).out)
    assert first["counts"]["waiting"] == 1 and first["counts"]["inserted"] == 0
    _runs(world, runs, [1])
    second = json.loads(rtmap(*base).out)
    assert second["runs"] == ["d1"] and second["known_runs"] == ["d0"]
    assert second["counts"]["inserted"] == 1 and second["version"] == 2
    (name,) = second["inserted"]
    new = read_map(tmp_path / "map").by_id()[name]
    assert new.runs == ("d0", "d1") and new.traversals == 2
    # What the first run said about known elements counted once.
    assert read_map(tmp_path / "map").by_id()["middle"].traversals == 2


def test_a_policy_file_says_how_many_drives_must_agree(rtmap: Call, tmp_path: Path) -> None:
    write_new_map(street(), tmp_path / "map", "prior")
    _runs(street(crossing("new", 50.0)), tmp_path / "runs", range(2))
    policy = tmp_path / "policy.toml"
    policy.write_text("[insert]\ntraversals = 3\n")
    base = ("crowdsource", tmp_path / "runs", "--map", tmp_path / "map", "--dry-run", "--json")
    assert json.loads(rtmap(*base).out)["counts"]["inserted"] == 1
    counts = json.loads(rtmap(*base, "--policy", policy).out)["counts"]
    assert counts["inserted"] == 0 and counts["waiting"] == 1
    policy.write_text("[insert]\ntraversal = 3\n")
    assert "traversal" in rtmap(*base, "--policy", policy, code=3).err


def test_a_first_map_may_keep_what_is_improbable_as_such(rtmap: Call, tmp_path: Path) -> None:
    # The second drive passes and sees no crossing: one against one.
    _runs(street(crossing("new", 50.0)), tmp_path / "runs", [0])
    _runs(street(), tmp_path / "runs", [1])
    policy = tmp_path / "policy.toml"
    policy.write_text("[insert]\ntraversals = 1\nfirst = 0.0\n")
    runs, made = tmp_path / "runs", tmp_path / "map"
    rtmap("crowdsource", runs, "--map", made, "--policy", policy)
    near = [e for e in read_map(made).of_class("ped_crossing") if abs(_middle(e) - 50.0) < 3]
    assert len(near) == 1 and near[0].existence < 0
    policy.write_text("[insert]\ntraversals = 1\nfirst = 0.5\n")
    rtmap("crowdsource", runs, "--map", tmp_path / "strict", "--policy", policy)
    strict = read_map(tmp_path / "strict").of_class("ped_crossing")
    assert not [e for e in strict if abs(_middle(e) - 50.0) < 3]


def _middle(element: Any) -> float:
    return float(element.xy[:-1, 0].mean() - ORIGIN[0])


def test_a_deleted_crossing_goes_after_two_drives_in_two_cycles(
    rtmap: Call, tmp_path: Path
) -> None:
    world = street(without=["west"])
    write_new_map(street(), tmp_path / "map", "prior")
    runs = tmp_path / "runs"
    base = ("crowdsource", runs, "--map", tmp_path / "map", "--json")
    _runs(world, runs, [0])
    assert json.loads(rtmap(*base).out)["deleted"] == []
    doubt = read_map(tmp_path / "map").by_id()["west"]
    assert doubt.existence < 1 and doubt.traversals == 1 and doubt.seen == 0
    _runs(world, runs, [1])
    assert json.loads(rtmap(*base).out)["deleted"] == ["west"]
    assert "west" not in read_map(tmp_path / "map").by_id()
    assert "west" in read_map(tmp_path / "map", 1).by_id()


def test_a_deleted_stretch_leaves_the_rest_of_the_line(rtmap: Call, tmp_path: Path) -> None:
    world = street(
        line("lane-a", "divider", 3.5, -20, 40), line("lane-b", "divider", 3.5, 60, 120),
        without=["lane"],
    )  # fmt: skip
    write_new_map(street(), tmp_path / "map", "prior")
    _runs(world, tmp_path / "runs", range(3))
    rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map")
    after = read_map(tmp_path / "map").by_id()
    pieces = [e for name, e in after.items() if name.startswith("lane")]
    assert {e.element_id for e in pieces} == {"lane", "lane.1"}
    x = np.concatenate([e.xy[:, 0] for e in pieces]) - ORIGIN[0]
    assert not ((x > 44) & (x < 56)).any()
    assert x.min() < -19 and x.max() > 119


def test_a_closed_gap_meets_its_neighbours_exactly(rtmap: Call, tmp_path: Path) -> None:
    prior = street(
        line("lane-a", "divider", 3.5, -20, 40), line("lane-b", "divider", 3.5, 60, 120),
        without=["lane"],
    )  # fmt: skip
    write_new_map(prior, tmp_path / "map", "prior")
    _runs(street(), tmp_path / "runs", range(2))
    rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map")
    after = read_map(tmp_path / "map")
    (new,) = [e for e in after.of_class("divider") if e.element_id.startswith("divider-")]
    ends = {tuple(p) for p in (new.xy[0], new.xy[-1])}
    known = after.by_id()
    assert ends == {tuple(known["lane-a"].xy[-1]), tuple(known["lane-b"].xy[0])}


def test_runs_are_known_and_never_count_twice(rtmap: Call, tmp_path: Path) -> None:
    write_new_map(street(), tmp_path / "map", "prior")
    _runs(street(), tmp_path / "runs", [0])
    base = ("crowdsource", tmp_path / "runs", "--map", tmp_path / "map")
    rtmap(*base, "--message", "monday")
    before = _digest(tmp_path / "map")
    again = rtmap(*base)
    assert "already" in again.out and _digest(tmp_path / "map") == before
    assert fused_runs(tmp_path / "map") == {"d0"}
    assert history(tmp_path / "map")[-1].message == "monday"
    existence = read_map(tmp_path / "map").by_id()["middle"].existence
    rtmap(*base, "--force")
    assert read_map(tmp_path / "map").by_id()["middle"].existence > existence


def test_a_map_from_runs_alone_is_the_same_drive_by_drive_and_at_once(
    rtmap: Call, tmp_path: Path
) -> None:
    growing, ids = tmp_path / "growing", []
    for seed in (0, 1, 2):
        _runs(street(), growing, [seed])
        rtmap("crowdsource", growing, "--map", tmp_path / "nightly")
        ids.append({e.element_id for e in read_map(tmp_path / "nightly")})
    rtmap("crowdsource", growing, "--map", tmp_path / "batch")
    nightly, batch = read_map(tmp_path / "nightly"), read_map(tmp_path / "batch")
    # The same geometry, and every element has kept the id of its first night.
    assert ids[0] == ids[1] == ids[2] and len(nightly) == len(batch) == 6
    shapes = [sorted(tuple(np.round(e.xy.ravel(), 6)) for e in m) for m in (nightly, batch)]
    assert shapes[0] == shapes[1]
    assert all(e.traversals == 3 and e.runs == ("d0", "d1", "d2") for e in nightly)
    told = json.loads(rtmap("crowdsource", growing, "--map", tmp_path / "nightly", "--json").out)
    assert told["version"] == 2 and told["runs"] == []


def test_a_dry_run_tells_and_writes_nothing(rtmap: Call, tmp_path: Path) -> None:
    write_new_map(street(), tmp_path / "map", "prior")
    _runs(street(without=["west"]), tmp_path / "runs", range(2))
    before = _digest(tmp_path)
    told = json.loads(
        rtmap(
            "crowdsource", tmp_path / "runs", "--map", tmp_path / "map", "--dry-run", "--json"
        ).out
    )
    assert told["deleted"] == ["west"] and told["version"] == 0 and told["dry_run"]
    rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "new", "--dry-run")
    assert _digest(tmp_path) == before and not (tmp_path / "new").exists()


def test_the_order_of_the_runs_does_not_matter(rtmap: Call, tmp_path: Path) -> None:
    world, maps = street(without=["east"]), []
    for names in (("a", "b", "c"), ("c", "a", "b")):
        folder = tmp_path / "".join(names)
        write_new_map(street(), folder / "map", "prior")
        for place, name in zip("xyz", names, strict=True):
            save(drive(world, name, seed=ord(name)), folder / "runs" / place)
        rtmap("crowdsource", folder / "runs", "--map", folder / "map")
        maps.append(read_map(folder / "map").by_id())
    assert set(maps[0]) == set(maps[1])
    for name, e in maps[0].items():
        assert np.allclose(e.points[:, :2], maps[1][name].points[:, :2], atol=1e-6)


def _noisy(run: Run, seed: int, much: float) -> Run:
    """The run with a noise of its own on every detection, each stating its own."""
    rng = np.random.default_rng(seed)
    o = run.observations
    size = rng.choice([0.05, much], len(o))[:, None, None]
    shift = rng.normal(size=(len(o), 1, 2)) * size
    points = (o.points + shift).astype(np.float32)
    sigma = np.broadcast_to(size, o.sigma.shape).astype(np.float32)
    return replace(run, observations=replace(o, points=points, sigma=sigma))


def test_sigma_tells_good_detections_from_bad_ones(rtmap: Call, tmp_path: Path) -> None:
    for k in range(3):
        run = drive(street(), f"d{k}", seed=k, noise=0.02)
        save(_noisy(run, k, 1.0), tmp_path / "runs" / run.log_id)
    errors = {}
    for name, flags in (("with", []), ("without", ["--without-sigma"])):
        rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / name, *flags)
        fused = read_map(tmp_path / name)
        lines = [e.xy for e in fused if e.class_name != "ped_crossing"]
        y = np.concatenate([resample_step(xy, 1.0) for xy in lines])[:, 1] - ORIGIN[1]
        errors[name] = float(np.median(np.abs(y[:, None] - LINES).min(axis=1)))
    assert errors["with"] < 0.5 * errors["without"]


def test_without_sigma_nothing_of_what_runs_state_counts(rtmap: Call, tmp_path: Path) -> None:
    for k in range(2):
        run = drive(street(), f"d{k}", seed=k, noise=0.1)
        save(run, tmp_path / "plain" / run.log_id)
        o = run.observations
        scale = np.random.default_rng(k).uniform(0.2, 5.0, (len(o), 1, 1))
        wild = replace(o, sigma=(o.sigma * scale).astype(np.float32))
        save(replace(run, observations=wild), tmp_path / "wild" / run.log_id)
    maps = []
    for name in ("plain", "wild"):
        target = tmp_path / f"map-{name}"
        rtmap("crowdsource", tmp_path / name, "--map", target, "--without-sigma")
        maps.append(read_map(target))
    assert len(maps[0]) == len(maps[1]) >= 6
    for one, other in zip(*maps, strict=True):
        assert np.array_equal(one.points, other.points, equal_nan=True)
        assert np.array_equal(one.covariance, other.covariance, equal_nan=True)


def test_what_no_drive_looked_at_stays_as_it_is(rtmap: Call, tmp_path: Path) -> None:
    far = line("far", "divider", 0.0, 400, 460)
    wall = np.array([[50.0, 9.0, 0.0, 400.0, 0.5]])
    behind = line("behind", "boundary", 13.0)
    prior = street(far, behind)
    write_new_map(prior, tmp_path / "map", "prior")
    _runs(street(), tmp_path / "runs", range(2), boxes=wall)
    told = rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map", "--json").out
    assert json.loads(told)["counts"]["untouched"] == 2
    after = read_map(tmp_path / "map").by_id()
    for e in (far, behind):
        kept = after[e.element_id]
        assert np.array_equal(kept.points[:, :2], e.points[:, :2])
        assert kept.existence == e.existence and kept.in_view == 0 and kept.covariance is None


def test_one_run_folder_is_enough(rtmap: Call, tmp_path: Path) -> None:
    run = save(drive(street(), "d0"), tmp_path / "d0")
    out = rtmap("crowdsource", run, "--map", tmp_path / "map").out
    assert "version 0" in out and "1 runs fused" in out


@pytest.mark.parametrize("case", ["no folder", "no runs", "other crs", "twice", "corrupt"])
def test_bad_input_is_one_line_and_writes_nothing(rtmap: Call, tmp_path: Path, case: str) -> None:
    write_new_map(street(), tmp_path / "map", "prior")
    runs = tmp_path / "runs"
    if case != "no folder":
        runs.mkdir()
    if case in ("twice", "corrupt"):
        save(drive(street(), "d0"), runs / "a")
    if case == "twice":
        save(drive(street(), "d0", seed=1), runs / "b")
    if case == "other crs":
        save(drive(street(), "d0", crs="EPSG:32618"), runs / "a")
    if case == "corrupt":
        (save(drive(street(), "d1"), runs / "b") / "frames.parquet").write_bytes(b"PAR1")
    before = _digest(tmp_path / "map")
    result = rtmap("crowdsource", runs, "--map", tmp_path / "map", code=3)
    assert len(result.err.strip().splitlines()) == 1
    assert _digest(tmp_path / "map") == before
    if case == "corrupt":
        told = rtmap("crowdsource", runs, "--map", tmp_path / "map", "--skip-bad-runs", "--json")
        assert json.loads(told.out)["runs"] == ["d0"] and "frames.parquet" in told.err


def test_a_run_that_found_nothing_makes_no_map(rtmap: Call, tmp_path: Path) -> None:
    world = VectorMap([line("far", "divider", 0.0)], CRS)
    run = drive(world, "d0", found=1.0)
    o = run.observations
    empty = Run(run.info, run.frames, o.select(np.zeros(len(o), bool)), None, run.poses)
    save(empty, tmp_path / "runs" / "d0")
    rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map", code=4)
    assert not (tmp_path / "map").exists()


def test_batch_and_one_by_one_agree_over_a_prior(rtmap: Call, tmp_path: Path) -> None:
    """The tolerance that docs/crowdsource.md states, in any order."""
    world = street(crossing("new", 50.0), without=["east"])
    drives = {f"d{k}": drive(world, f"d{k}", seed=k) for k in range(4)}
    maps = []
    for name, batches in (
        ("batch", [["d0", "d1", "d2", "d3"]]),
        ("nights", [["d0"], ["d1"], ["d2"], ["d3"]]),
        ("shuffled", [["d3"], ["d1", "d0"], ["d2"]]),
    ):
        write_new_map(shifted(street(), 0.1, 0.2), tmp_path / name, "prior")
        for batch in batches:
            for run in batch:
                save(drives[run], tmp_path / f"{name}-runs" / run)
            rtmap("crowdsource", tmp_path / f"{name}-runs", "--map", tmp_path / name)
        maps.append(read_map(tmp_path / name).by_id())
        assert fused_runs(tmp_path / name) == set(drives)
    for other in maps[1:]:
        assert set(other) == set(maps[0]) and "east" not in other
        for name, e in maps[0].items():
            line_, same = shapely.LineString(e.xy), shapely.LineString(other[name].xy)
            tolerance = 0.25 if e.class_name == "ped_crossing" else 0.05
            assert shapely.hausdorff_distance(line_, same, densify=0.1) < tolerance, name
            assert e.traversals == other[name].traversals == 4
