"""How good a network is on frames that training does not see: the figures of a model's card.

Three readings of every frame, nothing varied: without a prior; with a prior that is wrong by
σ 1 m and 1°; with the same kind of prior, 15 % of it missing and 15 % false. The noisy prior as it
is stands beside the second: what the network is worth is what it adds.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from rtmap_cli.errors import BadInput
from rtmap_cli.steps.evaluate.maps.precision import Detection, Scorer
from rtmap_models.config import ModelConfig
from rtmap_models.data.dataset import Batch, Frames, Sample, collate, make_sample
from rtmap_models.data.samples import PriorNoise, clip

NOISE = PriorNoise(1.0, 1.0, 0.0, 0.0, 0.0)
CHANGED = PriorNoise(1.0, 1.0, 0.15, 0.15, 0.0)
FLOOR = 0.02
"""Queries below this score are not looked at."""

BATCH = 8

Floats = NDArray[np.float64]


@torch.no_grad()
def validate(
    network: nn.Module, frames: Frames, limit: int = 64, bf16: bool = False
) -> dict[str, float]:
    """mAP (range and thresholds of the ``rtmap`` protocol) over at most ``limit`` frames, evenly
    taken, in evaluation mode.

    Returns "mAP", "mAP prior", "mAP unchanged prior", "AUC existence" (NaN where nothing is false)
    and "mAP CLASS" without a prior by class, all in 0 … 1. BadInput when there is no frame.
    """
    if len(frames) == 0:
        raise BadInput(frames.folder, "no frames to validate on", "render some first")
    config: ModelConfig = frames.config
    was_training = network.training
    network.eval()
    chosen = np.unique(np.linspace(0, len(frames) - 1, limit).round().astype(int)).tolist()
    alone, aided, unchanged = (Scorer(config.classes, protocol="rtmap") for _ in range(3))
    exists: list[tuple[float, bool]] = []
    for sample, found, _ in readings(network, frames, chosen, None, bf16):
        alone.add(found, truth_of(sample, config))
    for sample, found, _ in readings(network, frames, chosen, NOISE, bf16):
        assert sample.prior is not None
        truth = truth_of(sample, config)
        aided.add(found, truth)
        unchanged.add(named(sample.prior.points, sample.prior.classes, config), truth)
    for sample, _, existence in readings(network, frames, chosen, CHANGED, bf16):
        assert sample.prior is not None
        exists += zip(existence.tolist(), sample.prior.real.tolist(), strict=False)
    network.train(was_training)
    result = alone.result()
    return {
        "mAP": result.mAP,
        "mAP prior": aided.result().mAP,
        "mAP unchanged prior": unchanged.result().mAP,
        "AUC existence": area_under_curve(exists),
    } | {f"mAP {name}": score.mean for name, score in result.classes.items()}


def readings(
    network: Any, frames: Frames, chosen: list[int], noise: PriorNoise | None, bf16: bool
) -> Iterator[tuple[Sample, list[Detection], Floats]]:
    """Sample, detections and existence of its prior elements, for every chosen frame."""
    config = frames.config
    rng = np.random.default_rng(1)
    device = next(network.parameters()).device
    for start in range(0, len(chosen), BATCH):
        samples = [
            make_sample(
                frames[k], config, rng, noise, "none" if noise is None else "seen", train=False
            )
            for k in chosen[start : start + BATCH]
        ]
        batch = collate(samples, config).to(device)
        scores, points, existence = _answers(network, batch, bf16)
        for b, sample in enumerate(samples):
            yield sample, detections_of(scores[b], points[b], config), existence[b]


def _answers(network: Any, batch: Batch, bf16: bool) -> tuple[Floats, Floats, Floats]:
    """Scores (B, Q, C) and points (B, Q, V, 2) of all queries, existence (B, P) of prior slots."""
    prediction = network.predict_batch(batch, bf16)
    answer = network.answer(prediction, batch.prior_points, batch.prior_class, batch.prior_mask)
    scores, points, existence = (
        x.float().cpu().numpy().astype(np.float64)
        for x in (answer.scores, answer.points, answer.prior_score)
    )
    return scores, points, existence


def detections_of(scores: Floats, points: Floats, config: ModelConfig) -> list[Detection]:
    best = scores.argmax(axis=1)
    return [
        (config.classes[c], p, float(s[c]))
        for s, p, c in zip(scores, points, best, strict=True)
        if s[c] > FLOOR
    ]


def truth_of(sample: Sample, config: ModelConfig) -> list[Detection]:
    """What evaluation asks for: also pieces of lines that training leaves out as too short."""
    pieces = clip(sample.scene, config, min_length=0.5)
    return named(pieces.points, pieces.classes, config)


def named(points: Floats, classes: NDArray[np.int64], config: ModelConfig) -> list[Detection]:
    return [(config.classes[c], p, 1.0) for p, c in zip(points, classes, strict=True)]


def area_under_curve(pairs: list[tuple[float, bool]]) -> float:
    """How often a real element has a higher score than a false one; NaN with only one kind."""
    score, real = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs], dtype=bool)
    if real.all() or not real.any():
        return float("nan")
    a, b = score[real][:, None], score[~real][None]
    return float(((a > b) + 0.5 * (a == b)).mean())
