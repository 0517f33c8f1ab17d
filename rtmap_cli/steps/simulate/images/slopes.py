"""Where the rays of a camera meet a sloped ground.

Rays are followed on a lattice of pixels; between them the reciprocal of the depth, which is linear
over the image of a plane, is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import transform
from rtmap_cli.steps.simulate.worlds.heights import Ground, level

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

NEAR, FAR, STEPS = 0.8, 180.0, 30
"""Depths (m) between which a ray is followed, and how many it is tried at (geometric)."""
STEEP = 0.15
"""Slope of a ray above which it meets no hill."""


@lru_cache(maxsize=64)
def lattice(width: int, height: int) -> tuple[int, Floats, Floats]:
    """(block, u, v): pixel coordinates of the middles of blocks, one block beyond each side."""
    block = 8 if width <= 512 else 16
    u = (np.arange(-1, -(-width // block) + 1) + 0.5) * block - 0.5
    v = (np.arange(-1, -(-height // block) + 1) + 0.5) * block - 0.5
    uu, vv = np.meshgrid(u.astype(np.float32), v.astype(np.float32))
    return block, uu, vv


@dataclass(frozen=True)
class Terrain:
    """The ground around a vehicle, in its level frame: place and yaw of the ego frame, upright.

    ``lift`` raises the ground so that it lies under the wheels as the pose says.
    """

    ground: Ground
    lift: float
    map_SE3_level: Array
    level_SE3_ego: Array

    @classmethod
    def around(cls, ground: Ground, map_SE3_ego: Array, ground_z: float) -> Terrain:
        """``ground_z``: height of the road in the ego frame, metres."""
        upright = level(map_SE3_ego)
        foot = map_SE3_ego[:3, :3] @ np.array([0.0, 0.0, ground_z]) + map_SE3_ego[:3, 3]
        lift = float(foot[2] - ground.at(foot[:2]))
        return cls(ground, lift, upright, np.linalg.inv(upright) @ map_SE3_ego)

    def heights(self, xy: Array) -> Array:
        """Heights (n,) of the ground at places (n, 2), level frame."""
        places = transform(self.map_SE3_level, xy)
        return self.ground.at(places) + self.lift - self.map_SE3_level[2, 3]

    def slant(
        self, cv2: Any, width: int, height: int, rows: int, rays: tuple[Floats, Floats],
        level_SE3_camera: Array,
    ) -> tuple[Floats, float]:  # fmt: skip
        """(height · rows, width) height of the camera over the ground below it divided by the
        depth of the ground in sight, negative where there is none; and that height (m).

        ``rays`` are those of the ``lattice``. On flat ground the first is the slope of the rays.
        """
        pose = self.map_SE3_level @ level_SE3_camera
        rise = float(pose[2, 3] - self.ground.at(pose[:2, 3]) - self.lift)
        coarse = inverse_depth(cv2, self.ground, self.lift, *rays, pose)
        block = lattice(width, height)[0]
        n, m = coarse.shape
        size = (m * block, n * block * rows)
        full = cv2.resize(coarse * np.float32(rise), size, interpolation=cv2.INTER_LINEAR)
        part = full[block * rows : (block + height) * rows, block : block + width]
        return np.ascontiguousarray(part), rise


def inverse_depth(
    cv2: Any, ground: Ground, lift: float, rx: Floats, ry: Floats, map_SE3_camera: Array
) -> Floats:
    """Reciprocal depth (1/m, shape of ``rx``) at which rays (rx, ry, 1) meet the ground.

    ``lift`` raises the ground (m). Rays that meet none get what the plane ahead would give, which
    is negative above the horizon.
    """
    r = map_SE3_camera[:3, :3].astype(np.float32)
    shape = rx.shape
    x, y = rx.ravel(), ry.ravel()
    dx, dy, dz = (r[k, 0] * x + r[k, 1] * y + r[k, 2] for k in range(3))
    grid = ground.z
    zero = (map_SE3_camera[:2, 3] - ground.zero) / ground.step
    rise = np.float32(map_SE3_camera[2, 3] - ground.base - lift)
    out = -dz / np.float32(max(float(rise) - float(grid.mean()), 1.0))
    low = np.flatnonzero(dz < STEEP)
    if not len(low):
        return np.asarray(out.reshape(shape))
    gx, gy = dx[low] / np.float32(ground.step), dy[low] / np.float32(ground.step)
    dz = dz[low]

    def above(t: Floats) -> Floats:
        """Height of the points at depths t over the ground."""
        px, py = np.float32(zero[0]) + t * gx, np.float32(zero[1]) + t * gy
        under = cv2.remap(grid, px, py, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        over: Floats = rise + t * dz - under
        return over

    t = np.geomspace(NEAR, FAR, STEPS).astype(np.float32)[:, None]
    over = above(np.broadcast_to(t, (STEPS, len(low))))
    below = over < 0
    hit = below.any(axis=0)
    k = np.maximum(below.argmax(axis=0), 1)
    columns = np.arange(len(low))
    a, b = t[k - 1, 0], t[k, 0]
    fa, fb = over[k - 1, columns], over[k, columns]
    for _ in range(2):  # regula falsi within the bracket
        c = a + (b - a) * np.clip(fa / np.where(fa - fb > 1e-6, fa - fb, 1.0), 0.0, 1.0)
        fc = above(c[None])[0]
        behind = fc < 0
        b, fb = np.where(behind, c, b), np.where(behind, fc, fb)
        a, fa = np.where(behind, a, c), np.where(behind, fa, fc)
    c = a + (b - a) * np.clip(fa / np.where(fa - fb > 1e-6, fa - fb, 1.0), 0.0, 1.0)
    # Beyond the last depth the ground goes on level at the height that it has there.
    far = -dz / np.maximum(over[-1] - np.float32(FAR) * dz, np.float32(0.3))
    out[low] = np.where(hit, 1.0 / np.maximum(c, np.float32(0.3)), np.minimum(far, 1.0 / FAR))
    return np.asarray(out.reshape(shape))
