"""The pose head: weighted least squares between prior vertices and their refined places.

The prior is cut out with the initial pose, so its vertices p carry the pose error; the refined
vertices q are where the pictures show them. With ``true map_SE3_ego = initial · SE2(delta)`` both
are linked by ``p = SE2(delta) q``, linearised ``p - q = t + yaw · J q`` with J = [[0, -1], [1, 0]].
A vertex may slide along its line: the part of its error along the normal counts in full, the part
along the tangent as if its scale were four times larger. Weighted by existence and the Laplace
scale; iteratively reweighted L1, each step in closed form.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from rtmap_models.tiny.decoder import unit_tangents

LEVER_M = 10.0
"""Yaw is solved as metres at this distance: all unknowns are then of one size."""

ITERATIONS = 5

ALONG_STRETCH = 4.0
"""Factor on the scale of residuals along the line."""


class PoseEstimate(NamedTuple):
    """``delta`` (B, 3): dx, dy in metres, dyaw in radians; ``covariance`` (B, 3, 3)."""

    delta: Tensor
    covariance: Tensor


class PoseHead(nn.Module):
    """Closed form; its only numbers are measured ones, kept with the weights.

    ``inflation`` (3,) multiplies the standard deviations that the vertices give to dx, dy, dyaw:
    those of one element err together, so the plain covariance is too small. ``prior_sigma`` bounds
    the answer where nothing constrains it: metres, metres, radians.
    """

    inflation: Tensor
    prior_sigma: Tensor

    def __init__(self, prior_sigma: tuple[float, float, float] = (3.0, 3.0, 0.06)):
        super().__init__()
        self.register_buffer("inflation", torch.ones(3))
        self.register_buffer("prior_sigma", torch.tensor(prior_sigma), persistent=False)

    def forward(
        self, prior: Tensor, refined: Tensor, scale: Tensor, weight: Tensor
    ) -> PoseEstimate:
        """Prior and refined vertices (B, P, V, 2) m, Laplace scales alike, weights (B, P)."""
        t = unit_tangents(prior)
        normal = torch.stack([-t[..., 1], t[..., 0]], dim=-1)
        parts = [
            _equations(direction, prior, refined, scale, stretch)
            for direction, stretch in ((normal, 1.0), (t, ALONG_STRETCH))
        ]
        rows, y, b = (torch.cat(values, dim=1) for values in zip(*parts, strict=True))
        base = weight[..., None].expand(-1, -1, prior.shape[2]).flatten(1).repeat(1, 2) / b
        floor = b * 0.5
        sigma = torch.stack([self.prior_sigma[2] * LEVER_M, *self.prior_sigma[:2].flip(0)])
        ridge = torch.diag_embed(sigma.square().reciprocal())
        x = torch.zeros_like(rows[:, 0])
        for _ in range(ITERATIONS):
            error = (y - (rows * x[:, None]).sum(-1)).abs()
            weighted = rows * (base / torch.maximum(error, floor))[..., None]
            information = weighted.transpose(1, 2) @ rows
            x = solve3(information + ridge, (weighted * y[..., None]).sum(1))
        order = [2, 1, 0]
        shrink = self.inflation.flip(0).reciprocal()
        covariance = inverse3(information * shrink[:, None] * shrink + ridge)
        unit = torch.ones_like(sigma)
        unit[2] = 1.0 / LEVER_M
        covariance = covariance[:, order][:, :, order] * unit[:, None] * unit
        return PoseEstimate(x[:, order] * unit, covariance)


def _equations(
    direction: Tensor, prior: Tensor, refined: Tensor, scale: Tensor, stretch: float
) -> tuple[Tensor, Tensor, Tensor]:
    """One equation per vertex along unit ``direction`` (B, P, V, 2): rows (B, n, 3) of yaw (times
    the lever), y, x; residuals (B, n); Laplace scales (B, n) in metres.

    Yaw comes first and forward last: the weakest direction must be the last pivot.
    """
    dx, dy = direction.unbind(-1)
    turn = (dy * refined[..., 0] - dx * refined[..., 1]) / LEVER_M
    rows = torch.stack([turn, dy, dx], dim=-1).flatten(1, 2)
    residual = (direction * (prior - refined)).sum(-1).flatten(1)
    b = (direction * scale).square().sum(-1).sqrt().flatten(1)
    return rows, residual, b.clamp(min=0.02) * stretch


def solve3(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve (B, 3, 3) symmetric positive definite systems for (B, 3) by L D Lᵀ, written out."""
    a, b, c = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 0, 2]
    d1 = a
    l21, l31 = b / d1, c / d1
    d2 = matrix[:, 1, 1] - l21 * b
    l32 = (matrix[:, 1, 2] - l31 * b) / d2
    d3 = matrix[:, 2, 2] - l31 * c - l32 * l32 * d2
    z1 = right[:, 0]
    z2 = right[:, 1] - l21 * z1
    z3 = right[:, 2] - l31 * z1 - l32 * z2
    x3 = z3 / d3
    x2 = z2 / d2 - l32 * x3
    x1 = z1 / d1 - l21 * x2 - l31 * x3
    return torch.stack([x1, x2, x3], dim=-1)


def inverse3(matrix: Tensor) -> Tensor:
    """(B, 3, 3) inverses of symmetric positive definite matrices."""
    eye = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    columns = [solve3(matrix, eye[k].expand(matrix.shape[0], 3)) for k in range(3)]
    return torch.stack(columns, dim=-1)
