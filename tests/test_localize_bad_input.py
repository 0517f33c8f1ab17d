"""Bad input of rtmap localize, by the command line: a status or one line, never a silent guess."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from localize_scenes import CENTRE, CRS, drive, error_of, observed, run_of, straight_road, town

from rtmap_cli.logs.run import Poses, Run
from rtmap_cli.logs.run_files import read_poses, write_run
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import write_new_map

MODES = [(), ("--smooth",), ("--smooth", "--lag", "1")]


def _files(folder: Path, run: Run, world: VectorMap) -> tuple[Path, Path]:
    folder.mkdir()
    write_run(run, folder / "run")
    write_new_map(world, folder / "map", "world")
    return folder / "run", folder / "map"


def _poses(run: Path) -> Poses:
    return read_poses(run / "poses.parquet")


def _one_line(rtmap, paths: tuple[Path, Path], code: int, words: str, *options: str) -> None:
    result = rtmap("localize", paths[0], "--map", paths[1], *options, code=code)
    assert words in result.err and len(result.err.strip().splitlines()) == 1, result.err
    assert not (paths[0] / "poses.parquet").exists()


@pytest.mark.parametrize("options", MODES)
def test_no_element_in_range_is_no_answer(rtmap, tmp_path: Path, options) -> None:
    """50 m aside the map is read, but nothing is in view: exit 4; farther off: exit 3."""
    truth = drive(5, bend=False)
    run = run_of(truth, observed(town(), truth))
    for aside, code, words in ((-52.0, 4, "matches the map"), (-200.0, 3, "no element within")):
        x = np.linspace(-60.0, 20.0, 17)
        line = np.column_stack([x, np.full(17, aside)]) + CENTRE
        far = VectorMap([Element("far", "divider", line)], CRS)
        paths = _files(tmp_path / str(code), run, far)
        _one_line(rtmap, paths, code, words, *options)


@pytest.mark.parametrize("options", MODES)
def test_a_single_straight_line_is_degenerate(rtmap, tmp_path: Path, options) -> None:
    truth = drive(6, bend=False)
    world = straight_road((1.2,))
    run, path = _files(tmp_path / "a", run_of(truth, observed(world, truth)), world)
    rtmap("localize", run, "--map", path, *options)
    poses = _poses(run)
    assert (poses.status == "degenerate").all()
    assert np.abs(poses.weakest_direction[:, 0]).min() > 0.99
    along, across = np.sqrt(poses.covariance[:, 0, 0]), np.sqrt(poses.covariance[:, 1, 1])
    assert along.min() > 0.5 and across.max() < 0.25
    assert np.abs(error_of(poses.pose, truth)[:, 1]).max() < 0.1


@pytest.mark.parametrize("value", [np.nan, 0.0, -0.1])
def test_senseless_sigmas_are_refused(rtmap, tmp_path: Path, value: float) -> None:
    truth = drive(4)
    run = run_of(truth, observed(town(), truth))
    sigma = run.observations.sigma.copy()
    sigma[3, 7, 1] = value
    seen = replace(run, observations=replace(run.observations, sigma=sigma))
    _one_line(rtmap, _files(tmp_path / "seen", seen, town()), 3, "sigma above zero")
    sigma = run.frames.sigma.copy()
    sigma[2, 2] = value
    start = replace(run, frames=replace(run.frames, sigma=sigma))
    paths = _files(tmp_path / "start", start, town())
    _one_line(rtmap, paths, 3, "frame 2: the sigma of the initial pose", "--smooth")
    if not np.isnan(value):
        sigma = run.frames.odometry_sigma.copy()
        sigma[2, 0] = value
        steps = replace(run, frames=replace(run.frames, odometry_sigma=sigma))
        paths = _files(tmp_path / "steps", steps, town())
        _one_line(rtmap, paths, 3, "frame 2: the sigma of its odometry", "--smooth")


def test_a_prior_in_another_zone(rtmap, tmp_path: Path) -> None:
    """Named so: refused by its name; with its coordinates under this zone's name: far away."""
    truth = drive(4)
    run = run_of(truth, observed(town(), truth))
    other = VectorMap(town().elements, "EPSG:32633")
    _one_line(rtmap, _files(tmp_path / "named", run, other), 3, "EPSG:32633")
    moved = [e.with_points(e.xy - [420_000.0, -3_000.0]) for e in town()]
    paths = _files(tmp_path / "moved", run, VectorMap(moved, CRS))
    _one_line(rtmap, paths, 3, "no element within")


@pytest.mark.parametrize("options", MODES)
@pytest.mark.parametrize("axes", ["x", "y", "swapped"])
def test_mirrored_axes_are_noticed(rtmap, tmp_path: Path, axes: str, options) -> None:
    """The bend turns the other way: no answer, or a warning with numbers."""
    truth = drive(22)[10:]
    middle = truth[:, :2, 3].mean(axis=0)
    mirror = {"x": [[-1, 0], [0, 1]], "y": [[1, 0], [0, -1]], "swapped": [[0, 1], [1, 0]]}[axes]
    other = [e.with_points((e.xy - middle) @ mirror + middle, e.covariance) for e in town()]
    paths = _files(
        tmp_path / "a", run_of(truth, observed(town(), truth, 0.1)), VectorMap(other, CRS)
    )
    result = rtmap("localize", paths[0], "--map", paths[1], *options, code=None)
    assert result.code in (0, 4) and "Traceback" not in result.err
    if result.code == 0:
        assert "warning" in result.err and "is it the map of this place" in result.err
    right = _files(tmp_path / "b", run_of(truth, observed(town(), truth, 0.1)), town())
    assert not rtmap("localize", right[0], "--map", right[1], *options).err


def test_timestamps_out_of_order(rtmap, tmp_path: Path) -> None:
    truth = drive(4)
    run = run_of(truth, observed(town(), truth))
    time = run.frames.timestamp_ns[[0, 2, 1, 3]]
    paths = _files(
        tmp_path / "a", replace(run, frames=replace(run.frames, timestamp_ns=time)), town()
    )
    _one_line(rtmap, paths, 3, "not sorted by time")


def test_poses_that_are_no_numbers(rtmap, tmp_path: Path) -> None:
    truth = drive(4)
    paths = _files(tmp_path / "a", run_of(truth, observed(town(), truth)), town())
    file = paths[0] / "frames.parquet"
    table = pq.read_table(file)
    column = table.column_names.index("x")
    values = table["x"].to_numpy().copy()
    values[1] = np.nan
    pq.write_table(table.set_column(column, table.schema.field("x"), [values]), file)
    _one_line(rtmap, paths, 3, "the pose of frame 1 is not finite")


@pytest.mark.parametrize("value", ["low", True, float("inf")])
def test_a_ground_that_is_no_height(rtmap, tmp_path: Path, value) -> None:
    truth = drive(3)
    run = run_of(truth, observed(town(), truth))
    run = replace(run, info=run.info | {"ground_z": value})
    _one_line(rtmap, _files(tmp_path / "a", run, town()), 3, "ground_z is not a number")


@pytest.mark.parametrize("options", MODES[1:])
def test_a_gap_in_the_odometry(rtmap, tmp_path: Path, options) -> None:
    """GNSS bridges a step that is not known, and frames behind it do not inherit a jump."""
    truth = drive(14)
    run = run_of(truth, observed(town(), truth, 0.05), noise=0.3)
    odometry = run.frames.odometry.copy()
    odometry[6:8] = np.nan
    frames = replace(run.frames, odometry=odometry)
    seen = run.observations.select(~np.isin(run.observations.frame, [6]))
    paths = _files(tmp_path / "a", replace(run, frames=frames, observations=seen), town())
    rtmap("localize", paths[0], "--map", paths[1], *options)
    poses = _poses(paths[0])
    error = np.abs(error_of(poses.pose, truth)[:, :2])
    assert np.delete(error, 6, axis=0).max() < 0.25
    sigma = np.sqrt(poses.covariance[:, 0, 0])
    assert sigma[6] > 2 * max(sigma[4], sigma[9]) and error[6].max() < 2.5 * sigma[6]
