"""The scripts of examples/ run as a user runs them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rtmap_cli.geometry.polylines import project
from rtmap_cli.maps.store import read_map

ROOT = Path(__file__).resolve().parents[1]


def test_the_chain_on_a_real_log(av2_log: Path, tmp_path: Path) -> None:
    pytest.importorskip("cv2", reason="rendering needs the extra 'simulate'")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    result = subprocess.run(
        ["bash", str(ROOT / "examples/av2_chain.sh"), str(av2_log), str(tmp_path), "6"],
        capture_output=True,
        text=True,
        env={**os.environ, "PATH": path},
    )
    assert result.returncode == 0, result.stdout + result.stderr
    for name in ("map", "world", "runs/1/poses.parquet", "changes.geojson", "truth.json"):
        assert (tmp_path / name).exists(), name
    assert "mAP" in result.stdout and "lateral" in result.stdout
    versions = subprocess.run(
        [sys.executable, "-m", "rtmap_cli", "map", "log", str(tmp_path / "map"), "--json"],
        capture_output=True,
        text=True,
    )
    assert len(json.loads(versions.stdout)["versions"]) == 2


def test_a_construction_zone_from_first_to_last_day(tmp_path: Path) -> None:
    pytest.importorskip("cv2", reason="rendering needs the extra 'simulate'")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    result = subprocess.run(
        ["bash", str(ROOT / "examples/construction_zone.sh"), str(tmp_path), "40", "3"],
        capture_output=True,
        text=True,
        env={**os.environ, "PATH": path},
    )
    assert result.returncode == 0, result.stdout + result.stderr
    told = {}
    for name in ("during", "after", "again"):
        content = json.loads((tmp_path / f"{name}.geojson").read_text("utf-8"))
        told[name] = [f["properties"] for f in content["features"]]
    for name in ("during", "after"):
        assert {p["class"] for p in told[name]} == {"divider", "boundary"}
        assert not any(p["kind"] == "insert" and p["class"] == "divider" for p in told[name])
    assert told["again"] == []


def test_the_ring_from_a_survey_to_the_update_of_its_map(tmp_path: Path) -> None:
    """Without training, which tests of its own cover: an export takes longer than all the rest."""
    pytest.importorskip("cv2", reason="rendering needs the extra 'simulate'")
    pytest.importorskip("small_gicp", reason="clouds need the extra 'label'")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    result = subprocess.run(
        ["bash", str(ROOT / "examples/label_ring.sh"), str(tmp_path), "0", "80", "1", "192"],
        capture_output=True,
        text=True,
        env={**os.environ, "PATH": path},
    )
    assert result.returncode == 0, result.stdout + result.stderr
    labels = {e.element_id: e for e in read_map(tmp_path / "labels")}
    drawn = [name for name in labels if name.startswith("hand-")]
    assert drawn and all(labels[name].class_name == "ped_crossing" for name in drawn)
    truth = read_map(tmp_path / "frames/map")
    lines = [e for e in truth if e.class_name != "ped_crossing"]
    world = [e.xy for e in read_map(tmp_path / "world") if e.class_name != "ped_crossing"]
    off = [np.min([project(e.xy, line)[1] for line in world], axis=0) for e in lines]
    assert len(lines) >= 2 and np.percentile(np.concatenate(off), 90) < 0.5, "of a few sweeps"
    assert "lateral" in result.stdout and result.stdout.count("mAP") == 4
    told = json.loads((tmp_path / "changes.geojson").read_text("utf-8"))["features"]
    assert all(0.5 <= f["properties"]["probability"] <= 1 for f in told)
