"""The evaluators of the field, by name.

``maptr`` (MapTR, MapTRv2; 100 points, pairs whose 2 m bands touch), ``streammapnet`` (200 points,
every pair) and ``rtmap`` (the algorithm of ``maptr`` at the 72 × 36 m of the RTMap paper). All are
planar.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Detection = tuple[str, NDArray[np.float64], float]
"""Class, vertices (n, 2 or more columns; the first two count) in metres, score."""

THRESHOLDS = (0.5, 1.0, 1.5)


@dataclass(frozen=True)
class Protocol:
    """How one evaluator compares lines; ``range_m`` is the ego-frame box its numbers refer to."""

    name: str
    samples: int
    band: float | None
    keep_sampled: bool
    drop_single: bool
    range_m: tuple[float, float, float, float]


PROTOCOLS = {
    "maptr": Protocol("maptr", 100, 2.0, True, True, (-30.0, -15.0, 30.0, 15.0)),
    "streammapnet": Protocol("streammapnet", 200, None, False, False, (-30.0, -15.0, 30.0, 15.0)),
    "rtmap": Protocol("rtmap", 100, 2.0, True, True, (-36.0, -18.0, 36.0, 18.0)),
}
