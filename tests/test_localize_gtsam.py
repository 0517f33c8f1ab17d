"""gtsam as an oracle: the same factors, its own elimination, the same poses and covariances."""

from __future__ import annotations

import numpy as np
import pytest
from localize_scenes import drive, observed, run_of, town

from rtmap_cli.geometry.poses import wrap_angle, xyyaw_of
from rtmap_cli.steps.localize.drive.blocks import BlockSystem
from rtmap_cli.steps.localize.drive.motion import STATE, Motion, motion_of, motion_terms, step_error
from rtmap_cli.steps.localize.frame.single import _field_gram, _solve
from rtmap_cli.steps.localize.model import ErrorModel, Settings
from rtmap_cli.steps.localize.seeing.field import frame_basis
from rtmap_cli.steps.localize.seeing.frames import read_detections
from rtmap_cli.steps.localize.seeing.lines import MapLines
from rtmap_cli.steps.localize.seeing.residuals import judge, linearize, noise_of, place_amplitude

gtsam = pytest.importorskip("gtsam", reason="gtsam is not installed")

MODEL, SETTINGS = ErrorModel(), Settings()
COUNT = 24


def _motion() -> Motion:
    """GNSS of metre level, noisy odometry with one gap, through a bend."""
    truth = drive(COUNT)
    run = run_of(truth, observed(town(), truth), (0.4, -0.3, 0.01), noise=0.5, seed=3)
    odometry = run.frames.odometry + np.random.default_rng(4).normal(size=(COUNT, 3)) * [
        0.05, 0.05, 0.004,
    ]  # fmt: skip
    odometry[9] = np.nan
    run.frames.odometry[:] = odometry
    gnss = xyyaw_of(run.frames.initial)
    gnss[:, :2] -= np.round(gnss[:, :2].mean(axis=0))
    return motion_of(run.frames, gnss, MODEL, SETTINGS)


def _solve_ours(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Gauss–Newton over poses and biases; the covariance of every frame's six unknowns."""
    pose, bias = motion.gnss.copy(), np.zeros((COUNT, 3))
    chunk = np.arange(COUNT) // 7
    index = STATE * np.arange(COUNT)
    for _ in range(12):
        system = BlockSystem([int(n) * STATE for n in np.bincount(chunk)])
        terms = motion_terms(motion, pose, bias)
        system.add_chain(index, terms.own, terms.below, terms.gradient)
        system.factor()
        step = system.solve().reshape(COUNT, STATE)
        assert np.allclose(step, terms.solve(), atol=1e-9)
        pose, bias = pose + step[:, :3], bias + step[:, 3:]
    blocks, first = system.marginals(), np.searchsorted(chunk, chunk) * STATE
    at = index - first
    own = [blocks[c][i : i + STATE, i : i + STATE] for c, i in zip(chunk, at, strict=True)]
    return np.hstack([pose, bias]), np.stack(own)


def _sigmas(sigma: np.ndarray):
    return gtsam.noiseModel.Diagonal.Sigmas(np.asarray(sigma, float))


def _motion_graph(motion: Motion):
    """The factors of `motion_terms`, as functions of plain vectors."""
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    eye = np.eye(3)

    def gnss(t: int):
        def error(this, values, jacobians):
            pose, bias = map(values.atVector, this.keys())
            if jacobians is not None:
                jacobians[0], jacobians[1] = eye, eye
            out = pose + bias - motion.gnss[t]
            out[2] = wrap_angle(out[2])
            return out

        return error

    def walk(t: int):
        def error(this, values, jacobians):
            before, after = map(values.atVector, this.keys())
            if jacobians is not None:
                jacobians[0], jacobians[1] = np.diag(-motion.keep[t]), eye
            return after - motion.keep[t] * before

        return error

    def odometry(t: int):
        def error(this, values, jacobians):
            before, after = map(values.atVector, this.keys())
            out, jacobian = step_error(before, after, motion.odometry[t])
            if jacobians is not None:
                jacobians[0], jacobians[1] = jacobian[:, :3], jacobian[:, 3:]
            return out

        return error

    def add(sigma, keys, error) -> None:
        graph.add(gtsam.CustomFactor(_sigmas(sigma), keys, error))

    for t in range(COUNT):
        x, b = gtsam.symbol("x", t), gtsam.symbol("b", t)
        start.insert(x, motion.gnss[t])
        start.insert(b, np.zeros(3))
        add(motion.white[t], [x, b], gnss(t))
        if t == 0:
            graph.add(gtsam.PriorFactorVector(b, np.zeros(3), _sigmas(motion.slow[0])))
            continue
        before = [gtsam.symbol(name, t - 1) for name in "xb"]
        spread = np.sqrt(1.0 - motion.keep[t] ** 2) * motion.slow[t]
        add(spread, [before[1], b], walk(t))
        if np.isfinite(motion.odometry[t]).all():
            add(motion.odometry_sigma[t], [before[0], x], odometry(t))
    return graph, start


def test_motion_agrees() -> None:
    motion = _motion()
    graph, start = _motion_graph(motion)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-15)
    parameters.setAbsoluteErrorTol(1e-15)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()
    marginals = gtsam.Marginals(graph, solved)
    ours, covariance = _solve_ours(motion)
    for t in range(COUNT):
        keys = [gtsam.symbol(name, t) for name in "xb"]
        theirs = np.concatenate([solved.atVector(k) for k in keys])
        assert np.abs(ours[t] - theirs).max() < 1e-6
        for k, part in zip(keys, (slice(3), slice(3, 6)), strict=True):
            own = covariance[t][part, part]
            off = marginals.marginalCovariance(k) - own
            scale = np.sqrt(np.diagonal(own))
            assert np.abs(off / scale / scale[:, None]).max() < 1e-4


def test_map_residuals_agree() -> None:
    """Offsets of elements and the field of a place are eliminated by Woodbury and Schur here, and
    are unknowns there."""
    truth = drive(5)
    run = run_of(truth, observed(town(), truth, 0.2), (0.2, -0.1, 0.005), noise=0.1, seed=2)
    origin = np.round(run.frames.initial[:, :2, 3].mean(axis=0))
    lines = MapLines(town(), list(run.info["classes"]), origin, SETTINGS.heading_weight_m)
    seen = read_detections(run, lines, SETTINGS, False)
    linear = linearize(lines, seen, seen.pose, 1.0)
    noise = noise_of(lines, seen, linear, MODEL, MODEL.element_share)
    weight = judge(seen, linear, noise, linear.r, MODEL, SETTINGS.huber).weight(noise)
    ours, covariance = _solve(
        _field_gram(seen, linear, weight, noise.shared, MODEL), seen, seen.pose
    )
    basis = frame_basis(seen.points, MODEL.place_length_m)
    field = place_amplitude(seen, linear, MODEL)[..., None] * basis[..., None, :]
    field = field.reshape(*basis.shape[:-1], -1)
    unit = gtsam.noiseModel.Unit.Create
    for t in range(len(truth)):
        graph, pose = gtsam.GaussianFactorGraph(), gtsam.symbol("x", 0)
        graph.add(gtsam.JacobianFactor(pose, np.eye(3), np.zeros(3), _sigmas(seen.sigma[t])))
        for _, code, elements in (g for g in seen.groups() if g[0] == t):
            place = gtsam.symbol("f", code)
            size = field.shape[-1]
            graph.add(gtsam.JacobianFactor(place, np.eye(size), np.zeros(size), unit(size)))
            for e in range(elements.start, elements.stop):
                used = weight[e] > 0
                if not used.any():
                    continue
                offset = gtsam.symbol("o", e)
                graph.add(gtsam.JacobianFactor(offset, np.eye(2), np.zeros(2), unit(2)))
                graph.add(
                    gtsam.JacobianFactor(
                        pose, linear.jacobian[e][used],
                        place, field[e][used],
                        offset, noise.shared[e][used],
                        -linear.r[e][used],
                        _sigmas(weight[e][used] ** -0.5),
                    )
                )  # fmt: skip
        step = graph.optimize().at(pose)
        assert np.abs(seen.pose[t] + step - ours[t]).max() < 1e-6
        theirs = graph.eliminateMultifrontal().marginalCovariance(pose)
        assert np.abs(theirs / covariance[t] - 1.0).max() < 1e-4
