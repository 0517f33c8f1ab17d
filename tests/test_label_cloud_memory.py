"""rtmap label cloud streams: what it holds is that of the neighbourhood, not of the drive."""

from __future__ import annotations

import weakref
from pathlib import Path
from typing import Any

import cloud_scenes
import numpy as np
import pytest

from rtmap_cli.geometry.poses import se3_from_xyyaw
from rtmap_cli.logs.cloud import Voxels
from rtmap_cli.logs.native import NativeLog
from rtmap_cli.steps.label.cloud.build import Builder
from rtmap_cli.steps.label.cloud.graph import Edges, solve
from rtmap_cli.steps.label.cloud.mapping import VoxelMap
from rtmap_cli.steps.label.cloud.odometry import Odometry
from rtmap_cli.steps.label.cloud.track import Settings


def test_points_of_a_sweep_do_not_stay(tmp_path: Path, monkeypatch: Any) -> None:
    """While a drive is registered, the points of a few sweeps are held, not of all."""
    pytest.importorskip("small_gicp")
    poses = cloud_scenes.circle(72)[:16]
    log = cloud_scenes.write_log(tmp_path / "log", poses, cloud_scenes.yard(), skew=True)
    seen: list[weakref.ref[np.ndarray]] = []
    alive: list[int] = []
    add = Odometry.add

    def watched(self: Odometry, *args: Any) -> Any:
        step = add(self, *args)
        seen.append(weakref.ref(step.points))
        alive.append(sum(r() is not None for r in seen))
        return step

    monkeypatch.setattr(Odometry, "add", watched)
    (tmp_path / "cloud").mkdir()
    Builder(NativeLog(log), Settings()).write(tmp_path / "cloud", lambda items, what, total: items)
    assert len(alive) == 16 and max(alive) <= 3
    assert not list((tmp_path / "cloud").glob(".*"))


@pytest.mark.parametrize("method", ["vgicp", "gicp", "ndt"])
def test_the_local_map_forgets(method: str) -> None:
    """Along 600 m of scattered posts the local map stays as large as its neighbourhood."""
    if method != "ndt":
        pytest.importorskip("small_gicp")
    from rtmap_cli.steps.label.cloud.match import make_matcher

    rng = np.random.default_rng(8)
    matcher = make_matcher(method, 1.0)
    held = []
    for k in range(300):
        xyz = rng.uniform([-20, -15, 0], [20, 15, 3], (900, 3))
        matcher.insert(matcher.prepare(xyz), se3_from_xyyaw(2.0 * k, np.zeros(()), np.zeros(())))
        if k % 50 == 49:
            held.append(len(matcher.local_points()))
    assert held[-1] < 1.1 * held[3] and held[-1] < 300 * 900 / 3


def test_tiles_behind_the_vehicle_go_to_disk(tmp_path: Path) -> None:
    """Along 1 km the dense map holds the tiles around, and writes all of them."""
    rng = np.random.default_rng(9)
    dense = VoxelMap(0.2, tmp_path / "parked", 30.0)
    most, total = 0, set()
    for k in range(200):
        xyz = rng.uniform([5 * k - 30, -20, 0], [5 * k + 30, 20, 1], (400, 3))
        dense.add(xyz, np.zeros(len(xyz)))
        dense.leave(np.array([5.0 * k, 0.0]))
        most = max(most, len(dense._tiles))
        total |= set(map(tuple, np.floor(xyz / 0.2).astype(int)))
    assert most <= 8 and len(list((tmp_path / "parked").iterdir())) > 20
    found: list[Voxels] = []
    assert dense.finish(lambda at, voxels: found.append(voxels)) == len(total)
    assert sum(int(v.count.sum()) for v in found) == 200 * 400


def test_the_inverse_is_never_whole(monkeypatch: Any) -> None:
    """Marginals by a few poses at a time are the same."""
    from rtmap_cli.steps.label.cloud import graph

    rng = np.random.default_rng(2)
    step = se3_from_xyyaw(np.array(2.0), np.array(0.1), np.array(0.05))
    pose = [np.eye(4)]
    for _ in range(29):
        pose.append(pose[-1] @ step)
    information = np.diag(rng.uniform(1e2, 1e4, 6))
    edges = Edges.of([(k, k + 1, step, information, False) for k in range(29)])
    whole = solve(np.stack(pose), edges, None).covariance
    monkeypatch.setattr(graph, "COLUMNS", 36 * 30 * 4)
    assert np.allclose(solve(np.stack(pose), edges, None).covariance, whole, rtol=1e-9)
