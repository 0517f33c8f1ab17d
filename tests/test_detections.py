"""``rtmap import detections`` and the fleet benchmark's formats."""

from __future__ import annotations

import copy
import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.detections import (
    assumed_odometry_sigma,
    read_detections,
    read_fleet_poses,
)
from rtmap_cli.geometry.poses import xyyaw_of
from rtmap_cli.logs.run import NEW
from rtmap_cli.logs.run_files import read_run


def drive() -> dict[str, Any]:
    """Two frames; the second detection has seven vertices."""
    line = [[float(x), 2.0] for x in np.linspace(-10, 10, 20)]
    short = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [4.0, 0.0], [5.0, 0.0], [6.0, 0.0]]
    frame = {
        "frame": 0,
        "timestamp_ns": 1_000_000_000,
        "vectors": [
            {
                "pts": line,
                "cls_name": "divider",
                "confidence_level": 0.9,
                "sigma": [[0.2, 0.1]] * 20,
            },
            {
                "pts": short,
                "cls_name": "boundary",
                "confidence_level": 0.5,
                "sigma": [[0.1 + 0.1 * k, 0.3] for k in range(7)],
            },
        ],
        "initial_pose": {"easting": 500000.0, "northing": 4000000.0, "yaw_rad": 0.5},
        "initial_sigma": {"easting": 0.9, "northing": 0.8, "yaw_rad": 0.02},
        "odometry": {"dx": 0.0, "dy": 0.0, "dyaw": 0.0},
        "occluders": [{"x": 8.0, "y": -3.0, "yaw": 0.1, "length": 4.6, "width": 1.9}],
    }
    second = copy.deepcopy(frame) | {"frame": 4, "timestamp_ns": 1_500_000_000, "vectors": []}
    second["odometry"] = {"dx": 2.5, "dy": 0.0, "dyaw": 0.01}
    meta = {
        "log_id": "drive",
        "class_names": ["ped_crossing", "divider", "boundary"],
        "range_m": {"x": [-36.0, 36.0], "y": [-18.0, 18.0]},
        "crs_of_poses": "EPSG:32617",
    }
    return {"meta": meta, "results": [frame, second]}


def write(path: Path, value: Any) -> Path:
    with gzip.open(path, "wt") as file:
        json.dump(value, file)
    return path


def test_import_writes_a_run(rtmap: Any, tmp_path: Path) -> None:
    source = write(tmp_path / "drive.json.gz", drive())
    report = json.loads(rtmap("import", "detections", source, "-o", tmp_path / "run", "--json").out)
    assert report["observations"] == {"ped_crossing": 0, "divider": 1, "boundary": 1}
    run = read_run(tmp_path / "run")
    assert (run.log_id, run.crs) == ("drive", "EPSG:32617")
    assert (run.observations.state == NEW).all()
    assert run.observations.element_id.tolist() == [None, None]
    assert np.isnan(run.observations.prior_points).all()
    np.testing.assert_allclose(xyyaw_of(run.frames.initial)[0], [500000, 4000000, 0.5])
    np.testing.assert_allclose(run.frames.sigma[0], [0.9, 0.8, 0.02])
    # Nothing precedes the first frame; later steps get the stated default.
    assert np.isnan(run.frames.odometry[0]).all()
    np.testing.assert_allclose(run.frames.odometry[1], [2.5, 0.0, 0.01])
    np.testing.assert_allclose(run.frames.odometry_sigma[1], [0.025, 0.025, 2.5 * np.radians(0.05)])
    assert run.occluders is not None and run.occluders["frame"].to_pylist() == [0, 4]
    assert not run.info.get("map")


def test_other_vertex_counts_are_resampled_with_their_sigma(tmp_path: Path) -> None:
    observations = read_detections(write(tmp_path / "d.json.gz", drive())).observations
    np.testing.assert_allclose(observations.points[1, :, 0], np.linspace(0, 6, 20), atol=1e-6)
    np.testing.assert_allclose(observations.sigma[1, :, 0], np.linspace(0.1, 0.7, 20), atol=1e-6)


def test_a_standing_vehicle_is_not_infinitely_well_known() -> None:
    assert (assumed_odometry_sigma(np.zeros(3)) > 0).all()


def test_import_refuses_to_overwrite(rtmap: Any, tmp_path: Path) -> None:
    source = write(tmp_path / "drive.json.gz", drive())
    rtmap("import", "detections", source, "-o", tmp_path / "run")
    assert "exists" in rtmap("import", "detections", source, "-o", tmp_path / "run", code=2).err
    rtmap("import", "detections", source, "-o", tmp_path / "run", "--overwrite")


def _broken(change: Any) -> dict[str, Any]:
    value = drive()
    change(value)
    return value


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.pop("meta"), "meta is missing"),
        (lambda d: d["meta"].pop("log_id"), "meta.log_id"),
        (lambda d: d["meta"].update(crs_of_poses="EPSG:4326"), "projected"),
        (lambda d: d["meta"].update(crs_of_poses="nonsense"), "not a CRS"),
        (lambda d: d.update(results=[]), "no frames"),
        (lambda d: d["results"][1].update(frame=0), "twice"),
        (lambda d: d["results"][1].update(timestamp_ns=5), "earlier"),
        (lambda d: d["results"][1].pop("initial_pose"), "frame 4, initial_pose"),
        (lambda d: d["results"][0]["initial_sigma"].update(yaw_rad=0), "above zero"),
        (lambda d: d["results"][0]["initial_sigma"].update(easting=-1.0), "above zero"),
        (lambda d: d["results"][0]["initial_sigma"].update(northing=float("nan")), "not finite"),
        (
            lambda d: d["results"][1].update(odometry_sigma={"dx": 0.1, "dy": 0, "dyaw": 0.1}),
            "frame 4: odometry_sigma must be above zero",
        ),
        (
            lambda d: d["results"][0]["vectors"][0]["sigma"].__setitem__(2, [0.1, -0.1]),
            "above zero",
        ),
        (
            lambda d: d["results"][0]["vectors"][0]["sigma"].__setitem__(2, [float("nan"), 0.1]),
            "not finite",
        ),
        (lambda d: d["results"][0]["vectors"][1].pop("cls_name"), "frame 0, vector 1: cls_name"),
        (lambda d: d["results"][0]["vectors"][1].update(cls_name="tree"), "tree"),
        (lambda d: d["results"][0]["vectors"][1].update(confidence_level=1.5), "outside"),
        (
            lambda d: d["results"][0]["vectors"][0]["pts"][3].__setitem__(0, float("nan")),
            "frame 0, vector 0: pts is not finite",
        ),
        (lambda d: d["results"][0]["vectors"][0].update(pts=[[1, 2]]), "fewer than 2"),
        (lambda d: d["results"][0]["vectors"][0].update(pts="abc"), "not a list"),
        (lambda d: d["results"][0]["vectors"][0].update(sigma=[[0.1, 0.1]]), "per vertex"),
        (lambda d: d["results"][0]["vectors"][0].pop("sigma"), "--sigma"),
        (lambda d: d["results"][0]["occluders"][0].pop("yaw"), "occluder 0"),
    ],
)
def test_bad_input_names_the_place(rtmap: Any, tmp_path: Path, change: Any, words: str) -> None:
    source = write(tmp_path / "drive.json.gz", _broken(change))
    result = rtmap("import", "detections", source, "-o", tmp_path / "run", code=3)
    assert words in result.err and len(result.err.strip().splitlines()) == 1
    assert not (tmp_path / "run").exists()


def test_sigma_can_be_assumed(tmp_path: Path) -> None:
    value = _broken(lambda d: d["results"][0]["vectors"][0].pop("sigma"))
    run = read_detections(write(tmp_path / "d.json.gz", value), 0.4)
    np.testing.assert_allclose(run.observations.sigma[0], 0.4, rtol=1e-6)


def test_missing_and_broken_files(rtmap: Any, tmp_path: Path) -> None:
    assert (
        "no such file"
        in rtmap("import", "detections", tmp_path / "none.json", "-o", tmp_path / "r", code=3).err
    )
    broken = write(tmp_path / "drive.json.gz", drive())
    broken.write_bytes(broken.read_bytes()[:200])
    rtmap("import", "detections", broken, "-o", tmp_path / "r", code=3)
    with pytest.raises(BadInput, match="traversals"):
        read_fleet_poses(write(tmp_path / "p.json.gz", {"crs": "EPSG:32617"}))


def test_fleet_benchmark_files(rtmap_golden: Path) -> None:
    folder = rtmap_golden / "fleet" / "7fab2350" / "straight"
    run = read_detections(folder / "traversals" / "03.json.gz")
    truth = read_fleet_poses(folder / "truth" / "poses.json.gz")
    poses = truth.traversals["03"]
    assert truth.crs == run.crs
    assert (poses.frame == run.frames.frame).all()
    assert (poses.timestamp_ns == run.frames.timestamp_ns).all()
    assert np.abs(xyyaw_of(poses.pose) - xyyaw_of(run.frames.initial)).max() < 5
