"""Honest uncertainties: measure on frames that training did not see, and keep the factors.

A Laplace scale b is honest when 80 % of the errors lie within b·ln 5; a standard deviation σ of the
pose when 80 % lie within 1.2816 σ. Quantiles, not means: a few mismatched elements must not decide.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_models.answer import Answer, AnsweringNet, Layers
from rtmap_models.data.dataset import Batch, Frames, collate, make_sample
from rtmap_models.data.samples import PriorNoise
from rtmap_models.tiny.matcher import Matcher

LAPLACE_80 = math.log(5.0)
NORMAL_80 = 1.2816
FOUND_M = 1.5
"""A new query counts as having found an element when its vertices lie this near, on average."""

Ratios = NDArray[np.float64]


@torch.no_grad()
def calibrate(
    network: AnsweringNet, frames: Frames, seed: int = 0, batch: int = 8
) -> dict[str, float]:
    """Set ``sigma_factor`` and ``pose.inflation`` of a network from held-out frames.

    Every frame is read with a prior of 1 m / 1° that the new queries do not see. Returns the
    factors by name.
    """
    if len(frames) == 0:
        raise BadInput(frames.folder, "no frames to calibrate with", "render some first")
    network.eval()
    network.sigma_factor.fill_(1.0)
    network.pose.inflation.fill_(1.0)
    config, rng = network.config, np.random.default_rng(seed)
    noise = PriorNoise(1.0, 1.0, 0.15, 0.15, 0.0)
    ratios: dict[tuple[int, int], list[Ratios]] = {}
    for start in range(0, len(frames), batch):
        index = range(start, min(start + batch, len(frames)))
        samples = [
            make_sample(frames[k], config, rng, noise, prior="hidden", train=False) for k in index
        ]
        data = collate(samples, config)
        prediction = network.predict_batch(data)
        _collect(ratios, prediction, data)
    for (class_id, kind), values in ratios.items():
        ratio = float(np.quantile(np.concatenate(values), 0.8)) / LAPLACE_80
        network.sigma_factor[class_id, kind] = float(np.clip(ratio, 0.2, 5.0))
    _calibrate_pose(network, frames, seed, noise, batch)
    return _named(network)


def _collect(ratios: dict[tuple[int, int], list[Ratios]], prediction: Layers, data: Batch) -> None:
    """Ratios |error| / b of matched new queries (kind 0) and of real prior slots (kind 1)."""
    last, n = prediction.layers[-1], prediction.new_count
    match = Matcher(data)(last, n)
    sample, query, truth = (torch.from_numpy(x) for x in match)
    found, orders = last.points[sample, query], data.truth_orders[truth]
    distance = (orders - found[:, None]).abs()
    best = distance.mean(dim=(2, 3)).argmin(dim=1)
    error = distance[torch.arange(len(best)), best]
    near = error.mean(dim=(1, 2)) < FOUND_M
    new = (error / last.log_scale[sample, query].exp())[near]
    real = (data.prior_mask * data.prior_real) > 0
    old_error = (last.points[:, n:] - data.prior_target).abs()[real]
    old = old_error / last.log_scale[:, n:][real].exp()
    for kind, values, classes in (
        (0, new, data.truth_class[truth][near]),
        (1, old, data.prior_class[real]),
    ):
        for c in classes.unique().tolist():
            part = values[classes == c].reshape(-1).numpy().astype(np.float64)
            ratios.setdefault((c, kind), []).append(part)


def _calibrate_pose(
    network: AnsweringNet, frames: Frames, seed: int, noise: PriorNoise, batch: int
) -> None:
    config, rng = network.config, np.random.default_rng([seed, 1])
    ratios: list[Ratios] = []
    for start in range(0, len(frames), batch):
        index = range(start, min(start + batch, len(frames)))
        samples = [
            make_sample(frames[k], config, rng, noise, prior="seen", train=False) for k in index
        ]
        data = collate(samples, config)
        prior = (data.prior_points, data.prior_class, data.prior_mask)
        answer: Answer = network.answer(network.predict_batch(data), *prior)
        sigma = answer.pose_covariance.diagonal(dim1=1, dim2=2).sqrt()
        ratios.append(((answer.pose_delta - data.delta).abs() / sigma).numpy())
    quantile = np.quantile(np.concatenate(ratios), 0.8, axis=0) / NORMAL_80
    network.pose.inflation.copy_(torch.from_numpy(np.clip(quantile, 0.5, 20.0)).float())


def _named(network: AnsweringNet) -> dict[str, float]:
    out = {}
    for c, name in enumerate(network.config.classes):
        for kind, what in enumerate(("new", "prior")):
            out[f"sigma {name} {what}"] = float(network.sigma_factor[c, kind])
    for value, axis in zip(network.pose.inflation.tolist(), ("dx", "dy", "dyaw"), strict=True):
        out[f"pose {axis}"] = value
    return out
