"""Every frame on its own, and the error model that the run itself shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.steps.localize.frame.calibrate import calibrated
from rtmap_cli.steps.localize.frame.single import Solution, solve_single
from rtmap_cli.steps.localize.model import ErrorModel, Settings
from rtmap_cli.steps.localize.seeing.frames import Detections
from rtmap_cli.steps.localize.seeing.lines import MapLines

Array = NDArray[np.float64]


def single_frames(
    lines: MapLines,
    seen: Detections,
    model: ErrorModel | None,
    settings: Settings,
    around: Array | None = None,
) -> tuple[Solution, ErrorModel]:
    """Single-frame answers and the error model behind them, measured in the run if not given.

    ``around`` (T, 3): where to search, if not at the initial poses.
    """
    first = model or ErrorModel()
    start = solve_single(lines, seen, first, settings, start=around)
    if model is not None:
        return start, model
    model = calibrated(lines, seen, start, first, settings)
    # Other sigmas may choose another start; other shares of them only refine it.
    found = start if model.scale == first.scale else None
    return solve_single(lines, seen, model, settings, found, around), model
