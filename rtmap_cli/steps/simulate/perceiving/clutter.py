"""Delineators and barriers of a construction site, which a network takes for paint now and then."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import resample
from rtmap_cli.geometry.poses import invert, transform
from rtmap_cli.steps.simulate.driving.traffic import visible
from rtmap_cli.steps.simulate.perceiving.noise import generator
from rtmap_cli.steps.simulate.perceiving.perception import (
    VERTICES,
    Detection,
    ErrorModel,
    View,
)

Array = NDArray[np.float64]

MISTAKEN = 0.25
"""Share of the frames in which a row of posts is taken for a divider."""
FEWEST = 3
"""Posts that make a line."""
SET_AGAIN = 0.4
"""Posts are knocked and set again between two drives: standard deviation (m) of a row."""


class Clutter:
    """Rows of posts (n, 2), map frame, as one drive sees them."""

    def __init__(
        self, rows: Sequence[Array], errors: ErrorModel, score: tuple[float, float]
    ) -> None:
        self.errors, self.score = errors, score
        rng = generator(*errors.key.drive, "posts")
        self.rows = [row + rng.normal(0.0, SET_AGAIN, 2) for row in rows]

    def of(self, view: View, range_m: tuple[float, float, float, float]) -> list[Detection]:
        """False dividers of one frame: some neighbouring posts of a row that are in view."""
        x0, y0, x1, y1 = range_m
        out = []
        for k, row in enumerate(self.rows):
            rng = generator(*self.errors.key.drive, "mistaken", view.frame, k)
            points = transform(invert(view.pose), row)
            seen = ((points >= [x0, y0]) & (points <= [x1, y1])).all(axis=1)
            seen &= visible(points, view.occluders)
            points = points[seen]
            if len(points) < FEWEST or rng.random() >= MISTAKEN:
                continue
            count = int(rng.integers(FEWEST, len(points) + 1))
            first = int(rng.integers(0, len(points) - count + 1))
            line = resample(points[first : first + count], VERTICES)
            q = self.errors.spread(0.0, rng)
            places, sigma, _ = self.errors.measure("divider", f"posts{k}", view, line, q)
            score = 1.0 / (1.0 + np.exp(-(self.score[0] + self.score[1] * rng.normal())))
            out.append(Detection("divider", places, self.errors.stated(sigma, rng), float(score)))
        return out
