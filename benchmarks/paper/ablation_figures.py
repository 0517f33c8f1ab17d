"""What a network of ``paper/ablations.py`` is worth, frame by frame, and by how much two differ.

Every network reads the same frames with the same wrong priors, so that two of them can be compared
frame by frame; frames of one town resemble each other, so towns are what is drawn anew for the
intervals. An interval says what other towns would change. What other first weights would change is
told by training again with another seed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from rtmap_models.answer import Answer
from rtmap_models.data.dataset import Batch, Frames, Sample, collate, make_sample
from rtmap_models.data.samples import PriorNoise
from rtmap_models.paper.network import PaperNet
from rtmap_models.paper.prediction import PaperPrediction
from rtmap_models.training.validate import BATCH, CHANGED, NOISE, detections_of, named, truth_of

from rtmap_cli.steps.evaluate.maps.precision import Scorer

Array = NDArray[np.float64]
Figures = dict[str, Array]
"""By name: one value per row of weights."""

RESAMPLES = 400
MAP_FIGURES = ("mAP", "mAP prior", "mAP unchanged prior")
EXISTENCE = "AUC existence"


@dataclass
class Readings:
    """All test frames as one network reads them.

    ``maps`` scorers of `MAP_FIGURES`; ``existence`` rows (frame, score, real) of prior elements;
    ``poses`` (frames, 3) absolute errors of dx, dy (m) and dyaw (°) by the way they are found.
    """

    maps: dict[str, Scorer]
    existence: Array = field(default_factory=lambda: np.zeros((0, 3)))
    poses: dict[str, Array] = field(default_factory=dict)


def read(network: PaperNet, frames: Frames) -> Readings:
    """Three readings of every frame: without a prior, with a noisy one, with one that is also
    outdated (15 % missing, 15 % false). The network is in evaluation mode."""
    config = network.config
    out = Readings({name: Scorer(config.classes, protocol="rtmap") for name in MAP_FIGURES})
    for name, noise in ((MAP_FIGURES[0], None), (MAP_FIGURES[1], NOISE)):
        for samples, _, _, answer in _answered(network, frames, noise):
            scores, points = answer.scores.double().numpy(), answer.points.double().numpy()
            for b, sample in enumerate(samples):
                truth = truth_of(sample, config)
                out.maps[name].add(detections_of(scores[b], points[b], config), truth)
                if (prior := sample.prior) is not None:
                    kept = named(prior.points, prior.classes, config)
                    out.maps[MAP_FIGURES[2]].add(kept, truth)
    exists: list[tuple[int, float, bool]] = []
    poses: dict[str, list[Array]] = {}
    frame = 0
    for samples, batch, prediction, answer in _answered(network, frames, CHANGED):
        for sample, scores in zip(samples, answer.prior_score.tolist(), strict=True):
            if sample.prior is not None:
                pairs = zip(scores, sample.prior.real.tolist(), strict=False)
                exists += [(frame, score, real) for score, real in pairs]
            frame += 1
        for way, error in _pose_errors(network, prediction, answer, batch).items():
            poses.setdefault(way, []).append(error)
    out.existence = np.array(exists, np.float64).reshape(-1, 3)
    out.poses = {way: np.concatenate(parts) for way, parts in poses.items()}
    return out


@torch.no_grad()
def _answered(
    network: PaperNet, frames: Frames, noise: PriorNoise | None
) -> Iterator[tuple[list[Sample], Batch, PaperPrediction, Answer]]:
    """The frames in batches, nothing varied, the same prior for every network."""
    rng = np.random.default_rng(1)
    kind = "none" if noise is None else "seen"
    for first in range(0, len(frames), BATCH):
        chosen = range(first, min(first + BATCH, len(frames)))
        samples = [
            make_sample(frames[k], network.config, rng, noise, kind, train=False) for k in chosen
        ]
        batch = collate(samples, network.config)
        prediction = network.predict_batch(batch)
        prior = (batch.prior_points, batch.prior_class, batch.prior_mask)
        yield samples, batch, prediction, network.answer(prediction, *prior)


def _pose_errors(
    network: PaperNet, prediction: PaperPrediction, answer: Answer, batch: Batch
) -> dict[str, Array]:
    """(B, 3) by way: the start, least squares of all prior elements, of those that exist, and the
    head's own answer where it was trained."""
    n, mask = prediction.new_count, batch.prior_mask
    points, scale = answer.points[:, n:], answer.sigma[:, n:]
    kept = (answer.prior_score >= 0.5).float()
    found = {
        "start": torch.zeros_like(batch.delta),
        "all of Q_prior": network.pose(batch.prior_points, points, scale, mask).delta,
        "only Q_map": network.pose(batch.prior_points, points, scale, kept).delta,
    }
    if network.config.use_pose_loss:
        found["learned head"] = prediction.poses[-1]
    unit = [1.0, 1.0, np.degrees(1.0)]
    return {k: (d - batch.delta).abs().double().numpy() * unit for k, d in found.items()}


def towns_of(frames: Frames) -> NDArray[np.int64]:
    """(frames,) the number of the town that each frame is of."""
    return np.repeat(np.arange(len(frames.order)), [len(shard) for shard in frames.order])


def resampled(towns: NDArray[np.int64], count: int = RESAMPLES, seed: int = 0) -> Array:
    """(count + 1, frames) how often each frame counts: first once each, then as its town was drawn
    with replacement."""
    most = int(towns.max()) + 1
    rng = np.random.default_rng(seed)
    drawn = rng.multinomial(most, np.full(most, 1.0 / most), size=count)
    return np.concatenate([np.ones((1, len(towns))), drawn[:, towns].astype(np.float64)])


def figures(readings: Readings, weights: Array) -> Figures:
    """mAPs, the AUC of existence and the mean pose errors ("WAY 0" dx, "WAY 1" dy, "WAY 2" dyaw)
    for every row of (rows, frames) weights."""
    out = {name: mean_precision(scorer, weights) for name, scorer in readings.maps.items()}
    out[EXISTENCE] = area(readings.existence, weights)
    for way, error in readings.poses.items():
        mean = weights @ error / weights.sum(axis=1, keepdims=True)
        out |= {f"{way} {axis}": mean[:, axis] for axis in range(3)}
    return out


def mean_precision(scorer: Scorer, weights: Array) -> Array:
    """(rows,) mAP of a scorer's frames, each counted as often as its weight says."""
    classes = []
    for ranking in scorer.rankings().values():
        order = np.argsort(-ranking.scores, kind="stable")
        counted = weights[:, ranking.frame[order]]
        seen = np.maximum(np.cumsum(counted, axis=1), 1e-9)
        truth = np.maximum(weights @ ranking.num_gt, 1e-9)
        for hits in ranking.hits[order].T:
            right = counted * hits
            precision = np.cumsum(right, axis=1) / seen
            envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
            classes.append((envelope * right).sum(axis=1) / truth)
    mean: Array = np.mean(classes, axis=0)
    return mean


def area(existence: Array, weights: Array) -> Array:
    """(rows,) how often a real element has a higher score than a false one; NaN without both."""
    ranked = existence[np.argsort(existence[:, 1], kind="stable")]
    counted, real = weights[:, ranked[:, 0].astype(int)], ranked[:, 2]
    true, false = counted * real, counted * (1.0 - real)
    below = np.cumsum(false, axis=1)
    with np.errstate(invalid="ignore"):
        found: Array = (true * below).sum(axis=1) / (true.sum(axis=1) * false.sum(axis=1))
    return found


def differences(one: Mapping[str, Array], other: Mapping[str, Array]) -> dict[str, list[float]]:
    """By figure that both have: ``one`` minus ``other``, and the bounds of 95 % of the draws."""
    out = {}
    for name in [n for n in one if n in other]:
        gap = one[name] - other[name]
        low, high = np.nanpercentile(gap[1:], [2.5, 97.5])
        out[name] = [float(gap[0]), float(low), float(high)]
    return out
