"""First mapping: drives with GNSS alone are put onto each other; lines beside lines and forks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fusion_scene import ORIGIN, RANGE, crossing, drive, save, street

from rtmap_cli.geometry.poses import se3_from_xyyaw, xyyaw_of
from rtmap_cli.logs.run import Run
from rtmap_cli.logs.traversal import Traversal, traversal_of
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.stations import Samples, samples_of
from rtmap_cli.maps.store import read_map
from rtmap_cli.steps.crowdsource.align.align import align
from rtmap_cli.steps.crowdsource.forks import Branch, forked
from rtmap_cli.steps.detect_changes.doubles import split_doubles

Call = Callable[..., object]
BIASES = np.array([[0.9, 1.1], [-1.3, -0.8], [0.3, -1.2], [-0.4, 1.0], [0.5, -0.1]])


def gnss_drive(world: VectorMap, k: int, bias: np.ndarray, seed: int = 0) -> Run:
    """A drive whose initial poses have a bias, white noise, and good odometry."""
    rng = np.random.default_rng(100 * seed + k)
    run = drive(world, f"drive-{k}", seed=seed + k, noise=0.05, localized=False, y=-2.0 + 0.5 * k)
    pose = xyyaw_of(run.frames.initial)
    step = np.diff(pose, axis=0)
    c, s = np.cos(pose[:-1, 2]), np.sin(pose[:-1, 2])
    moved = np.stack([c * step[:, 0] + s * step[:, 1], c * step[:, 1] - s * step[:, 0]], -1)
    odometry = np.full((len(pose), 3), np.nan)
    odometry[1:] = np.column_stack([moved, step[:, 2]]) + rng.normal(0, 0.002, (len(step), 3))
    noise = np.column_stack([rng.normal(0, 0.2, (len(pose), 2)), rng.normal(0, 0.008, len(pose))])
    pose = pose + noise + [*bias, 0.01]
    frames = replace(
        run.frames,
        initial=se3_from_xyyaw(*pose.T),
        sigma=np.tile([1.1, 1.1, 0.02], (len(pose), 1)),
        odometry=odometry,
    )
    return replace(run, frames=frames)


def errors(traversals: list[Traversal], world: VectorMap) -> np.ndarray:
    """(drives, 3) mean error of the poses of each drive: x, y (m), yaw (rad)."""
    out = []
    for t in traversals:
        k = int(t.run_id.rsplit("-", 1)[1])
        true = xyyaw_of(drive(world, t.run_id, seed=k, y=-2.0 + 0.5 * k).frames.initial)
        out.append((t.pose - true).mean(axis=0))
    return np.array(out)


def test_drives_meet_and_stay_where_the_mean_of_gnss_has_them() -> None:
    world = street()
    drives = [traversal_of(gnss_drive(world, k, b)) for k, b in enumerate(BIASES)]
    found = align(drives)
    e = errors(found.traversals, world)
    apart = e - e.mean(axis=0)
    assert np.abs(apart[:, 1]).max() < 0.1
    assert np.abs(apart[:, 0]).max() < 0.4
    assert np.abs(e[:, 2]).max() < 0.004
    assert np.abs(e[:, :2].mean(axis=0) - BIASES.mean(axis=0)).max() < 0.15
    assert found.common == pytest.approx(1.1**2 / 5, rel=0.1)


def test_what_drives_saw_moves_with_them() -> None:
    world = street()
    before = traversal_of(gnss_drive(world, 0, BIASES[0]))
    other = traversal_of(gnss_drive(world, 1, BIASES[1]))
    after = align([before, other]).traversals[0]
    c, s = np.cos(after.pose[:, 2]), np.sin(after.pose[:, 2])
    back = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)
    local = np.einsum(
        "nij,nvj->nvi", back[after.frame], after.points - after.pose[after.frame, None, :2]
    )
    c, s = np.cos(before.pose[:, 2]), np.sin(before.pose[:, 2])
    back = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)
    same = np.einsum(
        "nij,nvj->nvi", back[before.frame], before.points - before.pose[before.frame, None, :2]
    )
    assert np.allclose(local, same, atol=1e-6)


def test_the_order_of_drives_does_not_matter() -> None:
    world = street()
    drives = [traversal_of(gnss_drive(world, k, b)) for k, b in enumerate(BIASES[:3])]
    one = {t.run_id: t.pose for t in align(drives).traversals}
    two = {t.run_id: t.pose for t in align(drives[::-1]).traversals}
    assert all(np.array_equal(one[k], two[k]) for k in one)


def test_localized_drives_stay_where_they_are() -> None:
    t = traversal_of(drive(street(), "here", localized=True))
    found = align([t])
    assert found.traversals == [t] and found.common == 0.0


def test_one_drive_alone_is_smoothed_by_its_odometry() -> None:
    t = traversal_of(gnss_drive(street(), 0, np.zeros(2)))
    jumps = [np.diff(p, n=2, axis=0)[:, :2].std() for p in (t.pose, align([t]).traversals[0].pose)]
    assert jumps[1] < 0.1 * jumps[0]


def test_a_first_map_of_biased_drives_has_each_line_once(rtmap: Call, tmp_path: Path) -> None:
    world = street()
    for k, b in enumerate(BIASES):
        save(gnss_drive(world, k, b), tmp_path / "runs" / str(k))
    rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map")
    found = read_map(tmp_path / "map")
    sure = [e for e in found if e.existence > 0]
    counts = {c: sum(e.class_name == c for e in sure) for c in ("divider", "boundary")}
    assert counts == {"divider": 2, "boundary": 2}
    y = sorted(float(np.median(e.xy[:, 1]) - ORIGIN[1]) for e in sure if e.class_name == "divider")
    assert y[1] - y[0] == pytest.approx(3.5, abs=0.1)
    # Where the map lies as a whole is what the mean of five GNSS biases leaves open.
    sigma = np.sqrt(np.concatenate([e.covariance[:, 2] for e in sure if e.class_name == "divider"]))
    assert sigma.min() > 0.4


def detections(lines: list[np.ndarray], frame: list[int]) -> Samples:
    points = np.stack(lines)
    covariance = np.broadcast_to(np.eye(2) * 0.09, (*points.shape[:2], 2, 2))
    return samples_of(points, covariance, np.full(len(lines), 0.8), np.array(frame))


def straight(y: float, x0: float = 0.0, x1: float = 40.0) -> np.ndarray:
    return np.stack([np.linspace(x0, x1, 20), np.full(20, y)], axis=-1)


def test_a_line_that_frames_see_twice_becomes_two() -> None:
    rng = np.random.default_rng(0)
    seen, frame = [], []
    for f in range(30):
        shift = rng.normal(0, 0.2)
        for y in (0.35, -0.35):
            if rng.random() < 0.7:
                seen.append(straight(y + shift + rng.normal(0, 0.1)))
                frame.append(f)
    double = split_doubles([straight(0.0)], [], [detections(seen, frame)])
    assert len(double) == 2
    assert sorted(round(float(p[:, 1].mean()), 1) for p in double) == pytest.approx(
        [-0.4, 0.4], abs=0.15
    )
    once = [k for k, f in enumerate(frame) if f not in frame[:k]]
    single = detections([seen[k] for k in once], [frame[k] for k in once])
    assert len(split_doubles([straight(0.0)], [], [single])) == 1


def test_a_line_is_cut_where_another_one_runs_into_it() -> None:
    def branch(xy: np.ndarray, source: int) -> Branch:
        points = np.column_stack([xy, np.full(len(xy), np.nan)])
        return Branch(points, np.tile([0.01, 0.0, 0.01, np.nan], (len(xy), 1)), source)

    through = branch(straight(0.0), 0)
    fork = branch(np.array([[20.0, 0.3], [30.0, 1.5], [40.0, 2.7]]), 1)
    beside = branch(straight(1.0, 5.0, 12.0), 2)
    parts = forked([through, fork, beside], [True, True, True])
    assert [p.source for p in parts] == [0, 0, 1, 2]
    node = parts[0].points[-1]
    assert np.array_equal(node[:2], parts[1].points[0, :2])
    assert np.array_equal(node[:2], parts[2].points[0, :2])
    assert node[0] == pytest.approx(17.5, abs=0.1) and node[1] == pytest.approx(0.0, abs=1e-9)
    assert all(len(p.points) == len(p.covariance) for p in parts)
    kept = forked([through, branch(straight(0.0), 1)], [False, True])
    assert [p.source for p in kept] == [0, 1]


def test_lines_on_top_of_each_other_before_they_part_share_that_stretch() -> None:
    """Two lines from one end on, a hand apart for 12 m: a stem and two branches."""

    def branch(xy: np.ndarray, source: int) -> Branch:
        points = np.column_stack([xy, np.full(len(xy), np.nan)])
        return Branch(points, np.tile([0.01, 0.0, 0.01, np.nan], (len(xy), 1)), source)

    x = np.arange(0.0, 41.0)
    through = branch(np.stack([x, np.zeros_like(x)], axis=-1), 0)
    away = np.stack([x[:36], 0.05 + 0.15 * np.maximum(x[:36] - 12.0, 0.0)], axis=-1)
    for line in (away, away[::-1]):
        parts = forked([through, branch(line, 1)], [True, True])
        assert [p.source for p in parts] == [0, 0, 1]
        node = parts[0].points[-1, :2]
        assert node == pytest.approx([12.0, 0.0], abs=0.6)
        assert (node == parts[1].points[0, :2]).all()
        assert (parts[2].points[[0, -1], :2] == node).all(axis=1).any()
        assert all(len(p.points) == len(p.covariance) for p in parts)
    # Two that never part are two, and so are those of which one must not change.
    beside = branch(np.stack([x, np.full_like(x, 0.1)], axis=-1), 1)
    assert [p.source for p in forked([through, beside], [True, True])] == [0, 1]
    assert [p.source for p in forked([through, branch(away, 1)], [False, True])] == [0, 1]


def test_a_crossing_that_the_range_always_cuts_is_as_long_as_what_was_seen(
    rtmap: Call, tmp_path: Path
) -> None:
    half = RANGE[3] + 1.0
    world = VectorMap(
        [*street(without=("west", "east")), crossing("long", 50.0, 4.0, half)], "EPSG:32617"
    )
    for k in range(3):
        save(drive(world, f"run-{k}", seed=k, noise=0.1, y=-2.0), tmp_path / "runs" / str(k))
    rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map")
    found = [e for e in read_map(tmp_path / "map").of_class("ped_crossing") if e.existence > 0]
    assert len(found) == 1
    assert np.ptp(found[0].xy[:, 1]) > 2 * RANGE[3] - 3.0
    assert np.ptp(found[0].xy[:, 0]) == pytest.approx(4.0, abs=0.4)
