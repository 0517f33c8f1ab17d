"""How far lines lie beside what drives saw of them: the consensus of traversals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs.traversal import Traversal, pose_variance
from rtmap_cli.maps.consensus import along, consensus, sightings
from rtmap_cli.maps.refit import FusionModel
from rtmap_cli.maps.stations import Samples, Stations, assign, smoother

Array = NDArray[np.float64]


def fused_offsets(
    stations: Stations,
    traversals: Sequence[Traversal],
    samples: Sequence[Samples],
    model: FusionModel,
) -> tuple[Array, Array]:
    """Offset (m, to the left) and variance (m²) of every station over all drives, whose
    ``samples`` of a class are given (NaN, inf where none saw it)."""
    n = len(stations)
    if not traversals or not n:
        return np.full(n, np.nan), np.full(n, np.inf)
    smooth = smoother(stations, model.width)
    drives = []
    for traversal, s in zip(traversals, samples, strict=True):
        feet, _ = assign(stations, s)
        noise = pose_variance(
            traversal, s.frame[feet.sample], s.xy[feet.sample], stations.normal[feet.station]
        )
        drives.append(sightings(stations, smooth, s, feet, noise, traversal.way))
    offset, variance = consensus(drives, n, model, along(stations, model.shared_m))
    return offset[:, 0], variance
