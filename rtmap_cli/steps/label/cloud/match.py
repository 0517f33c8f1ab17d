"""Scan matching by name: small_gicp's GICP, with voxels and without, and our NDT."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import UsageError
from rtmap_cli.steps.label.cloud.matcher import ITERATIONS, Match, Matcher, judged
from rtmap_cli.steps.label.cloud.points import thinned

Array = NDArray[np.float64]

METHODS = ("vgicp", "gicp", "ndt")

NEIGHBOURS = 10
FORGET = 120
"""Insertions after which a voxel that nothing touched leaves the local map."""
REACHES = (2.0, 1.0)
"""How far partners of GICP may be (m), round by round."""


def small_gicp() -> Any:
    """The package small_gicp; UsageError with the extra's name when it is not installed."""
    try:
        import small_gicp
    except ImportError:
        raise UsageError(
            "the methods vgicp and gicp need small_gicp: pip install 'rtmap[label]', "
            "or pass --method ndt"
        ) from None
    return small_gicp


class Vgicp:
    """Voxelised GICP (Koide et al., ICRA 2021): points with covariances against voxels of
    ``voxel`` metres that hold a mean and a mean covariance. Voxels that were not touched for
    `FORGET` insertions are dropped, so memory follows the neighbourhood."""

    def __init__(self, leaf: float, voxel: float | None = None) -> None:
        self.leaf, self.voxel = leaf, voxel or max(2.0 * leaf, 0.8)
        self._package = small_gicp()
        self._map = self._package.GaussianVoxelMap(self.voxel)
        self._map.set_lru(FORGET, 10)

    def prepare(self, xyz: Array) -> Any:
        """A thinned cloud with covariances."""
        return self._package.preprocess_points(xyz, self.leaf, NEIGHBOURS, 1)[0]

    def insert(self, prepared: Any, pose: Array) -> None:
        """Put a sweep into the voxels."""
        self._map.insert(prepared, pose)

    def match(self, prepared: Any, guess: Array) -> Match:
        """Gauss–Newton from ``guess``."""
        r = self._package.align(self._map, prepared, guess, self.voxel, 1, ITERATIONS, 2e-4, 1e-3)
        return judged(r.T_target_source, r.H, r.num_inliers, r.error, prepared.size())

    def local_points(self) -> Array:
        """The means of the voxels."""
        return np.asarray(self._map.voxel_points()[:, :3], np.float64)


class Gicp:
    """GICP of a sweep against the points of the local map (a KD-tree made anew at insertions):
    slower than voxels, exact in corners. ``sweeps`` sweeps make the local map."""

    def __init__(self, leaf: float, sweeps: int = 12) -> None:
        self.leaf, self.sweeps = leaf, sweeps
        self._package = small_gicp()
        self._parts: list[Array] = []
        self._target: Any = None

    def prepare(self, xyz: Array) -> Any:
        """A thinned cloud with covariances."""
        return self._package.preprocess_points(xyz, self.leaf, NEIGHBOURS, 1)[0]

    def insert(self, prepared: Any, pose: Array) -> None:
        """Put a sweep into the local map and forget the oldest."""
        self._parts.append(prepared.points()[:, :3] @ pose[:3, :3].T + pose[:3, 3])
        del self._parts[: -self.sweeps]
        self._target = None

    def match(self, prepared: Any, guess: Array) -> Match:
        """Two rounds: partners within 2 m, then within 1 m, which is how far rings lie apart."""
        if self._target is None:
            self._target = self._package.preprocess_points(
                self.local_points(), self.leaf, NEIGHBOURS, 1
            )
        pose = guess
        for reach in REACHES:
            r = self._package.align(
                *(self._target[0], prepared, self._target[1], pose),
                *("GICP", reach, 1, ITERATIONS, 2e-4, 1e-3),
            )
            pose = r.T_target_source
        return judged(pose, r.H, r.num_inliers, r.error, prepared.size())

    def local_points(self) -> Array:
        """The points themselves."""
        return thinned(np.concatenate(self._parts), self.leaf)


def make_matcher(method: str, leaf: float) -> Matcher:
    """The matcher of a name of `METHODS` for sweeps thinned to cells of ``leaf`` metres."""
    if method == "ndt":
        from rtmap_cli.steps.label.cloud.ndt import Ndt

        return Ndt(leaf)
    return Vgicp(leaf) if method == "vgicp" else Gicp(leaf)


def best_start(matcher: Matcher, prepared: Any, starts: Sequence[Array]) -> Match:
    """The best of the matches from several guesses."""
    return min((matcher.match(prepared, start) for start in starts), key=lambda m: m.cost)
