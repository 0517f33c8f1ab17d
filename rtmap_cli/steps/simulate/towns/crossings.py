"""Crossings on the arms of junctions and between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.steps.simulate.towns.junctions import Arm, Junction
from rtmap_cli.steps.simulate.towns.streets import Street

Array = NDArray[np.float64]
Crossing = tuple[Array, str]
"""A ring (5, 2) with the pattern of its paint."""


def lay_crossings(
    rng: np.random.Generator, streets: list[Street], junctions: list[Junction]
) -> list[Crossing]:
    """Crossings; sets how far from the junctions paint stops."""
    out: list[Crossing] = []
    for junction in junctions:
        profiles = [streets[a.street].profile for a in junction.arms]
        busy = min(p.crossings for p in profiles)
        marked = rng.random() < 0.5 * (busy + max(p.crossings for p in profiles))
        marked &= busy > 0.1 or rng.random() < 0.15
        pattern = profiles[0].pattern
        near, depth = rng.uniform(0.2, 3.0), rng.uniform(2.3, 4.6)
        for arm in junction.arms:
            arm.stop = rng.uniform(0.3, 3.5)
            if not marked or arm.oblique or rng.random() > 0.82:
                continue
            gap, wide = near + rng.normal(0, 0.3), depth * rng.uniform(0.9, 1.1)
            arm.stop = gap + wide + rng.uniform(0.8, 2.2)
            out.append((_ring(rng, streets[arm.street], arm, gap, wide), pattern))
    for index, street in enumerate(streets):
        if rng.random() < 0.3 * street.profile.crossings:
            ring = _midblock(rng, street, index, junctions)
            if ring is not None:
                out.append((ring, street.profile.pattern))
    return out


def _ring(rng: np.random.Generator, street: Street, arm: Arm, gap: float, depth: float) -> Array:
    """Parallel to the other street's edge, or straight across; it ends about at the curbs."""
    clear = arm.clear
    if rng.random() < 0.35:
        outer = max(clear) if arm.direction > 0 else min(clear)
        clear = (outer, outer)
    turned = rng.normal(0, 0.25, 2)
    corners = []
    for side, far in ((0, False), (1, False), (1, True), (0, True)):
        beyond = gap + (depth if far else 0.0) + turned[side]
        s = clear[side] + arm.direction * beyond
        reach = float(street.curb(side, np.array(s))) + 0.1
        # Next to the corner the curb is round and the crossing reaches further out.
        corners.append((s, (1.0 if side == 0 else -1.0) * (reach + rng.uniform(-0.2, 0.9))))
    ring = [street.at(s, o) for s, o in corners]
    return np.array([*ring, ring[0]])


def _midblock(
    rng: np.random.Generator, street: Street, index: int, junctions: list[Junction]
) -> Array | None:
    """A crossing away from junctions, sometimes askew; None where there is no room."""
    s = float(rng.uniform(15, max(16, street.length - 15)))
    depth, skew = rng.uniform(2.3, 4.0), rng.normal(0, 1.2)
    for junction in junctions:
        for arm in junction.arms:
            if arm.street == index and min(abs(s - c) for c in arm.clear) < 25:
                return None
    corners = []
    for side, far in ((0, False), (1, False), (1, True), (0, True)):
        at = s + depth * far + skew * side
        reach = float(street.curb(side, np.array(at))) + rng.uniform(-0.1, 0.3)
        corners.append(street.at(at, reach if side == 0 else -reach))
    return np.array([*corners, corners[0]])
