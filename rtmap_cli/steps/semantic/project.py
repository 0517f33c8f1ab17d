"""Points into masks: which class the cameras give to each point of the ground.

A point takes the class of the pixel it falls on in the camera whose axis it is nearest to. Points
that something nearer hides from that camera, though the LiDAR saw them from its own place, take
none of it: points standing on the ground are drawn into a picture of depths of half a degree per
cell, everything below them down to the foot counts as covered (the gaps between the rings of a
LiDAR too), and ground behind it is hidden.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import invert
from rtmap_cli.logs.log import Camera
from rtmap_cli.steps.semantic.labels import IGNORE

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Classes = NDArray[np.uint8]

NEAR = 0.5
"""Nearest depth that is looked at (m)."""
BIN = 0.009
"""Size of a cell of the picture of depths, as the tangent of an angle: half a degree."""
MARGIN, SHARE = 0.5, 0.03
"""A point is hidden when something is nearer by 0.5 m + 3 % of its depth."""
WIDEST = 5.0
"""Tangent of the largest angle from the axis that is looked at (79°)."""


@dataclass(frozen=True)
class View:
    """A camera of a frame with its mask (h, w) of classes; ``ego_SE3_camera`` (4, 4) is its pose at
    its exposure, in the ego frame of the frame."""

    camera: Camera
    ego_SE3_camera: Array
    mask: Classes

    @cached_property
    def into_camera(self) -> Floats:
        """(4, 4) camera_SE3_ego, float32."""
        return invert(self.ego_SE3_camera).astype(np.float32)

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Largest tangents |X / Z| and |Y / Z| that may fall into the image."""
        k, c = self.camera.intrinsics, self.camera
        across = max(k[0, 2] + 0.5, c.width - 0.5 - k[0, 2]) / k[0, 0]
        down = max(k[1, 2] + 0.5, c.height - 0.5 - k[1, 2]) / k[1, 1]
        if c.lens.straight:
            across += abs(k[0, 1]) / k[0, 0] * down
            return min(across, WIDEST), min(down, WIDEST)
        reach = min(c.lens.reach, WIDEST)
        return reach, reach

    def pixels(self, xy: Floats) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Row and column in the mask of normalised coordinates (n, 2), rounded."""
        k, lens = self.camera.intrinsics, self.camera.lens
        bent = xy if lens.straight else lens.distort(xy.astype(np.float64))
        u = k[0, 0] * bent[:, 0] + k[0, 1] * bent[:, 1] + k[0, 2]
        v = k[1, 1] * bent[:, 1] + k[1, 2]
        # The mask may be coarser than the image; pixel centres lie at integers in both.
        fx = self.mask.shape[1] / self.camera.width
        fy = self.mask.shape[0] / self.camera.height
        column = np.floor((u + 0.5) * fx).astype(np.int32)
        row = np.floor((v + 0.5) * fy).astype(np.int32)
        return row, column


def label_points(ground: Floats, standing: Floats, views: Sequence[View]) -> Classes:
    """(n,) the class of each point of the ground, `IGNORE` where no camera says one.

    ``ground`` (n, 3) and ``standing`` (m, 3) are points in the ego frame (m, float32); standing
    ones hide what is behind them.
    """
    out = np.full(len(ground), IGNORE, np.uint8)
    nearest = np.full(len(ground), np.inf, np.float32)
    for view in views:
        index, xy, depth = _ahead(view, ground)
        if not len(index):
            continue
        row, column = view.pixels(xy)
        h, w = view.mask.shape
        inside = (row >= 0) & (row < h) & (column >= 0) & (column < w)
        if not view.camera.lens.straight:
            inside &= view.camera.lens.inside(xy.astype(np.float64))
        _, near_xy, near_depth = _ahead(view, standing)
        if len(near_xy):
            inside &= ~_hidden(view, xy, depth, near_xy, near_depth)
        off = np.einsum("ij,ij->i", xy, xy)
        inside &= off < nearest[index]
        chosen = index[inside]
        out[chosen] = view.mask[row[inside], column[inside]]
        nearest[chosen] = off[inside]
    return out


def _ahead(view: View, points: Floats) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Numbers of the points in the field of view, their normalised coordinates (k, 2), depths."""
    m = view.into_camera
    depth = points @ m[2, :3] + m[2, 3]
    across, down = view.limits
    x = points @ m[0, :3] + m[0, 3]
    index = np.flatnonzero((depth > NEAR) & (np.abs(x) <= np.float32(across) * depth))
    depth, x = depth[index], x[index]
    y = points[index] @ m[1, :3] + m[1, 3]
    kept = np.abs(y) <= np.float32(down) * depth
    depth = depth[kept]
    xy = np.stack([x[kept] / depth, y[kept] / depth], axis=-1)
    return index[kept], xy, depth


def _hidden(
    view: View, xy: Floats, depth: Floats, near_xy: Floats, near_depth: Floats
) -> NDArray[np.bool_]:
    """(n,) which points (n, 2) at ``depth`` lie behind the standing ones."""
    across, down = view.limits
    columns, rows = int(2 * across / BIN) + 3, int(2 * down / BIN) + 2

    def cells(p: Floats) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        row = ((p[:, 1] + np.float32(down)) / np.float32(BIN)).astype(np.int32)
        return row, ((p[:, 0] + np.float32(across)) / np.float32(BIN)).astype(np.int32) + 1

    picture = np.full((rows, columns), np.inf, np.float32)
    order = np.argsort(-near_depth)  # the nearest is written last
    row, column = cells(near_xy[order])
    picture[row, column] = near_depth[order]
    wide = picture.copy()
    np.minimum(wide[:, 1:], picture[:, :-1], out=wide[:, 1:])
    np.minimum(wide[:, :-1], picture[:, 1:], out=wide[:, :-1])
    np.minimum.accumulate(wide, axis=0, out=wide)
    front = wide[cells(xy)]
    return np.asarray(front < depth * np.float32(1 - SHARE) - np.float32(MARGIN))
