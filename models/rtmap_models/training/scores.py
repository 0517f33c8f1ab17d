"""Scores that are probabilities: Platt scaling of the new queries on frames training did not see.

A new query is right when its vertices lie near an element of its class that the prior does not
hold, and no better scored query claims that element. What lies on a prior slot is left out, as
``rtmap infer`` leaves it out. With a prior at hand there is little left to find and the raw scores
are low; without one they are high: the two are measured apart.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize

from rtmap_cli.maps.prior import DUPLICATE_M, on_prior
from rtmap_models.answer import AnsweringNet
from rtmap_models.data.dataset import Batch, Frames, collate, make_sample
from rtmap_models.data.samples import PriorNoise
from rtmap_models.tiny.decoder import LayerOutput
from rtmap_models.training.calibrate import FOUND_M

Pairs = NDArray[np.float64]


@torch.no_grad()
def calibrate_scores(
    network: AnsweringNet, frames: Frames, seed: int = 0, batch: int = 8
) -> dict[str, list[float]]:
    """Set ``score_line`` from held-out frames; returns slope and offset by mode and class."""
    network.eval()
    config, out = network.config, {}
    for mode, prior in enumerate(("none", "seen")):
        rng = np.random.default_rng([seed, 2 + mode])
        noise = PriorNoise(1.0, 1.0, 0.15, 0.15, 0.0)
        pairs: dict[int, list[Pairs]] = {}
        for start in range(0, len(frames), batch):
            index = range(start, min(start + batch, len(frames)))
            samples = [
                make_sample(frames[k], config, rng, noise, prior=prior, train=False) for k in index
            ]
            data = collate(samples, config)
            prediction = network.predict_batch(data)
            _collect(pairs, prediction.layers[-1], prediction.new_count, data)
        for c, name in enumerate(config.classes):
            line = fit_line(np.concatenate(pairs[c])) if c in pairs else np.array([1.0, 0.0])
            network.score_line[mode, c] = torch.from_numpy(line).float()
            out[f"score {name} {'with' if mode else 'without'} prior"] = line.tolist()
    return out


def _collect(pairs: dict[int, list[Pairs]], last: LayerOutput, n: int, data: Batch) -> None:
    """(logit, right) of every new query, by the class that it claims."""
    classes = last.logits.shape[-1] - 1
    logits, claimed = (x.numpy() for x in last.logits[:, :n, :classes].max(dim=-1))
    points = last.points[:, :n].numpy()
    existence = last.logits[:, n:, classes].sigmoid().numpy() * data.prior_mask.numpy()
    slots = last.points[:, n:].numpy()
    orders, truth_class = data.truth_orders.numpy(), data.truth_class.numpy()
    for b in range(len(points)):
        known = existence[b] >= 0.5
        twice = on_prior(
            points[b], claimed[b], slots[b][known], data.prior_class[b].numpy()[known], DUPLICATE_M
        )
        wanted = np.arange(data.truth_start[b], data.truth_start[b + 1])
        wanted = wanted[data.truth_new[wanted]]
        free = set(wanted.tolist())
        for q in np.argsort(-logits[b], kind="stable"):
            if twice[q]:
                continue
            right = False
            for g in sorted(free):
                if truth_class[g] != claimed[b, q]:
                    continue
                distance = np.abs(orders[g] - points[b, q]).mean(axis=(1, 2)).min()
                if distance < FOUND_M:
                    free.discard(g)
                    right = True
                    break
            pair = np.array([[logits[b, q], float(right)]])
            pairs.setdefault(int(claimed[b, q]), []).append(pair)


def fit_line(pairs: Pairs) -> NDArray[np.float64]:
    """Slope and offset of logistic regression of (logit, right) pairs (n, 2); slope above 0.

    Platt's targets and a weak pull to (1, 0) keep few positives from running away.
    """
    x, y = pairs[:, 0], pairs[:, 1]
    positives = y.sum()
    target = np.where(y > 0, (positives + 1) / (positives + 2), 1 / (len(y) - positives + 2))

    def loss(line: NDArray[np.float64]) -> float:
        z = line[0] * x + line[1]
        fit = np.logaddexp(0.0, z) - target * z
        return float(fit.sum() + 0.5 * ((line[0] - 1) ** 2 + 0.01 * line[1] ** 2))

    found = minimize(loss, np.array([1.0, 0.0]), method="L-BFGS-B", bounds=[(0.1, 10), (-10, 10)])
    line: NDArray[np.float64] = found.x
    return line
