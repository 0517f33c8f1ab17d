"""Real sweeps: KITTI, Argoverse 2, Newer College, small_gicp's pair."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("small_gicp")


@pytest.fixture(scope="module")
def real() -> Any:
    from benchmarks.label import cloud_real

    return cloud_real


def _need(folder: Path) -> None:
    if not folder.is_dir():
        pytest.skip(f"{folder.name} not found in RTMAP_DATA")


def test_kitti_sweeps_far_apart(real: Any, rtmap_data: Path) -> None:
    _need(rtmap_data / "lidar_registration")
    found = real.kitti(rtmap_data, "vgicp")
    assert found["pair_m"] <= 0.05 and found["pair_deg"] <= 0.15
    assert found["aligned_m"] <= 0.05 and found["first_deg"] <= 0.15
    ndt = real.kitti(rtmap_data, "ndt")
    assert ndt["pair_m"] <= 0.05 and ndt["pair_deg"] <= 0.3


def test_argoverse_pair(real: Any, av2_log: Path, rtmap_data: Path) -> None:
    found = real.av2(rtmap_data, "vgicp")
    assert found["m"] <= 0.03 and found["deg"] <= 0.1


def test_newer_college_turns(real: Any, rtmap_data: Path) -> None:
    _need(rtmap_data / "lidar_registration")
    found = real.newer(rtmap_data, "-")
    assert found["raw_m"] > 0.4 and found["m"] < 0.1 and found["fitted_m"] < 0.05


def test_small_gicp_pair(real: Any, rtmap_data: Path) -> None:
    _need(rtmap_data / "lidar_registration")
    found = real.pair(rtmap_data, "vgicp")
    assert found["m"] <= 0.05 and found["deg"] <= 0.5
