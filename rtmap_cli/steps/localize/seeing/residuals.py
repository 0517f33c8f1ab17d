"""Residuals of detections against map lines, their correlated covariance and robust weights."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.steps.localize.model import ErrorModel
from rtmap_cli.steps.localize.seeing.frames import Detections
from rtmap_cli.steps.localize.seeing.lines import MapLines

Array = NDArray[np.float64]

# Nats that a vertex without a line near it costs when starts are compared: half a nat is what a
# matched one costs on average, and the vertices of an element are far from independent.
_UNMATCHED = 0.65


@dataclass(frozen=True)
class Linear:
    """Residuals at a pose: ``r`` (E, V) metres across the line, positive to its left;
    ``jacobian`` (E, V, 3) by x, y (map axes), yaw; ``normal`` (E, V, 2) in the ego frame (in the
    map frame it is ``jacobian[..., :2]``); ``sample`` (E, V) of the map, -1 where none is near."""

    r: Array
    jacobian: Array
    normal: Array
    sample: NDArray[np.int64]

    @property
    def found(self) -> NDArray[np.bool_]:
        """(E, V) True where a line is near."""
        return self.sample >= 0


@dataclass(frozen=True)
class Noise:
    """The covariance W⁻¹ + U Uᵀ of each element: ``weight`` (E, V) = 1 / vertex variance, 0 where
    nothing was found; ``normal`` (E, V, 2) in the ego frame; ``size`` (E, 2): standard deviation
    of the element's common offset along ego x and y."""

    weight: Array
    normal: Array
    size: Array

    @cached_property
    def shared(self) -> Array:
        """(E, V, 2) what a unit value of the common offset does to the residuals (U)."""
        return self.normal * self.size[:, None]

    def doubted(self, doubt_m: float) -> Noise:
        """With ``doubt_m`` more on the common offset: the pose itself is not known better yet."""
        return Noise(self.weight, self.normal, np.hypot(self.size, doubt_m))


def turn_of(seen: Detections, pose: Array) -> Array:
    """(E, 2, 2) turns of the elements' frames at poses (T, 3): p @ turn = R p."""
    c, s = np.cos(pose[seen.frame, 2]), np.sin(pose[seen.frame, 2])
    return np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)


def linearize(
    lines: MapLines, seen: Detections, pose: Array, gate_m: float, shift: Array | None = None
) -> Linear:
    """Associate every vertex at ``pose`` (T, 3) and differentiate n · (R p + t - q).

    ``shift`` (E, V or 1, 2), map axes, is added to the vertices when their lines are looked for:
    what is known of their errors must not lead them to another line. Residuals are without it.
    """
    turn = turn_of(seen, pose)
    turned = seen.points @ turn
    at = turned + pose[seen.frame, None, :2]
    at = at if shift is None else at + shift
    shape = seen.points.shape[:2]
    match = lines.match(
        at.reshape(-1, 2),
        (seen.tangent @ turn).reshape(-1, 2),
        np.repeat(seen.code, shape[1]),
        np.repeat(seen.chain, shape[1]),
        gate_m,
    )
    normal = match.normal.reshape(*shape, 2)
    jacobian = np.empty((*shape, 3))
    jacobian[..., :2] = normal
    # d(R p)/dyaw = R p turned left by 90 degrees.
    jacobian[..., 2] = normal[..., 1] * turned[..., 0] - normal[..., 0] * turned[..., 1]
    across = match.across.reshape(shape)
    if shift is not None:
        across = across - (normal * shift).sum(-1)
    r = np.where(match.sample.reshape(shape) >= 0, across, 0.0)
    return Linear(r, jacobian, normal @ np.swapaxes(turn, -1, -2), match.sample.reshape(shape))


def noise_of(
    lines: MapLines,
    seen: Detections,
    linear: Linear,
    model: ErrorModel,
    offset_share: Array | float,
    map_factor: Array | float = 1.0,
) -> Noise:
    """Covariance of each element's residuals.

    ``offset_share`` (E,) of the stated variance is common to the element; ``map_factor`` (E,)
    inflates the map's variance where several frames see the same error of it. That error is
    correlated over ``map_length_m``: common on a short element; on a long one it averages out
    along the line, but slower than the vertices' own errors.
    """
    count = seen.points.shape[1]
    found = linear.found
    variance = lines.variance[linear.sample]
    variance = np.where(found & np.isfinite(variance), variance, model.map_sigma_m**2)
    variance = variance * np.reshape(map_factor, (-1, 1))
    x = seen.length / model.map_length_m
    together = 1.0 / np.sqrt(1.0 + x * x / 6.0)
    clump = np.clip(2.5 * count / x, 1.0, count) * (1.0 - together)
    stated = ((linear.normal * seen.spread) ** 2).sum(-1) * model.scale**2
    vertex = model.vertex_share * stated + variance * clump[:, None]
    map_common = together * (variance * found).sum(-1) / np.maximum(found.sum(-1), 1)
    common = np.reshape(offset_share, (-1, 1)) * (seen.common * model.scale) ** 2
    weight = np.where(found, 1.0 / np.maximum(vertex, 1e-8), 0.0)
    return Noise(weight, linear.normal, np.sqrt(common + map_common[:, None]))


def place_amplitude(seen: Detections, linear: Linear, model: ErrorModel) -> Array:
    """(E, V, 2) what a unit value of the place field (map axes) does to each residual."""
    sigma = np.sqrt(((linear.normal * seen.common[:, None]) ** 2).sum(-1))
    size = np.sqrt(model.place_share) * model.scale * sigma
    amplitude: Array = size[..., None] * linear.jacobian[..., :2]
    return amplitude


def _root(weight: Array, shared: Array) -> tuple[Array, Array]:
    """L⁻¹ (E, 2, 2) with L Lᵀ = A = I + Uᵀ W U, and log det A (E,)."""
    return woodbury_root(np.swapaxes(shared, -1, -2) @ (shared * weight[..., None]))


def woodbury_root(a: Array) -> tuple[Array, Array]:
    """L⁻¹ (E, 2, 2) with L Lᵀ = I + ``a``, and log det (E,) of that."""
    l00 = np.sqrt(a[..., 0, 0] + 1.0)
    l10 = a[..., 0, 1] / l00
    l11 = np.sqrt(np.maximum(a[..., 1, 1] + 1.0 - l10 * l10, 1e-12))
    inverse = np.zeros_like(a)
    inverse[..., 0, 0], inverse[..., 1, 1] = 1.0 / l00, 1.0 / l11
    inverse[..., 1, 0] = -l10 / (l00 * l11)
    return inverse, 2.0 * (np.log(l00) + np.log(l11))


def gram_sum(columns: Array, weight: Array, shared: Array) -> Array:
    """The sum over the elements of Xᵀ C⁻¹ X (q, q), C = W⁻¹ + U Uᵀ, by Woodbury in one product;
    columns X (E, V, q)."""
    weighted = columns * weight[..., None]
    q = columns.shape[-1]
    b = _root(weight, shared)[0] @ (np.swapaxes(shared, -1, -2) @ weighted)
    b = b.reshape(-1, q)
    out: Array = columns.reshape(-1, q).T @ weighted.reshape(-1, q) - b.T @ b
    return out


def _explained(r: Array, weight: Array, shared: Array) -> tuple[Array, Array, Array]:
    """What the common offset explains of r (E, V), the part of χ² it takes (E,), log det A (E,)."""
    inverse, logdet = _root(weight, shared)
    b = inverse @ (np.swapaxes(shared, -1, -2) @ (r * weight)[..., None])
    offset = (shared @ (np.swapaxes(inverse, -1, -2) @ b))[..., 0]
    return offset, (b * b).sum((-1, -2)), logdet


def common_offset(r: Array, weight: Array, noise: Noise) -> Array:
    """(E, 2) likeliest common offset of each element in the ego frame (m), from residuals (E, V)
    with robust weights (E, V): E[o | r] with r = n · o + v, o ~ N(0, diag size²)."""
    inverse, _ = _root(weight, noise.shared)
    b = inverse @ (np.swapaxes(noise.shared, -1, -2) @ (r * weight)[..., None])
    offset: Array = noise.size * (np.swapaxes(inverse, -1, -2) @ b)[..., 0]
    return offset


@dataclass(frozen=True)
class Judgement:
    """``vertex`` (E, V) Huber weights; ``inlier`` (E,) probability that an element is what the map
    says it is; ``fits`` (E,): its residuals speak for that, whatever was thought before;
    ``evidence`` (E,) log-likelihood of its residuals under the mixture of both."""

    vertex: Array
    inlier: Array
    fits: NDArray[np.bool_]
    evidence: Array

    def weight(self, noise: Noise) -> Array:
        """(E, V) robust vertex weights."""
        return noise.weight * self.vertex * self.inlier[:, None]


def judge(
    seen: Detections, linear: Linear, noise: Noise, r: Array, model: ErrorModel, huber: float
) -> Judgement:
    """Robust weights from the residuals ``r`` (E, V) that are left.

    Vertices are judged after the element's common offset is taken out; elements by a mixture: its
    offset is the stated one, or ``outlier_sigma_m`` because it belongs to something else.
    """
    offset, _, _ = _explained(r, noise.weight, noise.shared)
    size = np.abs(r - offset) * np.sqrt(noise.weight)
    vertex = huber / np.maximum(size, huber)
    weight = noise.weight * vertex
    square = (r * r * weight).sum(-1)
    _, fit, logdet = _explained(r, weight, noise.shared)
    inside = -np.logaddexp(0.0, -seen.logit) - 0.5 * (square - fit + logdet)
    _, fit, logdet = _explained(r, weight, linear.normal * model.outlier_sigma_m)
    p_out = -np.logaddexp(0.0, seen.logit)
    outside = p_out - 0.5 * (square - fit + logdet)
    matched = linear.found.any(-1)
    either = np.logaddexp(inside, outside)
    inlier = np.where(matched, np.exp(inside - either), 0.0)
    # An element with no line near it at all: as an outlier with all its vertices would fare.
    vertex_variance = 0.5 * model.vertex_share * (seen.common**2).sum(-1) * model.scale**2
    lost = p_out - 0.5 * np.log1p(r.shape[1] * model.outlier_sigma_m**2 / vertex_variance)
    fits = matched & (inside - outside > seen.logit)
    missing = (~linear.found).sum(-1) * _UNMATCHED
    return Judgement(vertex, inlier, fits, np.where(matched, either, lost) - missing)
