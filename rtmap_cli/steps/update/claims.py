"""Detections shared out among the lines of the old map, drive by drive.

In one frame a place of a line is seen once: of two detections side by side one is the old line's
and the other is *loose*, however near they are. What a drive is off as a whole around a place is
taken out first, with the lines of the map as the measure. Of the lines this says how often each
metre of them was found and how far aside; of the loose rest grids are made again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.blocks import Float
from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.assignment import FLOOR, assign_once
from rtmap_cli.maps.element import Element
from rtmap_cli.maps.registration import registered
from rtmap_cli.maps.stations import (
    MIN_COS,
    Feet,
    Samples,
    Stations,
    loose_stretches,
    smoother,
    stations_of,
)

Array = NDArray[np.float64]
Int = NDArray[np.int64]

ALONG = 2.0
"""Sigma (m) of the window along a line in which it is judged."""
AROUND = 10.0
"""Sigma (m) of the surroundings in which lines are off alike."""
PLACE = 0.3
"""Share of the variance of an offset that all drives have in common."""
FEW = 8.0
"""Stations of other lines that weigh as much as the guess that nothing is off."""
THERE = 0.05
"""Stations of more confidence say what is usual."""
LOOSE = 3.0
"""Shorter rests (m) of a detection are its ragged ends, not a line."""
COMMON, CENTRES = 0.5, 3.0
"""An outline that touches an old one is that one's if it has so much of the smaller area in common
with it, or if their centres lie so near (m)."""
FELT = 0.1
"""Share of looks that must have found a place before a drive says how far aside it lies."""


@dataclass(frozen=True)
class Drive:
    """One drive's ``samples``, put onto the map by a ``shift`` (n, 2; m), the ``feet`` of those
    that old lines claim, and the indices of those that are ``loose``."""

    traversal: Traversal
    samples: Samples
    feet: Feet
    loose: Int
    shift: Array

    @staticmethod
    def of(traversal: Traversal, class_name: str, stations: Stations) -> Drive:
        """The detections of a class shared out among the lines of some stations."""
        seen = traversal.samples(class_name)
        samples = registered(seen, stations)
        feet, taken = assign_once(stations, samples, wide=False)
        loose = loose_stretches(samples, taken, LOOSE)
        return Drive(traversal, samples, feet, loose, samples.xy - seen.xy)

    def of_line(self, stations: Stations, k: int) -> Int:
        """Indices of the samples that line ``k`` claims."""
        return self.feet.sample[stations.line[self.feet.station] == k]


def loose_rings(traversal: Traversal, class_name: str, old: Sequence[Element]) -> Int:
    """Rows of the traversal's outlines of a class that lie on none of the old ones."""
    import shapely

    mine = np.flatnonzero(traversal.class_name == class_name)
    if not old or not len(mine):
        return mine
    # Detected outlines may cross themselves.
    seen = shapely.convex_hull(shapely.multipoints(traversal.points[mine]))
    known = [shapely.convex_hull(shapely.multipoints(e.xy)) for e in old]
    i, j = shapely.STRtree(known).query(seen)
    there = np.array(known)[j]
    common = shapely.area(shapely.intersection(seen[i], there))
    least = np.minimum(shapely.area(seen[i]), shapely.area(there))
    own = common >= COMMON * np.maximum(least, 1e-9)
    own |= shapely.distance(shapely.centroid(seen[i]), shapely.centroid(there)) <= CENTRES
    return np.setdiff1d(mine, mine[i[own]])


@dataclass
class Claims:
    """What the drives say of the lines of one class, station by station (n,).

    ``share``: sum over drives of the share of looks that found it (by score, as in the grids);
    ``looked``: drives that looked; ``sides``: of every drive how far to the left of the line it
    lies (m, NaN: not felt), ``variances`` (m²) what it states of its detections there.
    """

    stations: Stations
    share: Array
    looked: Array
    drives: list[Drive] = field(default_factory=list)
    sides: list[Array] = field(default_factory=list)
    variances: list[Array] = field(default_factory=list)
    window: Any = None

    @staticmethod
    def empty(old: Sequence[Element]) -> Claims:
        """Nothing said yet of some elements."""
        stations = stations_of([e.xy for e in old])
        window = smoother(stations, ALONG) if len(stations) else None
        return Claims(stations, np.zeros(len(stations)), np.zeros(len(stations)), window=window)

    def add(self, drive: Drive, weight: Array, looks: Array | Float) -> None:
        """One drive: ``weight`` (samples,) clarity · score of each, ``looks`` (n,) the weighted
        frames that had each station in view (inf: it did not look)."""
        self.drives.append(drive)
        feet, n = drive.feet, len(self.stations)
        if not n:
            return
        mass = (weight * drive.samples.spacing)[feet.sample]
        total = self.along(np.bincount(feet.station, mass, n))
        length = self.along(self.stations.spacing)
        share = total / np.maximum(length * looks, 1e-9)
        self.share += np.minimum(np.where(np.isfinite(looks), share, 0.0), 1.0)
        self.looked += np.isfinite(looks)
        # Where a line alone lies aside, the drive was put onto it: as it was seen.
        shift = (drive.shift[feet.sample] * self.stations.normal[feet.station]).sum(axis=1)
        aside = self.along(np.bincount(feet.station, mass * (feet.offset - shift), n))
        squares = drive.samples.across_sigma[feet.sample] ** 2
        stated = self.along(np.bincount(feet.station, mass * squares, n))
        felt = np.isfinite(looks) & (share >= FELT)
        for parts, values in ((self.sides, aside), (self.variances, stated)):
            parts.append(np.where(felt, values / np.maximum(total, 1e-9), np.nan))

    def along(self, values: Any) -> Array:
        """(n,) values summed in a window along the lines."""
        return np.asarray(self.window @ values, np.float64)

    @property
    def confidence(self) -> Array:
        """(n,) mean share of looks that found a station, over the drives that looked."""
        return self.share / np.maximum(self.looked, 1.0)

    @property
    def usual(self) -> float:
        """The usual confidence: the median over stations that were looked at and are there at
        all."""
        value = self.confidence[self.looked >= 1]
        there = value[value > THERE]
        return float(np.median(there)) if len(there) else 0.0

    def aside(self, agreed: int) -> tuple[Array, Array, Array]:
        """(n,) how far (m) to the left of its place a line lies, the median over the drives (NaN
        where fewer than ``agreed`` felt it); the same beyond what its neighbours do; and the
        standard deviation (n,) of these, up to a factor that is the same for the class."""
        n = len(self.stations)
        out, sigma = np.full(n, np.nan), np.full(n, np.nan)
        sides, variances = (np.array(v).reshape(-1, n) for v in (self.sides, self.variances))
        felt = np.isfinite(sides).sum(axis=0)
        some = felt >= max(agreed, 1)
        out[some] = np.nanmedian(sides[:, some], axis=0)
        shared = PLACE + (1 - PLACE) / felt[some]
        sigma[some] = np.sqrt(np.nanmean(variances[:, some], axis=0) * shared + FLOOR**2)
        return out, out - self._around(out), sigma

    def _around(self, offset: Array) -> Array:
        """(n,) the mean offset of other lines that run along within some metres, towards zero where
        there are few."""
        known = np.flatnonzero(np.isfinite(offset))
        if not len(known):
            return np.zeros(len(offset))
        from scipy.spatial import cKDTree

        a = self.stations
        pairs = cKDTree(a.xy).sparse_distance_matrix(
            cKDTree(a.xy[known]), 2.5 * AROUND, output_type="coo_matrix"
        )
        i, j = pairs.row, known[pairs.col]
        turn = (a.tangent[i] * a.tangent[j]).sum(axis=1)
        good = (np.abs(turn) >= MIN_COS) & (a.strand[i] != a.strand[j])
        weight = np.exp(-0.5 * (pairs.data / AROUND) ** 2) * good
        total = np.bincount(i, weight * np.sign(turn) * offset[j], len(offset))
        return np.asarray(total / (np.bincount(i, weight, len(offset)) + FEW), np.float64)
