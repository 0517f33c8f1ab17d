"""The body under a simulated LiDAR sways smoothly, as much as it was said to."""

from __future__ import annotations

import numpy as np
import pytest

from rtmap_cli.steps.simulate.sensing.lidar_drive import _swaying


def test_neighbouring_sweeps_show_one_swing() -> None:
    rng = np.random.default_rng(1)
    lean = rng.normal(0.005, 0.01, (4000, 3))
    close = _swaying(lean, 0.1 * np.arange(4000))
    assert close.std(axis=0) == pytest.approx(0.01, rel=0.08)
    assert close.mean(axis=0) == pytest.approx(lean.mean(axis=0), abs=2e-3)
    assert np.diff(close, axis=0).std() < 0.5 * np.diff(lean, axis=0).std()


def test_frames_far_apart_keep_what_they_had() -> None:
    lean = np.random.default_rng(2).normal(0, 0.01, (50, 3))
    assert np.allclose(_swaying(lean, 1.0 * np.arange(50)), lean, atol=1e-8)
