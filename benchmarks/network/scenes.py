"""Places to measure a network at: simulated images over towns and over Argoverse 2 maps.

Every shot knows what a vehicle there would know, its pose (attitude to 0.1°), the path that it
drives and the map, and levels its cameras from them as ``rtmap infer`` does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rtmap_models.config import ModelConfig
from rtmap_models.data.generate import TownStage, projections
from rtmap_models.data.views import View, scene_at

from rtmap_cli.formats.av2.log import Av2Log
from rtmap_cli.formats.av2.vector_map import read_av2_archive, vector_map_of
from rtmap_cli.geometry.cameras import fit_camera, levelled
from rtmap_cli.geometry.poses import invert, se3_from_xyyaw
from rtmap_cli.logs.log import Camera, Occluder, Rig
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.steps.infer.levelling import RoadUnder
from rtmap_cli.steps.simulate.images.drive_images import leaned
from rtmap_cli.steps.simulate.images.render import body_motion, render_cameras
from rtmap_cli.steps.simulate.images.style import Style, make_style
from rtmap_cli.steps.simulate.worlds.heights import Ground, level, stand_on
from rtmap_cli.steps.simulate.worlds.world import World, world_from_map
from rtmap_cli.steps.simulate.worlds.world_objects import random_occluders

Array = NDArray[np.float64]

TEST_SEED = 90_000_000
"""Towns from this seed on are neither trained nor calibrated with."""

WEATHERS = 8


@dataclass(frozen=True)
class Shot:
    """One frame: ``view``; ``known`` the pose (4, 4) with the attitude that the vehicle knows, its
    z on the road; ``path`` poses that it drives through; ``vector_map``."""

    view: View
    known: Array
    path: Sequence[Array]
    vector_map: VectorMap
    level: bool = True

    def cameras(self, delta: Array | None) -> NDArray[np.float32]:
        """(N, 3, 4) projections levelled from the path or, with a prior that is off by ``delta``
        (dx, dy, dyaw: true = initial · SE2(delta)), from the heights of the map there."""
        if not self.level:
            return self.view.ego_to_image
        road = RoadUnder(self.path, None if delta is None else self.vector_map)
        pose = self.known
        if delta is not None:
            pose = pose @ invert(se3_from_xyyaw(*delta))
        return levelled(self.view.ego_to_image, road.plane(pose)).astype(np.float32)


def unseen_towns(config: ModelConfig, towns: int, frames: int) -> Iterator[Shot]:
    """Random places of towns that training never drew."""
    for k in range(towns):
        stage, rng = TownStage(config, TEST_SEED + k), np.random.default_rng([TEST_SEED, k])
        for _ in range(frames):
            view = stage.look()
            path = _along(stage.lanes, view.map_SE3_ego, stage.world.ground)
            yield Shot(view, leaned(view.map_SE3_ego[None], rng)[0], path, stage.town.vector_map)


class RealMap:
    """An Argoverse 2 log's map as a world for simulated images, with a rig fitted to a network.

    A log without calibration borrows the rig of ``rig_from``. ``flat``: the heights of the map are
    forgotten and vehicles lean on their springs only; else the ground has the map's heights and a
    recorded pose leans as it did.
    """

    def __init__(
        self, config: ModelConfig, folder: Path, rig_from: Path | None = None, flat: bool = False
    ):
        self.config, self.log, self.flat = config, Av2Log(folder), flat
        self.archive = read_av2_archive(folder)
        self.vector_map = vector_map_of(self.archive)
        if flat:
            self.vector_map = _without_heights(self.vector_map)
        self.world: World = world_from_map(self.vector_map, 0)
        self.index = MapIndex(self.vector_map, join=True)
        lender = self.log if self.log.rig is not None else Av2Log(rig_from or folder)
        if lender.rig is None:
            raise SystemExit(f"{folder}: the log has no calibration; give one that has first")
        self.rig = Rig(tuple(_fitted(c, config, lender.ground_z) for c in lender.rig))

    def drive(self, frames: int) -> Iterator[Shot]:
        """Evenly chosen frames of the recorded drive, with its vehicles, in turn under one of
        `WEATHERS` weathers: a network may like one drive's light and not another's."""
        rng = np.random.default_rng(0)
        styles, drop = [make_style(rng) for _ in range(WEATHERS)], np.eye(4)
        drop[2, 3] = self.log.ground_z
        recorded = list(self.log.frames())
        path = [frame.map_SE3_ego @ drop for frame in recorded]
        if self.flat:
            path = [_flattened(pose) for pose in path]
        chosen = np.linspace(0, len(recorded) - 1, frames).round().astype(int)
        for n, k in enumerate(chosen):
            boxes = [replace(o, z=o.z - self.log.ground_z) for o in recorded[k].occluders]
            view, known = self._look(path[k], styles[n % WEATHERS], boxes, rng)
            yield Shot(view, known, path, self.vector_map)

    def random_places(self, frames: int) -> Iterator[Shot]:
        """Places on lanes of the whole map, other weather at each, parked vehicles at some."""
        rng = np.random.default_rng(1)
        lanes = [_middle(a.left, a.right) for a in self.archive.lanes.values()
                 if a.lane_type == "VEHICLE"]  # fmt: skip
        length = np.array([np.hypot(*np.diff(lane[[0, -1]], axis=0)[0]) for lane in lanes])
        for k in rng.choice(len(lanes), frames, p=length / length.sum()):
            lane, at = lanes[k], rng.uniform(0, len(lanes[k]) - 1.001)
            here, step = lane[int(at)], lane[int(at) + 1] - lane[int(at)]
            x, y = here + (at % 1) * step + rng.normal(0, 0.2, 2)
            flat = se3_from_xyyaw(x, y, np.arctan2(step[1], step[0]) + rng.normal(0, 0.05))
            pose = stand_on(self.world.ground, flat)
            boxes = random_occluders(self.world, pose, rng, float(rng.choice([0.0, 3.0])))
            view, known = self._look(pose, make_style(rng), boxes, rng)
            path = _along([lane], pose, self.world.ground)
            yield Shot(view, known, path, self.vector_map)

    def _look(
        self, pose: Array, style: Style, boxes: Sequence[Occluder], rng: np.random.Generator
    ) -> tuple[View, Array]:
        """A view and the pose with the attitude that the vehicle knows."""
        body = body_motion(style, rng) if self.flat else np.eye(4)
        images = render_cameras(
            self.world, pose, self.rig.cameras, style, tuple(boxes), rng, body=body
        )
        scene = scene_at(self.index, pose, self.config)
        view = View(np.stack(images), projections(self.rig), scene, pose @ body)
        return view, leaned(view.map_SE3_ego[None], rng)[0]


def _without_heights(vector_map: VectorMap) -> VectorMap:
    flat = [
        replace(e, points=np.column_stack([e.points[:, :2], np.full(len(e.points), np.nan)]))
        for e in vector_map
    ]
    return VectorMap(flat, vector_map.crs)


def _flattened(pose: Array) -> Array:
    """The pose upright at height zero."""
    out = level(pose)
    out[2, 3] = 0.0
    return out


def _fitted(camera: Camera, config: ModelConfig, ground_z: float) -> Camera:
    """The camera at the model's image size, in the frame dropped to the road, undistorted."""
    pose = camera.ego_SE3_camera.copy()
    pose[2, 3] -= ground_z
    size = (camera.height, camera.width)
    _, k = fit_camera(camera.intrinsics, pose, size, config.image_size, config.horizon)
    height, width = config.image_size
    return Camera(camera.name, width, height, k, pose)


def _middle(left: Array, right: Array, step: float = 2.0) -> Array:
    """(n, 2) middle of a lane every ``step`` metres or so."""
    count = max(2, int(np.hypot(*(left[-1, :2] - left[0, :2])) / step))
    at = np.linspace(0, 1, count)
    sides = []
    for line in (left[:, :2], right[:, :2]):
        s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
        sides.append(np.stack([np.interp(at * s[-1], s, line[:, k]) for k in (0, 1)], axis=-1))
    return (sides[0] + sides[1]) / 2


def _along(lanes: Sequence[Array], pose: Array, ground: Ground | None) -> list[Array]:
    """Poses on the lane nearest to a pose, on the ground, within 36 m, and the pose itself."""
    here = pose[:2, 3]
    lane = min(lanes, key=lambda line: float(np.hypot(*(line[:, :2] - here).T).min()))
    near = lane[np.hypot(*(lane[:, :2] - here).T) < 36.0, :2]
    flat = se3_from_xyyaw(near[:, 0], near[:, 1], np.zeros(len(near)))
    return [pose, *stand_on(ground, flat)]
