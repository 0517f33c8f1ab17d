"""Which direction a match does not know: the spectrum of its translation information."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry import lie
from rtmap_cli.geometry.poses import invert

Array = NDArray[np.float64]

WEAK = 0.012
"""A direction that has less than this share of the best known one's information is not known:
rough normals alone leave about 0.5 % in a tunnel, real streets have 4 % and more."""


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues (3,) of the information on translation, rotation unknown, ascending, and its
    directions (3, 3), columns, in the ego frame."""

    values: Array
    directions: Array

    @property
    def weak(self) -> NDArray[np.bool_]:
        """(3,) directions that are not known."""
        return np.asarray(self.values < WEAK * self.values[2])


def spectrum(information: Array) -> Spectrum:
    """The Schur complement of translation in an information matrix (6, 6): rotation first."""
    a, b, c = information[:3, :3], information[:3, 3:], information[3:, 3:]
    schur = c - b.T @ np.linalg.pinv(a) @ b
    values, directions = np.linalg.eigh((schur + schur.T) / 2)
    return Spectrum(np.maximum(values, 0.0), directions)


def held(pose: Array, guess: Array, found: Spectrum) -> Array:
    """A match (4, 4) that keeps the ``guess`` along directions that it does not know (solution
    remapping: Zhang, Kaess and Singh, ICRA 2016)."""
    twist = lie.log(invert(guess) @ pose)
    strong = found.directions[:, ~found.weak]
    twist[3:] = strong @ strong.T @ twist[3:]
    return np.asarray(guess @ lie.exp(twist))


def without_weak(information: Array, found: Spectrum) -> Array:
    """The information (6, 6) with nothing along the weak directions."""
    weak = found.directions[:, found.weak]
    if not weak.size:
        return information
    clean = np.eye(6)
    clean[3:, 3:] -= weak @ weak.T
    return np.asarray(clean @ information @ clean)
