"""The motion of a run as localization's own model has it; see ``rtmap_cli.logs.motion``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs import motion
from rtmap_cli.logs.motion import REACH, STATE, Motion, MotionTerms, motion_terms, step_error
from rtmap_cli.logs.run import RunFrames
from rtmap_cli.steps.localize.model import ErrorModel, Settings

Array = NDArray[np.float64]

__all__ = ["REACH", "STATE", "Motion", "MotionTerms", "motion_of", "motion_terms", "step_error"]


def motion_of(
    frames: RunFrames,
    gnss: Array,
    model: ErrorModel,
    settings: Settings,
    known: int | None = None,
) -> Motion:
    """The motion of a run; ``gnss`` (T, 3) its initial poses relative to the map's origin."""
    return motion.motion_of(
        frames,
        gnss,
        motion.MotionModel(
            settings.odometry_share,
            settings.odometry_rad_per_m,
            model.gnss_walk_m,
            model.gnss_yaw_length_m,
        ),
        known,
    )
