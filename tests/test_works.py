"""A construction zone through the command line: opened, mapped around, and gone again."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from fusion_scene import CRS, ORIGIN, street

from rtmap_cli.errors import NoAnswer
from rtmap_cli.geometry.poses import se3_from_xyyaw
from rtmap_cli.logs.log import Frame
from rtmap_cli.logs.native import NativeLogWriter
from rtmap_cli.logs.run import true_poses
from rtmap_cli.logs.run_files import write_poses
from rtmap_cli.maps.crs import lonlat_to
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import read_map, write_new_map
from rtmap_cli.steps.simulate.worlds.works import open_works

Call = Callable[..., Any]
DRIVES = 3


def _log(folder: Path) -> None:
    """A log along the right lane, with true poses and no images."""
    x = np.arange(0.0, 100.0, 2.5)
    n = len(x)
    pose = se3_from_xyyaw(ORIGIN[0] + x, np.full(n, ORIGIN[1] - 2.0), np.zeros(n))
    times = 10**18 + (np.arange(n) * 5e8).astype(np.int64)
    writer = NativeLogWriter(folder, "way", CRS, None)
    for k in range(n):
        writer.add(Frame(k, int(times[k]), pose[k], np.ones(3)), {})
    writer.close()
    (folder / "truth").mkdir()
    write_poses(true_poses(np.arange(n, dtype=np.int32), times, pose), folder / "truth", CRS)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The world before and during the works, the map of before, and the log whose way it is."""
    from rtmap_cli.cli import run

    folder = tmp_path_factory.mktemp("site")
    (folder / "log").mkdir()
    _log(folder / "log")
    write_new_map(street(), folder / "world", "as ever")
    words = ["simulate", "changes", "--map", folder / "world", "--works", 40, "--seed", 4]
    words += ["--near", folder / "log", "-o", folder / "works", "--truth", folder / "truth.json"]
    assert run([str(w) for w in words]) == 0
    return folder


def _drives(site: Path, world: str, map_path: Path, runs: Path, first: int, rtmap: Call) -> None:
    """Drives through a world, localized on a map."""
    more = ["--works", site / "truth.json"] if world == "works" else []
    for k in range(first, first + DRIVES):
        rtmap("simulate", "observations", "--map", site / world, "--log", site / "log", "--preset",
              "mild", "--traversal", k, *more, "-q", "-o", runs / str(k))  # fmt: skip
        rtmap("localize", runs / str(k), "--map", map_path, "--smooth")


def _off(vector_map: VectorMap, class_name: str, truth: VectorMap) -> float:
    """The distance (m) from the true lines of a class that a tenth of the points every 2 m along
    its lines exceeds, over the works and 10 m around them."""
    lines = shapely.union_all([shapely.LineString(e.xy) for e in truth.of_class(class_name)])
    xy = [
        shapely.get_coordinates(shapely.segmentize(shapely.LineString(e.xy), 2.0))
        for e in vector_map.of_class(class_name)
    ]
    points = np.concatenate(xy)
    inside = (points[:, 0] > ORIGIN[0] - 5.0) & (points[:, 0] < ORIGIN[0] + 57.0)
    return float(np.quantile(shapely.distance(shapely.points(points[inside]), lines), 0.9))


def _stray(vector_map: VectorMap, site: Path) -> float:
    """Metres of dividers where there is none, neither before nor during the works."""
    true = [e for n in ("world", "works") for e in read_map(site / n).of_class("divider")]
    room = shapely.union_all([shapely.LineString(e.xy) for e in true]).buffer(1.5)
    lines = [shapely.LineString(e.xy) for e in vector_map.of_class("divider")]
    return sum(float(shapely.difference(x, room).length) for x in lines)


def test_works_narrow_the_street_and_move_the_lanes(site: Path) -> None:
    truth = json.loads((site / "truth.json").read_text("utf-8"))
    pairs: dict[str, set[str]] = {}
    for c in truth["changes"]:
        pairs.setdefault(c["moved"], set()).add(f"{c['kind']} {c['class']}")
    assert {"delete boundary", "insert boundary"} in pairs.values()
    assert {"delete divider", "insert divider"} in pairs.values()
    works = read_map(site / "works")
    barrier, lanes = works.by_id()["works-curb"], works.of_class("divider")
    aside = 7.0 - np.abs(barrier.xy[:, 1] - ORIGIN[1])
    assert 1.9 < aside.max() < 2.7 and aside[[0, -1]].max() < 0.1
    moved = [e for e in lanes if e.element_id.startswith("works-lane")]
    assert len(moved) == 2
    shapes = [shapely.LineString(e.xy) for e in lanes]
    for row in truth["delineators"]:
        posts = shapely.points(lonlat_to(CRS, np.array(row)))
        assert len(posts) >= 3
        assert min(shapely.distance(posts, s).min() for s in shapes) > 0.3


def test_delineators_never_become_dividers(site: Path, tmp_path: Path, rtmap: Call) -> None:
    shutil.copytree(site / "world", tmp_path / "map")
    _drives(site, "works", tmp_path / "map", tmp_path / "runs", 0, rtmap)
    said = json.loads(rtmap("update", tmp_path / "runs", "--map", tmp_path / "map", "-o",
                            tmp_path / "c.geojson", "--json").out)  # fmt: skip
    assert {(c["kind"], c["class"]) for c in said["changes"]} <= {
        ("modify", "boundary"), ("modify", "divider")
    }  # fmt: skip
    works = read_map(site / "works")
    middle = works.by_id()["works-curb"].xy.mean(axis=0)
    flagged = np.array([c["low"] for c in said["cells"] if c["flagged"]]) + 9.0
    assert np.hypot(*(flagged - middle).T).min() < 13.0
    assert np.abs(flagged[:, 0] - middle[0]).max() < 20.0 + 18.0
    for method in ("elements", "grid"):
        shutil.copytree(site / "world", tmp_path / method)
        rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / method, "--method", method)
        assert _stray(read_map(tmp_path / method), site) < 3.0, method
    told = json.loads(rtmap("detect-changes", *sorted((tmp_path / "runs").glob("?")), "--map",
                            tmp_path / "map", "-o", tmp_path / "d.geojson", "--displaced",
                            "--json").out)  # fmt: skip
    assert {c["class"] for c in told["changes"]} >= {"boundary"}
    assert not any(c["kind"] == "insert" and c["class"] == "divider" for c in told["changes"])


def test_after_the_works_the_map_comes_back(site: Path, tmp_path: Path, rtmap: Call) -> None:
    target, truth = tmp_path / "map", {n: read_map(site / n) for n in ("world", "works")}
    shutil.copytree(site / "world", target)
    before = _off(read_map(target), "boundary", truth["works"])
    for first, world in ((0, "works"), (DRIVES, "world")):
        runs, changes = tmp_path / f"runs-{world}", tmp_path / f"{world}.geojson"
        _drives(site, world, target, runs, first, rtmap)
        rtmap("update", runs, "--map", target, "-o", changes)
        rtmap("map", "apply", target, changes, "--all")
        now = read_map(target)
        assert _off(now, "boundary", truth[world]) < 0.5 < before
        # Lanes that moved by about a metre are not always told in a map as small as this one.
        assert _off(now, "divider", truth[world]) < (0.7 if world == "world" else 1.6)
        if world == "works":
            continue
        # The same drives have nothing more to say: no flicker.
        again = json.loads(rtmap("update", runs, "--map", target, "-o", changes, "--overwrite",
                                 "--json").out)  # fmt: skip
        assert again["changes"] == []


def test_bad_works(site: Path, tmp_path: Path, rtmap: Call) -> None:
    base = ("simulate", "changes", "--map", site / "world", "-o", tmp_path / "out")
    assert "--works needs --near" in rtmap(*base, "--works", 40, code=2).err
    near = ("--works", 40, "--near", site / "log")
    rtmap(*base, *near, "--change", "delete:divider", code=2)
    rtmap(*base, *near, "--outdate", code=2)
    assert "name a --change" in rtmap(*base, code=2).err
    told = rtmap(*base, "--works", 400, "--near", site / "log", code=4)
    assert "choose shorter works" in told.err and not (tmp_path / "out").exists()
    see = ("simulate", "observations", "--map", site / "works", "--log", site / "log", "-q", "-o",
           tmp_path / "run")  # fmt: skip
    for text in ('{"changes": []}', "[1]", '{"delineators": [[1, 2]]}', '{"delineators": [["x"]]}'):
        (tmp_path / "t.json").write_text(text, "utf-8")
        told = rtmap(*see, "--works", tmp_path / "t.json", code=3)
        assert told.err.count("\n") == 1 and not (tmp_path / "run").exists()
    rtmap(*see, "--works", tmp_path / "none.json", code=3)


def test_a_way_without_a_curb() -> None:
    way = ORIGIN + np.stack([np.arange(100.0), np.full(100, -2.0)], axis=-1)
    with pytest.raises(NoAnswer):
        open_works(street(without=("left", "right")), way, 30.0, np.random.default_rng(0))
