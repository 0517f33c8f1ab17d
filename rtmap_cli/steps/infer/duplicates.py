"""Detections that say the same thing twice: all but the best of them fade."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from rtmap_cli.geometry.polylines import resample

SAME_M = 1.0
"""Elements of one class whose Chamfer distance is below this are one element, metres."""

FADE = 0.3
"""What the score of a duplicate is multiplied with: it may be a close neighbour after all."""

SAMPLES = 40
FAINT = 0.02
"""Scores below this are left alone: nobody looks at them."""


def fade_duplicates(
    points: NDArray[Any], class_index: NDArray[Any], scores: NDArray[Any]
) -> NDArray[np.float32]:
    """Scores (n,) of detections (n, V, 2) in metres, in which everything that lies on a better
    detection of its class is worth less."""
    out = np.array(scores, dtype=np.float32)
    order = np.argsort(-out, kind="stable")
    order = order[out[order] > FAINT]
    dense = {int(k): resample(np.asarray(points[k], np.float64), SAMPLES) for k in order}
    kept: list[int] = []
    for k in map(int, order):
        if any(class_index[k] == class_index[j] and _same(dense[k], dense[j]) for j in kept):
            out[k] *= FADE
        else:
            kept.append(k)
    return out


def _same(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    # The middles of two lines are no further apart than the lines, give or take their lengths.
    if np.abs(a.mean(axis=0) - b.mean(axis=0)).max() > 12.0:
        return False
    gap = cdist(a, b)
    return bool(gap.min(axis=0).mean() + gap.min(axis=1).mean() < 2 * SAME_M)
