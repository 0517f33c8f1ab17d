"""Lanes of a town: pieces between junctions and the connectors through them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.steps.simulate.towns.junctions import Junction
from rtmap_cli.steps.simulate.towns.streets import UNDRIVEN, Street

Array = NDArray[np.float64]

Lane = tuple[Array, int, int]
"""A lane piece with the junction it leaves (-1: the edge of the town) and the one it enters."""


def lane_network(streets: list[Street], junctions: list[Junction]) -> list[Array]:
    """Directed lane centre lines (n, 2): pieces between junctions, then connectors.

    A connector starts exactly where a piece ends and ends exactly where another one starts.
    """
    pieces = [p for k, s in enumerate(streets) for p in _pieces(k, s, junctions)]
    lanes = [line for line, _, _ in pieces]
    for index, junction in enumerate(junctions):
        entries = [p[0] for p in pieces if p[2] == index]
        exits = [p[0] for p in pieces if p[1] == index]
        lanes += _connectors(entries, exits, junction)
    return [line for line in lanes if len(line) > 1]


def _pieces(index: int, street: Street, junctions: list[Junction]) -> list[Lane]:
    """The lanes of one street, cut at its junctions."""
    stops: list[tuple[float, float, int]] = []
    for k, junction in enumerate(junctions):
        own = [a for a in junction.arms if a.street == index]
        if not own:
            continue
        low = high = junction.stations[index]
        for arm in own:
            edge = arm.edge + arm.direction * max(arm.stop, 1.0)
            low, high = min(low, float(edge)), max(high, float(edge))
        stops.append((float(low), float(high), k))
    stops.sort()
    first, last = (0.0 if closed else UNDRIVEN for closed in street.closed)
    cuts = [(-1.0, first, -1), *stops, (street.length - last, street.length + 1, -1)]
    out: list[Lane] = []
    for (_, start, leaves), (end, _, enters) in pairwise(cuts):
        if end - start < 4:
            continue
        for offset, direction in street.profile.lane_offsets():
            line = street.between(start, end, offset)
            if direction > 0:
                out.append((line, leaves, enters))
            else:
                out.append((line[::-1], enters, leaves))
    return out


def _connectors(entries: list[Array], exits: list[Array], junction: Junction) -> list[Array]:
    """Smooth paths from every entry to the exits it may take."""
    out = []
    for entry in entries:
        a, da = entry[-1], _unit(entry[-1] - entry[-2])
        options: dict[str, list[tuple[float, Array]]] = {}
        for exit_ in exits:
            b, db = exit_[0], _unit(exit_[1] - exit_[0])
            turn = float(np.arctan2(da[0] * db[1] - da[1] * db[0], da @ db))
            if abs(turn) > np.radians(150):
                continue
            kind = "straight" if abs(turn) < np.radians(35) else "left" if turn > 0 else "right"
            aside = abs(float(da[0] * (b - a)[1] - da[1] * (b - a)[0]))
            along = float(da @ (b - a))
            if along < 1:
                continue
            options.setdefault(kind, []).append((aside if kind == "straight" else along, exit_))
        for kind, found in options.items():
            # Straight on keeps the lane; a right turn takes the nearest lane, a left turn too.
            offset, best = min(found, key=lambda o: o[0])
            if kind == "straight" and offset > 2.5 + 0.12 * float(np.hypot(*(best[0] - a))):
                continue
            b, db = best[0], _unit(best[1] - best[0])
            if junction.radius:
                out.append(_around(a, da, b, db, junction))
            else:
                out.append(_bezier(a, da, b, db))
    return out


def _unit(v: Array) -> Array:
    return v / max(float(np.hypot(v[0], v[1])), 1e-9)


def _bezier(a: Array, da: Array, b: Array, db: Array) -> Array:
    """A cubic Bézier curve with the given end points and directions."""
    reach = 0.5 * float(np.hypot(*(b - a)))
    t = np.linspace(0, 1, max(6, int(reach)))[:, None]
    p, q = a + da * reach * 0.8, b - db * reach * 0.8
    return (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * p + 3 * (1 - t) * t**2 * q + t**3 * b


def _around(a: Array, da: Array, b: Array, db: Array, junction: Junction) -> Array:
    """Counter-clockwise through a roundabout, on the middle of its ring."""
    middle = (junction.radius + junction.island) / 2
    start = np.arctan2(*(a - junction.place)[::-1]) + 0.45
    end = np.arctan2(*(b - junction.place)[::-1]) - 0.45
    sweep = (end - start) % (2 * np.pi)
    if sweep > 5.5:
        return _bezier(a, da, b, db)
    angle = start + np.linspace(0, sweep, max(3, int(sweep * middle / 2)))
    ring = junction.place + middle * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    tangent = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    enter = _bezier(a, da, ring[0], tangent[0])
    leave = _bezier(ring[-1], tangent[-1], b, db)
    return np.concatenate([enter, ring[1:-1], leave])
