"""Where streets meet: the arms of a junction, and the stretches of street between junctions."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.steps.simulate.towns.streets import Street

Array = NDArray[np.float64]


@dataclass
class Arm:
    """One side of a street at a junction: stations where paint stops and the lane ends.

    ``direction`` +1: the arm lies beyond the junction along the street, -1: before it.
    ``clear`` (left, right) are the stations at which the two curbs leave the other street.
    ``oblique``: the streets meet too sharply for a crossing.
    """

    street: int
    junction: int
    direction: int
    clear: tuple[float, float]
    stop: float = 0.0
    oblique: bool = False

    def station(self, share: float, beyond: float) -> float:
        """Station ``beyond`` metres outside the junction; share 0 = left curb, 1 = right curb."""
        left, right = self.clear
        return left + share * (right - left) + self.direction * beyond

    @property
    def edge(self) -> float:
        """Station in the middle of the street where the junction ends."""
        return 0.5 * (self.clear[0] + self.clear[1])


@dataclass
class Junction:
    """Where two streets meet: ``place`` (2,) local metres; a roundabout has a radius.

    ``streets`` are the indices of the two; ``open_sides`` tells for both on which sides (0 left,
    1 right) the other one leaves. The paint of the street ``passes`` runs through (None: of none).
    """

    place: Array
    arms: list[Arm]
    streets: tuple[int, int]
    open_sides: tuple[frozenset[int], frozenset[int]]
    radius: float = 0.0
    island: float = 0.0
    passes: int | None = None
    stations: dict[int, float] = field(default_factory=dict)

    def sides_of(self, street: int) -> frozenset[int]:
        """Sides of a street on which the other one leaves."""
        return self.open_sides[self.streets.index(street)]


def find_junctions(streets: list[Street]) -> list[Junction]:
    """Every place where two streets cross or one ends on the other."""
    outlines = [shapely.polygons(s.outline()).buffer(0) for s in streets]
    lines = [shapely.linestrings(s.line) for s in streets]
    junctions: list[Junction] = []
    for i, a in enumerate(streets):
        for j in range(i + 1, len(streets)):
            b = streets[j]
            near = lines[i].buffer(4.0).intersection(lines[j])
            for part in shapely.get_parts(near):
                if part.is_empty:
                    continue
                place = np.asarray(part.interpolate(0.5, normalized=True).coords[0])
                arms = [
                    arm
                    for index, street, outline in ((i, a, outlines[j]), (j, b, outlines[i]))
                    for arm in _arms(street, index, place, outline, len(junctions))
                ]
                if len(arms) >= 3:
                    sides = _sides(streets, arms, i, j), _sides(streets, arms, j, i)
                    at = {k: streets[k].station_of(place) for k in (i, j)}
                    junctions.append(Junction(place, arms, (i, j), sides, stations=at))
    return junctions


def _sides(streets: list[Street], arms: list[Arm], street: int, other: int) -> frozenset[int]:
    """Sides of ``street`` on which the arms of ``other`` leave."""
    own, out = streets[street], set()
    for arm in arms:
        if arm.street != other:
            continue
        p = streets[other].at(arm.edge + 4.0 * arm.direction)
        s = own.station_of(p)
        along = own.at(min(s + 1, own.length)) - own.at(max(s - 1, 0.0))
        away = p - own.at(s)
        out.add(0 if along[0] * away[1] - along[1] * away[0] > 0 else 1)
    return frozenset(out)


def _arms(street: Street, index: int, place: Array, other: Any, junction: int) -> list[Arm]:
    """The arms of one street at a junction."""
    middle = street.station_of(place)
    found: list[Arm] = []
    for direction in (1, -1):
        limit = street.length if direction > 0 else 0.0
        if abs(limit - middle) < 18:
            continue
        arm = Arm(index, junction, direction, (middle, middle))
        measure(arm, street, middle, other)
        found.append(arm)
    return found


def measure(arm: Arm, street: Street, middle: float, other: Any) -> None:
    """Walk both curbs of an arm from the ``middle`` until they leave the ``other`` street."""
    limit = street.length if arm.direction > 0 else 0.0
    s = middle + arm.direction * np.arange(0, min(45.0, abs(limit - middle)), 0.5)
    clear = []
    for side, sign in ((0, 1.0), (1, -1.0)):
        p = street.at(s, sign * street.curb(side, s))
        inside = np.flatnonzero(shapely.contains_xy(other, p[:, 0], p[:, 1]))
        clear.append(float(s[inside[-1]] if len(inside) else s[0]))
    # Streets that meet at a sharp angle get no crossing, but their paint stops as well.
    arm.oblique = abs(clear[0] - clear[1]) > 14 or max(abs(c - middle) for c in clear) > 36
    arm.clear = (clear[0], clear[1])


def measure_again(streets: list[Street], junctions: list[Junction]) -> None:
    """Where the arms end now that the streets have been widened."""
    outlines = [shapely.polygons(s.outline()).buffer(0) for s in streets]
    for junction in junctions:
        i, j = junction.streets
        for arm in junction.arms:
            other = outlines[j if arm.street == i else i]
            measure(arm, streets[arm.street], junction.stations[arm.street], other)


def make_roundabout(
    rng: np.random.Generator, streets: list[Street], junctions: list[Junction]
) -> None:
    """Turn the junction nearest to the middle of the town into a roundabout."""
    wide = [j for j in junctions if all(streets[k].profile.rank != "alley" for k in j.streets)]
    best = min(wide or junctions, key=lambda j: float(np.hypot(*j.place)))
    widths = [max(streets[a.street].profile.half_width(k) for k in (0, 1)) for a in best.arms]
    best.radius = max(float(rng.uniform(15, 19)), max(widths) * 1.35 + 4)
    best.island = best.radius - float(rng.uniform(6.0, 7.5))
    for arm in best.arms:
        street = streets[arm.street]
        edge = best.stations[arm.street] + arm.direction * best.radius
        arm.clear = (edge, edge)
        arm.oblique = False
        for changes in (street.widenings, street.shifts):
            changes[:] = [c for c in changes if min(abs(c.start - edge), abs(c.end - edge)) > 40]


def free_stretches(
    index: int,
    street: Street,
    junctions: list[Junction],
    share: float,
    extra: float = 0.0,
    passing: int | None = None,
) -> list[tuple[float, float]]:
    """Station intervals of a street outside its junctions' stop lines.

    ``share`` across the street: 0 at the left curb, 1 at the right one. With ``passing`` a line on
    that side (0, 1; -1: in the middle) is not cut where the junction lets the street's paint pass.
    """
    blocked = []
    for junction in junctions:
        own = [a for a in junction.arms if a.street == index]
        if not own:
            continue
        passes = passing is not None and junction.passes == index
        if passes and passing not in junction.sides_of(index):
            continue
        ends = {a.direction: a.station(share, a.stop + extra) for a in own}
        middle = junction.stations[index]
        low = ends.get(-1, -1.0 if middle < 25 else middle - 25)
        high = ends.get(1, street.length + 1 if middle > street.length - 25 else middle + 25)
        blocked.append((low, high))
    out, at = [], 0.0
    for low, high in sorted(blocked):
        if low > at:
            out.append((at, low))
        at = max(at, high)
    if at < street.length:
        out.append((at, street.length))
    return out
