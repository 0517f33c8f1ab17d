"""What `label cloud` is asked to do, and what its odometry found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs.log import Frame

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Settings:
    """``method`` of `METHODS`, side of a ``voxel`` of the map and of a ``leaf`` of matched sweeps
    (m; None: by the first sweep), whether to use ``gnss``, ``odometry`` and ``loops``, the range
    of points that enter the ``map`` (m)."""

    method: str = "vgicp"
    voxel: float = 0.1
    leaf: float | None = None
    gnss: bool = True
    odometry: bool = True
    loops: bool = True
    reach: float = 60.0


@dataclass
class Track:
    """What the odometry found, sweep by sweep, in the local frame of the drive."""

    frames: list[Frame]
    local: Array
    information: Array
    status: NDArray[np.object_]
    weak: Array
    keyframe: NDArray[np.bool_]
    cost: Array
    turn: NDArray[np.bool_]

    def open(self) -> str:
        """What the sweeps do not tell, in words."""
        if not np.isfinite(self.weak).any():
            return "turn" if self.turn.any() else "motion"
        axis = np.nanmean(np.abs(self.weak), axis=0)
        way = ("forward", "sideways", "upward")[int(np.nanargmax(axis))]
        return f"motion {way}" + (", nor the turn" if self.turn.any() else "")
