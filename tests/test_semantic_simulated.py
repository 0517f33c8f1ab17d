"""A simulated cart: two cameras, a LiDAR, masks; the semantic map against the town it drove in."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
from PIL import Image

from rtmap_cli.cli import run
from rtmap_cli.logs.native import NativeLog
from rtmap_cli.maps.store import read_map

pytest.importorskip("cv2")

Call = Any


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("town") / "map"
    assert run(["simulate", "town", "--seed", "3", "-o", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def cart(town: Path) -> Path:
    """A log of ten frames; the cameras expose 60 ms after the LiDAR."""
    return drive(town, town.parent / "cart", 10, "vlp16")


def drive(town: Path, out: Path, frames: int, lidar: str, *more: object) -> Path:
    words = ["simulate", "images", "--map", town, "--log", "town:", "--seed", 1, "--masks", "-q"]
    words += ["--rig", "campus", "--camera-delay", 0.06, "--frames", frames, "--width", 640]
    assert run([str(w) for w in [*words, "--lidar", lidar, "-o", out, *more]]) == 0
    return out


def test_the_log_holds_what_a_cart_records(rtmap: Call, cart: Path) -> None:
    log = NativeLog(cart)
    assert log.rig is not None and [c.name for c in log.rig] == ["front_left", "front_right"]
    names = [r["name"] for r in json.loads((cart / "masks" / "labels.json").read_text())["labels"]]
    for frame in log.frames():
        assert set(frame.image_time_ns.values()) == {frame.timestamp_ns + 60_000_000}
        assert frame.lidar_time_ns == frame.timestamp_ns
        points = log.read_sweep(frame)
        assert points is not None and 8_000 < len(points) < 28_800
        assert points[:, 3].min() >= 0 and points[:, 3].max() <= 1
    assert len(list((cart / "masks").glob("*/*.png"))) == 20
    assert "construction--flat--road" in names
    assert "0 errors" in rtmap("check-log", cart).out


def test_sweeps_lie_on_the_ground_and_on_what_stands(cart: Path) -> None:
    """Points on the painted lines are bright; near ground lies at the height of the road."""
    log = NativeLog(cart)
    frame = next(log.frames())
    points = log.read_sweep(frame)
    assert points is not None
    near = np.hypot(points[:, 0], points[:, 1]) < 9
    low = points[near & (np.abs(points[:, 2] - log.ground_z) < 0.4)]
    assert len(low) > 300
    slope = np.linalg.lstsq(np.column_stack([low[:, :2], np.ones(len(low))]), low[:, 2], rcond=None)
    residual = low[:, 2] - np.column_stack([low[:, :2], np.ones(len(low))]) @ slope[0]
    assert residual.std() < 0.05 and abs(slope[0][2] - log.ground_z) < 0.1


def test_the_semantic_map_is_that_of_the_town(
    rtmap: Call, town: Path, cart: Path, tmp_path: Path
) -> None:
    """Laid down along the true poses: classes agree with the elements of the map."""
    poses = cart / "truth" / "poses.parquet"
    rtmap("semantic-map", cart, "--poses", poses, "-o", tmp_path / "out", "-q", "--windows", "none")
    table = pq.read_table(tmp_path / "out" / "cells.parquet").to_pydict()
    xy = np.column_stack([table["x"], table["y"]])
    names, weight = np.array(table["class_name"]), np.array(table["weight"])
    sure = weight > 0.6
    xy, names = xy[sure], names[sure]
    assert len(xy) > 3_000
    world = read_map(town, None)

    def off(kind: str) -> Any:
        lines = shapely.union_all([shapely.linestrings(e.xy) for e in world.of_class(kind)])
        return lambda p: shapely.distance(lines, shapely.points(p))

    curb = off("boundary")(xy[names == "curb"])
    assert len(curb) > 15 and np.median(curb) < 0.3
    rings = [shapely.polygons(e.xy) for e in world.of_class("ped_crossing")]
    crossings = shapely.union_all(rings)
    inside = shapely.distance(crossings, shapely.points(xy[names == "crosswalk"]))
    assert np.mean(inside < 0.3) > 0.9
    inner = shapely.contains_xy(crossings.buffer(-0.4), *xy.T)
    assert inner.sum() > 100 and np.mean(names[inner] == "crosswalk") > 0.9
    walk = off("boundary")(xy[names == "sidewalk"])
    assert len(walk) > 20 and np.percentile(walk, 95) < 3.6
    # Lines of the map that were driven past are found as paint.
    lines = [e for e in world.of_class("divider") if "SOLID" in e.attributes.get("mark", "SOLID")]
    dividers = shapely.union_all([shapely.linestrings(e.xy) for e in lines])
    on_line = shapely.distance(dividers, shapely.points(xy)) < 0.08
    on_line &= shapely.distance(crossings, shapely.points(xy)) > 0.5
    assert on_line.sum() > 20 and np.mean(names[on_line] == "marking") > 0.75


def test_rough_poses_still_give_a_sharp_picture(rtmap: Call, cart: Path, tmp_path: Path) -> None:
    """Initial poses are metres off: smoothed along the odometry, frames lie on each other."""
    rtmap("semantic-map", cart, "-o", tmp_path / "rough", "-q")
    rtmap(
        "semantic-map", cart, "-o", tmp_path / "true", "-q",
        "--poses", cart / "truth" / "poses.parquet",
    )  # fmt: skip
    sizes = {}
    for name in ("rough", "true"):
        table = pq.read_table(tmp_path / name / "cells.parquet").to_pydict()
        share = np.stack([table[f"p_{n}"] for n in ("road", "crosswalk", "marking", "curb")])
        seen = np.array(table["frames"]) >= 2
        sizes[name] = float(np.mean(share.max(axis=0)[seen] > 0.8))
    assert sizes["rough"] > 0.9 * sizes["true"]
    from rtmap_cli.logs.semantic import SemanticMap

    true, rough = (SemanticMap(tmp_path / n) for n in ("true", "rough"))
    a, b = (m.read_window(int(m.frame[-1])) for m in (true, rough))
    both = (a[-1] > 60) & (b[-1] > 60)
    same = a[:-1].argmax(axis=0) == b[:-1].argmax(axis=0)
    assert both.sum() > 2_000 and same[both].mean() > 0.9


def test_same_seed_same_frames(town: Path, cart: Path) -> None:
    once, again = (drive(town, cart.parent / name, 2, "vlp16") for name in ("once", "again"))
    files = [p.relative_to(again) for p in again.rglob("*.*") if p.is_file()]
    assert len(files) > 2 * (2 + 2 + 1)
    for file in files:
        assert (once / file).read_bytes() == (again / file).read_bytes(), file
    assert json.loads((cart / "log.json").read_text())["creation"]["lidar"] == "vlp16"


def test_masks_may_be_wrong(town: Path, cart: Path) -> None:
    """A share of the paint is missed, the rest stays about where it is."""
    folder = cart.parent / "wrong"
    drive(town, folder, 10, "vlp16", "--mask-errors", 0.2)
    names = [r["name"] for r in json.loads((cart / "masks" / "labels.json").read_text())["labels"]]
    painted = [names.index(n) for n in ("marking--general", "construction--flat--crosswalk-plain")]
    before, after, same = 0, 0, []
    for path in sorted((cart / "masks").glob("*/*.png")):
        right = np.asarray(Image.open(path))
        wrong = np.asarray(Image.open(folder / path.relative_to(cart)))
        before += np.isin(right, painted).sum()
        after += np.isin(wrong, painted).sum()
        same.append((right == wrong).mean())
    assert 0.65 < after / before < 0.93
    assert 0.8 < np.mean(same) < 0.995


def test_denser_lidars_see_more(town: Path, cart: Path) -> None:
    dense = NativeLog(drive(town, cart.parent / "dense", 1, "os64"))
    counts = [len(log.read_sweep(next(log.frames()))) for log in (dense, NativeLog(cart))]  # type: ignore[arg-type]
    assert counts[0] > 2 * counts[1]
