"""Where a network was trained, and how much of a test area it saw there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_logs import write_native_log

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.model_file import find_model, read_model_metadata
from rtmap_cli.geometry.poses import se3_from_xyyaw
from rtmap_cli.logs.run import Observations, Run, RunFrames, run_info, true_poses
from rtmap_cli.logs.run_files import write_run
from rtmap_cli.maps.crs import local_crs, to_lonlat
from rtmap_cli.maps.element import CLASSES, Element, VectorMap
from rtmap_cli.maps.footprint import (
    METADATA_KEY,
    NOTHING_KNOWN,
    TOWNS,
    Footprint,
    footprint_of_map,
    footprint_of_poses,
    read_footprint,
    union,
)
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.steps.evaluate.gates.leak import Area, find_leak
from rtmap_cli.steps.infer.contract import read_metadata

CRS = "EPSG:32617"
EAST, NORTH = 583_000.0, 4_477_000.0
"""Where `write_native_log` begins."""
RANGE = (-36.0, -18.0, 36.0, 18.0)


def along(x0: float, x1: float, step: float = 10.0, y: float = 0.0) -> np.ndarray:
    """Poses (n, 4, 4) of a drive to the east."""
    x = np.arange(x0, x1, step)
    return se3_from_xyyaw(EAST + x, np.full(len(x), NORTH + y), np.zeros(len(x)))


# --- footprints ----------------------------------------------------------------------------------


def test_cells_hold_what_frames_saw() -> None:
    drive = along(0, 1000)
    found = footprint_of_poses(drive, CRS, RANGE)
    assert found.known and found.origins == {"places"}
    # A kilometre of road, 36 m wide, in cells of about 117 m: one row of them or two.
    assert 9 <= len(found.cells) <= 24 and {len(c) for c in found.cells} == {18}
    assert found.holds(to_lonlat(CRS, drive[:, :2, 3])).all()
    ahead = np.array([[EAST + 990 + 30, NORTH + 15], [EAST - 30, NORTH - 15]])
    assert found.holds(to_lonlat(CRS, ahead)).all()
    far = np.array([[EAST + 1200, NORTH], [EAST, NORTH + 180], [EAST - 200, NORTH]])
    assert not found.holds(to_lonlat(CRS, far)).any()
    # The same street of a log in the neighbouring zone is the same street.
    from rtmap_cli.maps.crs import convert

    moved = drive.copy()
    moved[:, :2, 3] = convert(CRS, "EPSG:32618", drive[:, :2, 3])
    turned = footprint_of_poses(moved, "EPSG:32618", RANGE)
    assert len(found.cells & turned.cells) >= 0.8 * len(found.cells)


@pytest.mark.parametrize("seed", range(5))
def test_a_footprint_survives_its_file(seed: int) -> None:
    rng = np.random.default_rng(seed)
    keys = ["".join(map(str, row)) for row in rng.integers(0, 4, (int(rng.integers(1, 40)), 18))]
    near = {keys[0][:12] + k[12:] for k in keys}
    whole = Footprint(frozenset({"places", "unknown"}), frozenset({*keys, *near}))
    text = json.dumps(whole.as_json())
    assert read_footprint(json.loads(text)) == whole
    assert len(text) < 100 + 7 * len(near) + 32 * len(keys)
    assert whole | whole == whole and whole | TOWNS == TOWNS | whole
    assert union([]) == Footprint() and union([whole, TOWNS]) == whole | TOWNS


def test_footprints_without_places() -> None:
    assert read_footprint(None) == NOTHING_KNOWN and not NOTHING_KNOWN.known
    assert TOWNS.known and TOWNS.text() == "procedural towns"
    local = footprint_of_poses(along(0, 50), local_crs("a yard"), RANGE)
    assert local.origins == {"local"} and not local.known and not local.cells
    assert read_footprint(local.as_json()) == local
    seen = NOTHING_KNOWN | footprint_of_poses(along(0, 50), CRS, RANGE)
    assert seen.stated(TOWNS).origins == {"places", "procedural"} and not seen.known
    assert footprint_of_map(VectorMap([], CRS)) == Footprint()


@pytest.mark.parametrize(
    "value",
    [
        [],
        {"origins": ["places"], "zoom": 18},
        {"origins": ["places"], "zoom": 18, "cells": {"0" * 12: "012345"}},
        {"origins": ["places"], "zoom": 17, "cells": {"0" * 12: "012301"}},
        {"origins": ["places"], "zoom": 18, "cells": {}},
        {"origins": ["procedural"], "zoom": 18, "cells": {"0" * 12: "012301"}},
        {"origins": ["moon"], "zoom": 18, "cells": {}},
        {"origins": [], "zoom": 18, "cells": {}},
        {"origins": "places", "zoom": 18, "cells": {"0" * 12: "012301"}},
    ],
)
def test_a_footprint_that_makes_no_sense(value: Any) -> None:
    with pytest.raises(ValueError, match="training footprint"):
        read_footprint(value)


def test_what_a_model_file_says() -> None:
    path = find_model("rtmap-tiny")
    metadata = read_model_metadata(path)
    seen = footprint_of_poses(along(0, 200), CRS, RANGE)
    told = metadata | {METADATA_KEY: json.dumps(seen.as_json())}
    assert read_metadata(path, told, "0").footprint == seen
    silent = {k: v for k, v in metadata.items() if k != METADATA_KEY}
    assert read_metadata(path, silent, "0").footprint == NOTHING_KNOWN
    for wrong in ("{", json.dumps({"cells": 3})):
        with pytest.raises(BadInput, match="metadata make no sense"):
            read_metadata(path, metadata | {METADATA_KEY: wrong}, "0")


# --- leaks ---------------------------------------------------------------------------------------


def test_shares_of_area_and_frames() -> None:
    trained = footprint_of_poses(along(0, 1000), CRS, RANGE)
    half = find_leak("a", trained, Area(along(500, 1500), CRS, RANGE))
    assert half.certain and half.area is not None and half.frames is not None
    # Cells reach up to one of their edges (117 m) beyond what was seen.
    assert 0.5 <= half.area <= 0.68 and 0.5 <= half.frames <= 0.68
    apart = find_leak("a", trained, Area(along(0, 1000, y=400), CRS, RANGE))
    assert (apart.area, apart.frames) == (0.0, 0.0) and not apart.findings(0.0)
    same = find_leak("a", trained, Area(along(0, 1000), CRS, RANGE))
    assert same.area == same.frames == 1.0 and "100.0%" in same.findings(0.05)[0]
    least = find_leak("a", trained | NOTHING_KNOWN, Area(along(500, 1500), CRS, RANGE))
    assert not least.certain and "at least" in least.sentence()
    nowhere = find_leak("a", trained, Area(along(0, 100), local_crs("a yard"), RANGE))
    assert nowhere.area is None and not nowhere.certain
    assert find_leak("a", TOWNS, Area(along(0, 100), CRS, RANGE)).area == 0.0


def a_run(folder: Path, x0: float = 0.0, **info: Any) -> Path:
    """A run over 300 m that saw nothing; it knows its poses."""
    pose = along(x0, x0 + 300)
    n, nothing = len(pose), np.full((len(pose), 3), np.nan)
    times = 1_700_000_000_000_000_000 + np.arange(n, dtype=np.int64) * 500_000_000
    frames = RunFrames(
        frame=np.arange(n, dtype=np.int32),
        timestamp_ns=times,
        initial=pose,
        sigma=np.ones((n, 3)),
        odometry=nothing,
        odometry_sigma=nothing,
        end_to_end=nothing,
        end_to_end_covariance=np.full((n, 3, 3), np.nan),
        camera_count=np.ones(n, np.int32),
    )
    box = {"x": [-36.0, 36.0], "y": [-18.0, 18.0]}
    known = run_info("drive", CRS, list(CLASSES), box, **info)
    truth = true_poses(frames.frame, times, pose)
    folder.mkdir()
    write_run(Run(known, frames, Observations.empty(), poses=truth), folder)
    return folder


def a_street(folder: Path, x1: float = 2000.0) -> Path:
    line = np.array([[EAST - 50, NORTH + 2], [EAST + x1, NORTH + 2]])
    write_new_map(VectorMap([Element("a", "divider", line)], CRS), folder, "test")
    return folder


@pytest.fixture
def judge(rtmap: Any, tmp_path: Path) -> Any:
    """``judge(run, …)`` evaluates a run against a street of two kilometres."""
    truth = a_street(tmp_path / "truth")

    def call(run: Path, *arguments: object, code: int = 0) -> Any:
        command = ("evaluate", "map", run, "--truth", truth, "--poses", run)
        return rtmap(*command, *arguments, code=code)

    return call


def test_a_run_warns_of_its_own_model(judge: Any, tmp_path: Path) -> None:
    seen = footprint_of_poses(along(0, 1000), CRS, RANGE).as_json()
    run = a_run(tmp_path / "run", 100.0, model="mine", model_footprint=seen)
    told = judge(run, "--json")
    leak = json.loads(told.out)["leak"]
    assert leak["trained_on"] == "mine" and leak["certain"]
    assert leak["area_seen"] == leak["frames_seen"] == 1.0
    assert "100.0% of the test area" in told.err and "mine" in told.err
    failed = judge(run, "--fail-on-leak", code=1)
    assert "100.0% of the test area was seen in training, over 5.0%" in failed.err
    assert "mAP" in failed.out
    judge(run, "--fail-on-leak", "--max-leak", "1")
    far = a_run(tmp_path / "far", 1500.0, model="mine", model_footprint=seen)
    told = judge(far, "--json", "--fail-on-leak")
    assert json.loads(told.out)["leak"]["area_seen"] == 0.0 and "leak: 0.0%" in told.err
    assert "leak" not in judge(far).err, "nothing to say where nothing was asked"


def test_a_run_whose_model_says_nothing(judge: Any, tmp_path: Path) -> None:
    run = a_run(tmp_path / "run", model="mine", model_footprint=NOTHING_KNOWN.as_json())
    told = judge(run, "--json")
    leak = json.loads(told.out)["leak"]
    assert leak["area_seen"] is None and not leak["certain"] and "unknown" in leak["training"]
    unknown = judge(run, "--fail-on-leak", code=4)
    assert "cannot be told" in unknown.err and "--trained-on" in unknown.err
    bare = a_run(tmp_path / "bare")
    assert "leak" not in json.loads(judge(bare, "--json").out)
    judge(bare, "--fail-on-leak", code=4)
    odd = a_run(tmp_path / "odd", model="mine", model_footprint={"cells": 3})
    told = judge(odd, code=3)
    assert "run.json makes no sense" in told.err and told.err.count("\n") == 1


def test_what_training_saw_may_be_named(judge: Any, rtmap: Any, tmp_path: Path) -> None:
    run = a_run(tmp_path / "run", 0.0)
    short = a_street(tmp_path / "short", 100.0)
    leak = json.loads(judge(run, "--trained-on", short, "--json").out)["leak"]
    assert 0.3 <= leak["area_seen"] <= 0.85 and leak["certain"]
    log = write_native_log(tmp_path / "log")
    judge(run, "--trained-on", log, "--fail-on-leak", code=1)
    other = a_run(tmp_path / "other", 0.0, model="towns", model_footprint=TOWNS.as_json())
    judge(run, "--trained-on", other, "--fail-on-leak")
    both = judge(run, "--trained-on", other, "--trained-on", log, "--fail-on-leak", code=1)
    assert "over 5.0%" in both.err
    for wrong, what in (("nowhere", "no such model, run, map or log"), ("no.onnx", "no such")):
        told = judge(run, "--trained-on", tmp_path / wrong, code=3)
        assert what in told.err and told.err.count("\n") == 1
    (tmp_path / "odd.onnx").write_bytes(b"hello")
    told = judge(run, "--trained-on", tmp_path / "odd.onnx", code=3)
    assert "cannot be loaded as ONNX" in told.err and told.err.count("\n") == 1


def test_the_shipped_model_can_be_asked(judge: Any, tmp_path: Path) -> None:
    run = a_run(tmp_path / "run", 0.0)
    leak = json.loads(judge(run, "--trained-on", "rtmap-tiny", "--json").out)["leak"]
    assert leak["trained_on"] == "rtmap-tiny" and leak["area_seen"] in (None, 0.0)


def test_a_leak_check_that_cannot_be_meant(rtmap: Any, tmp_path: Path) -> None:
    line = {"class": "divider", "points": [[-20, 0], [20, 0]], "score": 0.9}
    frames = tmp_path / "frames.json"
    frames.write_text(json.dumps({"classes": ["divider"], "frames": {"log_1": [line]}}))
    call = ("evaluate", "map", frames, "--truth", frames)
    assert "--trained-on" in rtmap(*call, "--fail-on-leak", code=2).err
    street = a_street(tmp_path / "street")
    assert "--poses" in rtmap(*call, "--trained-on", street, code=2).err
