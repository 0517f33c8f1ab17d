"""Simulated drives as semantic rasters, without drawing an image.

What `rtmap simulate images --lidar … --masks` and `rtmap semantic-map` do to a drive, by the same
code, but for the masks: a camera is asked only for the pixels that points of the sweep fall on.
What stands in front of the ground is left to the occlusion test of `rtmap semantic-map`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from rtmap_cli.errors import NoAnswer
from rtmap_cli.geometry.poses import transform
from rtmap_cli.logs.log import Camera
from rtmap_cli.logs.semantic import Window
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.steps.semantic.evidence import Weighting, floored
from rtmap_cli.steps.semantic.observe import Sweep, semantic_points
from rtmap_cli.steps.semantic.project import View
from rtmap_cli.steps.semantic.raster import Raster
from rtmap_cli.steps.semantic.trajectory import initial_trajectory
from rtmap_cli.steps.simulate.driving.drive import linked, town_drive
from rtmap_cli.steps.simulate.driving.drive_source import Source
from rtmap_cli.steps.simulate.driving.drives import Drive
from rtmap_cli.steps.simulate.driving.routes import Lane
from rtmap_cli.steps.simulate.images.drive_images import frames_of, on_springs, with_vehicles
from rtmap_cli.steps.simulate.images.style import make_style
from rtmap_cli.steps.simulate.perceiving.noise import generator
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
from rtmap_cli.steps.simulate.sensing import ground_labels as labels
from rtmap_cli.steps.simulate.sensing.lidar import sweep
from rtmap_cli.steps.simulate.sensing.scene import Scene as Surroundings
from rtmap_cli.steps.simulate.sensing.scene import scene_at
from rtmap_cli.steps.simulate.towns.town import make_town
from rtmap_cli.steps.simulate.worlds.heights import ground_of, stand_on
from rtmap_cli.steps.simulate.worlds.world import world_from_map
from rtmap_cli.steps.simulate.worlds.world_ground import noise_fields
from rtmap_models.config import SemanticConfig
from rtmap_models.semantic.domains import Domain

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

REACH_M = 40.0
"""Range of `rtmap semantic-map`."""


@dataclass(frozen=True)
class Seen:
    """One frame: ``raster`` uint8 (K + 1, rows, columns) and where the vehicle truly was."""

    raster: Bytes
    map_SE3_ego: Array


@dataclass(frozen=True)
class PixelMask:
    """A label mask that is drawn where it is read: ``mask[rows, columns]``, as an array would be.

    A ``share`` of it is wrong as `spoil` of the simulator makes it, ``places`` (4, 2) being where
    its noise fields are read; ``classes`` gives the class of each label.
    """

    ground: labels.GroundLabels
    scene: Surroundings
    camera: Camera
    share: float
    places: NDArray[np.int64]
    classes: Bytes

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.camera.height, self.camera.width

    @cached_property
    def pose(self) -> Array:
        """level_SE3_camera."""
        return np.asarray(self.scene.level_SE3_ego @ self.camera.ego_SE3_camera)

    def __getitem__(self, at: tuple[NDArray[np.int32], NDArray[np.int32]]) -> Bytes:
        row, column = (a.astype(np.int64) for a in at)
        height, width = self.shape
        off = 8 * self.share
        r = np.clip(row + np.round(off * self._noise(0, 1, row, column)), 0, height - 1)
        c = np.clip(column + np.round(off * self._noise(1, 1, row, column)), 0, width - 1)
        out = self._labels(r, c)
        missed = self._noise(2, 2, row, column) < norm.ppf(self.share)
        mixed = self._noise(3, 2, row, column) < norm.ppf(self.share / 2)
        thin = np.isin(out, (labels.MARKING, labels.CROSSWALK, labels.CURB))
        out[missed & thin] = labels.ROAD
        out[mixed & (out == labels.SIDEWALK)] = labels.ROAD
        out[mixed & (out == labels.TERRAIN)] = labels.SIDEWALK
        return np.asarray(self.classes[out])

    def _noise(
        self, k: int, layer: int, row: NDArray[np.int64], column: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        fields = noise_fields()
        i, j = self.places[k]
        size = len(fields)
        return np.asarray(fields[(row + i) % size, (column + j) % size, layer])

    def _labels(self, row: NDArray[Any], column: NDArray[Any]) -> Bytes:
        k = self.camera.intrinsics
        y = (row - k[1, 2]) / k[1, 1]
        x = (column - k[0, 2] - k[0, 1] * y) / k[0, 0]
        ray = np.stack([x, y, np.ones_like(x)], axis=-1) @ self.pose[:3, :3].T
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        origin = self.pose[:3, 3]
        distance = np.minimum(self.scene.ground_distance(origin, ray), 200.0)
        hit = origin[:2] + distance[:, None] * ray[:, :2]
        found = self.ground.at(transform(self.scene.map_SE3_level, hit))
        return np.asarray(found & np.uint8(labels.LABEL))


def drive_through(lanes: list[Lane], crs: str, key: DriveKey, domain: Domain) -> Drive:
    """A drive that the lanes hold: turning, else straight, else shorter."""
    for share in (1.0, 0.6, 0.35):
        for kind in ("turning", "straight"):
            try:
                return town_drive(lanes, crs, key, kind, domain.length * share, domain.spacing)
            except NoAnswer:
                continue
    raise NoAnswer("no route through the lanes of this town")


def town_rasters(
    config: SemanticConfig, domain: Domain, seed: int, every: int
) -> tuple[VectorMap, Iterator[Seen]]:
    """The map of the town of a seed and its rasters, one of ``every`` frames of a drive: what had
    been seen up to there. NoAnswer when there is no way through the town."""
    rng = np.random.default_rng([seed, 0x73656D])
    town = make_town(seed, domain.town_size(rng), style=domain.style)
    key, lanes = DriveKey(seed, seed, 0), linked(town.lanes)
    there = town.vector_map if domain.hills else _levelled(town.vector_map)
    drive = drive_through(lanes, there.crs, key, domain)
    drive = replace(drive, pose=stand_on(ground_of(there), drive.pose))
    source = Source(drive, None, 0.0, lanes)
    return there, _rasters(config, domain, source, there, key, every)


def _levelled(vector_map: VectorMap) -> VectorMap:
    """The map without its heights."""
    flat = [replace(e, points=e.points * (1.0, 1.0, 0.0)) for e in vector_map]
    return VectorMap(flat, vector_map.crs)


def _rasters(
    config: SemanticConfig,
    domain: Domain,
    source: Source,
    vector_map: VectorMap,
    key: DriveKey,
    every: int,
) -> Iterator[Seen]:
    world = world_from_map(vector_map, key.world_seed)
    path = on_springs(with_vehicles(source.drive, source, world.surface, key, None), source, key)
    poses = initial_trajectory(list(frames_of(path, key)))[0]
    ground, style = labels.GroundLabels(world), make_style(generator(*key.drive, "style"))
    rig, lidar = domain.cameras(), domain.rays()
    weighting = Weighting(confusion=floored(domain.confusion()))
    classes = domain.class_table()
    raster = Raster(config.raster_cell_m)
    window = Window(*config.raster_half_m, config.raster_cell_m)
    for k, pose in enumerate(path.pose):
        scene = scene_at(world, source, pose, path.occluders[k] if path.occluders else (), style)
        found = sweep(lidar, ground, scene, generator(*key.drive, "lidar", k)).astype(np.float32)
        rng = generator(*key.drive, "masks", k)
        views = []
        for camera in rig:
            places = rng.integers(0, 1024, (4, 2))
            mask: Any = PixelMask(ground, scene, camera, domain.errors, places, classes)
            views.append(View(camera, camera.ego_SE3_camera, mask))
        points = semantic_points(Sweep(found[:, :3], found[:, 3]), views, 0.0, REACH_M, weighting)
        raster.add(transform(poses[k], points.xyz.astype(float)), points.classes, points.weight)
        if k % every == every - 1:
            yield Seen(raster.window(window, poses[k], weighting), pose)
