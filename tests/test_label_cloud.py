"""rtmap label cloud: drives with known truth, through the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cloud_scenes
import numpy as np
import pytest

from rtmap_cli.geometry import lie
from rtmap_cli.geometry.poses import invert, se3_from_xyyaw, transform
from rtmap_cli.logs.cloud import CloudFolder
from rtmap_cli.logs.native import NativeLog

pytest.importorskip("small_gicp")

Call = Any


@pytest.fixture(scope="module")
def world() -> cloud_scenes.Array:
    return cloud_scenes.yard()


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory, world: Any) -> Path:
    """A circle and a bit, skewed turns, GNSS of half a metre that jumps for a while."""
    folder = tmp_path_factory.mktemp("drive") / "log"
    poses = cloud_scenes.circle(72)
    return cloud_scenes.write_log(folder, poses, world, jump=slice(30, 40), skew=True)


@pytest.fixture(scope="module")
def cloud(drive: Path) -> Path:
    from rtmap_cli.cli import run

    out = drive.parent / "cloud"
    assert run(["label", "cloud", str(drive), "--laz", "--ply", "-q", "-o", str(out)]) == 0
    return out


def test_trajectory_lies_where_the_vehicle_was(cloud: Path, drive: Path) -> None:
    path = CloudFolder(cloud).trajectory()
    truth = NativeLog(drive).truth_poses()
    assert truth is not None and len(path) == 72
    e = lie.log(invert(truth.pose) @ path.pose)
    # The bias of the mean of the fixes stays: half a metre over some of them.
    assert np.linalg.norm(e[:, 3:], axis=1).max() < 0.5
    first = truth.pose[0] @ invert(path.pose[0]) @ path.pose
    assert np.linalg.norm(lie.log(invert(truth.pose) @ first)[:, 3:], axis=1).max() < 0.35
    spread = np.sqrt(path.covariance[:, range(3), range(3)])
    assert (spread > 0.005).all() and (spread < 1.0).all()
    assert np.allclose(path.covariance, np.swapaxes(path.covariance, 1, 2))
    assert set(path.status) == {"ok"}


def test_loops_and_jumps_are_told(cloud: Path) -> None:
    info = json.loads((cloud / "cloud.json").read_text())
    assert info["loops"] >= 1
    keys = int(CloudFolder(cloud).trajectory().keyframe.sum())
    assert info["keyframes"] == keys
    assert 8 <= info["gnss_rejected"] <= 12
    assert any("jump" in note for note in info["notes"])


def test_the_map_is_sharp_and_in_its_tiles(cloud: Path, drive: Path, world: Any) -> None:
    from scipy.spatial import cKDTree

    found = CloudFolder(cloud)
    path, truth = found.trajectory(), NativeLog(drive).truth_poses()
    assert truth is not None
    back = truth.pose[40] @ invert(path.pose[40])
    for i, j in found.tiles():
        voxels = found.read_tile(i, j)
        assert (np.floor(voxels.xyz[:, :2] / found.tile).astype(int) == (i, j)).all()
        assert voxels.intensity == pytest.approx(0.3, abs=1e-5)
        assert (voxels.count >= voxels.sweeps).all()
        tall = voxels.xyz[:, 2] > cloud_scenes.ZERO[2] + 1.0
        if tall.sum() > 100:
            at = transform(back, voxels.xyz[tall]) - cloud_scenes.ZERO
            assert np.median(cKDTree(world).query(at)[0]) < 0.15


def test_exports_hold_every_voxel(cloud: Path) -> None:
    import laspy

    found = CloudFolder(cloud)
    total = sum(len(found.read_tile(*t)) for t in found.tiles())
    las = laspy.read(cloud / "cloud.laz")
    assert len(las.x) == total == json.loads((cloud / "cloud.json").read_text())["voxels"]
    assert las.header.parse_crs().to_epsg() == 32632
    head = (cloud / "cloud.ply").read_bytes()[:400].decode("latin1")
    assert f"element vertex {total}" in head
    assert (cloud / "overview.png").stat().st_size > 1000


@pytest.mark.parametrize("method", ["gicp", "ndt"])
def test_other_methods_agree(rtmap: Call, tmp_path: Path, world: Any, method: str) -> None:
    poses = cloud_scenes.circle(72)[:12]
    rng = np.random.default_rng(2)
    folder = cloud_scenes.write_bins(
        tmp_path / "bins", [cloud_scenes.seen(world, p, rng, 6000) for p in poses]
    )
    result = json.loads(
        rtmap("label", "cloud", f"sweeps:{folder}", "--method", method, "-o", tmp_path / "c",
              "--json", "-q").out
    )  # fmt: skip
    assert result["method"] == method and result["gnss"] is False
    path = CloudFolder(tmp_path / "c").trajectory()
    e = lie.log(invert(invert(poses[0]) @ poses) @ path.pose)
    assert np.linalg.norm(e[:, 3:], axis=1).max() < 0.1
    assert np.degrees(np.linalg.norm(e[:, :3], axis=1)).max() < 0.5
    assert any("no times" in note for note in result["notes"])


def tunnel(count: int) -> list[np.ndarray]:
    """Sweeps in a long even tube: nothing tells how far along it the vehicle is."""
    rng = np.random.default_rng(4)
    out = []
    for _ in range(count):
        n = 8000
        x, a = rng.uniform(-45, 45, n), rng.uniform(0, 2 * np.pi, n)
        tube = np.column_stack([x, 4 * np.cos(a), 1.5 + 2.5 * np.sin(a)])
        out.append(tube + rng.normal(0, 0.02, (n, 3)))
    return out


def test_a_tunnel_has_no_answer(rtmap: Call, tmp_path: Path) -> None:
    folder = cloud_scenes.write_bins(tmp_path / "bins", tunnel(6))
    err = rtmap("label", "cloud", f"sweeps:{folder}", "-o", tmp_path / "c", code=4).err
    assert "forward" in err and "rtmap:" in err and not (tmp_path / "c").exists()


def test_a_tunnel_with_odometry_is_told(rtmap: Call, tmp_path: Path, monkeypatch: Any) -> None:
    """Held by the odometry along the tube, with the status and the weak direction."""
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 0, 3] = 2.0 * np.arange(8)
    poses[:, :3, 3] += cloud_scenes.ZERO
    sweeps = iter(tunnel(8))
    monkeypatch.setattr(cloud_scenes, "seen", lambda *_: next(sweeps))
    log = cloud_scenes.write_log(tmp_path / "log", poses, np.zeros((1, 3)), odometry=True)
    done = rtmap("label", "cloud", log, "--no-gnss", "-q", "-o", tmp_path / "c")
    assert "do not tell the motion forward" in done.err
    path = CloudFolder(tmp_path / "c").trajectory()
    assert (path.status[1:] == "degenerate").all()
    assert np.abs(path.weak[1:, 0]).min() > 0.95
    away = np.linalg.norm(path.pose[:, :3, 3] - path.pose[0, :3, 3], axis=1)
    assert away[-1] == pytest.approx(14.0, abs=0.3)
    along = path.covariance[:, 0, 0]
    assert along[-1] - along[0] > 0.05


def hall(count: int) -> list[np.ndarray]:
    """Sweeps from the middle of a round hall: nothing tells how the vehicle turned."""
    rng = np.random.default_rng(6)
    out = []
    for _ in range(count):
        a, b = rng.uniform(0, 2 * np.pi, (2, 5000))
        r = 12 * np.sqrt(rng.random(5000))
        wall = np.column_stack([12 * np.cos(a), 12 * np.sin(a), rng.uniform(0, 5, 5000)])
        floor = np.column_stack([r * np.cos(b), r * np.sin(b), np.zeros(5000)])
        out.append(np.concatenate([wall, floor]) + rng.normal(0, 0.02, (10_000, 3)))
    return out


@pytest.mark.parametrize("method", ["vgicp", "ndt"])
def test_a_round_hall_has_no_answer(rtmap: Call, tmp_path: Path, method: str) -> None:
    folder = cloud_scenes.write_bins(tmp_path / "bins", hall(4))
    words = ["--method", method, "-o", tmp_path / "c"]
    err = rtmap("label", "cloud", f"sweeps:{folder}", *words, code=4).err
    assert "do not tell the turn" in err and not (tmp_path / "c").exists()


def test_a_round_hall_with_odometry_is_told(rtmap: Call, tmp_path: Path, monkeypatch: Any) -> None:
    """The odometry's turn is kept, with the status and a covariance that says so."""
    yaw = np.radians(6.0) * np.arange(6)
    poses = se3_from_xyyaw(np.zeros(6), np.zeros(6), yaw)
    poses[:, :3, 3] += cloud_scenes.ZERO
    sweeps = iter(hall(6))
    monkeypatch.setattr(cloud_scenes, "seen", lambda *_: next(sweeps))
    log = cloud_scenes.write_log(tmp_path / "log", poses, np.zeros((1, 3)), odometry=True)
    done = rtmap("label", "cloud", log, "--no-gnss", "-q", "-o", tmp_path / "c")
    assert "do not tell the turn" in done.err
    path = CloudFolder(tmp_path / "c").trajectory()
    assert (path.status[1:] == "degenerate").all() and np.isnan(path.weak).all()
    turned = lie.log(invert(path.pose[0]) @ path.pose[-1])
    assert np.degrees(turned[2]) == pytest.approx(30.0, abs=1.5)
    assert np.linalg.norm(turned[3:]) < 0.2
    assert path.covariance[-1, 5, 5] - path.covariance[0, 5, 5] > 2 * 0.02**2


def test_bad_returns_are_dropped(rtmap: Call, tmp_path: Path, world: Any) -> None:
    poses = cloud_scenes.circle(72)[:5]
    rng = np.random.default_rng(3)
    sweeps = [cloud_scenes.seen(world, p, rng, 5000) for p in poses]
    for sweep in sweeps:
        sweep[::50], sweep[1::50] = np.nan, 0.0
    sweeps[3] = np.full((40, 3), np.nan)
    folder = cloud_scenes.write_bins(tmp_path / "bins", sweeps)
    result = json.loads(
        rtmap("label", "cloud", f"sweeps:{folder}", "-o", tmp_path / "c", "--json", "-q").out
    )
    assert result["returns_dropped"] >= 4 * 200 and result["lost"] == 1
    path = CloudFolder(tmp_path / "c").trajectory()
    assert path.status[3] == "lost" and path.status[4] == "ok"


def test_logs_without_sweeps_and_folders_of_nothing(rtmap: Call, tmp_path: Path) -> None:
    poses = cloud_scenes.circle(6)
    log = cloud_scenes.write_log(tmp_path / "log", poses, cloud_scenes.yard()[:500])
    (log / "lidar.parquet").unlink()
    assert "no frame has a LiDAR sweep" in rtmap("label", "cloud", log, "-o", "x", code=3).err
    (tmp_path / "none").mkdir()
    spec = f"sweeps:{tmp_path / 'none'}"
    assert "no .bin, .ply or .pcd" in rtmap("label", "cloud", spec, "-o", "x", code=3).err
    folder = cloud_scenes.write_bins(tmp_path / "bins", [np.zeros((9, 3)), np.zeros((9, 3))])
    err = rtmap("label", "cloud", f"sweeps:{folder}", "-o", tmp_path / "x", code=3).err
    assert "no sweep holds" in err
    (folder / "times.txt").write_text("1.0\n0.5\n")
    err = rtmap("label", "cloud", f"sweeps:{folder}", "-o", tmp_path / "x", code=3).err
    assert "out of order" in err
    for text, said in (("0\nnan\n", "times.txt"), ("0\n0\n", "out of order"), ("0\n", "2 sweeps")):
        (folder / "times.txt").write_text(text)
        err = rtmap("label", "cloud", f"sweeps:{folder}", "-o", tmp_path / "x", code=3).err
        assert said in err
    (folder / "times.txt").unlink()
    for text, said in (("1 0 0 0 0 1 0 0 0 0 1 0\n", "1 poses for 2"), ("1 2\n1 2\n", "poses.txt")):
        (folder / "poses.txt").write_text(text)
        err = rtmap("label", "cloud", f"sweeps:{folder}", "-o", tmp_path / "x", code=3).err
        assert said in err
    (folder / "poses.txt").unlink()
    (folder / "000000.bin").write_bytes(b"abc")
    err = rtmap("label", "cloud", f"sweeps:{folder}", "-o", tmp_path / "x", code=3).err
    assert "000000.bin" in err
