"""Every residual behind the poses, for those who want to see why."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs.residuals import Residuals
from rtmap_cli.logs.run import Run
from rtmap_cli.steps.localize.model import ErrorModel, Settings
from rtmap_cli.steps.localize.seeing.frames import Detections
from rtmap_cli.steps.localize.seeing.lines import MapLines
from rtmap_cli.steps.localize.seeing.residuals import judge, linearize, noise_of, turn_of

Array = NDArray[np.float64]


def residuals_at(
    run: Run,
    lines: MapLines,
    seen: Detections,
    pose: Array,
    model: ErrorModel,
    settings: Settings,
) -> Residuals:
    """The residuals at ``pose`` (T, 3) to the lines nearest there, weighed as in single frames."""
    linear = linearize(lines, seen, pose, settings.gates_m[-1])
    noise = noise_of(lines, seen, linear, model, model.offset_share)
    judgement = judge(seen, linear, noise, linear.r, model, settings.huber)
    count = seen.points.shape[1]
    at = seen.points @ turn_of(seen, pose) + pose[seen.frame, None, :2] + lines.origin
    found = linear.found.ravel()
    vertex = 1.0 / np.where(linear.found, noise.weight, 1.0)
    sigma = np.sqrt(vertex + (noise.shared**2).sum(-1)).ravel()
    element = np.full(found.shape, None, object)
    element[found] = lines.element_id[linear.sample.ravel()[found]]
    rows = seen.row
    return Residuals(
        frame=np.repeat(run.frames.frame[seen.frame], count).astype(np.int32),
        query=np.repeat(run.observations.query[rows], count).astype(np.int32),
        vertex=np.tile(np.arange(count), len(rows)).astype(np.int16),
        class_name=np.repeat(np.array(lines.classes, object)[seen.code], count),
        element_id=element,
        at=at.reshape(-1, 2),
        normal=linear.jacobian[..., :2].reshape(-1, 2),
        across=np.where(found, linear.r.ravel(), np.nan),
        sigma=np.where(found, sigma, np.nan),
        weight=np.where(found, judgement.vertex.ravel(), 0.0),
        inlier=np.where(found, np.repeat(judgement.inlier, count), 0.0),
    )
