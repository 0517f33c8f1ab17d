"""The mathematics of localization: exact data gives the exact pose, and what cannot be known is
said to be unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from localize_scenes import (
    CENTRE,
    CRS,
    drive,
    error_of,
    gram,
    observed,
    run_of,
    straight_road,
    town,
)

from rtmap_cli.errors import BadInput, NoAnswer, UsageError
from rtmap_cli.geometry.poses import se3_from_quaternion, xyyaw_of
from rtmap_cli.logs.run import OUTDATED, Observations
from rtmap_cli.maps.element import CLASSES, Element, VectorMap
from rtmap_cli.steps.localize.answer import lift
from rtmap_cli.steps.localize.drive.blocks import BlockSystem
from rtmap_cli.steps.localize.drive.motion import step_error
from rtmap_cli.steps.localize.drive.smooth import chunks
from rtmap_cli.steps.localize.frame.calibrate import calibrated
from rtmap_cli.steps.localize.frame.single import solve_single
from rtmap_cli.steps.localize.localize import localize
from rtmap_cli.steps.localize.model import ErrorModel, Settings
from rtmap_cli.steps.localize.seeing.field import GridField, frame_basis
from rtmap_cli.steps.localize.seeing.frames import read_detections
from rtmap_cli.steps.localize.seeing.lines import MapLines
from rtmap_cli.steps.localize.seeing.residuals import gram_sum, linearize, noise_of

MODEL, SETTINGS = ErrorModel(), Settings()


@pytest.mark.parametrize("matched", [False, True])
@pytest.mark.parametrize("smooth", [False, True])
def test_exact_data_gives_the_exact_pose(matched: bool, smooth: bool) -> None:
    truth = drive()
    run = run_of(truth, observed(town(0.001), truth, 0.005, matched))
    poses = localize(run, town(0.001), smooth=smooth)
    error = np.abs(error_of(poses.pose, truth))
    assert error[:, :2].max() < 0.02
    assert error[:, 2].max() < 0.001
    assert poses.method == ("smooth" if smooth else "matches" if matched else "geometry")
    assert (poses.status == "ok").all()
    assert np.allclose(poses.pose[:, 2, 3], 3.0)


def test_start_in_the_next_lane_is_recovered() -> None:
    truth = drive(6, bend=False)
    run = run_of(truth, observed(town(), truth), start_error=(0.3, 2.3, 0.0))
    error = error_of(localize(run, town()).pose, truth)
    assert np.abs(error[:, 1]).max() < 0.05


def _problem(truth: np.ndarray):
    run = run_of(truth, observed(town(), truth))
    origin = CENTRE.copy()
    lines = MapLines(town(), list(CLASSES), origin, 2.0)
    return run, lines, read_detections(run, lines, SETTINGS, False)


def test_jacobian_of_residuals_is_their_derivative() -> None:
    _, lines, seen = _problem(drive(3))
    pose = seen.pose.copy()
    at = linearize(lines, seen, pose, 4.0)
    for axis in range(3):
        moved = pose.copy()
        moved[:, axis] += 1e-6
        other = linearize(lines, seen, moved, 4.0)
        same = (other.sample == at.sample) & at.found
        slope = (other.r - at.r)[same] / 1e-6
        assert same.sum() > 100
        assert np.allclose(slope, at.jacobian[same][:, axis], atol=1e-4)


def test_jacobian_of_odometry_is_its_derivative() -> None:
    before, after = np.array([1.0, 2.0, 3.1]), np.array([3.0, 1.0, -3.0])
    odometry = np.array([2.0, 0.3, 0.1])
    error, jacobian = step_error(before, after, odometry)
    state = np.concatenate([before, after])
    for k in range(6):
        moved = state.copy()
        moved[k] += 1e-6
        slope = (step_error(moved[:3], moved[3:], odometry)[0] - error) / 1e-6
        assert np.allclose(slope, jacobian[:, k], atol=1e-4)


def test_woodbury_equals_the_dense_inverse() -> None:
    rng = np.random.default_rng(1)
    columns, shared = rng.normal(size=(3, 8, 5)), rng.normal(size=(3, 8, 2))
    weight = rng.uniform(0.5, 4.0, size=(3, 8))
    got = gram(columns, weight, shared)
    for x, w, u, g in zip(columns, weight, shared, got, strict=True):
        assert np.allclose(g, x.T @ np.linalg.inv(np.diag(1 / w) + u @ u.T) @ x)
    assert np.allclose(gram_sum(columns, weight, shared), got.sum(0))


def test_a_vertex_without_weight_says_nothing() -> None:
    rng = np.random.default_rng(2)
    columns, shared = rng.normal(size=(1, 6, 4)), rng.normal(size=(1, 6, 2))
    weight = np.full((1, 6), 2.0)
    weight[0, 4:] = 0.0
    short = gram(columns[:, :4], weight[:, :4], shared[:, :4])
    assert np.allclose(gram(columns, weight, shared), short)


def test_block_system_equals_the_dense_one() -> None:
    rng = np.random.default_rng(3)
    sizes = [4, 5, 3]
    system, dense, g = BlockSystem(sizes), np.zeros((12, 12)), np.zeros(12)
    for low, high in ((0, 9), (4, 12), (0, 4), (9, 12)):
        index = np.arange(low, high)
        a = rng.normal(size=(len(index), len(index)))
        information, pull = a @ a.T + np.eye(len(index)), rng.normal(size=len(index))
        system.add(index, information, pull)
        dense[np.ix_(index, index)] += information
        g[index] += pull
    system.add_prior(np.array([1, 6, 11]), np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3]))
    dense[[1, 6, 11], [1, 6, 11]] += [1.0, 2.0, 3.0]
    g[[1, 6, 11]] += [0.1, 0.4, 0.9]
    system.factor()
    assert np.allclose(system.solve(), -np.linalg.solve(dense, g))
    inverse = np.linalg.inv(dense)
    for b, block in enumerate(system.marginals()):
        own = slice(system.offset[b], system.offset[b + 1])
        assert np.allclose(block, inverse[own, own])


def test_fields_have_the_covariance_that_they_state() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform([-36, -18], [36, 18], size=(200, 2))
    wanted = np.exp(-0.5 * ((points[:, None] - points) ** 2).sum(-1) / 20.0**2)
    basis = frame_basis(points, 20.0)
    assert np.abs(basis @ basis.T - wanted).max() < 0.08
    cells, values = GridField(20.0).basis(points)
    names, inverse = np.unique(cells.reshape(-1, 2), axis=0, return_inverse=True)
    dense = np.zeros((200, len(names)))
    dense[np.arange(200)[:, None], inverse.reshape(200, -1)] = values
    assert np.allclose((dense**2).sum(1), 1.0)
    assert np.abs(dense @ dense.T - wanted).mean() < 0.06


def test_parallel_lines_are_degenerate_along_the_road() -> None:
    truth = drive(4, bend=False)
    run = run_of(truth, observed(straight_road(), truth))
    poses = localize(run, straight_road())
    assert (poses.status == "degenerate").all()
    assert np.abs(poses.weakest_direction[:, 0]).min() > 0.99
    assert (poses.eigenvalues[:, 0] < 1.0).all()
    error = error_of(poses.pose, truth)
    assert np.abs(error[:, 1]).max() < 0.05
    # Nothing but GNSS speaks of the longitudinal axis: its sigma of a metre stays.
    assert np.sqrt(poses.covariance[:, 0, 0]).min() > 0.9
    assert np.sqrt(poses.covariance[:, 1, 1]).max() < 0.2


def test_frames_without_detections_are_no_match_alone_and_answered_in_the_log() -> None:
    truth = drive()
    seen = observed(town(), truth)
    run = run_of(truth, seen.select(seen.frame != 5))
    alone, together = localize(run, town()), localize(run, town(), smooth=True)
    assert alone.status[5] == "no-match"
    assert alone.residual_count[5] == 0
    assert together.status[5] == "ok"
    assert np.abs(error_of(together.pose, truth)[5, :2]).max() < 0.1


def test_outdated_elements_do_not_pull() -> None:
    truth = drive(6, bend=False)
    right = observed(town(), truth, matched=True)
    moved = right.select(right.class_name == "boundary")
    gone = replace(moved, state=np.full(len(moved), OUTDATED, np.int8))
    gone = replace(gone, points=gone.points + np.float32(0.8))
    both = Observations.concatenate([right, gone])
    want = localize(run_of(truth, right), town(), model=MODEL)
    got = localize(run_of(truth, both), town(), model=MODEL)
    assert np.allclose(got.pose, want.pose, atol=1e-12)


def test_an_element_that_is_elsewhere_loses_its_vote() -> None:
    truth = drive(6, bend=False)
    seen = observed(town(), truth)
    moved = (seen.class_name == "divider") & (seen.query % 2 == 0)
    points = seen.points + np.where(moved, 0.7, 0.0)[:, None, None].astype(np.float32)
    poses = localize(run_of(truth, replace(seen, points=points)), town())
    assert np.abs(error_of(poses.pose, truth)[:, :2]).max() < 0.1


def test_the_whole_log_survives_a_heading_through_south() -> None:
    truth = drive(16)
    spin = np.eye(4)
    spin[:2, :2] = -np.eye(2)
    spin[:2, 3] = 2.0 * CENTRE
    world = town(0.001)
    turned = VectorMap(
        [replace(e, points=np.column_stack([2 * CENTRE - e.xy, e.points[:, 2]])) for e in world],
        CRS,
    )
    poses = spin @ truth
    run = run_of(poses, observed(turned, poses, 0.01), (0.5, -0.4, 0.0), noise=0.5)
    yaw = xyyaw_of(run.frames.initial)[:, 2]
    assert yaw.min() < -2.0 and yaw.max() > 2.0
    error = error_of(localize(run, turned, smooth=True).pose, poses)
    assert np.abs(error[:, :2]).max() < 0.1


def test_smoothing_is_better_than_single_frames_under_noise() -> None:
    rng = np.random.default_rng(5)
    truth = drive(24)
    seen = observed(town(), truth, 0.3)
    offset = 0.3 * rng.normal(size=(len(seen), 1, 2))
    seen = replace(seen, points=(seen.points + offset).astype(np.float32))
    run = run_of(truth, seen, noise=0.2)
    alone, together = localize(run, town()), localize(run, town(), smooth=True)
    errors = [np.abs(error_of(p.pose, truth)).mean(0) for p in (alone, together)]
    assert (errors[1] < errors[0]).all()
    assert np.linalg.det(together.covariance).mean() < np.linalg.det(alone.covariance).mean()


def test_sigmas_that_are_far_too_small_are_noticed() -> None:
    rng = np.random.default_rng(6)
    truth = np.concatenate([drive(24)] * 2)
    seen = observed(town(), truth, 0.3)
    noise = 0.25 * rng.normal(size=(len(seen), 1, 2)) + 0.12 * rng.normal(size=seen.points.shape)
    for stated, low, high in ((0.28, 1.0, 1.0), (0.07, 2.0, 4.0)):
        got = replace(
            seen,
            points=(seen.points + noise).astype(np.float32),
            sigma=np.full_like(seen.sigma, stated),
        )
        run = run_of(truth, got)
        lines = MapLines(town(), list(CLASSES), CENTRE.copy(), 2.0)
        detections = read_detections(run, lines, SETTINGS, False)
        start = solve_single(lines, detections, MODEL, SETTINGS)
        model = calibrated(lines, detections, start, MODEL, SETTINGS)
        assert low <= model.scale <= high, stated


def test_lifting_keeps_height_roll_and_pitch() -> None:
    tilt = se3_from_quaternion(np.array([[0.99, 0.02, -0.03, 0.1]]), np.array([[1.0, 2.0, 3.0]]))
    planar = xyyaw_of(tilt) + [[0.5, -0.25, 0.3]]
    out = lift(tilt, planar, np.zeros(2))
    assert np.allclose(xyyaw_of(out), planar)
    assert np.allclose(out[:, 2], tilt[:, 2])
    assert np.allclose(out[0, :3, :3] @ out[0, :3, :3].T, np.eye(3))


def test_longer_lines_average_the_maps_error() -> None:
    """One long line and a short piece of it: both keep an honest share of the map's sigma."""
    _, lines, seen = _problem(drive(1))
    at = linearize(lines, seen, seen.pose, 4.0)
    noise = noise_of(lines, seen, at, replace(MODEL, vertex_share=0.0), 0.0)
    one = np.ones((*at.r.shape, 1))
    information = gram(one, noise.weight, noise.shared)[:, 0, 0]
    sigma = 1.0 / np.sqrt(information[at.found.all(1)])
    assert (sigma < 0.021).all() and (sigma > 0.005).all()


def test_chunks_are_longer_than_the_view_and_end_while_waiting() -> None:
    assert np.bincount(chunks(np.full(101, 2.5), 100.0)).max() == 41
    assert chunks(np.zeros(300), 100.0).max() >= 3


def test_clear_errors() -> None:
    truth = drive(3)
    run = run_of(truth, observed(town(), truth))
    with pytest.raises(BadInput, match=r"EPSG:32633.*expected EPSG:32632"):
        localize(run, VectorMap(town().elements, "EPSG:32633"))
    far = [Element("far", "divider", np.array([[0.0, 0.0], [50.0, 0.0]]))]
    with pytest.raises(BadInput, match="no element within"):
        localize(run, VectorMap(far, CRS))
    with pytest.raises(BadInput, match="no element within"):
        localize(run, VectorMap([], CRS))
    with pytest.raises(UsageError, match="no matched elements"):
        localize(run, town(), method="matches")
    with pytest.raises(NoAnswer, match="no detection"):
        localize(run_of(truth, Observations.empty()), town())
    with pytest.raises(NoAnswer, match="no end-to-end poses"):
        localize(run, town(), method="end-to-end")
    sigma = run.frames.sigma.copy()
    sigma[1, 0] = np.nan
    run.frames = replace(run.frames, sigma=sigma)
    with pytest.raises(BadInput, match="frame 1: the sigma"):
        localize(run, town())


def test_the_end_to_end_pose_is_taken_as_it_is() -> None:
    truth = drive(4)
    run = run_of(truth, observed(town(), truth))
    pose = xyyaw_of(truth)
    pose[3] = np.nan
    covariance = np.tile(np.diag([0.04, 0.09, 0.01]), (4, 1, 1))
    covariance[3] = np.nan
    run.frames = replace(run.frames, end_to_end=pose, end_to_end_covariance=covariance)
    poses = localize(run, town(), method="end-to-end")
    assert np.abs(error_of(poses.pose, truth)[:3]).max() < 1e-6
    assert poses.status.tolist() == ["ok", "ok", "ok", "no-match"]
    assert np.allclose(poses.covariance[0][np.ix_([0, 1, 5], [0, 1, 5])], covariance[0])
