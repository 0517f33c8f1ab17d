"""``rtmap infer --looks``: from metres off, the network is asked again from where it pointed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rtmap_cli.logs.run_files import read_run

OFF_M = 2.2


@pytest.fixture
def far_log(rtmap: Callable[..., Any], tmp_path: Path) -> Path:
    """A simulated drive whose initial poses are 3.1 m from the truth, and say so."""
    pytest.importorskip("cv2")
    rtmap("simulate", "town", "-o", tmp_path / "town", "--seed", 5)
    drive = ("--log", "town:", "--frames", 6, "--spacing", 8, "--width", 256, "--seed", 3)
    rtmap("simulate", "images", "--map", tmp_path / "town", *drive, "-o", tmp_path / "log", "-q")
    frames, truth = (
        pq.read_table(tmp_path / "log" / name) for name in ("frames.parquet", "truth/poses.parquet")
    )
    off = {
        "x": truth["x"].to_numpy() + OFF_M,
        "y": truth["y"].to_numpy() - OFF_M,
        "sigma_x": np.full(len(frames), OFF_M),
        "sigma_y": np.full(len(frames), OFF_M),
    }
    for name, values in off.items():
        frames = frames.set_column(frames.schema.get_field_index(name), name, pa.array(values))
    pq.write_table(frames, tmp_path / "log" / "frames.parquet")
    return tmp_path / "log"


def test_another_look_brings_a_far_start_nearer(
    rtmap: Callable[..., Any], far_log: Path, tmp_path: Path
) -> None:
    truth = pq.read_table(far_log / "truth" / "poses.parquet")
    true = np.column_stack([truth[k].to_numpy() for k in "xy"])
    error = {}
    for looks in (1, 2):
        run = tmp_path / f"run{looks}"
        rtmap("infer", far_log, "--map", tmp_path / "town", "--looks", looks, "-o", run, "-q")
        read = read_run(run)
        assert read.info["options"]["looks"] == looks
        rtmap("localize", run, "--map", tmp_path / "town", "--method", "end-to-end")
        out = rtmap("evaluate", "poses", run, "--truth", far_log, "--json").out
        mean = json.loads(out)["all_frames"]
        error[looks] = mean["lateral_m"]["mean"] + mean["longitudinal_m"]["mean"]
        # The initial poses stay what the log says, whatever the prior was cropped at.
        off = read.frames.initial[:, :2, 3] - true
        np.testing.assert_allclose(off, np.tile([OFF_M, -OFF_M], (len(off), 1)), atol=1e-6)
    assert error[2] < error[1] < 0.6


def test_without_a_prior_there_is_nothing_to_look_at_again(
    rtmap: Callable[..., Any], far_log: Path, tmp_path: Path
) -> None:
    for looks in (1, 3):
        command = ("infer", far_log, "--looks", looks, "--frames", 2, "-q")
        rtmap(*command, "-o", tmp_path / f"run{looks}")
    once, thrice = (tmp_path / f"run{k}" / "observations.parquet" for k in (1, 3))
    assert once.read_bytes() == thrice.read_bytes()
    rtmap("infer", far_log, "--looks", 0, "-o", tmp_path / "none", code=2)
