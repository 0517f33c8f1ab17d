"""Cross-sections of streets: lanes, medians, cycle lanes, parking, and the paint between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

Pair = tuple[float, float]

CENTRE, LANE, EDGE = "centre", "lane", "edge"
"""Kinds of painted lines: between the directions, between lanes, beyond the outermost lane."""


@dataclass(frozen=True)
class Profile:
    """The cross-section of a street; offsets are positive to the left of its centre line.

    ``forward`` are the widths of the lanes on the right of the centre, ``backward`` of those on its
    left, from the middle outwards (none = one-way); ``median`` is the width between the two
    directions, and on each side (left, right) follow ``buffer``, ``bike`` and ``shoulder`` beyond
    the outermost lane, all in metres. ``centre_mark``, ``lane_mark`` and ``edge_mark`` name the
    paint (None = not painted). ``raised``: the median may carry islands. ``crossings`` is the
    chance of crossings at junctions, drawn as ``pattern``.
    """

    forward: tuple[float, ...]
    backward: tuple[float, ...]
    median: float
    buffer: Pair
    bike: Pair
    shoulder: Pair
    centre_mark: str | None
    lane_mark: str | None
    edge_mark: str | None
    raised: bool
    crossings: float
    pattern: str
    rank: str

    def lane_edge(self, side: int) -> float:
        """Distance of the outermost lane's outer edge on the left (0) or right (1) side."""
        return self.median / 2 + sum((self.backward, self.forward)[side])

    def half_width(self, side: int) -> float:
        """Distance of the curb from the centre line on the left (0) or right (1) side."""
        return self.lane_edge(side) + self.buffer[side] + self.bike[side] + self.shoulder[side]

    def lane_offsets(self) -> list[tuple[float, int]]:
        """(offset, direction) of the lane centres: +1 along the line, -1 against it."""
        out: list[tuple[float, int]] = []
        for widths, direction in ((self.forward, 1), (self.backward, -1)):
            inner = self.median / 2 + np.cumsum((0.0, *widths))
            middles = (inner[:-1] + inner[1:]) / 2
            out += [(-direction * float(m), direction) for m in middles]
        return out

    def painted_lines(self) -> list[tuple[float, str, str]]:
        """(offset, mark, kind) of every painted line of the undisturbed street."""
        half = self.median / 2
        lines: list[tuple[float, str, str]] = []
        if self.centre_mark and self.backward:
            if self.median > 0:
                # Where one side is dashed it faces the middle: the lane of those who turn.
                turned = self.centre_mark.replace("SOLID_DASHED", "DASHED_SOLID")
                lines += [(half, self.centre_mark, CENTRE), (-half, turned, CENTRE)]
            else:
                lines.append((0.0, self.centre_mark, CENTRE))
        for side, sign, widths in ((0, 1.0, self.backward), (1, -1.0, self.forward)):
            if self.lane_mark:
                inner = half + np.cumsum(widths)[:-1]
                lines += [(sign * float(d), self.lane_mark, LANE) for d in inner]
            if not widths or not self.edge_mark:
                continue
            at, beyond = self.lane_edge(side), self.half_width(side) - self.lane_edge(side)
            if beyond > 0.4:
                lines.append((sign * at, self.edge_mark, EDGE))
            if self.bike[side]:
                if self.buffer[side]:
                    at += self.buffer[side]
                    lines.append((sign * at, self.edge_mark, EDGE))
                if self.shoulder[side] > 0.6:
                    lines.append((sign * (at + self.bike[side]), self.edge_mark, EDGE))
        return lines


CENTRE_MARKS = {
    "DOUBLE_SOLID_YELLOW": 0.46,
    "SOLID_YELLOW": 0.2,
    "DASHED_YELLOW": 0.14,
    "DASHED_WHITE": 0.1,
    "SOLID_WHITE": 0.1,
}
MEDIAN_MARKS = {
    "SOLID_YELLOW": 0.45,
    "DOUBLE_SOLID_YELLOW": 0.3,
    "SOLID_WHITE": 0.15,
    "SOLID_DASHED_YELLOW": 0.1,
}
PATTERNS = {"zebra": 0.4, "ladder": 0.25, "outline": 0.35}


@dataclass(frozen=True)
class TownStyle:
    """How a place builds and paints its streets; pairs are for main and for minor streets.

    ``lane`` is the range of lane widths (m); ``lanes`` the shares of one, two and three lanes per
    direction; ``one_way``, ``painted`` and ``parking`` are chances, ``edge`` that of edge lines;
    ``centre`` shares the marks between the directions, ``patterns`` those of crossings.
    """

    lane: Pair = (2.75, 3.7)
    lanes: tuple[tuple[float, float, float], tuple[float, float, float]] = (
        (0.42, 0.43, 0.15),
        (0.9, 0.1, 0.0),
    )
    one_way: Pair = (0.08, 0.22)
    painted: Pair = (0.94, 0.48)
    bikes: float = 0.26
    parking: float = 0.36
    edge: float = 0.45
    centre: Mapping[str, float] = field(default_factory=lambda: CENTRE_MARKS)
    patterns: Mapping[str, float] = field(default_factory=lambda: PATTERNS)


STYLES = {
    "mixed": TownStyle(),
    "city": TownStyle(
        lane=(3.35, 3.9),
        lanes=((0.2, 0.5, 0.3), (0.75, 0.25, 0.0)),
        painted=(0.98, 0.7),
        parking=0.6,
        edge=0.35,
        centre={"DOUBLE_SOLID_YELLOW": 0.7, "DASHED_YELLOW": 0.2, "SOLID_YELLOW": 0.1},
        patterns={"zebra": 0.15, "ladder": 0.45, "outline": 0.4},
    ),
    "campus": TownStyle(
        lane=(2.55, 3.05),
        lanes=((0.8, 0.2, 0.0), (1.0, 0.0, 0.0)),
        painted=(0.92, 0.75),
        bikes=0.3,
        parking=0.12,
        edge=0.3,
        centre={"DASHED_WHITE": 0.35, "SOLID_YELLOW": 0.3, "DASHED_YELLOW": 0.35},
        patterns={"zebra": 0.75, "ladder": 0.15, "outline": 0.1},
    ),
}
"""``city``: wide lanes, several of them, parked cars, ladders and outlines. ``campus``: lanes of
10 ft and less, one per direction, single lines, zebras. ``mixed``: anything."""


def draw(rng: np.random.Generator, shares: Mapping[str, float]) -> str:
    """One of the keys, with the shares as probabilities."""
    return str(rng.choice(list(shares), p=list(shares.values())))


def random_profile(
    rng: np.random.Generator, rank: str, style: TownStyle = STYLES["mixed"]
) -> Profile:
    """A cross-section of rank ``main``, ``minor`` or ``alley``."""
    pattern = draw(rng, style.patterns)
    if rank == "alley":
        wide = float(rng.uniform(1.9, 3.1))
        none = (0.0, 0.0)
        return Profile(
            (wide,), (wide,), 0, none, none, none, None, None, None, False, 0.04, pattern, rank
        )
    main = rank == "main"
    ahead = int(rng.choice([1, 2, 3], p=style.lanes[not main]))
    back = ahead if rng.random() < 0.65 else int(rng.choice([1, 2]))
    if rng.random() < style.one_way[not main]:
        back = 0
    lane = rng.uniform(*style.lane)
    forward, backward = (
        tuple(float(w) for w in lane + rng.uniform(-0.15, 0.35, n) * (rng.random() < 0.5))
        for n in (ahead, back)
    )
    median = _median(rng, main) if back else 0.0
    painted = rng.random() < style.painted[not main]
    bikes = painted and rng.random() < style.bikes
    bike, buffer, shoulder = np.zeros((3, 2))
    for side in (0, 1):
        if bikes and rng.random() < 0.8 and (back or side):
            bike[side] = rng.uniform(1.3, 2.0)
            buffer[side] = rng.uniform(0.5, 1.1) if rng.random() < 0.3 else 0.0
        parking = rng.random() < style.parking
        shoulder[side] = rng.uniform(1.9, 2.8) if parking else rng.choice([0.1, 0.3, 0.6, 1.0])
    edge = "SOLID_WHITE" if painted and (bikes or rng.random() < style.edge) else None
    marks = MEDIAN_MARKS if median else style.centre
    return Profile(
        forward,
        backward,
        median,
        (float(buffer[0]), float(buffer[1])),
        (float(bike[0]), float(bike[1])),
        (float(shoulder[0]), float(shoulder[1])),
        draw(rng, marks) if painted else None,
        draw(rng, {"DASHED_WHITE": 0.9, "SOLID_WHITE": 0.1}) if painted else None,
        edge,
        bool(median > 1.6 and rng.random() < 0.6),
        rng.uniform(0.65, 1.0) if main else rng.uniform(0.25, 0.85),
        pattern,
        rank,
    )


def _median(rng: np.random.Generator, main: bool) -> float:
    """None, a narrow painted one, or one that is wide enough for islands and turning lanes."""
    kind = rng.random()
    if main and kind < 0.32:
        return float(rng.uniform(1.7, 4.4))
    if kind < (0.44 if main else 0.05):
        return float(rng.uniform(0.45, 1.4))
    return 0.0
