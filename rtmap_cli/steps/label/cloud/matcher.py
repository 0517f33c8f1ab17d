"""What a scan matcher offers.

A matcher holds the local map. Poses take the ego frame to the local frame of the drive; the
information is that of a perturbation on the right (rotation, then translation; ego frame).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ITERATIONS = 25
FREE = 5.0
"""Cost of a point without a partner, in the unit of squared Mahalanobis distance / 2."""


@dataclass(frozen=True)
class Match:
    """Where a sweep lies: ``pose`` (4, 4), ``information`` (6, 6), the share of its points that
    found a partner, and the mean robust cost of a point (lower is better)."""

    pose: Array
    information: Array
    share: float
    cost: float


class Matcher(Protocol):
    """A local map that sweeps are matched with and put into."""

    leaf: float

    def prepare(self, xyz: Array) -> Any:
        """Points (n, 3) of the ego frame made ready for `match` and `insert`."""
        ...

    def insert(self, prepared: Any, pose: Array) -> None:
        """Put a sweep into the local map."""
        ...

    def match(self, prepared: Any, guess: Array) -> Match:
        """Find the pose of a sweep near ``guess``."""
        ...

    def local_points(self) -> Array:
        """(n, 3) points that stand for the local map."""
        ...


def judged(pose: Array, information: Array, inliers: int, error: float, points: int) -> Match:
    """A Match from what a solver says: points without a partner cost `FREE` each."""
    count = max(points, 1)
    return Match(pose, information, inliers / count, (error + FREE * (points - inliers)) / count)
