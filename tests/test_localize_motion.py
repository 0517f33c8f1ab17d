"""The normal equations of a drive without a map: written out by hand, so checked entry by entry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtmap_cli.geometry.poses import wrap_angle
from rtmap_cli.steps.localize.drive.motion import STATE, Motion, motion_terms, step_error


def _motion(count: int, seed: int = 0) -> Motion:
    """A drive of odd weights, with a gap in the odometry where it is long enough for one."""
    rng = np.random.default_rng(seed)
    odometry = rng.normal(size=(count, 3))
    odometry[:1] = np.nan
    odometry[7:8] = np.nan

    def sigma() -> np.ndarray:
        return rng.uniform(0.1, 1.0, size=(count, 3))

    keep = rng.uniform(0.1, 0.9, size=(count, 3))
    gnss = rng.normal(size=(count, 3))
    return Motion(gnss, sigma(), sigma(), keep, odometry, sigma(), np.ones(count))


def _residuals(motion: Motion, state: np.ndarray) -> np.ndarray:
    """All whitened residuals at poses and biases (T, STATE), factor by factor."""
    pose, bias = state[:, :3], state[:, 3:]
    off = pose + bias - motion.gnss
    off[:, 2] = wrap_angle(off[:, 2])
    walk = bias[1:] - motion.keep[1:] * bias[:-1]
    moved, _ = step_error(pose[:-1], pose[1:], motion.odometry[1:])
    parts = (
        off / motion.white,
        bias[:1] / motion.slow[:1],
        walk / motion.slow[1:] / np.sqrt(1.0 - motion.keep[1:] ** 2),
        np.nan_to_num(moved / motion.odometry_sigma[1:]),
    )
    return np.concatenate([p.ravel() for p in parts])


def _dense(motion: Motion, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Information and gradient by central differences of the residuals."""
    columns = []
    for k in range(state.size):
        step = np.zeros(state.size)
        step[k] = 1e-6
        step = step.reshape(state.shape)
        d = _residuals(motion, state + step) - _residuals(motion, state - step)
        columns.append(d / 2e-6)
    jacobian = np.stack(columns, -1)
    return jacobian.T @ jacobian, jacobian.T @ _residuals(motion, state)


@pytest.mark.parametrize("count", [1, 2, 12])
def test_terms_are_the_square_of_the_residuals(count: int) -> None:
    motion, state = _motion(count), np.random.default_rng(5).normal(size=(count, STATE))
    information, gradient = _dense(motion, state)
    extra = np.random.default_rng(6).normal(size=(count, 3, 3))
    extra, pull = extra @ extra.swapaxes(1, 2), extra[:, 0]
    terms = motion_terms(motion, state[:, :3], state[:, 3:])
    assert np.allclose(terms.gradient.ravel(), gradient, rtol=1e-6, atol=1e-4)
    terms.add(extra, pull)
    blocks = information.reshape(count, STATE, count, STATE)
    for t in range(count):
        blocks[t, :3, t, :3] += extra[t]
        assert np.allclose(terms.own[t], blocks[t, :, t], rtol=1e-6, atol=1e-4)
        if t:
            assert np.allclose(terms.below[t], blocks[t, :, t - 1], rtol=1e-6, atol=1e-4)
            assert not blocks[t, :, : t - 1].any()
    wanted = np.linalg.solve(information, -terms.gradient.ravel())
    assert np.allclose(terms.solve().ravel(), wanted, atol=1e-5)


def test_blocks_cannot_be_written_to_by_mistake() -> None:
    terms = motion_terms(_motion(3), np.zeros((3, 3)), np.zeros((3, 3)))
    for blocks in (terms.own, terms.below):
        with pytest.raises(ValueError, match="read-only"):
            blocks[0] += 1.0


def test_yaw_wraps() -> None:
    motion = _motion(4)
    turned = replace(motion, gnss=motion.gnss + [0.0, 0.0, 2.0 * np.pi])
    poses, biases = np.zeros((4, 3)), np.zeros((4, 3))
    ours, theirs = (motion_terms(m, poses, biases).gradient for m in (motion, turned))
    assert np.allclose(ours, theirs)
