"""Lenses: what bends rays between a camera's axes and its pixels.

Normalised image coordinates are (X / Z, Y / Z) of the camera frame (x right, y down, z forward).
``pinhole`` is OpenCV's model: radial k1, k2, k3 or the rational k1 … k6, tangential p1, p2;
``fisheye`` is Kannala and Brandt's of four terms (PAMI 2006), as in OpenCV's fisheye module.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TERMS = {"pinhole": (3, 6), "fisheye": (4,)}
"""How many radial terms a model may have."""

_STEEPEST = np.radians(89.0)
"""Rays farther from the axis have no place on a plane in front of the camera."""


@dataclass(frozen=True)
class Lens:
    """``radial`` k1, k2, k3 or k1 … k6 (pinhole: (1 + k1 r² + k2 r⁴ + k3 r⁶) over
    (1 + k4 r² + k5 r⁴ + k6 r⁶)) or k1 … k4 (fisheye: θ (1 + k1 θ² + … + k4 θ⁸)); ``tangential``
    p1, p2 (pinhole only). ValueError for another model or number of terms.
    """

    model: str = "pinhole"
    radial: tuple[float, ...] = (0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if self.model not in TERMS:
            raise ValueError(f"unknown lens model {self.model!r} (known: {', '.join(TERMS)})")
        if len(self.radial) not in TERMS[self.model]:
            counts = " or ".join(map(str, TERMS[self.model]))
            raise ValueError(f"a {self.model} lens has {counts} terms, not {len(self.radial)}")
        if self.model == "fisheye" and any(self.tangential):
            raise ValueError("a fisheye lens has no tangential terms")

    @property
    def straight(self) -> bool:
        """True when the lens bends nothing: a pure pinhole."""
        return self.model == "pinhole" and not any(self.radial) and not any(self.tangential)

    def distort(self, xy: Array) -> Array:
        """(..., 2) straight coordinates → (..., 2) where the lens puts them."""
        xy = np.asarray(xy, np.float64)
        r = np.hypot(xy[..., 0], xy[..., 1])
        factor = np.divide(self._bent(r), r, out=np.ones_like(r), where=r > 1e-9)
        out = xy * factor[..., None]
        if any(self.tangential):
            out = out + self._shifted(xy, r)
        return out

    @cached_property
    def reach(self) -> float:
        """Largest straight radius up to which the image radius rises; beyond it the model folds
        the picture back and means nothing."""
        r = np.tan(np.linspace(0.0, _STEEPEST, 4000))
        bent = self._bent(r)
        falls = np.flatnonzero(~(np.diff(bent) > 0))
        return float(r[falls[0]] if len(falls) else r[-1])

    def inside(self, xy: Array) -> NDArray[np.bool_]:
        """(...,) which straight coordinates (..., 2) the model is meant for (see ``reach``)."""
        return np.asarray(np.hypot(xy[..., 0], xy[..., 1]) <= self.reach, bool)

    def _bent(self, r: Array) -> Array:
        """Image radius of straight radii."""
        k = self.radial
        if self.model == "fisheye":
            a = np.arctan(r)
            s = a * a
            return a * (1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))
        s = r * r
        out = r * (1 + s * (k[0] + s * (k[1] + s * k[2])))
        if len(k) == 6:
            below = 1 + s * (k[3] + s * (k[4] + s * k[5]))
            # Past a pole of the fraction the model folds: NaN ends the rising branch.
            out = np.divide(out, below, out=np.full_like(out, np.nan), where=below > 1e-6)
        return out

    def _shifted(self, xy: Array, r: Array) -> Array:
        """The tangential part."""
        (p1, p2), x, y, s = self.tangential, xy[..., 0], xy[..., 1], r * r
        return np.stack(
            [2 * p1 * x * y + p2 * (s + 2 * x * x), p1 * (s + 2 * y * y) + 2 * p2 * x * y], axis=-1
        )
