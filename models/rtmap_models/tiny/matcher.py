"""Which new query answers for which truth element (R9 of the paper).

Prior slots are not matched: each knows its element from the way its prior was made. What the prior
does not hold is given to the new queries by the Hungarian method.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from rtmap_models.data.dataset import Batch
from rtmap_models.tiny.decoder import LayerOutput

POINT_WEIGHT, CLASS_WEIGHT = 0.6, 2.0
FAR_M = 30.0


class Matches(NamedTuple):
    """Pairs: sample (M,), query (M,), truth (M,) indices."""

    sample: NDArray[np.int64]
    query: NDArray[np.int64]
    truth: NDArray[np.int64]


class Matcher:
    """One batch; call it for the output of each layer."""

    def __init__(self, batch: Batch):
        self.batch = batch
        orders = batch.truth_orders.numpy()[:, :, ::2]  # every other vertex is enough here
        self.targets: list[tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.int64]]] = []
        for b in range(len(batch.truth_start) - 1):
            index = np.arange(batch.truth_start[b], batch.truth_start[b + 1])
            index = index[batch.truth_new[index]]
            variants = [orders[g] if batch.truth_closed[g] else orders[g, :2] for g in index]
            first = np.cumsum([0] + [len(v) for v in variants])[:-1]
            flat = np.concatenate(variants) if variants else np.zeros((1, 1, 2), np.float32)
            self.targets.append((index, flat.reshape(len(flat), -1), first))

    @torch.no_grad()
    def __call__(self, output: LayerOutput, new_count: int) -> Matches:
        """Cheapest one-to-one pairs of new queries and elements that they must find."""
        classes = output.logits.shape[-1] - 1
        points = output.points[:, :new_count, ::2].numpy()
        p = output.logits[:, :new_count, :classes].sigmoid().numpy()
        positive = 0.25 * (1 - p) ** 2 * -np.log(p + 1e-8)
        negative = 0.75 * p**2 * -np.log(1 - p + 1e-8)
        truth_class = self.batch.truth_class.numpy()
        parts: list[NDArray[np.int64]] = []
        for b, (index, flat, first) in enumerate(self.targets):
            if len(index) == 0:
                continue
            mine = points[b].reshape(new_count, -1)
            distance = cdist(mine, flat, "cityblock") / (mine.shape[1] / 2)
            distance = np.minimum.reduceat(distance, first, axis=1)
            cost = POINT_WEIGHT * np.minimum(distance, FAR_M)
            cost = cost + CLASS_WEIGHT * (positive - negative)[b][:, truth_class[index]]
            query, column = linear_sum_assignment(cost)
            parts.append(np.stack([np.full_like(query, b), query, index[column]]))
        pairs = np.concatenate(parts, axis=1) if parts else np.zeros((3, 0), np.int64)
        return Matches(*pairs)
