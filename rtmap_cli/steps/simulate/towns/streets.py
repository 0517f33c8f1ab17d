"""Streets of a procedural town: where they run and how their width changes along them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import arc_length, normals, resample_step
from rtmap_cli.steps.simulate.towns.profiles import Profile, TownStyle, random_profile

Array = NDArray[np.float64]

STEP = 2.0
"""Spacing of the vertices of street lines, metres."""
MARGIN = 52.0
"""How far streets run on beyond the town (m): what is driven on is not cut off in sight."""
UNDRIVEN = 26.0
"""Stretch at an open end of a street that has no lanes, metres."""


@dataclass(frozen=True)
class Change:
    """Something that is ``amount`` metres more on one side from ``start`` to ``end`` (stations).

    It grows over ``before`` metres ahead of the start and shrinks over ``after`` behind the end.
    """

    side: int
    start: float
    end: float
    before: float
    after: float
    amount: float

    def at(self, stations: Array) -> Array:
        """The amount at stations, metres."""
        rise = (stations - self.start) / max(self.before, 1e-3) + 1
        fall = (self.end - stations) / max(self.after, 1e-3) + 1
        return self.amount * np.clip(np.minimum(rise, fall), 0, 1)

    def corners(self) -> tuple[float, float, float, float]:
        """Stations of the four corners."""
        before, after = max(self.before, 1e-3), max(self.after, 1e-3)
        return self.start - before, self.start, self.end, self.end + after


@dataclass
class Street:
    """One street: ``line`` (n, 2) its centre line in local metres, with its profile.

    ``widenings`` move the curb outwards (bays, turning lanes) or, negative, inwards; ``shifts``
    move the lanes of one side and the middle line outwards. ``closed`` tells for both ends
    whether the street ends there (else it runs out of the town).
    """

    line: Array
    profile: Profile
    closed: tuple[bool, bool] = (False, False)
    widenings: list[Change] = field(default_factory=list)
    shifts: list[Change] = field(default_factory=list)
    stations: Array = field(init=False)

    def __post_init__(self) -> None:
        self.line = resample_step(self.line, STEP)
        self.stations = arc_length(self.line)
        self._normals = normals(self.line)

    @property
    def length(self) -> float:
        """Length of the centre line, metres."""
        return float(self.stations[-1])

    def at(self, station: float | Array, offset: float | Array = 0.0) -> Array:
        """(..., 2) points at stations along and offsets across (left positive), metres."""
        station = np.asarray(station, dtype=np.float64)
        p = np.stack([np.interp(station, self.stations, self.line[:, k]) for k in (0, 1)], -1)
        n = np.stack([np.interp(station, self.stations, self._normals[:, k]) for k in (0, 1)], -1)
        n /= np.maximum(np.hypot(n[..., 0], n[..., 1]), 1e-9)[..., None]
        return p + n * np.asarray(offset, dtype=np.float64)[..., None]

    def between(self, start: float, end: float, offset: float = 0.0) -> Array:
        """The line at an offset from one station to another (end < start: reversed)."""
        low, high = min(start, end), max(start, end)
        inner = self.stations[(self.stations > low + 0.2) & (self.stations < high - 0.2)]
        s = np.concatenate([[start], inner if end >= start else inner[::-1], [end]])
        return self.at(s, self.shifted(offset, s))

    def shifted(self, offset: float, stations: Array) -> Array:
        """Offsets of a lane or line at stations, after the shifts of its side."""
        out = np.full(stations.shape, offset)
        for shift in self.shifts:
            sign = 1.0 if shift.side == 0 else -1.0
            if sign * offset > -1e-6:
                out += sign * shift.at(stations)
        return out

    def curb(self, side: int, stations: Array) -> Array:
        """Distances of the curb from the centre line on the left (0) or right (1) side."""
        out = np.full(np.shape(stations), self.profile.half_width(side))
        for widening in self.widenings:
            if widening.side == side:
                out = out + widening.at(stations)
        return out

    def outline(self) -> Array:
        """The ring of the street's asphalt, curb to curb."""
        sides = []
        for side, sign in ((0, 1.0), (1, -1.0)):
            corners = [c for w in self.widenings if w.side == side for c in w.corners()]
            s = np.unique(np.concatenate([self.stations, np.clip(corners, 0, self.length)]))
            sides.append(self.at(s, sign * self.curb(side, s)))
        return np.concatenate([sides[0], sides[1][::-1], sides[0][:1]])

    def station_of(self, place: Array) -> float:
        """Station nearest to a place (2,)."""
        return float(shapely.linestrings(self.line).project(shapely.points(place)))


def lay_streets(rng: np.random.Generator, size: float, style: TownStyle) -> list[Street]:
    """Streets about ``size`` metres across, centred at the origin, from straight to winding.

    The grid is sheared, single streets run askew; some end at another one (tee junctions) or go on
    a little aside (two tees near each other), some end blind. Alleys run between the streets.
    """
    grid = [_axis(rng, size), _axis(rng, size)]
    bend = rng.choice([0.0, 3.0, 8.0, 16.0], p=[0.5, 0.2, 0.2, 0.1]) * min(1.0, size / 300)
    warp = _Warp(rng, bend)
    wavy = bool(bend > 0)
    first = [_track(rng, size, float(offset), 0, wavy) for offset in grid[0]]
    streets = [_street(rng, warp(p), _rank(rng, 0.5), style) for p in first]
    for offset in grid[1]:
        line = warp(_track(rng, size, float(offset), 1, wavy))
        rank = _rank(rng, 0.3)
        streets += _cut(rng, line, rank, streets[: len(first)], size, style)
    for axis in (0, 1):
        for low, high in zip(grid[axis], grid[axis][1:], strict=False):
            if rng.random() < 0.4 and high - low > 55:
                line = warp(_track(rng, size, (low + high) / 2 + rng.normal(0, 4), axis, wavy))
                streets += _alley(rng, line, streets, style)
    return streets


def _rank(rng: np.random.Generator, main: float) -> str:
    return "main" if rng.random() < main else "minor"


class _Warp:
    """From the grid to the ground: waves, shear and a turn."""

    def __init__(self, rng: np.random.Generator, bend: float) -> None:
        self.bend = bend
        self.waves = rng.uniform(150, 420, (2, 2))
        self.phases = rng.uniform(0, 2 * np.pi, (2, 2))
        shear = rng.normal(0, 0.3 if rng.random() < 0.35 else 0.06)
        turn = rng.uniform(0, 2 * np.pi)
        c, s = np.cos(turn), np.sin(turn)
        self.matrix = np.array([[1, 0], [shear, 1]]) @ np.array([[c, s], [-s, c]])

    def __call__(self, p: Array) -> Array:
        p = p + self.bend * np.sin(p[:, ::-1] / self.waves[0] * 2 * np.pi + self.phases[0])
        p = p + 0.5 * self.bend * np.sin(p[:, ::-1] / self.waves[1] * 4 * np.pi + self.phases[1])
        out: Array = p @ self.matrix
        return out


def _track(rng: np.random.Generator, size: float, offset: float, axis: int, wavy: bool) -> Array:
    """A line across the town at an offset; every eighth one runs clearly askew."""
    t = np.arange(-size / 2 - MARGIN, size / 2 + MARGIN + 0.1, 4.0)
    slope = rng.normal(0, 0.35 if rng.random() < 0.12 else 0.02)
    across = offset + slope * t
    if wavy:
        across = across + rng.normal(0, 1.5) * np.sin(t / rng.uniform(25, 60))
    if rng.random() < 0.15:  # one bend, as where a grid meets another one
        bent = rng.uniform(-0.25, 0.25) * size
        turn, radius = rng.uniform(-0.6, 0.6), rng.uniform(12, 60)
        across = across + turn * 0.5 * (np.hypot(t - bent, radius) + (t - bent))
    return np.stack([t, across] if axis == 0 else [across, t], axis=-1)


def _street(
    rng: np.random.Generator,
    line: Array,
    rank: str,
    style: TownStyle,
    closed: tuple[bool, bool] = (False, False),
) -> Street:
    if rng.random() < 0.5:
        line, closed = line[::-1], closed[::-1]
    return Street(line, random_profile(rng, rank, style), closed)


def _cut(
    rng: np.random.Generator,
    line: Array,
    rank: str,
    others: list[Street],
    size: float,
    style: TownStyle,
) -> list[Street]:
    """The street, or what is left of it when it ends at another one, jogs or ends blind."""
    kind = rng.random()
    whole = shapely.linestrings(line)
    meets = sorted(
        float(whole.project(p))
        for other in others
        for p in shapely.get_parts(whole.intersection(shapely.linestrings(other.line)))
        if p.geom_type == "Point"
    )
    if not meets or kind > 0.62:
        return [_street(rng, line, rank, style)]
    s = arc_length(line)
    cut = meets[rng.integers(len(meets))]
    if kind < 0.3 or (size < 320 and kind < 0.4):  # tee
        if cut > s[-1] / 2:
            return [_street(rng, _part(line, 0, cut), rank, style, (False, True))]
        return [_street(rng, _part(line, cut, s[-1]), rank, style, (True, False))]
    if kind < 0.5:  # jog
        aside = rng.uniform(6, 28) * rng.choice([-1, 1])
        along = line[-1] - line[0]
        step = np.array([-along[1], along[0]]) / np.hypot(*along) * aside
        moved = line + step
        other = _crossing_with(moved, others, cut)
        pieces = [_street(rng, _part(line, 0, cut), rank, style, (False, True))]
        if other is not None:
            rest = _part(moved, other, arc_length(moved)[-1])
            pieces.append(_street(rng, rest, rank, style, (True, False)))
        return pieces
    if kind < 0.58:  # blind end
        end = min(s[-1], meets[-1] + rng.uniform(35, 60))
        return [_street(rng, _part(line, 0, end), rank, style, (False, True))]
    return [_street(rng, line, rank, style)]


def _crossing_with(line: Array, others: list[Street], near: float) -> float | None:
    """Station where a line crosses one of the streets, the one nearest to station ``near``."""
    whole = shapely.linestrings(line)
    found = [
        float(whole.project(p))
        for other in others
        for p in shapely.get_parts(whole.intersection(shapely.linestrings(other.line)))
        if p.geom_type == "Point"
    ]
    return min(found, key=lambda x: abs(x - near)) if found else None


def _alley(
    rng: np.random.Generator, line: Array, streets: list[Street], style: TownStyle
) -> list[Street]:
    """An alley along the line between two of the streets that it meets."""
    whole = shapely.linestrings(line)
    meets = sorted(
        float(whole.project(p))
        for other in streets
        for p in shapely.get_parts(whole.intersection(shapely.linestrings(other.line)))
        if p.geom_type == "Point"
    )
    if len(meets) < 2:
        return []
    k = int(rng.integers(len(meets) - 1))
    last = min(len(meets) - 1, k + int(rng.integers(1, 4)))
    if meets[last] - meets[k] < 40:
        return []
    return [_street(rng, _part(line, meets[k], meets[last]), "alley", style, (True, True))]


def _part(line: Array, start: float, end: float) -> Array:
    """The line from one station to another, metres."""
    s = arc_length(line)
    at = np.concatenate([[start], s[(s > start + 0.1) & (s < end - 0.1)], [end]])
    return np.stack([np.interp(at, s, line[:, k]) for k in (0, 1)], axis=-1)


def _axis(rng: np.random.Generator, size: float) -> Array:
    """Positions of parallel streets over ``size`` metres, 60 to 120 m apart."""
    at = [-size / 2 + rng.uniform(20, 60)]
    while at[-1] + 60 < size / 2:
        at.append(at[-1] + rng.uniform(60, 120))
    return np.array([a for a in at if a < size / 2 + 10])
