"""The surroundings of one simulated frame: level frame, ground, boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import transform
from rtmap_cli.logs.log import Occluder
from rtmap_cli.steps.simulate.images.drive_images import lean_of
from rtmap_cli.steps.simulate.images.render_boxes import scene_boxes
from rtmap_cli.steps.simulate.images.slopes import Terrain
from rtmap_cli.steps.simulate.images.style import Style
from rtmap_cli.steps.simulate.sensing.ground_labels import BUILDING, TREE, VEHICLE
from rtmap_cli.steps.simulate.worlds.heights import level
from rtmap_cli.steps.simulate.worlds.roadside import CROWN
from rtmap_cli.steps.simulate.worlds.world import World

if TYPE_CHECKING:
    from rtmap_cli.steps.simulate.driving.drive_source import Source

Array = NDArray[np.float64]

FIRST, LAST, STEPS = 1.5, 160.0, 20
"""Distances (m) between which the ground is looked for along a ray over hills, and how often."""


@dataclass(frozen=True)
class Scene:
    """What is around a vehicle, in its level frame (its place and yaw, upright): ``boxes`` (n, 11),
    far ones first (see `scene_boxes`), with their labels ``kinds`` (n,). ``terrain`` are the hills;
    without them the ground is the plane z = ``ground_z``."""

    level_SE3_ego: Array
    map_SE3_level: Array
    ground_z: float
    terrain: Terrain | None
    boxes: Array
    kinds: NDArray[np.uint8]

    def clearance(self, points: Array) -> Array:
        """(n,) height over the ground of points (n, 3) of the level frame."""
        if self.terrain is None:
            return np.asarray(points[:, 2] - self.ground_z)
        return np.asarray(points[:, 2] - self.terrain.heights(points[:, :2]))

    def ground_distance(self, origin: Array, rays: Array) -> Array:
        """(n,) distance along unit rays (n, 3) from ``origin`` (3,) or (n, 3) to the ground, inf
        where there is none within `LAST`."""
        if self.terrain is None:
            with np.errstate(divide="ignore"):
                away = (self.ground_z - origin[..., 2]) / rays[:, 2]
            return np.where(rays[:, 2] < 0, away, np.inf)
        terrain = self.terrain
        origin = np.broadcast_to(origin, rays.shape)

        def over(t: Array, rows: NDArray[np.int64]) -> Array:
            p = origin[rows] + t[:, None] * rays[rows]
            return np.asarray(p[:, 2] - terrain.heights(p[:, :2]))

        out = np.full(len(rays), np.inf)
        open_ = np.flatnonzero(rays[:, 2] < 0.15)
        before, height = np.full(len(open_), FIRST), over(np.full(len(open_), FIRST), open_)
        for t in np.geomspace(FIRST, LAST, STEPS)[1:]:
            after = over(np.full(len(open_), t), open_)
            hit = after < 0
            rows, a, b = open_[hit], before[hit], np.full(int(hit.sum()), t)
            fa, fb = height[hit], after[hit]
            for _ in range(4):  # regula falsi within the bracket
                c = a + (b - a) * fa / np.maximum(fa - fb, 1e-9)
                fc = over(c, rows)
                low = fc < 0
                b, fb = np.where(low, c, b), np.where(low, fc, fb)
                a, fa = np.where(low, a, c), np.where(low, fa, fc)
            out[rows] = a + (b - a) * fa / np.maximum(fa - fb, 1e-9)
            open_, height, before = open_[~hit], after[~hit], np.full(int((~hit).sum()), t)
        return out


def scene_at(
    world: World, source: Source, map_SE3_ego: Array, found: Sequence[Occluder], style: Style
) -> Scene:
    """The surroundings of a vehicle at a true pose among the boxes ``found`` (ego frame)."""
    terrain = None
    if world.ground is not None:
        terrain = Terrain.around(world.ground, map_SE3_ego, source.ground_z)
    lean = terrain.level_SE3_ego if terrain else lean_of(world, source, map_SE3_ego)
    boxes = scene_boxes(world, map_SE3_ego, found, style, source.ground_z, terrain)
    kinds = np.where(boxes[:, 10] == CROWN, TREE, BUILDING).astype(np.uint8)
    for vehicle in found:
        x, y, _ = transform(lean, np.array([[vehicle.x, vehicle.y, vehicle.z]]))[0]
        kinds[np.hypot(boxes[:, 0] - x, boxes[:, 1] - y) < 1.0] = VEHICLE
    return Scene(lean, level(map_SE3_ego), source.ground_z, terrain, boxes, kinds)
