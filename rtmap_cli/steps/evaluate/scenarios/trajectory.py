"""A drive by distance: places, headings, bends and closed loops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.steps.evaluate.drives import Drive

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

STEP = 0.5
"""Distance between stations, metres: what a vehicle does on the spot makes no path."""
HALF_WINDOW = 10.0
"""A bend is measured over this much of the path behind and ahead (m) …"""
LEAST_WINDOW = 2.5
"""… or over what there is of it at an end of the drive, if it is at least this (m)."""
TURNING = np.radians(0.75)
"""Mean bend (rad/m) from which a frame is turning: a radius of 76 m."""
LEAST_SHARE = 1 / 3
"""Each half of the window bends at least this share of the mean: a turn ahead is not yet one."""
CLOSED = 5.0
"""A path closes where it comes back to within this distance (m) …"""
LOOP_LENGTH = (80.0, 1000.0)
"""… after a way of this length (m) …"""
LOOP_ROUNDNESS = 0.4
"""… round an area A with 4πA/L² at least this (circle 1; a street and its other
side 5 m beside it at most 0.39)."""


@dataclass(frozen=True)
class Trajectory:
    """Stations of one drive: places ``xy`` (n, 2) in the map frame, headings ``yaw`` (n,) in
    radians without jumps, distance ``s`` (n,) in metres."""

    xy: Array
    yaw: Array
    s: Array
    timestamp_ns: NDArray[np.int64]

    @classmethod
    def of(cls, drive: Drive) -> Trajectory:
        """The stations of a drive, at least ``STEP`` apart."""
        places = drive.pose[:, :2, 3]
        kept, last = [0], places[0].tolist()
        for k, (x, y) in enumerate(places.tolist()):
            if (x - last[0]) ** 2 + (y - last[1]) ** 2 >= STEP**2:
                kept.append(k)
                last = [x, y]
        xy = places[kept]
        yaw = np.unwrap(np.arctan2(drive.pose[kept, 1, 0], drive.pose[kept, 0, 0]))
        s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
        return cls(xy, yaw, s, drive.timestamp_ns[kept])

    def __len__(self) -> int:
        return len(self.s)

    def at(self, timestamp_ns: NDArray[np.int64]) -> NDArray[np.intp]:
        """The station at which the vehicle is, or was last, at some times (clipped)."""
        k = np.searchsorted(self.timestamp_ns, np.asarray(timestamp_ns), side="right") - 1
        return np.asarray(np.clip(k, 0, len(self) - 1), np.intp)

    def bends(self) -> tuple[Array, Array]:
        """(n,) signed bends behind and ahead of each station, rad/m; left is positive.

        At an end of the drive that leaves less than ``LEAST_WINDOW`` the other one stands for it.
        """
        sides = []
        for low, high in ((-HALF_WINDOW, 0.0), (0.0, HALF_WINDOW)):
            start = np.clip(self.s + low, 0.0, self.s[-1])
            stop = np.clip(self.s + high, 0.0, self.s[-1])
            change = np.interp(stop, self.s, self.yaw) - np.interp(start, self.s, self.yaw)
            way = stop - start
            with np.errstate(divide="ignore", invalid="ignore"):
                sides.append(np.where(way >= LEAST_WINDOW, change / way, np.nan))
        behind, ahead = sides
        behind = np.where(np.isnan(behind), ahead, behind)
        ahead = np.where(np.isnan(ahead), behind, ahead)
        return np.nan_to_num(behind), np.nan_to_num(ahead)

    def turning(self) -> Bools:
        """(n,) True where the path bends behind and ahead, to one side (module's constants)."""
        behind, ahead = self.bends()
        mean = np.abs(behind + ahead) / 2
        least = np.minimum(np.abs(behind), np.abs(ahead))
        same_side = behind * ahead > 0
        return np.asarray(same_side & (mean >= TURNING) & (least >= LEAST_SHARE * mean))

    def looping(self) -> Bools:
        """(n,) True on closed loops: the shortest stretches that come back to their start."""
        from scipy.spatial import cKDTree

        out = np.zeros(len(self), dtype=bool)
        pairs = cKDTree(self.xy).query_pairs(CLOSED, output_type="ndarray")
        i, j = np.sort(pairs, axis=1).T if len(pairs) else np.zeros((2, 0), dtype=int)
        way = self.s[j] - self.s[i]
        fits = (way >= LOOP_LENGTH[0]) & (way <= LOOP_LENGTH[1])
        i, j, way = i[fits], j[fits], way[fits]
        closes = 4 * np.pi * self._enclosed(i, j) / way**2 >= LOOP_ROUNDNESS
        reached = -1
        # By falling start, a stretch that ends before all later ones began is a shortest one.
        for a, b in sorted(zip(i[closes].tolist(), j[closes].tolist(), strict=True), reverse=True):
            if reached < 0 or b < reached:
                out[a : b + 1] = True
                reached = b
        return out

    def _enclosed(self, i: NDArray[np.intp], j: NDArray[np.intp]) -> Array:
        """(k,) areas (m²) inside the path from stations i to stations j and straight back."""
        x, y = (self.xy - self.xy[0]).T
        swept = np.concatenate([[0.0], np.cumsum(x[:-1] * y[1:] - x[1:] * y[:-1])])
        return np.asarray(np.abs(swept[j] - swept[i] + x[j] * y[i] - x[i] * y[j]) / 2)
