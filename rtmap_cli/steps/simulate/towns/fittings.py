"""What changes along a street: turning lanes, curbs that step in at corners, bays for parking."""

from __future__ import annotations

import numpy as np

from rtmap_cli.steps.simulate.towns.junctions import Arm, Junction, free_stretches
from rtmap_cli.steps.simulate.towns.streets import Change, Street

Line = tuple[float, float, float, str]
"""A painted line from one station to another at an offset, with its mark."""


def fit_out(
    rng: np.random.Generator, streets: list[Street], junctions: list[Junction]
) -> dict[int, list[Line]]:
    """Give the streets their widenings and shifts; returns the lines of turning lanes by street.

    Offsets of these lines are final, the shifts of the street do not move them.
    """
    lines: dict[int, list[Line]] = {k: [] for k in range(len(streets))}
    for junction in junctions:
        for arm in junction.arms:
            street = streets[arm.street]
            if street.profile.rank == "alley" or _room(arm, street, junctions) < 45:
                continue
            kind = rng.random()
            main = street.profile.rank == "main"
            if kind < (0.3 if main else 0.06):
                line = _aside(rng, arm, street, junction) or _at_the_curb(
                    rng, arm, street, junction
                )
                lines[arm.street].append(line)
            elif kind < (0.45 if main else 0.12):
                lines[arm.street].append(_at_the_curb(rng, arm, street, junction))
            elif kind < 0.75:
                _step_in(rng, arm, street, junction)
    for index, street in enumerate(streets):
        for start, end in free_stretches(index, street, junctions, 0.5, 34.0):
            _bays(rng, street, start, end)
    return lines


def _room(arm: Arm, street: Street, junctions: list[Junction]) -> float:
    """Metres from an arm to the next junction along the street, or to its end."""
    limit = street.length if arm.direction > 0 else 0.0
    others = [
        a.edge
        for j in junctions
        for a in j.arms
        if a.street == arm.street and (a.edge - arm.edge) * arm.direction > 1.0
    ]
    return min([abs(limit - arm.edge), *(abs(e - arm.edge) for e in others)])


def _along(arm: Arm, junction: Junction, far: float) -> tuple[float, float]:
    """Stations (low, high) from the middle of the junction to ``far`` metres outside it."""
    a, b = junction.stations[arm.street], arm.edge + arm.direction * far
    return min(a, b), max(a, b)


def _entry_side(arm: Arm) -> int:
    """The side on which traffic comes towards the junction (it keeps to the right)."""
    return 1 if arm.direction < 0 else 0


def _aside(rng: np.random.Generator, arm: Arm, street: Street, junction: Junction) -> Line | None:
    """A lane for left turns in the middle: the lanes that leave the junction move outwards."""
    profile = street.profile
    leaving = 1 - _entry_side(arm)
    if not profile.centre_mark or not profile.backward or profile.median:
        return None
    width = float(rng.uniform(2.7, 3.2))
    low, high = _along(arm, junction, rng.uniform(18, 30))
    taper = float(rng.uniform(10, 20))
    before, after = (taper, 0.0) if arm.direction < 0 else (0.0, taper)
    street.shifts.append(Change(leaving, low, high, before, after, width))
    spare = max(0.0, profile.shoulder[leaving] - 0.3)
    if spare < width:
        street.widenings.append(Change(leaving, low, high, before, after, width - spare))
    return (low, high, 0.0, "SOLID_WHITE")


def _at_the_curb(rng: np.random.Generator, arm: Arm, street: Street, junction: Junction) -> Line:
    """A lane for right turns: the curb steps out, a line parts it from the others."""
    side = _entry_side(arm)
    profile = street.profile
    width = float(rng.uniform(2.7, 3.3))
    low, high = _along(arm, junction, rng.uniform(16, 30))
    taper = float(rng.uniform(6, 18))
    before, after = (taper, 0.0) if arm.direction < 0 else (0.0, taper)
    beyond = profile.shoulder[side] + profile.buffer[side] + profile.bike[side]
    grown = max(0.3, width + (profile.bike[side] + profile.buffer[side]) - beyond + 0.3)
    street.widenings.append(Change(side, low, high, before, after, grown))
    offset = profile.lane_edge(side) * (1.0 if side == 0 else -1.0)
    mark = "SOLID_WHITE" if rng.random() < 0.75 else "DASHED_WHITE"
    return (low, high, offset, mark)


def _step_in(rng: np.random.Generator, arm: Arm, street: Street, junction: Junction) -> None:
    """Curbs that take the parking lane away near the corner."""
    for side in (0, 1):
        shoulder = street.profile.shoulder[side]
        if shoulder > 1.8 and rng.random() < 0.6:
            low, high = _along(arm, junction, rng.uniform(6, 14))
            ramp = float(rng.choice([0.3, 1.5, 3.0]))
            before, after = (ramp, 0.0) if arm.direction < 0 else (0.0, ramp)
            street.widenings.append(Change(side, low, high, before, after, 0.35 - shoulder))


def _bays(rng: np.random.Generator, street: Street, start: float, end: float) -> None:
    """Bays for parking or buses, and curbs that step in for a few metres, away from junctions."""
    if street.profile.rank == "alley" or end - start < 15:
        return
    for side in (0, 1):
        at = start + rng.exponential(120.0)
        while at < end - 8:
            long = float(min(rng.uniform(8, 40), end - at))
            ramp = float(rng.choice([0.2, 2.0, 5.0]))
            shoulder = street.profile.shoulder[side]
            if shoulder > 1.8 and rng.random() < 0.4:
                change = Change(side, at, at + min(long, 9.0), ramp, ramp, 0.4 - shoulder)
            else:
                change = Change(side, at, at + long, ramp, ramp, float(rng.uniform(1.8, 3.2)))
            street.widenings.append(change)
            at += long + 2 * ramp + 4 + rng.exponential(120.0)
