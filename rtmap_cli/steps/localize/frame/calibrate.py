"""The error model of a run, measured in the run itself after a first solution.

Vertex errors show in second differences of residuals along an element, where whatever is smooth
(pose, offsets, place, map) cancels. Whether stated sigmas are honest shows in the mean residuals of
whole elements, compared with what the model expects after the pose took its share.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.steps.localize.frame.single import Solution
from rtmap_cli.steps.localize.model import ErrorModel, Settings
from rtmap_cli.steps.localize.seeing.frames import Detections
from rtmap_cli.steps.localize.seeing.lines import MapLines
from rtmap_cli.steps.localize.seeing.residuals import Linear, linearize

Array = NDArray[np.float64]

_MIN_COUNT = 100
# Straight: neighbouring normals this close (cosine), so that curvature does not look like noise.
_STRAIGHT = 0.995
# Elements less certain than this hide behind the gate of association (metres).
_SURE_M = 0.5
_MEDIAN_OF_CHI2 = 0.4549
# Medians of mixed errors are low by up to a half: within these limits stated sigmas are believed.
_BELIEVED = (0.25, 1.6)
_LIMITS = (0.3, 4.0)


def calibrated(
    lines: MapLines, seen: Detections, start: Solution, model: ErrorModel, settings: Settings
) -> ErrorModel:
    """``model`` with the run's own vertex share and scale, where it has enough elements to say.

    The place and element parts keep their proportion; ``scale`` stays 1 unless stated sigmas are
    clearly dishonest.
    """
    linear = linearize(lines, seen, start.pose, settings.gates_m[-1])
    vertex = _vertex_variance(seen, linear)
    offset = _offset_ratio(seen, linear, start, model)
    if vertex is None or offset is None:
        return model
    total = vertex + offset * model.offset_share
    scale = 1.0
    if not _BELIEVED[0] < total < _BELIEVED[1]:
        scale = float(np.clip(np.sqrt(total), *_LIMITS))
    share = float(np.clip(vertex / scale**2, 0.05, 0.8))
    element = model.element_share / model.offset_share * (1.0 - share)
    return replace(model, vertex_share=share, element_share=element, scale=scale)


def _vertex_variance(seen: Detections, linear: Linear) -> float | None:
    """Variance of a vertex' own error as a share of its stated variance (robust)."""
    found, n = linear.found, linear.normal
    triple = found[:, :-2] & found[:, 1:-1] & found[:, 2:]
    for a, b in ((slice(None, -2), slice(1, -1)), (slice(1, -1), slice(2, None))):
        triple &= (n[:, a] * n[:, b]).sum(-1) > _STRAIGHT
    second = linear.r[:, :-2] - 2.0 * linear.r[:, 1:-1] + linear.r[:, 2:]
    sigma = np.sqrt(((n * seen.spread) ** 2).sum(-1))[:, 1:-1]
    size = np.abs(second / sigma)[triple]
    if len(size) < _MIN_COUNT:
        return None
    # Errors have heavy tails, so that a median alone is too small; beyond four of it they are
    # clipped. (1, -2, 1) has the square sum 6.
    clipped = np.minimum(size, 4.0 * 1.4826 * np.median(size))
    return float((clipped**2).mean() / 6.0)


def _offset_ratio(
    seen: Detections, linear: Linear, start: Solution, model: ErrorModel
) -> float | None:
    """Variance of elements' offsets over what the model expects (robust)."""
    found = linear.found
    count = np.maximum(found.sum(-1), 1)
    mean = (linear.r * found).sum(-1) / count
    jacobian = (linear.jacobian * found[..., None]).sum(1) / count[:, None]
    straight = np.hypot(jacobian[:, 0], jacobian[:, 1]) > 0.9
    sigma2 = (((linear.normal * seen.common[:, None]) ** 2).sum(-1) * found).sum(-1) / count
    expected = model.offset_share * sigma2 + model.map_sigma_m**2
    covariance = start.covariance[seen.frame]
    taken = np.einsum("ei,eij,ej->e", jacobian, covariance, jacobian)
    usable = straight & (count >= 5) & (expected < _SURE_M**2) & (taken < 0.7 * expected)
    if usable.sum() < _MIN_COUNT:
        return None
    ratio = mean[usable] ** 2 / (expected - taken)[usable]
    return float(np.median(ratio) / _MEDIAN_OF_CHI2)
