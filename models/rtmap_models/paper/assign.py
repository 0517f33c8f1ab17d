"""Existence-aware matching: which query answers for which truth element (section 3.3).

With pre-attribution a prior slot that exists (Q_map) answers for its own element, vertex for
vertex, a false one (Q_fake) for nothing, and the Hungarian method gives what the prior lacks to the
new queries. Without it (an ablation) the Hungarian method has all queries and all elements.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from rtmap_models.config import PaperConfig
from rtmap_models.data.dataset import Batch
from rtmap_models.tiny.decoder import LayerOutput
from rtmap_models.tiny.matcher import Matches

ALPHA = 0.25
"""Weight of positives in focal costs and losses (γ = 2)."""

Index = NDArray[np.int64]


class Job(NamedTuple):
    """In one sample, these queries compete for these truth elements."""

    sample: int
    queries: Index
    truth: Index


def jobs_of(batch: Batch, new_count: int, pre_attribution: bool) -> list[Job]:
    """What the Hungarian method has to solve for each sample of a batch."""
    used = batch.prior_mask.cpu().numpy() > 0
    visible = batch.prior_visible.cpu().numpy() > 0
    new = np.arange(new_count)
    jobs: list[Job] = []
    for b in range(len(used)):
        every = np.arange(batch.truth_start[b], batch.truth_start[b + 1])
        slots = new_count + np.flatnonzero(used[b])
        if pre_attribution or len(slots) == 0:
            jobs.append(Job(b, new, every[batch.truth_new[every]]))
        elif visible[b]:
            jobs.append(Job(b, np.concatenate([new, slots]), every))
        else:  # new queries that do not see the prior find everything anew
            jobs += [Job(b, new, every), Job(b, slots, every)]
    return jobs


def many_jobs(batch: Batch, count: int) -> list[Job]:
    """One-to-many queries compete for every element, whatever the prior holds."""
    starts = batch.truth_start
    return [
        Job(b, np.arange(count), np.arange(starts[b], starts[b + 1]))
        for b in range(len(starts) - 1)
    ]


class Assigner:
    """Solves jobs for the outputs of any layer of one batch."""

    def __init__(self, batch: Batch, config: PaperConfig):
        self.config = config
        self.length = 2.0 * np.array(config.half_range, np.float32)
        orders = batch.truth_orders.cpu().numpy() / self.length
        closed = batch.truth_closed
        self.variants = [o if c else o[:2] for o, c in zip(orders, closed, strict=True)]
        self.truth_class = batch.truth_class.cpu().numpy()

    @torch.no_grad()
    def __call__(self, output: LayerOutput, jobs: list[Job], repeat: int = 1) -> Matches:
        """Cheapest pairs; each element is given to ``repeat`` queries, each query to one at most.

        Costs are the weighted parts of the loss: focal class, and Manhattan distance of all
        vertices in units of the range, in the best order of the element's vertices.
        """
        classes = output.logits.shape[-1] - 1
        points = output.points.float().cpu().numpy() / self.length
        p = output.logits[..., :classes].sigmoid().float().cpu().numpy()
        positive = ALPHA * (1 - p) ** 2 * -np.log(p + 1e-8)
        negative = (1 - ALPHA) * p**2 * -np.log(1 - p + 1e-8)
        parts: list[Index] = []
        for b, queries, truth in jobs:
            if len(truth) == 0 or len(queries) == 0:
                continue
            variants = [self.variants[g] for g in truth]
            first = np.cumsum([0] + [len(v) for v in variants])[:-1]
            flat = np.concatenate(variants).reshape(sum(map(len, variants)), -1)
            distance = cdist(points[b, queries].reshape(len(queries), -1), flat, "cityblock")
            distance = np.minimum.reduceat(distance, first, axis=1)
            score = (positive - negative)[b, queries][:, self.truth_class[truth]]
            cost = self.config.manhattan_weight * distance + self.config.class_weight * score
            row, column = linear_sum_assignment(np.tile(cost, (1, repeat)))
            found = truth[column % len(truth)]
            parts.append(np.stack([np.full_like(row, b), queries[row], found]))
        pairs = np.concatenate(parts, axis=1) if parts else np.zeros((3, 0), np.int64)
        return Matches(*pairs)
