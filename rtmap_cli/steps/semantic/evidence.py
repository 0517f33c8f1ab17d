"""What an observation is worth: the confusion matrix, weights by distance and by intensity.

A cell of class k is observed as class o with probability C[k, o]. Observations i of weight w_i give
it the log-likelihood

    log p(observations | k) = Σ_i w_i log C[k, o_i] = Σ_o n_o log C[k, o],  n_o = Σ_{i: o_i = o} w_i

(Paz et al., Probabilistic Semantic Mapping for Urban Autonomous Driving, IROS 2020): what a cell
must remember is the summed weight n_o per observed class, whatever the matrix.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.semantic import CLASSES
from rtmap_cli.tables import read_json

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

CONFUSION = np.array(
    [
        # road  cross  mark   curb   side   terrain
        [0.900, 0.020, 0.030, 0.015, 0.020, 0.015],
        [0.130, 0.790, 0.060, 0.005, 0.010, 0.005],
        [0.350, 0.030, 0.590, 0.010, 0.010, 0.010],
        [0.180, 0.005, 0.015, 0.560, 0.160, 0.080],
        [0.040, 0.010, 0.010, 0.030, 0.850, 0.060],
        [0.030, 0.005, 0.005, 0.020, 0.060, 0.880],
    ]
)
"""C[k, o]: what a ground of class k (row) is taken for. Paint and kerbs are thinner than a cell,
so part of what falls into their cells shows the road beside them."""

PAINT = tuple(CLASSES.index(n) for n in ("crosswalk", "marking"))
ROAD = CLASSES.index("road")
ENOUGH = 50
"""Points on the road that a sweep needs for its intensity to be judged."""
BRIGHT = 1.5
"""Paint is that many standard deviations of the road's intensity brighter, for even odds."""


@dataclass(frozen=True)
class Weighting:
    """``distance`` (m): a point there weighs half of one at the vehicle. ``intensity`` in [0, 1]:
    how far dull paint loses and bright paint gains weight. ``confusion`` (K, K)."""

    distance: float = 20.0
    intensity: float = 0.5
    confusion: Array = field(default_factory=lambda: CONFUSION)

    def of(self, xyz: Floats, intensity: Floats | None, classes: NDArray[np.uint8]) -> Floats:
        """(n,) weights of points (n, 3) of the ego frame: 1 / (1 + (r / distance)²), for paint
        times 1 + a · tanh((I − median) / (1.48 MAD) − `BRIGHT`), median and MAD of the road's."""
        r2 = xyz[:, 0] ** 2 + xyz[:, 1] ** 2
        weight: Floats = np.float32(1) / (1 + r2 * np.float32(1 / self.distance**2))
        if intensity is None or not self.intensity:
            return weight
        road = intensity[classes == ROAD]
        if len(road) < ENOUGH:
            return weight
        middle = np.median(road)
        spread = 1.4826 * np.median(np.abs(road - middle))
        if spread < 1e-4:
            return weight
        paint = np.flatnonzero((classes == PAINT[0]) | (classes == PAINT[1]))
        excess = (intensity[paint] - middle) / np.float32(spread) - np.float32(BRIGHT)
        weight[paint] *= 1 + np.float32(self.intensity) * np.tanh(excess)
        return weight

    def probabilities(self, counts: Floats) -> Floats:
        """(..., K) probability of each class of cells with summed weights (..., K), every class as
        likely before; 0 where nothing was observed."""
        likelihood: Floats = counts @ np.log(self.confusion).astype(np.float32).T
        likelihood -= likelihood.max(axis=-1, keepdims=True)
        np.exp(likelihood, out=likelihood)
        likelihood /= likelihood.sum(axis=-1, keepdims=True)
        likelihood[counts.sum(axis=-1) <= 0] = 0
        return likelihood


def read_confusion(path: Path) -> Array:
    """(K, K) of ``{"classes": […], "matrix": [[…], …]}``: row = true class, column = observed one,
    counts or shares; rows are made to add up to one. BadInput when it is none or another class
    list's."""
    content = read_json(path)
    if not isinstance(content, dict) or "matrix" not in content or "classes" not in content:
        raise BadInput(path, "is not a confusion matrix (classes and matrix)")
    if list(content["classes"]) != list(CLASSES):
        raise BadInput(path, f"has other classes than {', '.join(CLASSES)}", "in this order")
    try:
        matrix = np.array(content["matrix"], np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (len(CLASSES), len(CLASSES)) or not np.isfinite(matrix).all():
        raise BadInput(path, f"the matrix is not {len(CLASSES)} × {len(CLASSES)} numbers")
    if (matrix < 0).any() or (matrix.sum(axis=1) <= 0).any():
        raise BadInput(path, "the matrix has a negative entry or an empty row")
    return floored(matrix)


def floored(matrix: Array) -> Array:
    """A confusion matrix whose rows add up to one and no entry of which is 0, which would let one
    observation forbid a class for ever."""
    matrix = np.maximum(matrix / matrix.sum(axis=1, keepdims=True), 1e-3)
    out: Array = matrix / matrix.sum(axis=1, keepdims=True)
    return out
