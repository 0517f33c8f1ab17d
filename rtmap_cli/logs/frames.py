"""FrameLog: a log of another format whose frames are all known once its tables are read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.log import Frame, Rig
from rtmap_cli.logs.native import decode_image

Array = NDArray[np.float64]

POSE_SIGMA = np.array([0.1, 0.1, np.radians(0.1)])
"""Assumed standard deviations of poses (m, m, rad) where a data set states none."""


class FrameLog:
    """Satisfies ``Log``; ``notes`` says what the log lacks, one sentence each.

    BadInput when there is no frame or when times do not rise.
    """

    def __init__(
        self,
        path: Path,
        log_id: str,
        crs: str,
        rig: Rig | None,
        frames: Sequence[Frame],
        ground_z: float = 0.0,
        notes: Sequence[str] = (),
    ) -> None:
        self.path, self.log_id, self.crs, self.rig = path, log_id, crs, rig
        self.ground_z, self.notes, self._frames = ground_z, list(notes), list(frames)
        if not self._frames:
            raise BadInput(path, f"{log_id} holds no frame")
        times = [f.timestamp_ns for f in self._frames]
        for k, (first, second) in enumerate(pairwise(times)):
            if second <= first:
                raise BadInput(path, f"{log_id}: frame {k + 1} is not later than frame {k}")

    def __len__(self) -> int:
        return len(self._frames)

    def frames(self) -> Iterator[Frame]:
        """The frames in time order."""
        return iter(self._frames)

    def read_sweep(self, frame: Frame) -> Array | None:
        """(n, 4) x, y, z (ego frame of the frame, metres) and intensity in [0, 1]; None without."""
        raise NotImplementedError

    def read_image(
        self, frame: Frame, camera: str, at_least: tuple[int, int] | None = None
    ) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB of one camera of one frame (see ``decode_image``)."""
        if camera not in frame.images:
            raise BadInput(self.path, f"frame {frame.index} has no image of {camera}")
        return decode_image(frame.images[camera], at_least)
