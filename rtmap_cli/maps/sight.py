"""How well a place is seen from a frame: by distance, by the ends of its line, by the range.

Relative detection probabilities, measured on the lines of the map that the drives themselves
confirm: what is far, near the end of a line (detections are cut short there) or near the border of
the range is found less often, and a miss there says less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

KNOTS = {
    "distance": (3.0, 9.0, 15.0, 21.0, 27.0, 33.0, 38.0),
    "to_end": (0.3, 1.0, 2.0, 3.0, 4.2, 6.0, 8.5, 14.0),
    "to_border": (0.5, 1.5, 2.5, 3.5, 4.5, 6.0, 8.5, 14.0),
}
"""Places (m) at which the relative probability is known; between them it is interpolated."""
DEFAULT = {
    "distance": (1.0, 1.0, 0.98, 0.96, 0.92, 0.85, 0.80),
    "to_end": (0.55, 0.65, 0.75, 0.80, 0.84, 0.89, 0.93, 1.0),
    "to_border": (0.45, 0.65, 0.75, 0.83, 0.87, 0.91, 0.96, 1.0),
}
PSEUDO = 150.0
"""The default counts as so many looks per knot."""


@dataclass(frozen=True)
class Look:
    """From where places were looked at (n,), metres: ``distance`` from the vehicle, ``to_end`` of
    the line (inf on rings), ``to_border`` of the range."""

    distance: Array
    to_end: Array
    to_border: Array


@dataclass(frozen=True)
class SightModel:
    """Relative detection probabilities at the ``KNOTS``; their product is that of a look."""

    distance: tuple[float, ...] = DEFAULT["distance"]
    to_end: tuple[float, ...] = DEFAULT["to_end"]
    to_border: tuple[float, ...] = DEFAULT["to_border"]

    def weight(self, look: Look) -> Array:
        """(n,) detection probability of each look, relative to the best one."""
        out = np.ones(len(look.distance))
        for name in KNOTS:
            out *= self.curve(name, getattr(look, name))
        return out

    def curve(self, name: str, value: Array) -> Array:
        """(n,) relative probability by one of the ``KNOTS``, at values in metres."""
        return np.interp(value, KNOTS[name], getattr(self, name))


def measured_sight(look: Look, found: NDArray[np.bool_]) -> SightModel:
    """The model of looks (n,) at places that exist, of which some ``found`` them.

    Each curve is the share found around a knot against that of looks that are good in the other
    two respects, shrunk to the default, and monotonic: better seen is not found less.
    """
    curves = {}
    good = {name: getattr(look, name) > limit for name, limit in (("to_end", 8), ("to_border", 6))}
    good["distance"] = look.distance < 24
    for name, knots in KNOTS.items():
        others = np.all([good[k] for k in KNOTS if k != name], axis=0)
        value, hit = getattr(look, name)[others], found[others]
        best = good[name][others]
        if best.sum() < 50:
            curves[name] = DEFAULT[name]
            continue
        usual = max(float(hit[best].mean()), 0.05)
        bin_ = np.digitize(value, (np.array(knots[:-1]) + knots[1:]) / 2)
        looks = np.bincount(bin_, minlength=len(knots))
        hits = np.bincount(bin_, hit, len(knots))
        default = np.array(DEFAULT[name])
        share = (hits + PSEUDO * usual * default) / (looks + PSEUDO) / usual
        order = np.minimum.accumulate if name == "distance" else np.maximum.accumulate
        curves[name] = tuple(np.clip(order(share), 0.1, 1.0).tolist())
    return SightModel(**curves)
