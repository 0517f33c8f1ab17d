"""Streets of a procedural town: where they run, how wide they are, how they are painted."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import arc_length, normals, resample_step

Array = NDArray[np.float64]

STEP = 2.0
"""Spacing of the vertices of street lines, metres."""


@dataclass(frozen=True)
class Profile:
    """The cross-section of a street; offsets are positive to the left of its centre line.

    ``forward`` lanes lie on the right of the centre, ``backward`` lanes on the left (0 = one-way);
    ``median`` is the width between the two directions, ``bike`` and ``shoulder`` (left, right) the
    widths beyond the outermost lanes, metres. ``marks`` names the paint of centre, lane lines and
    edges (None = not painted).
    """

    forward: int
    backward: int
    lane: float
    median: float
    bike: tuple[float, float]
    shoulder: tuple[float, float]
    centre_mark: str | None
    lane_mark: str | None
    edge_mark: str | None
    raised: bool
    crossings: float
    pattern: str

    def half_width(self, side: int) -> float:
        """Distance of the curb from the centre line on the left (0) or right (1) side."""
        lanes = (self.backward, self.forward)[side]
        return self.median / 2 + lanes * self.lane + self.bike[side] + self.shoulder[side]

    def lane_offsets(self) -> list[tuple[float, int]]:
        """(offset, direction) of the lane centres: +1 along the line, -1 against it."""
        half = self.median / 2
        forward = [(-(half + (k + 0.5) * self.lane), 1) for k in range(self.forward)]
        backward = [(half + (k + 0.5) * self.lane, -1) for k in range(self.backward)]
        return forward + backward

    def painted_lines(self) -> list[tuple[float, str]]:
        """(offset, mark) of every painted line of the undisturbed street."""
        half = self.median / 2
        lines: list[tuple[float, str]] = []
        if self.centre_mark and self.backward:
            if self.median > 0:
                lines += [(half, "SOLID_YELLOW"), (-half, "SOLID_YELLOW")]
            else:
                lines.append((0.0, self.centre_mark))
        for side, count in ((1.0, self.backward), (-1.0, self.forward)):
            if self.lane_mark:
                lines += [(side * (half + k * self.lane), self.lane_mark) for k in range(1, count)]
            index = 0 if side > 0 else 1
            edge = half + count * self.lane
            beyond = self.bike[index] + self.shoulder[index]
            if count and self.edge_mark and beyond > 0.4:
                lines.append((side * edge, self.edge_mark))
                if self.bike[index] and self.shoulder[index] > 0.4:
                    lines.append((side * (edge + self.bike[index]), self.edge_mark))
        return lines


@dataclass
class Street:
    """One street: ``line`` (n, 2) its centre line in local metres, with its profile."""

    line: Array
    profile: Profile
    name: str
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

    def between(self, start: float, end: float, offset: float | Array = 0.0) -> Array:
        """The line at an offset from one station to another (end < start: reversed)."""
        inner = self.stations[
            (self.stations > min(start, end) + 0.2) & (self.stations < max(start, end) - 0.2)
        ]
        s = np.concatenate([[start], inner if end >= start else inner[::-1], [end]])
        return self.at(s, np.broadcast_to(offset, s.shape) if np.ndim(offset) == 0 else offset)

    def outline(self) -> Array:
        """The ring of the street's asphalt, curb to curb."""
        left = self.between(0, self.length, self.profile.half_width(0))
        right = self.between(self.length, 0, -self.profile.half_width(1))
        return np.concatenate([left, right, left[:1]])

    def heading(self, station: float) -> float:
        """Direction of the line at a station, radians."""
        d = self.at(min(station + 1, self.length)) - self.at(max(station - 1, 0.0))
        return float(np.arctan2(d[1], d[0]))


def random_profile(rng: np.random.Generator, rank: str) -> Profile:
    """A cross-section of rank ``main``, ``minor`` or ``alley``."""
    if rank == "alley":
        wide = rng.uniform(2.0, 3.0)
        pattern = str(rng.choice(PATTERNS))
        return Profile(1, 1, wide, 0, (0, 0), (0, 0), None, None, None, False, 0.05, pattern)
    main = rank == "main"
    forward = int(rng.choice([1, 2, 3], p=[0.35, 0.45, 0.2] if main else [0.85, 0.15, 0]))
    backward = forward if rng.random() < 0.65 else int(rng.choice([1, 2]))
    if rng.random() < (0.08 if main else 0.25):
        backward = 0
    lane = rng.uniform(2.9, 3.7)
    median = rng.uniform(1.6, 4.2) if main and backward and rng.random() < 0.35 else 0.0
    bike = tuple(rng.uniform(1.3, 1.9) if rng.random() < 0.3 else 0.0 for _ in range(2))
    shoulder = tuple(
        rng.uniform(2.0, 2.8) if rng.random() < 0.4 else rng.choice([0.15, 0.3, 0.6, 1.0])
        for _ in range(2)
    )
    painted = rng.random() < (0.93 if main else 0.6)
    centre = str(rng.choice(CENTRE_MARKS, p=[0.42, 0.28, 0.12, 0.1, 0.08])) if painted else None
    lane_mark = str(rng.choice(["DASHED_WHITE", "SOLID_WHITE"], p=[0.88, 0.12]))
    edge = "SOLID_WHITE" if painted and rng.random() < 0.6 else None
    return Profile(
        forward,
        backward,
        lane,
        median,
        (bike[0], bike[1]) if backward else (0.0, bike[1]),
        (float(shoulder[0]), float(shoulder[1])),
        centre,
        lane_mark if painted else None,
        edge,
        bool(median > 1.6 and rng.random() < 0.6),
        rng.uniform(0.7, 1.0) if main else rng.uniform(0.3, 0.9),
        str(rng.choice(PATTERNS, p=[0.45, 0.25, 0.3])),
    )


CENTRE_MARKS = (
    "DOUBLE_SOLID_YELLOW",
    "SOLID_YELLOW",
    "DASHED_YELLOW",
    "DASHED_WHITE",
    "SOLID_WHITE",
)
PATTERNS = ("zebra", "ladder", "outline")


def lay_streets(rng: np.random.Generator, size: float) -> list[Street]:
    """Streets on a warped, rotated grid about ``size`` metres across, centred at the origin.

    Some streets end at another one (tee junctions); straight towns and winding ones occur.
    """
    margin = 30.0
    lines = [_axis(rng, size), _axis(rng, size)]
    bend = rng.choice([0.0, 4.0, 10.0, 18.0]) * min(1.0, size / 300)
    waves = rng.uniform(150, 420, (2, 2))
    phases = rng.uniform(0, 2 * np.pi, (2, 2))
    shear = rng.normal(0, 0.15)
    turn = rng.uniform(0, 2 * np.pi)
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    streets: list[Street] = []
    for axis in (0, 1):
        others = lines[1 - axis]
        for k, offset in enumerate(lines[axis]):
            start, end = -size / 2 - margin, size / 2 + margin
            if len(others) > 1 and len(lines[axis]) > 1 and rng.random() < 0.35:
                if rng.random() < 0.5:
                    start = float(others[rng.integers(0, len(others) - 1)])
                else:
                    end = float(others[rng.integers(1, len(others))])
            elif size < 320 and rng.random() < 0.3 and axis == 1:
                start = float(others[0])
            t = np.arange(start, end + 0.1, 4.0)
            t[-1] = end
            across = offset + rng.normal(0, 1.5) * np.sin(t / rng.uniform(25, 60)) * (bend > 0)
            p = np.stack([t, across] if axis == 0 else [across, t], axis=-1)
            p = p + bend * np.sin(p[:, ::-1] / waves[0] * 2 * np.pi + phases[0])
            p = p + 0.5 * bend * np.sin(p[:, ::-1] / waves[1] * 4 * np.pi + phases[1])
            p = p @ np.array([[1, 0], [shear, 1]]) @ rotation
            rank = "main" if rng.random() < (0.6 if axis == 0 else 0.35) else "minor"
            profile = random_profile(rng, rank)
            if rng.random() < 0.5:
                p = p[::-1]
            streets.append(Street(p, profile, f"{'hv'[axis]}{k}"))
    return streets


def _axis(rng: np.random.Generator, size: float) -> Array:
    """Positions of parallel streets over ``size`` metres, 60 to 120 m apart."""
    at = [-size / 2 + rng.uniform(20, 60)]
    while at[-1] + 60 < size / 2:
        at.append(at[-1] + rng.uniform(60, 120))
    return np.array([a for a in at if a < size / 2 + 10])
