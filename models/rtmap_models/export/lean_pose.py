"""The pose head in few operations: equations as planes (B, 4, n), elimination by rows.

The same sums as `PoseHead.forward`; the unknowns are eliminated in the same order.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rtmap_models.export.lean_decoder import tangents
from rtmap_models.pose import ALONG_STRETCH, ITERATIONS, LEVER_M, PoseEstimate, PoseHead


def locate(
    self: PoseHead, prior: Tensor, refined: Tensor, scale: Tensor, weight: Tensor
) -> PoseEstimate:
    """As `PoseHead.forward`."""
    before = prior.permute(0, 3, 1, 2)
    tangent, after = tangents(before), refined.permute(0, 3, 1, 2).flatten(2)
    normal = torch.cat([-tangent[:, 1:], tangent[:, :1]], dim=1)
    directions = torch.stack([normal, tangent], dim=2)  # (B, 2, 2, K), and so are all planes
    off = (before.flatten(2) - after)[:, :, None]
    spread = directions * scale.permute(0, 3, 1, 2).flatten(2)[:, :, None]
    b = spread.square().sum(dim=1, keepdim=True).sqrt().clamp(min=0.02)
    b = (b * torch.tensor([1.0, ALONG_STRETCH])[:, None]).flatten(2)
    dx, dy = directions[:, :1], directions[:, 1:]
    turn = (dy * after[:, :1, None] - dx * after[:, 1:, None]) / LEVER_M
    residual = (directions * off).sum(dim=1, keepdim=True)
    equations = torch.cat([turn, dy, dx, residual], dim=1).flatten(2)  # (B, 4, 2 K)
    rows, y = equations[:, :3], equations[:, 3:]
    used = weight[:, None, None, :, None].expand(-1, 1, 2, -1, prior.shape[2])
    base, floor = used.flatten(2) / b, b * 0.5
    sigma = torch.stack([self.prior_sigma[2] * LEVER_M, *self.prior_sigma[:2].flip(0)])
    ridge = torch.diag(sigma.square().reciprocal())
    beside = torch.cat([ridge, torch.zeros_like(ridge[:, :1])], dim=1)
    sides, x = equations.transpose(1, 2), torch.zeros_like(rows[:, :, :1])
    for _ in range(ITERATIONS):
        error = (y - x.transpose(1, 2) @ rows).abs()
        system = (rows * (base / torch.maximum(error, floor))) @ sides
        x = solve(system + beside)
    shrink = self.inflation.flip(0).reciprocal()
    information = system[:, :, :3] * (shrink[:, None] * shrink) + ridge
    eye = torch.eye(3).expand(information.shape[0], -1, -1)
    unit = torch.tensor([1.0, 1.0, 1.0 / LEVER_M])
    covariance = solve(torch.cat([information, eye], dim=2)).flip(1, 2)
    return PoseEstimate(x[:, :, 0].flip(1) * unit, covariance * (unit[:, None] * unit))


def solve(system: Tensor) -> Tensor:
    """(B, 3, 3 + k): symmetric positive definite matrices and k right sides → (B, 3, k)."""
    k = system.shape[2] - 3
    top, rest = system.split([1, 2], dim=1)
    a, beside = top.split([1, 2 + k], dim=2)
    left, rest = rest.split([1, 2 + k], dim=2)
    rest = rest - left / a * beside
    middle, last = rest.split([1, 1], dim=1)
    d, after = middle.split([1, 1 + k], dim=2)
    left, last = last.split([1, 1 + k], dim=2)
    pivot, right = (last - left / d * after).split([1, k], dim=2)
    x3 = right / pivot
    across, right = after.split([1, k], dim=2)
    x2 = (right - across * x3) / d
    across, further, right = beside.split([1, 1, k], dim=2)
    x1 = (right - across * x2 - further * x3) / a
    return torch.cat([x1, x2, x3], dim=1)
