"""No two detections of a frame are one line: the cells of lines that detections have taken."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rtmap_cli.maps.stations import Samples, Stations

Array = NDArray[np.float64]
Int = NDArray[np.int64]

CELL = 3.0
"""Two detections of a frame that meet a line within such a stretch (m) of it lie side by side."""


def cells_of(stations: Stations) -> Int:
    """(n,) number of the stretch of ``CELL`` metres of its line that each station lies in."""
    along = np.floor(stations.s / CELL).astype(np.int64)
    change = np.ones(len(stations), bool)
    change[1:] = (np.diff(stations.line) != 0) | (np.diff(along) != 0)
    return np.asarray(np.cumsum(change) - 1)


class Taken:
    """Cells (frame, line, a few metres) that detections have taken."""

    def __init__(self, stations: Stations, samples: Samples) -> None:
        self.place = cells_of(stations)
        self.places = int(self.place[-1]) + 1
        self.samples = samples
        self.cells = np.zeros(0, np.int64)
        self.owner = np.zeros(0, np.int64)

    def cell(self, sample: Int, station: Int) -> Int:
        """Number of the cell of a sample with its foot at a station."""
        return np.asarray(self.samples.frame[sample] * self.places + self.place[station])

    def contested(
        self, best: NDArray[np.bool_], owner: Int, gain: Array, sample: Int, station: Int, row: Int
    ) -> NDArray[np.bool_]:
        """``best`` less those that lose most of their cells to a detection with more to lose.

        A detection loses the difference between its best and its second chain; of two detections
        and two lines the better one of both ways to pair them comes out.
        """
        second = np.where(best, -np.inf, gain)
        other = np.full(int(owner.max()) + 1, 0.0)
        np.maximum.at(other, owner, second)
        regret = np.where(best, gain - other[owner], -np.inf)
        mine = np.flatnonzero(best[row])
        cells = self.cell(sample[mine], station[mine])
        r = row[mine]
        _, place = np.unique(cells, return_inverse=True)
        order = np.lexsort((-r, regret[r], place))
        top = np.full(int(place.max(initial=-1)) + 1, -1)
        # The last one written is the one with the highest regret.
        top[place[order]] = r[order]
        lost = np.bincount(r, top[place] != r, len(best))
        return best & (lost <= 0.5 * np.bincount(r, minlength=len(best)))

    def mark(self, sample: Int, station: Int) -> None:
        """Take the cells of these feet."""
        cells, first = np.unique(self.cell(sample, station), return_index=True)
        cells = np.concatenate([self.cells, cells])
        owner = np.concatenate([self.owner, self.samples.detection[sample[first]]])
        self.cells, first = np.unique(cells, return_index=True)
        self.owner = owner[first]

    def by_others(self, sample: Int, station: Int) -> NDArray[np.bool_]:
        """(k,) True where another detection of the frame has the cell of a foot."""
        cell = self.cell(sample, station)
        at = np.minimum(np.searchsorted(self.cells, cell), len(self.cells) - 1)
        taken = self.cells[at] == cell
        return np.asarray(taken & (self.owner[at] != self.samples.detection[sample]))
