"""The pose graph: odometry and loops between keyframes, GNSS fixes on them.

Poses are perturbed on the right, T exp(δ), δ = (rotation, translation) in the ego frame. An edge
measures Z = Tᵢ⁻¹ Tⱼ with r = log(Z⁻¹ Tᵢ⁻¹ Tⱼ); a fix measures a place and an attitude. Loops and
fixes may be wrong: they get Geman–McClure weights whose width shrinks from that of the worst
residual down (graduated non-convexity: Yang et al., RA-L 2020).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry import lie
from rtmap_cli.geometry.poses import invert

Array = NDArray[np.float64]
Int = NDArray[np.int64]

ROUNDS = 25
WIDTH = 3.0
"""Residuals of more than so many standard deviations lose their vote."""
SHRINK = 1.6
SMALL_STEP = 1e-4
FIXED = (1e-4, 1e-4)
COLUMNS = 2_000_000
"""Numbers of the inverse that are computed at once."""
REJECTED = 0.25
"""A weight below this: the measurement was rejected."""


@dataclass
class Edges:
    """Relative poses: ``measured`` (e, 4, 4) takes frames ``j`` to frames ``i``; ``information``
    (e, 6, 6) of a perturbation on its right. ``doubted`` (e,): may be wrong (loops)."""

    i: Int
    j: Int
    measured: Array
    information: Array
    doubted: NDArray[np.bool_]

    @staticmethod
    def of(rows: list[tuple[int, int, Array, Array, bool]]) -> Edges:
        """From rows i, j, measured, information, doubted."""
        i, j, z, w, d = zip(*rows, strict=True) if rows else ((), (), (), (), ())
        return Edges(
            np.array(i, np.int64), np.array(j, np.int64), np.array(z).reshape(-1, 4, 4),
            np.array(w).reshape(-1, 6, 6), np.array(d, bool),
        )  # fmt: skip


@dataclass
class Fixes:
    """Places and attitudes from GNSS: ``pose`` (f, 4, 4) of keyframes ``i`` (f,), ``sigma`` (f, 2):
    standard deviations of a coordinate (m) and of an angle (rad); ``repeats`` (f,): fixes that
    share an error, and together count as one."""

    i: Int
    pose: Array
    sigma: Array
    repeats: Array


@dataclass
class Solved:
    """Poses (n, 4, 4), their covariances (n, 6, 6; rotation, translation; ego frame), the weights
    of edges and fixes in [0, 1] and the residuals of the fixes (f, 3), metres."""

    pose: Array
    covariance: Array
    edge_weight: Array
    fix_weight: Array
    fix_residual: Array


def solve(
    start: Array,
    edges: Edges,
    fixes: Fixes | None,
    anchor: tuple[float, float] = FIXED,
    most_marginals: int = 400,
) -> Solved:
    """Gauss–Newton over all keyframes; without fixes the first pose stays where it is, known to
    ``anchor`` (standard deviations of a coordinate, m, and of an angle, rad)."""
    pose = start.copy()
    width = np.inf
    for _ in range(ROUNDS):
        r_edge, r_place, r_turn = _residuals(pose, edges, fixes)
        d_edge = np.einsum("ei,eij,ej->e", r_edge, edges.information, r_edge) / 6
        d_fix = np.zeros(0)
        if fixes is not None:
            d_fix = (r_place**2).sum(-1) / fixes.sigma[:, 0] ** 2 / 3
        doubted = d_edge[edges.doubted]
        worst = float(np.sqrt(max(doubted.max(initial=0.0), d_fix.max(initial=0.0))))
        width = max(WIDTH, min(width / SHRINK, 2 * worst))
        w_edge = np.where(edges.doubted, _weight(d_edge, width), 1.0)
        w_fix = _weight(d_fix, width)
        shared = w_fix if fixes is None else w_fix / fixes.repeats
        matrix, gradient = _normal(
            pose, edges, fixes, (r_edge, r_place, r_turn), w_edge, shared, anchor
        )
        factor = _factored(matrix)
        step = -factor.solve(gradient).reshape(-1, 6)
        pose = pose @ lie.exp(step)
        if np.abs(step).max() < SMALL_STEP and width <= WIDTH:
            break
    covariance = _marginals(factor, len(pose), most_marginals)
    return Solved(pose, covariance, w_edge, w_fix, r_place)


def _weight(d2: Array, width: float) -> Array:
    """Geman–McClure weights of squared residuals in units of their variance."""
    return np.asarray(1.0 / (1.0 + d2 / width**2) ** 2)


def _residuals(pose: Array, edges: Edges, fixes: Fixes | None) -> tuple[Array, Array, Array]:
    """Residuals of edges (e, 6), of places (f, 3; map frame) and attitudes (f, 3; ego frame)."""
    r = lie.log(invert(edges.measured) @ invert(pose[edges.i]) @ pose[edges.j])
    if fixes is None:
        return r.reshape(-1, 6), np.zeros((0, 3)), np.zeros((0, 3))
    here = pose[fixes.i]
    turn = lie.log(_turn_only(invert(fixes.pose) @ here))[:, :3]
    return r.reshape(-1, 6), here[:, :3, 3] - fixes.pose[:, :3, 3], turn


def _turn_only(pose: Array) -> Array:
    out = pose.copy()
    out[:, :3, 3] = 0
    return out


def _normal(
    pose: Array,
    edges: Edges,
    fixes: Fixes | None,
    residuals: tuple[Array, Array, Array],
    w_edge: Array,
    w_fix: Array,
    anchor: tuple[float, float],
) -> tuple[Any, Array]:
    """The normal equations: a sparse matrix (6n, 6n) and the gradient (6n,)."""
    from scipy.sparse import coo_matrix

    n = len(pose)
    r_edge, r_place, r_turn = residuals
    gradient = np.zeros((n, 6))
    blocks: list[tuple[Int, Int, Array]] = []
    ji = -lie.adjoint(invert(pose[edges.j]) @ pose[edges.i])
    wj = w_edge[:, None, None] * edges.information
    wi = np.swapaxes(ji, 1, 2) @ wj
    blocks += [
        (edges.i, edges.i, wi @ ji), (edges.i, edges.j, wi),
        (edges.j, edges.i, np.swapaxes(wi, 1, 2)), (edges.j, edges.j, wj),
    ]  # fmt: skip
    np.add.at(gradient, edges.i, (wi @ r_edge[..., None])[..., 0])
    np.add.at(gradient, edges.j, (wj @ r_edge[..., None])[..., 0])
    if fixes is None:
        first = np.zeros(1, np.int64)
        held = np.diag([anchor[1] ** -2.0] * 3 + [anchor[0] ** -2.0] * 3)
        blocks.append((first, first, held[None]))
    else:
        place, turn = w_fix / fixes.sigma[:, 0] ** 2, w_fix / fixes.sigma[:, 1] ** 2
        h = np.zeros((len(fixes.i), 6, 6))
        h[:, range(3), range(3)] = turn[:, None]
        h[:, range(3, 6), range(3, 6)] = place[:, None]
        rotation = pose[fixes.i][:, :3, :3]
        g = np.concatenate(
            [turn[:, None] * r_turn, place[:, None] * np.einsum("fji,fj->fi", rotation, r_place)],
            axis=1,
        )
        blocks.append((fixes.i, fixes.i, h))
        np.add.at(gradient, fixes.i, g)
    offset = np.arange(6)
    rows = [np.broadcast_to(6 * a[:, None, None] + offset[:, None], m.shape) for a, _, m in blocks]
    columns = [np.broadcast_to(6 * b[:, None, None] + offset, m.shape) for _, b, m in blocks]
    values = np.concatenate([m.ravel() for _, _, m in blocks])
    place_of = (
        np.concatenate([r.ravel() for r in rows]), np.concatenate([c.ravel() for c in columns])
    )  # fmt: skip
    matrix = coo_matrix((values, place_of), shape=(6 * n, 6 * n)).tocsc()
    return matrix, gradient.ravel()


def _factored(matrix: Any) -> Any:
    from scipy.sparse.linalg import splu

    return splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})


def _marginals(factor: Any, count: int, most: int) -> Array:
    """(n, 6, 6) diagonal blocks of the inverse: at up to ``most`` poses, between them linear."""
    at = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))
    found = np.empty((len(at), 6, 6))
    together = max(1, COLUMNS // (36 * count))
    for first in range(0, len(at), together):
        part = at[first : first + together]
        columns = np.zeros((6 * count, 6 * len(part)))
        for k, a in enumerate(part.tolist()):
            columns[6 * a : 6 * a + 6, 6 * k : 6 * k + 6] = np.eye(6)
        inverse = factor.solve(columns)
        for k, a in enumerate(part.tolist()):
            block = inverse[6 * a : 6 * a + 6, 6 * k : 6 * k + 6]
            found[first + k] = (block + block.T) / 2
    if len(at) == count:
        return found
    flat = found.reshape(len(at), 36)
    every = np.arange(count)
    out = np.stack([np.interp(every, at, flat[:, k]) for k in range(36)], axis=-1)
    return out.reshape(count, 6, 6)
