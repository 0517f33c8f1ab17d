"""Which stretches of another map's lines are lines of this one.

The other map's lines are cut into pieces of ten metres that compete for the lines of this one as
detections of one frame do (`maps/assignment.py`): two lines a foot apart are one there only where
this map has one line, and the nearer of the two is it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import arc_length
from rtmap_cli.maps.assignment import PLACE, assign_once
from rtmap_cli.maps.element import Element
from rtmap_cli.maps.existence import runs_of
from rtmap_cli.maps.pieces import GAP
from rtmap_cli.maps.refit import planar
from rtmap_cli.maps.stations import MIN_COS, Feet, Samples, Stations, stations_of

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

PIECE = 10.0
"""Length (m) of the pieces that are compared with this map's lines."""
SAME = 0.75
"""Lines that lie so near (m) side by side are one line."""
CORNER = 6.0
"""Shorter stretches (m) that leave a line and come back to it are the same line."""
CLOSE = 0.25
"""Stretches shorter than a piece have to lie so near (m)."""


@dataclass(frozen=True)
class Lines:
    """Lines of one class with their stations; ``samples``: the same as pieces to be compared."""

    elements: Sequence[Element]
    stations: Stations
    samples: Samples

    def at_stations(self, k: int, column: int) -> Array:
        """One column of line ``k`` (0 x, 1 y, 2 z) at its stations."""
        line = self.elements[k].points
        own = self.stations.of_line(k)
        return np.interp(self.stations.s[own], arc_length(line), line[:, column])


@dataclass(frozen=True)
class Common:
    """``feet`` of the other map's samples on this one's stations, ``same`` (n,) stations of
    the other map that need not be added, and ``known`` (m,) stations of this one that it has."""

    feet: Feet
    same: Mask
    known: Mask


def lines_of(elements: Sequence[Element]) -> Lines:
    """Stations and pieces of lines."""
    stations = stations_of([e.xy for e in elements])
    piece, count = np.zeros(len(stations), np.int64), 0
    covariance = np.zeros((len(stations), 2, 2))
    for k, e in enumerate(elements):
        own = stations.of_line(k)
        s, at = stations.s[own], arc_length(e.points)
        number = max(1, round(float(at[-1]) / PIECE))
        share = s / max(float(at[-1]), 1e-9)
        piece[own] = count + np.minimum((share * number).astype(np.int64), number - 1)
        count += number
        full = planar(e.covariance, len(e.points)).reshape(-1, 4)
        rows = [np.interp(s, at, full[:, c]) for c in range(4)]
        covariance[own] = np.stack(rows, axis=-1).reshape(-1, 2, 2)
    n = len(stations)
    samples = Samples(
        piece, stations.xy, stations.tangent, stations.spacing, covariance,
        np.ones(n), np.zeros(n, np.int64),
    )  # fmt: skip
    return Lines(elements, stations, samples)


def in_common(base: Lines, other: Lines, limit: float = SAME) -> Common:
    """What ``other`` lines, which were put onto this map, share with the ``base`` ones: stretches
    within ``limit`` (m), and what lies within `SAME` of a line that is the same elsewhere."""
    known, samples = base.stations, other.samples
    feet, _ = assign_once(known, samples, wide=False)
    near = np.flatnonzero(np.abs(feet.offset) <= limit)
    feet = Feet(feet.sample[near], feet.station[near], feet.offset[near], feet.along[near])
    same = np.zeros(len(samples), bool)
    same[feet.sample] = True
    there = np.zeros(len(known), bool)
    there[feet.station] = True
    offset = np.full(len(samples), np.nan)
    offset[feet.sample] = np.abs(feet.offset)
    if len(known) and len(samples):
        loose, at, across = _nobody_elses(known, other, feet, same)
        same[loose], there[at], offset[loose] = True, True, across
    apart = _distance(known, other.stations.xy)
    for k, element in enumerate(other.elements):
        own = other.stations.of_line(k)
        whole = _without_gaps(same[own], other.stations.spacing[own], apart[own], element.ring)
        same[own] = _without_tips(whole, other.stations.s[own], offset[own])
    return Common(feet, same, there)


def _nobody_elses(known: Stations, other: Lines, feet: Feet, same: Mask) -> tuple[Int, Int, Array]:
    """The loose stations, the known ones beside them and how far (m) off those are, at places of a
    line that their own line has or nobody, and which is theirs elsewhere or close by: what does not
    fit there is the same line, drawn a little differently."""
    place = (known.s / PLACE).astype(np.int64)
    slot = known.line * (int(place.max()) + 1) + place
    line = other.stations.line
    # The first and the last line at a slot tell whether any other one is there.
    low = np.full(int(slot.max()) + 1, len(other.elements))
    high = np.full(len(low), -1)
    np.minimum.at(low, slot[feet.station], line[feet.sample])
    np.maximum.at(high, slot[feet.station], line[feet.sample])
    loose = np.flatnonzero(~same)
    _, at = known.tree.query(other.stations.xy[loose], distance_upper_bound=SAME + 0.5)
    loose, at = loose[at < len(known)], at[at < len(known)]
    across = ((other.stations.xy[loose] - known.xy[at]) * known.normal[at]).sum(axis=1)
    cosine = (other.stations.tangent[loose] * known.tangent[at]).sum(axis=1)
    ok = (np.abs(across) <= SAME) & (np.abs(cosine) >= MIN_COS)
    loose, at, across = loose[ok], at[ok], across[ok]
    a, b = low[slot[at]], high[slot[at]]
    own = line[loose]
    alone = ((a == own) | (a == len(other.elements))) & ((b == own) | (b == -1))
    count = len(other.elements)
    theirs = np.isin(
        known.line[at] * count + own, known.line[feet.station] * count + line[feet.sample]
    )
    ok = alone & (theirs | (np.abs(across) <= CLOSE))
    return loose[ok], at[ok], np.abs(across[ok])


def _distance(known: Stations, xy: Array) -> Array:
    """(n,) metres to the nearest station."""
    if not len(known):
        return np.full(len(xy), np.inf)
    return np.asarray(known.tree.query(xy)[0])


def _without_gaps(same: Mask, spacing: Array, apart: Array, ring: bool) -> Mask:
    """Short stretches between two that are the same are the same, too: a corner that is drawn
    rounder, but no bay. ``apart`` (m): from the nearest line of this map."""
    out = same.copy()
    if not same.any():
        return out
    for run in runs_of(~same, ring):
        inner = ring or (run[0] > 0 and run[-1] < len(same) - 1)
        size = float(spacing[run].sum())
        corner = size < CORNER and float(apart[run].max()) < 2 * SAME
        if inner and (size < GAP or corner):
            out[run] = True
    return out


def _without_tips(same: Mask, s: Array, offset: Array) -> Mask:
    """A short stretch of a line that goes on elsewhere is the same only where it lies close: at
    the tip of an island another line is near, too. ``offset`` (m), NaN where unknown."""
    out = same.copy()
    if same.all():
        return out
    for run in runs_of(same):
        known = offset[run][np.isfinite(offset[run])]
        short = s[run[-1]] - s[run[0]] < PIECE
        if short and (not len(known) or float(np.median(known)) > CLOSE):
            out[run] = False
    return out
