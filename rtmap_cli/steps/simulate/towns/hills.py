"""The lie of the land: gentle hills, and streets that are higher in the middle than at the curb."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rtmap_cli.geometry.polylines import resample_step

Array = NDArray[np.float64]

FLAT = 0.25
"""Share of towns without hills."""
SPACING = 6.0
"""Greatest distance of the vertices of lines on hills, metres."""


class Hills:
    """Heights over local metres: a tilted plane, a few waves, and a crown over the asphalt."""

    def __init__(self, rng: np.random.Generator, surface: Any) -> None:
        steepest = 0.0 if rng.random() < FLAT else float(rng.uniform(0.005, 0.085))
        angles = rng.uniform(0, 2 * np.pi, 4)
        shares = rng.dirichlet((1.5, 1.0, 1.0, 0.5))
        length = np.array([np.inf, *rng.uniform((260, 140, 80), (700, 320, 160))])
        direction = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        self.plane = steepest * shares[0] * direction[0]
        self.waves = 2 * np.pi / length[1:, None] * direction[1:]
        # The steepest slope of a wave is its height times its wave number.
        self.heights = steepest * shares[1:] * length[1:] / (2 * np.pi)
        self.phases = rng.uniform(0, 2 * np.pi, 3)
        self.crown = float(rng.uniform(0.0, 0.025)) * (steepest > 0)
        self.flat = steepest == 0
        edges = [resample_step(r, 1.0) for r in _rings(surface)]
        self.edge = cKDTree(np.concatenate(edges)) if self.crown else None

    def at(self, xy: Array) -> Array:
        """Heights (n,) at places (n, 2), metres."""
        z: Array = xy @ self.plane
        z = z + np.sin(xy @ self.waves.T + self.phases) @ self.heights
        if self.edge is not None:
            z = z + self.crown * np.minimum(self.edge.query(xy)[0], 6.0)
        return z

    def drape(self, line: Array, pieces: float = SPACING) -> Array:
        """A line (n, 2) laid on the hills (m, 3); its vertices are at most ``pieces`` m apart."""
        if self.flat:
            return np.column_stack([line, np.zeros(len(line))])
        steps = np.hypot(*np.diff(line, axis=0).T)
        counts = np.maximum(1, np.ceil(steps / pieces - 1e-9).astype(int))
        at = np.concatenate([np.arange(n) / n + k for k, n in enumerate(counts)] + [[len(steps)]])
        dense = np.stack([np.interp(at, np.arange(len(line)), line[:, k]) for k in (0, 1)], -1)
        return np.column_stack([dense, self.at(dense)])


def _rings(surface: Any) -> list[Array]:
    return [
        np.asarray(ring.coords)
        for part in shapely.get_parts(surface)
        for ring in (part.exterior, *part.interiors)
    ]
