"""Scores that are probabilities: logistic regression of the new queries' `hints` on frames that
training did not see (Platt scaling, with how sharply and how long a line is told beside the logit).

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
from rtmap_models.answer import AnsweringNet, hints
from rtmap_models.data.dataset import Batch, Frames, collate, make_sample
from rtmap_models.data.samples import PriorNoise
from rtmap_models.tiny.decoder import LayerOutput
from rtmap_models.training.calibrate import FOUND_M

Rows = NDArray[np.float64]

PLAIN = np.array([1.0, 0.0, 0.0, 0.0])
"""Weights of the hints that leave a score as it is."""


@torch.no_grad()
def calibrate_scores(
    network: AnsweringNet, frames: Frames, seed: int = 0, batch: int = 8
) -> dict[str, list[float]]:
    """Set ``score_fit`` from held-out frames; returns the weights by mode and class."""
    network.eval()
    classes, out = network.config.classes, {}
    for mode, prior in enumerate(("none", "seen")):
        rows, claimed = score_rows(network, frames, prior, [seed, 2 + mode], batch)
        for c, name in enumerate(classes):
            own = rows[claimed == c]
            fit = fit_scores(own) if len(own) else PLAIN
            network.score_fit[mode, c] = torch.from_numpy(fit).float()
            out[f"score {name} {'with' if mode else 'without'} prior"] = fit.tolist()
    return out


@torch.no_grad()
def score_rows(
    network: AnsweringNet, frames: Frames, prior: str, seed: list[int], batch: int = 8
) -> tuple[Rows, NDArray[np.int64]]:
    """The `hints` of every new query and whether it is right (n, 5), and the class it claims."""
    config, rng = network.config, np.random.default_rng(seed)
    noise = PriorNoise(1.0, 1.0, 0.15, 0.15, 0.0)
    rows: list[Rows] = [np.zeros((0, 5))]
    claimed = [np.zeros(0, np.int64)]
    for start in range(0, len(frames), batch):
        index = range(start, min(start + batch, len(frames)))
        samples = [
            make_sample(frames[k], config, rng, noise, prior=prior, train=False) for k in index
        ]
        data = collate(samples, config)
        prediction = network.predict_batch(data)
        own = _judged(prediction.layers[-1], prediction.new_count, data)
        rows.append(own[0])
        claimed.append(own[1])
    return np.concatenate(rows), np.concatenate(claimed)


def _judged(last: LayerOutput, n: int, data: Batch) -> tuple[Rows, NDArray[np.int64]]:
    """As `score_rows`, of one batch."""
    classes = last.logits.shape[-1] - 1
    every = hints(last, n, classes).numpy()
    logits, claimed = (x.numpy() for x in last.logits[:, :n, :classes].max(dim=-1))
    points = last.points[:, :n].numpy()
    existence = last.logits[:, n:, classes].sigmoid().numpy() * data.prior_mask.numpy()
    slots = last.points[:, n:].numpy()
    orders, truth_class = data.truth_orders.numpy(), data.truth_class.numpy()
    out: list[Rows] = [np.zeros((0, 5))]
    of_class = [np.zeros(0, np.int64)]
    for b in range(len(points)):
        known = existence[b] >= 0.5
        twice = on_prior(
            points[b], claimed[b], slots[b][known], data.prior_class[b].numpy()[known], DUPLICATE_M
        )
        wanted = np.arange(data.truth_start[b], data.truth_start[b + 1])
        wanted = wanted[data.truth_new[wanted]]
        free = set(wanted.tolist())
        right = np.zeros(n)
        for q in np.argsort(-logits[b], kind="stable"):
            if twice[q]:
                continue
            for g in sorted(free):
                if truth_class[g] != claimed[b, q]:
                    continue
                distance = np.abs(orders[g] - points[b, q]).mean(axis=(1, 2)).min()
                if distance < FOUND_M:
                    free.discard(g)
                    right[q] = 1.0
                    break
        kept = np.flatnonzero(~twice)
        own = every[b, kept, claimed[b, kept]]
        out.append(np.column_stack([own, right[kept]]))
        of_class.append(claimed[b, kept])
    return np.concatenate(out), np.concatenate(of_class)


def fit_scores(rows: Rows) -> NDArray[np.float64]:
    """(4,) weights of logistic regression of hints and right (n, 5); that of the logit above 0.

    Platt's targets and a weak pull to `PLAIN` keep few positives from running away.
    """
    x, y = rows[:, :4], rows[:, 4]
    positives = y.sum()
    target = np.where(y > 0, (positives + 1) / (positives + 2), 1 / (len(y) - positives + 2))
    pull = np.array([1.0, 0.1, 0.1, 0.01])

    def loss(weights: NDArray[np.float64]) -> float:
        z = x @ weights
        fit = np.logaddexp(0.0, z) - target * z
        return float(fit.sum() + 0.5 * (pull * (weights - PLAIN) ** 2).sum())

    bounds = [(0.1, 10.0), (-10.0, 10.0), (-10.0, 10.0), (-20.0, 20.0)]
    found = minimize(loss, PLAIN, method="L-BFGS-B", bounds=bounds)
    weights: NDArray[np.float64] = found.x
    return weights
