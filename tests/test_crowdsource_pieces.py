"""Elements that crowdsource must not cut: doubted stretches, and lines that fold back."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fusion_scene import ORIGIN, drive, line, save, street

from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.evidence import Counts, Stretch
from rtmap_cli.maps.existence import probability
from rtmap_cli.maps.stations import stations_of
from rtmap_cli.maps.store import read_map, write_new_map
from rtmap_cli.steps.crowdsource import fuse
from rtmap_cli.steps.detect_changes import folds
from rtmap_cli.steps.detect_changes.votes import DriveCounts

Call = Callable[..., Any]


def _fused(rtmap: Call, world: VectorMap, folder: Path, drives: int) -> dict[str, Any]:
    for k in range(drives):
        if not (folder / "runs" / f"d{k}").exists():
            save(drive(world, f"d{k}", seed=k), folder / "runs" / f"d{k}")
    told = rtmap("crowdsource", folder / "runs", "--map", folder / "map", "--json").out
    return dict(json.loads(told))


def test_a_stretch_that_is_unlikely_waits_beside_what_it_met(rtmap: Call, tmp_path: Path) -> None:
    """One drive is not enough to delete: the map remembers the doubt, and nothing comes open."""
    world = street(
        line("lane-a", "divider", 3.5, -20, 40), line("lane-b", "divider", 3.5, 60, 120),
        without=["lane"],
    )  # fmt: skip
    write_new_map(street(), tmp_path / "map", "prior")
    told = _fused(rtmap, world, tmp_path, 1)
    assert told["deleted"] == [] and told["split"] == ["lane"]
    parts = [e for e in read_map(tmp_path / "map") if e.element_id.startswith("lane")]
    west, doubt, east = sorted(parts, key=lambda e: e.xy[:, 0].min())
    assert np.array_equal(west.xy[-1], doubt.xy[0]) and np.array_equal(doubt.xy[-1], east.xy[0])
    assert probability(doubt.existence) < 0.2 < 0.9 < probability(west.existence)
    told = _fused(rtmap, world, tmp_path, 2)
    assert told["deleted"] == [doubt.element_id]
    known = read_map(tmp_path / "map").by_id()
    assert doubt.element_id not in known and {west.element_id, east.element_id} <= known.keys()


def _stretch(start: int, stop: int, odds: float) -> Stretch:
    x = np.arange(start, stop + 1.0)
    geometry = np.stack([x, 0 * x, 0 * x], axis=-1)
    return Stretch(odds > 0, odds, odds - 2.5, geometry, Counts(frames_seen=stop), start, stop)


def test_what_is_only_doubtful_does_not_cut_a_line() -> None:
    parts = [_stretch(0, 9, 3.0), _stretch(10, 14, -0.5), _stretch(15, 40, 4.0)]
    none = [False] * 3
    (whole,) = fuse._kept(parts, none, none, False)
    assert np.array_equal(whole.geometry[:, 0], np.arange(41.0)) and whole.exists
    assert (whole.start, whole.stop, whole.counts.frames_seen) == (0, 40, 40)
    assert whole.log_odds == pytest.approx((9 * 3.0 - 4 * 0.5 + 25 * 4.0) / 38)
    unsure = [False, True, False]
    assert [len(p.geometry) for p in fuse._kept(parts, none, unsure, False)] == [11, 6, 26]
    west, east = fuse._kept(parts, unsure, unsure, False)
    assert (west.stop, east.start) == (9, 15) and len(west.geometry) == 10
    # A ring goes on where it starts, unless something there has gone or is unlikely.
    (ring,) = fuse._kept(parts, unsure, unsure, True)
    assert (ring.start, ring.stop) == (15, 9) and len(ring.geometry) == 36
    first = [True, False, False]
    assert [len(p.geometry) for p in fuse._kept(parts, none, first, True)] == [11, 32]
    assert [len(p.geometry) for p in fuse._kept(parts, first, first, True)] == [31]


def _finger(width: float = 0.6) -> Element:
    """The right kerb with a finger, six metres out and back, between two bays."""
    corners = [(-20, -7), (40, -7), (40, -13), (40 + width, -13), (40 + width, -7), (120, -7)]
    return Element("kerb", "boundary", ORIGIN + np.array(corners, float))


def test_the_two_sides_of_a_finger_stay(rtmap: Call, tmp_path: Path) -> None:
    """Frames see one line where the map has two sides: neither of them has gone."""
    write_new_map(street(_finger(), without=["right"]), tmp_path / "map", "prior")
    stub = Element("stub", "boundary", ORIGIN + np.array([[40.3, -7.4], [40.3, -13.0]]))
    told = _fused(rtmap, street(stub), tmp_path, 3)
    assert told["deleted"] == told["split"] == []
    (kerb,) = [e for e in read_map(tmp_path / "map") if e.element_id.startswith("kerb")]
    assert len(kerb.points) == 6 and kerb.xy[:, 1].min() < ORIGIN[1] - 12.5
    assert probability(kerb.existence) > 0.9


def test_a_finger_that_nobody_sees_goes(rtmap: Call, tmp_path: Path) -> None:
    write_new_map(street(_finger(), without=["right"]), tmp_path / "map", "prior")
    told = _fused(rtmap, street(), tmp_path, 3)
    assert told["deleted"] == ["kerb"]
    left = [e for e in read_map(tmp_path / "map") if e.element_id.startswith("kerb")]
    assert len(left) == 2 and min(e.xy[:, 1].min() for e in left) > ORIGIN[1] - 10


@pytest.mark.parametrize(("width", "folded"), [(0.6, True), (1.6, False)])
def test_folds_pair_the_sides_of_one_line(width: float, folded: bool) -> None:
    beside = line("left", "boundary", -6.5).xy
    stations = stations_of([_finger(width).xy, beside])
    before = len(stations.of_line(0))
    pairs = folds.folds(stations, before)
    assert bool(len(pairs)) == folded
    if folded:
        a, b = stations.xy[pairs[:, 0]], stations.xy[pairs[:, 1]]
        assert len(set(pairs[:, 0].tolist())) == len(pairs) > 8
        assert np.abs(np.abs(a[:, 0] - b[:, 0]) - width).max() < 1e-6
        assert (a[:, 1] < ORIGIN[1] - 6.9).all() and pairs.max() < before


def test_what_either_side_of_a_fold_finds_counts_once_a_frame() -> None:
    asked = np.array([False, False, False, True])
    place, frame = np.array([0, 0, 1, 1, 2]), np.array([0, 1, 1, 2, 3])
    score = np.array([1.0, 0.55, 1.0, 0.55, 1.0])
    views = np.full(4, 4.0)
    counts = DriveCounts(np.array([1.5, 1.5, 1.0, 0.0]), views, asked, None, place, frame, score)  # type: ignore[arg-type]
    got = folds.shared(counts, np.array([[0, 1], [1, 0], [3, 2]]))
    # Frame 2 of the other side, frame 0 of this one; the answer of the fourth stays.
    assert got.hits == pytest.approx([2.0, 2.5, 1.0, 0.0])
    assert counts.hits == pytest.approx([1.5, 1.5, 1.0, 0.0])
