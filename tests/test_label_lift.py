"""rtmap label lift: heights from clouds whose ground is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import se3_from_xyyaw
from rtmap_cli.logs.cloud import (
    CloudFolder,
    Trajectory,
    Voxels,
    write_info,
    write_tile,
    write_trajectory,
)
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import read_map, write_new_map
from rtmap_cli.steps.label.lift.planes import heights

Call = Any
Array = NDArray[np.float64]

CRS = "EPSG:32632"
ZERO = np.array([500_000.0, 5_400_000.0])


def write_cloud(folder: Path, xyz: Array, path: Array, crs: str = CRS) -> Path:
    """A cloud folder of points (n, 3) and a trajectory on the road (k, 3), both about ZERO."""
    (folder / "tiles").mkdir(parents=True)
    points = xyz + (*ZERO, 0.0)
    tile = np.floor(points[:, :2] / 50.0).astype(int)
    for t in np.unique(tile, axis=0):
        p = points[(tile == t).all(axis=1)]
        one = np.ones(len(p))
        write_tile(Voxels(p, 0.1 * one, one, one, 0.01 * one), folder, (t[0], t[1]), crs)
    n = len(path)
    yaw = np.arctan2(np.gradient(path[:, 1]), np.gradient(path[:, 0]))
    pose = se3_from_xyyaw(path[:, 0] + ZERO[0], path[:, 1] + ZERO[1], yaw, path[:, 2])
    trajectory = Trajectory(
        np.arange(n, dtype=np.int32), np.arange(n, dtype=np.int64), pose,
        np.tile(np.diag([1e-4] * 3 + [1e-6] * 3), (n, 1, 1)), path[:, 2], np.ones(n, bool),
        np.array(["ok"] * n, object), np.full((n, 3), np.nan),
    )  # fmt: skip
    write_trajectory(trajectory, folder, crs)
    write_info(folder, {"crs": crs, "voxel_m": 0.1, "tile_m": 50.0})
    return folder


def slab(rng: Any, x: tuple[float, float], y: tuple[float, float], z: Any, n: int) -> Array:
    """(n, 3) points of a surface z(x, y) with 1.5 cm of noise."""
    xy = np.column_stack([rng.uniform(*x, n), rng.uniform(*y, n)])
    return np.column_stack([xy, z(xy[:, 0], xy[:, 1]) + rng.normal(0, 0.015, n)])


def write_map(folder: Path, lines: dict[str, Array]) -> Path:
    """A map of dividers about ZERO, without heights."""
    elements = [Element(k, "divider", v + ZERO) for k, v in lines.items()]
    write_new_map(VectorMap(elements, CRS), folder, "flat")
    return folder


def along_x(y: float, first: float = -60.0, last: float = 60.0) -> Array:
    x = np.arange(first, last + 0.1, 3.0)
    return np.column_stack([x, np.full(len(x), y)])


def test_a_sloped_road_between_curbs_with_cars_and_bushes(rtmap: Call, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)

    def road(x: Array, y: Array) -> Array:
        return np.asarray(20 + 0.04 * x + 0.01 * y + 0.14 * (np.abs(y) > 5.0))

    parts = [slab(rng, (-70, 70), (-12, 12), road, 120_000)]
    for x in (-40.0, -10.0, 25.0):
        car = slab(rng, (x, x + 4.5), (2.5, 4.3), lambda a, b: road(a, b) + 0.7, 2500)
        hidden = (np.abs(parts[0][:, 0] - x - 2.2) < 2.2) & (np.abs(parts[0][:, 1] - 3.4) < 0.9)
        parts[0] = parts[0][~hidden | (rng.random(len(hidden)) < 0.3)]
        parts.append(car)
    bush = slab(
        rng, (-70, 70), (6, 12), lambda a, b: road(a, b) + rng.uniform(0.1, 1, len(a)), 9000
    )
    path = np.column_stack([along_x(-2.0), np.zeros(41)])
    path[:, 2] = road(path[:, 0], path[:, 1])
    cloud = write_cloud(tmp_path / "cloud", np.concatenate([*parts, bush]), path)
    curb, lane, far = along_x(5.0), along_x(3.4), along_x(60.0)
    town = write_map(tmp_path / "map", {"curb": curb, "lane": lane, "far": far})
    result = json.loads(rtmap("label", "lift", town, "--cloud", cloud, "--json").out)
    assert result["version"] == 1 and result["unknown"] == len(far)
    found = read_map(town).by_id()
    for name, line in (("curb", curb), ("lane", lane)):
        e = found[name]
        off = np.abs(e.points[:, 2] - (20 + 0.04 * line[:, 0] + 0.01 * line[:, 1]))
        assert np.percentile(off, 90) < 0.05, name
        assert e.covariance is not None
        assert ((e.covariance[:, 3] > 0) & (e.covariance[:, 3] < 0.05**2)).all()
        assert np.isnan(e.covariance[:, 0]).all()
    assert np.isnan(found["far"].points[:, 2]).all()
    assert np.isnan(read_map(town, 0).by_id()["lane"].points[:, 2]).all()


def test_a_bridge_and_the_road_below_do_not_mix(rtmap: Call, tmp_path: Path) -> None:
    """A ramp leads up to a bridge that crosses the road; both were driven."""
    rng = np.random.default_rng(2)
    low = slab(rng, (-60, 60), (-8, 8), lambda x, y: 0 * x, 60_000)

    def deck(x: Array, y: Array) -> Array:
        return np.asarray(np.clip(6.0 - 0.1 * (np.abs(y) - 15), 0, 6.0))

    high = slab(rng, (-5, 5), (-60, 60), deck, 60_000)
    x = np.arange(-60.0, 60.1, 2.0)
    under = np.column_stack([x, np.full(len(x), -1.5), np.zeros(len(x))])
    over = np.column_stack([np.full(len(x), 1.5), x, deck(0 * x, x)])
    joint = np.column_stack([np.linspace(60, 80, 8), np.linspace(0, -80, 8), np.zeros(8)])
    path = np.concatenate([under, joint, over])
    cloud = write_cloud(tmp_path / "cloud", np.concatenate([low, high]), path)
    up = along_x(0.0)[:, ::-1] + (2.0, 0.0)
    town = write_map(tmp_path / "map", {"under": along_x(1.0, -54, 54), "over": up})
    rtmap("label", "lift", town, "--cloud", cloud)
    found = read_map(town).by_id()
    below = found["under"].points[:, 2]
    assert np.nanmax(np.abs(below)) < 0.1 and np.isfinite(below).mean() > 0.9
    z = found["over"].points[:, 2]
    assert np.nanmax(np.abs(z - deck(0 * up[:, 1], up[:, 1]))) < 0.3
    middle = np.abs(up[:, 1]) < 14
    assert np.abs(z[middle] - 6.0).max() < 0.1


def test_planes_know_their_height_and_how_well() -> None:
    """90 % of errors lie within the stated 90 %, floor aside; no points, no height."""
    rng = np.random.default_rng(3)
    n, k = 600, 40
    near = np.concatenate([rng.uniform(-1.2, 1.2, (n, k, 2)), np.zeros((n, k, 1))], axis=-1)
    near[..., 2] = 7 + 0.02 * near[..., 0] + rng.normal(0, 0.03, (n, k))
    near[:, :6, 2] += 0.8
    near[5:9, 3:] = np.nan
    found = heights(near, np.full(n, 7.3), np.zeros((n, 2)))
    known = np.isfinite(found.z)
    assert set(np.flatnonzero(~known)) == {5, 6, 7, 8}
    off = np.abs(found.z[known] - 7.0)
    assert np.median(off) < 0.012 and (off < 1.645 * found.sigma[known]).mean() > 0.85
    assert found.support[known].min() >= 6


def test_bad_input(rtmap: Call, tmp_path: Path) -> None:
    flat = slab(np.random.default_rng(4), (-9, 9), (-9, 9), lambda x, y: 0 * x, 4000)
    path = np.column_stack([along_x(0.0, -9, 9), np.zeros(7)])
    other = write_cloud(tmp_path / "other", flat, path, "EPSG:32633")
    town = write_map(tmp_path / "map", {"a": along_x(0.0, -6, 6)})
    assert "EPSG:32633" in rtmap("label", "lift", town, "--cloud", other, code=3).err
    assert "not a cloud folder" in rtmap("label", "lift", town, "--cloud", town, code=3).err
    far = write_map(tmp_path / "far", {"a": along_x(900.0, -6, 6)})
    cloud = write_cloud(tmp_path / "cloud", flat, path)
    err = rtmap("label", "lift", far, "--cloud", cloud, code=4).err
    assert "none of the 5 vertices" in err
    rtmap("label", "lift", town, "--cloud", cloud, "-o", tmp_path / "new")
    assert np.isfinite(read_map(tmp_path / "new").elements[0].points[:, 2]).all()
    assert len(CloudFolder(cloud).near(ZERO - 1.0, ZERO + 1.0)) < len(flat)
    tile = next((cloud / "tiles").iterdir())
    tile.write_bytes(tile.read_bytes()[:100])
    assert tile.name in rtmap("label", "lift", town, "--cloud", cloud, code=3).err
