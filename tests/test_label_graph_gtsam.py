"""gtsam as an oracle of the pose graph: the same factors, its own solver and marginals."""

from __future__ import annotations

import numpy as np
import pytest

from rtmap_cli.geometry import lie
from rtmap_cli.geometry.poses import invert
from rtmap_cli.steps.label.cloud.graph import REJECTED, WIDTH, Edges, Fixes, Solved, solve

gtsam = pytest.importorskip("gtsam", reason="gtsam is not installed")

COUNT = 40
STEP = np.array([0.003, 0.003, 0.002, 0.03, 0.02, 0.02])
"""Standard deviations of an edge: rotation (rad), translation (m)."""
PLACE, TURN = 0.4, 0.02
"""Standard deviations of a fix (m, rad)."""
WRONG = 3
"""The loop that is no loop."""


def _truth() -> np.ndarray:
    """(n, 4, 4) poses of a vehicle on one and a half rounds over a hill."""
    a = np.linspace(0, 3 * np.pi, COUNT)
    twist = np.zeros((COUNT, 6))
    twist[:, 2], twist[:, 3:] = a + np.pi / 2, 0.0
    pose = lie.exp(twist)
    pose[:, :3, 3] = np.column_stack([30 * np.cos(a), 20 * np.sin(a), 2 * np.sin(a / 2)])
    return np.asarray(pose @ lie.exp(np.array([0.02, 0.04, 0.0, 0.0, 0.0, 0.0])))


def _graph(fixed: bool) -> tuple[np.ndarray, Edges, Fixes | None]:
    """Start, edges with loops of which one is wrong, and fixes of which two jump."""
    rng = np.random.default_rng(6)
    truth = _truth()
    information = np.diag(STEP**-2.0)
    information[0, 4] = information[4, 0] = 0.3 / (STEP[0] * STEP[4])
    rows = []
    for k in range(1, COUNT):
        noise = lie.exp(rng.normal(size=6) * STEP)
        rows.append((k - 1, k, invert(truth[k - 1]) @ truth[k] @ noise, information, False))
    for n, (i, j) in enumerate([(0, 26), (5, 32), (9, 35), (3, 30), (12, 38)]):
        noise = lie.exp(rng.normal(size=6) * STEP)
        if n == WRONG:
            noise = lie.exp(np.array([0.0, 0.0, 0.1, 4.0, -3.0, 0.5]))
        rows.append((i, j, invert(truth[i]) @ truth[j] @ noise, information, True))
    start = [truth[0]]
    for row in rows[: COUNT - 1]:
        start.append(start[-1] @ row[2])
    fixes = None
    if fixed:
        at = np.arange(0, COUNT, 2)
        pose = truth[at] @ lie.exp(rng.normal(size=(len(at), 6)) * [*[TURN / 2] * 3, 0, 0, 0])
        pose[:, :3, 3] = truth[at, :3, 3] + rng.normal(0, PLACE / 2, (len(at), 3))
        pose[[4, 5], :2, 3] += (15.0, -6.0)
        sigma = np.tile([PLACE, TURN], (len(at), 1))
        fixes = Fixes(at, pose, sigma, np.full(len(at), 4.0))
    return np.stack(start), Edges.of(rows), fixes


def _theirs(
    start: np.ndarray, edges: Edges, fixes: Fixes | None, ours: Solved
) -> tuple[np.ndarray, np.ndarray]:
    """gtsam's poses and marginal covariances. Loops have its own Geman–McClure kernel; a fix, which
    is two factors there with one weight, has the weight that was found here."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, pose in enumerate(start):
        values.insert(k, gtsam.Pose3(pose))
    for k in range(len(edges.i)):
        noise = gtsam.noiseModel.Gaussian.Information(edges.information[k])
        if edges.doubted[k]:
            kernel = gtsam.noiseModel.mEstimator.GemanMcClure(WIDTH * np.sqrt(6))
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        i, j, z = int(edges.i[k]), int(edges.j[k]), gtsam.Pose3(edges.measured[k])
        graph.add(gtsam.BetweenFactorPose3(i, j, z, noise))
    if fixes is None:
        sigmas = np.array([1e-4] * 6)
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(start[0]), noise))
    else:
        for k, i in enumerate(fixes.i.tolist()):
            loose = np.sqrt(fixes.repeats[k] / ours.fix_weight[k])
            place = gtsam.noiseModel.Isotropic.Sigma(3, loose * fixes.sigma[k, 0])
            turn = gtsam.noiseModel.Isotropic.Sigma(3, loose * fixes.sigma[k, 1])
            graph.add(gtsam.GPSFactor(i, fixes.pose[k, :3, 3], place))
            graph.add(gtsam.PoseRotationPrior3D(i, gtsam.Pose3(fixes.pose[k]), turn))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    marginals = gtsam.Marginals(graph, found)
    pose = np.stack([found.atPose3(k).matrix() for k in range(len(start))])
    return pose, np.stack([marginals.marginalCovariance(k) for k in range(len(start))])


@pytest.mark.parametrize("fixed", [False, True])
def test_poses_and_covariances_are_those_of_gtsam(fixed: bool) -> None:
    start, edges, fixes = _graph(fixed)
    ours = solve(start, edges, fixes)
    loop = ours.edge_weight[edges.doubted]
    assert loop[WRONG] < REJECTED < np.delete(loop, WRONG).min()
    if fixes is not None:
        jumps = np.isin(np.arange(len(fixes.i)), [4, 5])
        assert ours.fix_weight[jumps].max() < REJECTED < ours.fix_weight[~jumps].min()
    pose, covariance = _theirs(start, edges, fixes, ours)
    off = np.abs(lie.log(invert(pose) @ ours.pose))
    spread = np.sqrt(np.einsum("nii->ni", covariance))
    # Jacobians here are of first order in the residuals, and steps end at a tenth of a millimetre.
    assert (off / spread)[1:].max() < 0.01
    assert off[:, 3:].max() < 1e-3 and off[:, :3].max() < 5e-5
    size = spread[:, :, None] * spread[:, None]
    assert np.abs((ours.covariance - covariance) / size).max() < 0.005


def test_the_truth_lies_within_what_is_stated() -> None:
    """Errors squared over their variance are about one."""
    start, edges, _ = _graph(False)
    ours = solve(start, edges, None)
    e = lie.log(invert(ours.pose) @ _truth())[1:]
    chi2 = np.einsum("ni,nij,nj->n", e, np.linalg.inv(ours.covariance[1:]), e) / 6
    assert 0.4 < chi2.mean() < 2.0
