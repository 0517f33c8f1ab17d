"""Checks before the network runs: does the prior lie where the log drove?"""

from __future__ import annotations

import numpy as np

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.log import Log
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.element import VectorMap


def check_prior_in_range(prior: VectorMap, log: Log, where: str, reach: float = 100.0) -> None:
    """BadInput when no element of the prior comes within ``reach`` metres of any frame."""
    if not len(prior):
        raise BadInput(where, "the map is empty", "pass another, or leave out --map")
    index = MapIndex(prior)
    nearest = np.inf
    for frame in log.frames():
        x, y = frame.map_SE3_ego[:2, 3]
        if index.near(x, y, reach):
            return
        b = index.boxes
        dx = np.maximum(np.maximum(b[:, 0] - x, x - b[:, 2]), 0)
        dy = np.maximum(np.maximum(b[:, 1] - y, y - b[:, 3]), 0)
        nearest = min(nearest, float(np.hypot(dx, dy).min()))
    far = f"{nearest:,.0f} m from the nearest frame"
    raise BadInput(where, f"out of the log's range: {far}", "pass the map of this place")
