"""What a match does not know: directions, by the spectrum of its translation information, and the
turn about the vertical, by trying other turns (a round hall looks alike under all of them)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry import lie
from rtmap_cli.geometry.poses import invert
from rtmap_cli.steps.label.cloud.matcher import Match

Array = NDArray[np.float64]

WEAK = 0.012
"""A direction that has less than this share of the best known one's information is not known:
rough normals alone leave about 0.5 % in a tunnel, real streets have 4 % and more."""

SUSPECT = 0.05
"""A turn known worse than this share is tried: streets have 5 % and more, round halls 0.3 to 2."""
PROBE, ALIKE, NOISE = np.radians(10.0), 1.1, 0.05
"""How far other turns are tried (rad), and how much more they may cost: so many times, and this."""


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


def turn_share(information: Array, found: Spectrum, xyz: Array) -> float:
    """How well the turn about the vertical is known beside the best known direction, as points
    (n, 3) would tell it from their distance: some per cent where rough normals alone tell it."""
    a, b, c = information[:3, :3], information[:3, 3:], information[3:, 3:]
    spread = np.linalg.pinv(a - b @ np.linalg.pinv(c) @ b.T, hermitian=True)
    reach = float((xyz[:, :2] ** 2).sum(axis=1).mean())
    return float(1.0 / max(spread[2, 2] * found.values[2] * reach, 1e-12))


def turn_is_open(match: Callable[[Array], Match], found: Match) -> bool:
    """True when the sweep lies as well on the map under another turn: matches that start `PROBE`
    to either side stay away and cost no more."""
    for side in (PROBE, -PROBE):
        other = match(found.pose @ lie.exp(np.array([0.0, 0.0, side, 0.0, 0.0, 0.0])))
        turned = abs(float(lie.log(invert(found.pose) @ other.pose)[2]))
        if turned < PROBE / 2 or other.cost > ALIKE * found.cost + NOISE:
            return False
    return True


def held(pose: Array, guess: Array, found: Spectrum, turn: bool = False) -> Array:
    """A match (4, 4) that keeps the ``guess`` along directions that it does not know (solution
    remapping: Zhang, Kaess and Singh, ICRA 2016), and with ``turn`` about the vertical."""
    twist = lie.log(invert(guess) @ pose)
    strong = found.directions[:, ~found.weak]
    twist[3:] = strong @ strong.T @ twist[3:]
    if turn:
        twist[2] = 0.0
    return np.asarray(guess @ lie.exp(twist))


def without_weak(information: Array, found: Spectrum, turn: bool = False) -> Array:
    """The information (6, 6) with nothing along the weak directions, nor with ``turn`` about the
    vertical."""
    clean = np.eye(6)
    weak = found.directions[:, found.weak]
    clean[3:, 3:] -= weak @ weak.T
    clean[2, 2] = 0.0 if turn else 1.0
    return np.asarray(clean @ information @ clean)
