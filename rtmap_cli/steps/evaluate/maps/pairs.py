"""The frames of an evaluation: where each is, and what either side says there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.maps.crop import Range
from rtmap_cli.steps.evaluate.maps.frames import MapSide
from rtmap_cli.steps.evaluate.maps.precision import Detection

Array = NDArray[np.float64]
ByFrame = Mapping[str, list[Detection]]
Pair = tuple[str, list[Detection], list[Detection]]


@dataclass(frozen=True)
class Pairs:
    """Frames by key; a side is a map, cropped at ``poses`` (n, 4, 4) to ``box``, or a mapping of
    keys (a frame that it lacks is empty)."""

    keys: list[str]
    pred: MapSide | ByFrame
    truth: MapSide | ByFrame
    poses: Array | None = None
    box: Range | None = None

    def __len__(self) -> int:
        return len(self.keys)

    def __iter__(self) -> Iterator[Pair]:
        for k, key in enumerate(self.keys):
            yield key, self._at(self.pred, k), self._at(self.truth, k)

    def _at(self, side: MapSide | ByFrame, k: int) -> list[Detection]:
        if isinstance(side, MapSide):
            assert self.poses is not None and self.box is not None
            return side.crop(self.poses[k], self.box)
        return side.get(self.keys[k], [])

    def part(self, start: int, stop: int) -> Pairs:
        """Some of the frames with what they need of a mapping; maps stay whole."""
        keys = self.keys[start:stop]
        sides = {
            name: side if isinstance(side, MapSide) else {k: side[k] for k in keys if k in side}
            for name, side in (("pred", self.pred), ("truth", self.truth))
        }
        poses = None if self.poses is None else self.poses[start:stop]
        return replace(self, keys=keys, poses=poses, **sides)  # type: ignore[arg-type]

    def without_maps(self) -> Pairs:
        """The same frames with empty sides in place of maps, for sending to another process."""
        sides = {
            name: {} if isinstance(side, MapSide) else side
            for name, side in (("pred", self.pred), ("truth", self.truth))
        }
        return replace(self, **sides)  # type: ignore[arg-type]

    def with_maps(self, pred: MapSide | None, truth: MapSide | None) -> Pairs:
        """The same frames with maps put back where there are some."""
        return replace(self, pred=pred or self.pred, truth=truth or self.truth)
