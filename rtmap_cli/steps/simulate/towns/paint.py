"""Painted lines of a town: where they run, where they stop, how they are marked."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.steps.simulate.towns.fittings import Line
from rtmap_cli.steps.simulate.towns.junctions import Junction, free_stretches
from rtmap_cli.steps.simulate.towns.profiles import CENTRE, EDGE
from rtmap_cli.steps.simulate.towns.streets import Street

Array = NDArray[np.float64]

MIN_PIECE = 4.0
"""Shorter pieces (m) that obstacles leave of a line are not painted."""


def let_paint_pass(
    rng: np.random.Generator, streets: list[Street], junctions: list[Junction]
) -> None:
    """At alleys and tees without crossings the lines of the greater street often go on."""
    for junction in junctions:
        i, j = junction.streets
        ranks = [("alley", "minor", "main").index(streets[k].profile.rank) for k in (i, j)]
        through = [sum(a.street == k for a in junction.arms) == 2 for k in (i, j)]
        if junction.radius:
            continue
        for k, here in ((i, 0), (j, 1)):
            at = junction.stations[k]
            if any(c.start - 15 < at < c.end + 15 for c in streets[k].shifts):
                continue
            tee = through[here] and not through[1 - here]
            chance = 0.65 if ranks[here] > 0 == ranks[1 - here] else 0.45 if tee else 0.08
            if through[here] and ranks[here] >= ranks[1 - here] and rng.random() < chance:
                junction.passes = k
                break


def lay_dividers(
    rng: np.random.Generator,
    streets: list[Street],
    junctions: list[Junction],
    turning: dict[int, list[Line]],
    crossings: list[Array],
    surface: Any,
) -> list[tuple[Array, str]]:
    """Painted lines between the stop lines; they stop at crossings and where asphalt ends."""
    keep = surface.buffer(-0.1)
    if crossings:
        keep = keep.difference(shapely.union_all(shapely.buffer(shapely.polygons(crossings), 0.8)))
    shapely.prepare(keep)
    out: list[tuple[Array, str]] = []
    for index, street in enumerate(streets):
        ahead = rng.uniform(12, 30) if rng.random() < 0.5 else 0.0
        sparse = rng.random() < 0.1
        pieces: list[tuple[Array, str]] = []
        for offset, mark, kind in street.profile.painted_lines():
            for start, end in _runs(rng, index, street, junctions, offset, kind, turning[index]):
                if sparse and rng.random() < 0.5:
                    end = start + rng.uniform(0.3, 0.8) * (end - start)
                if end - start < 5 or rng.random() < 0.03:
                    continue
                for a, b, paint in _marks(start, end, mark, ahead, street.length):
                    pieces.append((street.between(a, b, offset), paint))
        for low, high, offset, mark in turning[index]:
            for start, end in free_stretches(index, street, junctions, _share(street, offset)):
                a, b = max(low, start), min(high, end)
                if b - a > MIN_PIECE:
                    pieces.append((_unshifted(street, a, b, offset), mark))
        for line, mark in pieces:
            left = shapely.intersection(shapely.linestrings(line), keep)
            out += [
                (np.asarray(g.coords), mark)
                for g in shapely.get_parts(left)
                if g.geom_type == "LineString" and g.length > MIN_PIECE
            ]
    return out


def _runs(
    rng: np.random.Generator, index: int, street: Street, junctions: list[Junction],
    offset: float, kind: str, turning: list[Line],
) -> list[tuple[float, float]]:  # fmt: skip
    """Station intervals of one line; a turning lane's own line takes the place of an edge line."""
    passing = -1 if kind == CENTRE or abs(offset) < 0.1 else 0 if offset > 0 else 1
    if kind != EDGE and passing >= 0 and rng.random() < 0.5:
        passing = -1
    runs = free_stretches(index, street, junctions, _share(street, offset), passing=passing)
    if kind != EDGE:
        return runs
    for low, high, other, _ in turning:
        if other * offset <= 0 or abs(offset) < abs(other) - 0.01:
            continue
        runs = [
            piece
            for start, end in runs
            for piece in ((start, min(end, low)), (max(start, high), end))
            if piece[1] - piece[0] > 1.0
        ]
    return runs


def _share(street: Street, offset: float) -> float:
    """Where an offset lies across a street: 0 at the left curb, 1 at the right one."""
    left, right = street.profile.half_width(0), street.profile.half_width(1)
    return (left - offset) / (left + right)


def _unshifted(street: Street, low: float, high: float, offset: float) -> Array:
    inner = street.stations[(street.stations > low + 0.2) & (street.stations < high - 0.2)]
    s = np.clip(np.concatenate([[low], inner, [high]]), 0, street.length)
    return street.at(s, np.full(s.shape, offset))


def _marks(
    start: float, end: float, mark: str, ahead: float, total: float
) -> list[tuple[float, float, str]]:
    """Dashed lane lines become solid ``ahead`` metres before a junction."""
    if mark != "DASHED_WHITE" or ahead == 0 or end - start < 2.5 * ahead:
        return [(start, end, mark)]
    cuts = [start, start + ahead if start > 0 else start, end - ahead if end < total else end, end]
    marks = ["SOLID_WHITE", mark, "SOLID_WHITE"]
    return [(a, b, m) for a, b, m in zip(cuts, cuts[1:], marks, strict=False) if b - a > 1]
