"""A labelled drive cut into logs to train on and to test on."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtmap_cli.geometry.poses import se3_from_xyyaw, xyyaw_of
from rtmap_cli.logs.native import NativeLog
from rtmap_cli.maps.crop import DEFAULT_RANGE
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.footprint import points_in_range
from rtmap_cli.maps.store import read_map
from rtmap_cli.steps.label.frames import (
    TYPES,
    Ground,
    apart_split,
    paper_split,
    truth_map,
    types_of,
)

Rtmap = Callable[..., Any]


def drive(count: int = 400) -> np.ndarray[Any, Any]:
    """A frame every 2 m to the east, then to the north."""
    x = np.minimum(np.arange(count) * 2.0, count)
    y = np.maximum(np.arange(count) * 2.0 - count, 0.0)
    yaw = np.where(y > 0, np.pi / 2, 0.0)
    return se3_from_xyyaw(x, y, yaw)


def test_the_papers_split_keeps_the_shares_and_shares_the_ground() -> None:
    pose = drive()
    kind = np.where(np.arange(400) < 40, TYPES.index("loop"), TYPES.index("straight"))
    ground = Ground(pose)
    split = paper_split(kind, ground, 0.75, 1)
    assert split.by_type == {"loop": (30, 10, 0), "straight": (270, 90, 0)}
    assert split.shared > 0.95
    other = paper_split(kind, ground, 0.75, 2)
    assert (other.train != split.train).any()


def test_the_split_apart_shares_no_ground() -> None:
    pose = drive()
    kind = np.full(400, TYPES.index("straight"))
    split = apart_split(kind, pose[:, :2, 3], Ground(pose), 0.75)
    assert split.shared == 0.0 and not (split.train & split.test).any()
    a, b = (
        {tuple(p) for p in points_in_range(pose[m], DEFAULT_RANGE).tolist()}
        for m in (split.train, split.test)
    )
    assert not a & b
    assert 0.2 < split.test.mean() < 0.3
    assert split.train.mean() > 0.6, "only frames near the cut are left out"


def test_a_frame_is_of_the_rarest_type_that_holds() -> None:
    yes, no = np.array([True, True]), np.array([True, False])
    got = types_of({"straight": yes, "intersection": yes, "roundabout": no, "turning": ~yes})
    assert [TYPES[k] for k in got] == ["roundabout", "intersection"]


def test_lines_that_two_lanes_share_are_learned_once() -> None:
    x = np.arange(0.0, 101.0, 2.0)
    left = Element("left", "divider", np.column_stack([x, 0 * x]))
    again = Element("again", "divider", np.column_stack([x[:26], 0 * x[:26] + 0.1]))
    longer = Element("longer", "divider", np.column_stack([x + 60.0, 0 * x + 0.1]))
    across = Element("across", "divider", np.array([[50.0, -20.0], [50.0, 20.0]]))
    curb = Element("curb", "boundary", np.column_stack([x, 0 * x + 0.1]))
    lane = Element("lane", "lanelet", np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 3.0], [0.0, 0.0]]))
    out = truth_map(VectorMap([left, again, longer, across, curb, lane], "EPSG:32632")).by_id()
    assert set(out) == {"left", "longer-0", "across", "curb"}
    assert out["longer-0"].points[0, 0] == pytest.approx(100.0, abs=0.5)


def test_stretches_that_were_assumed_can_be_left_out() -> None:
    x = np.arange(0.0, 101.0, 2.0)
    points = np.column_stack([x, 0 * x])
    sigma = np.where((x > 30) & (x < 50), 1.5, 0.06)
    row = np.stack([sigma**2, 0 * x, sigma**2, np.nan * x], axis=-1)
    half = Element("half", "divider", points, covariance=row)
    none = Element("none", "boundary", points, covariance=np.tile([2.0, 0.0, 2.0, np.nan], (51, 1)))
    hand = Element("hand", "divider", points + [0.0, 9.0])
    moved = Element("moved", "boundary", points + [0.0, 5.0], covariance=np.full((51, 4), np.nan))
    labels = VectorMap([half, none, hand, moved], "EPSG:32632")
    out = truth_map(labels, 0.5).by_id()
    assert set(out) == {"half-s0", "half-s1", "hand", "moved"}
    assert out["half-s0"].points[-1, 0] == 30.0 and out["half-s1"].points[0, 0] == 50.0
    assert out["half-s1"].covariance is not None
    assert set(truth_map(labels).by_id()) == {"half", "none", "hand", "moved"}


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A town, and the images of a drive of 40 frames through it, small."""
    from rtmap_cli.cli import run

    pytest.importorskip("cv2", reason="rendering needs the extra 'simulate'")
    folder = tmp_path_factory.mktemp("town")
    town, log = str(folder / "town"), str(folder / "log")
    assert run(["simulate", "town", "--seed", "3", "--size", "300", "-o", town]) == 0
    line = ["simulate", "images", "--map", town, "--log", "town:", "--seed", "1", "--width", "160",
            "--spacing", "8", "-q", "-o", log]  # fmt: skip
    assert run(line) == 0
    return folder


def test_logs_come_out_that_the_other_commands_read(
    simulated: Path, rtmap: Rtmap, tmp_path: Path
) -> None:
    out = tmp_path / "frames"
    said = rtmap(
        "label", "frames", simulated / "town", simulated / "log", "-o", out, "-q", "--json"
    )
    told = json.loads(said.out)
    assert json.loads((out / "frames.json").read_text())["splits"] == {
        k: told[k] for k in ("apart", "paper")
    }
    assert told["paper"]["shared_ground"] > 0.5 and told["apart"]["shared_ground"] == 0.0
    whole = NativeLog(simulated / "log")
    count = 0
    for part in ("train", "test"):
        log = NativeLog(out / "paper" / part / "000")
        count += len(log)
        truth, all_truth = log.truth_poses(), whole.truth_poses()
        assert truth is not None and all_truth is not None
        rows = np.searchsorted(all_truth.frame, log.index)
        assert np.allclose(xyyaw_of(truth.pose), xyyaw_of(all_truth.pose[rows]), atol=1e-9)
        frames = list(log.frames())
        first = frames[0]
        camera = next(iter(first.images))
        before = next(f for f in whole.frames() if f.index == first.index)
        assert first.images[camera].read_bytes() == before.images[camera].read_bytes()
        for a, b in pairwise(frames):
            assert (b.odometry is not None) == (b.index == a.index + 1)
        rtmap("check-log", out / "paper" / part / "000")
    assert count == len(whole)
    assert {e.class_name for e in read_map(out / "map")} <= {"divider", "boundary", "ped_crossing"}
    text = rtmap("label", "frames", simulated / "town", simulated / "log", "-o", out, "-q",
                 "--overwrite").out  # fmt: skip
    assert "shared ground" in text and "multi-lane" in text


def test_bad_input_is_one_line(simulated: Path, rtmap: Rtmap, tmp_path: Path) -> None:
    town, log, out = simulated / "town", simulated / "log", tmp_path / "out"
    rtmap("label", "frames", town, log, "--poses", log, "--poses", log, "-o", out, code=2)
    from rtmap_cli.maps.store import write_new_map

    write_new_map(VectorMap([], "EPSG:32633"), tmp_path / "far", "empty")
    said = rtmap("label", "frames", tmp_path / "far", log, "-o", out, code=3)
    assert "EPSG:3263" in said.err and said.err.count("\n") == 1
    assert not out.exists()
