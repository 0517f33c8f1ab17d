"""Training frames: small procedural towns, seen by random rigs, as bird's-eye pictures on disk.

One shard is one town. Everything in it follows from the seed of the town, so that shards can be
made in any order, by any number of processes, and again.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from rtmap_cli.geometry.cameras import fit_plane, projection
from rtmap_cli.geometry.poses import se3_from_xyyaw
from rtmap_cli.logs.log import Rig
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.steps.simulate.images.render import body_motion, render_cameras
from rtmap_cli.steps.simulate.images.style import make_style
from rtmap_cli.steps.simulate.towns.town import Town, make_town
from rtmap_cli.steps.simulate.worlds.heights import Ground, stand_on
from rtmap_cli.steps.simulate.worlds.world import world_from_map
from rtmap_cli.steps.simulate.worlds.world_objects import random_occluders
from rtmap_models.config import ModelConfig
from rtmap_models.data.rigs import sample_rig
from rtmap_models.data.samples import Array
from rtmap_models.data.views import Pictures, View, scene_at

FRAMES_PER_TOWN = 24
TOWN_SIZES = (150.0, 220.0, 320.0)
TOWNS_PER_SEED = 100_000


class TownStage:
    """A town with one rig and one style, all from ``seed``; ``lanes`` (n, 2) are its lane centres.

    ``look`` draws from the generator that the town was made with, so that a stage's views follow
    from its seed and their order.
    """

    def __init__(self, config: ModelConfig, seed: int):
        self.config = config
        self.rng = rng = np.random.default_rng([seed, 0x746F776E])
        self.town = make_town(seed, TOWN_SIZES[rng.choice(3, p=[0.5, 0.3, 0.2])])
        self.lanes = self.town.lanes
        self.world = world_from_map(self.town.vector_map, seed)
        self.index = MapIndex(self.town.vector_map, join=True)
        self.rig, self.style = sample_rig(config, rng), make_style(rng)

    def look(self) -> View:
        """What the cameras see at one more random place; the view's pose leans on its springs."""
        rng, ground = self.rng, self.world.ground
        pose = stand_on(ground, random_pose(self.town, rng))
        occluders = random_occluders(self.world, pose, rng, float(rng.choice([0.0, 3.0, 7.0])))
        body = body_motion(self.style, rng)
        images = render_cameras(
            self.world, pose, self.rig.cameras, self.style, occluders, rng, body=body
        )
        scene, plane = scene_at(self.index, pose, self.config), road_plane(ground, pose, body)
        return View(np.stack(images), projections(self.rig), scene, pose @ body, plane)


def town_views(config: ModelConfig, seed: int, count: int) -> Iterator[View]:
    """Frames of one town, one rig, one style: all from ``seed``."""
    stage = TownStage(config, seed)
    for _ in range(count):
        yield stage.look()


def road_plane(ground: Ground | None, pose: Array, body: Array) -> Array:
    """(3,) how the road lies around a vehicle that stands at ``pose`` (on the ground, the z of
    its ego frame on the road) and moves on its springs by ``body``; see `fit_plane`."""
    x, y = np.meshgrid(np.arange(-30.0, 31.0, 5.0), np.arange(-15.0, 16.0, 5.0))
    flat = np.stack([x, y, np.zeros_like(x), np.ones_like(x)], axis=-1).reshape(-1, 4)
    points = flat @ pose.T
    if ground is not None:
        points[:, 2] = ground.at(points[:, :2])
    return fit_plane((points @ np.linalg.inv(pose @ body).T)[:, :3])


def projections(rig: Rig) -> NDArray[np.float32]:
    """(N, 3, 4) of the cameras of a rig whose ego frame lies on the road."""
    rows = [projection(c.intrinsics, c.ego_SE3_camera) for c in rig]
    return np.stack(rows).astype(np.float32)


def random_pose(town: Town, rng: np.random.Generator) -> Array:
    """A pose near a lane centre, along the lane (σ 0.3 m, 3°), in one case of ten askew."""
    lengths = np.array([len(lane) for lane in town.lanes], dtype=np.float64)
    lane = town.lanes[rng.choice(len(town.lanes), p=lengths / lengths.sum())]
    k = rng.integers(len(lane) - 1)
    start, step = lane[k], lane[k + 1] - lane[k]
    x, y = start + rng.random() * step
    askew = rng.random() < 0.1
    yaw = np.arctan2(step[1], step[0]) + rng.normal(0, 0.25 if askew else 0.05)
    side = rng.normal(0, 0.8 if askew else 0.3)
    return se3_from_xyyaw(x - side * np.sin(yaw), y + side * np.cos(yaw), yaw)


def generate(
    config: ModelConfig,
    folder: Path,
    frames: int,
    seed: int,
    workers: int,
    report: Callable[[str], None],
    per_town: int = FRAMES_PER_TOWN,
    keep_images: bool | None = None,
) -> None:
    """Fill ``folder`` with towns ``seed · 100000 + 0, 1, …`` until it holds ``frames`` frames.

    Shards that are there already are kept: an interrupted run goes on where it stopped.
    ``keep_images`` keeps the camera images too (default: where the network needs them).
    """
    folder.mkdir(parents=True, exist_ok=True)
    sizes = [min(per_town, frames - start) for start in range(0, frames, per_town)]
    keep = config.needs_images if keep_images is None else keep_images
    jobs = [
        TownJob(config, folder, seed * TOWNS_PER_SEED + k, count, keep)
        for k, count in enumerate(sizes)
        if not (folder / f"{town_name(seed * TOWNS_PER_SEED + k)}.json").exists()
    ]
    if not jobs:
        return
    report(f"rendering {sum(j.frames for j in jobs)} frames of {len(jobs)} towns into {folder}")
    workers = min(workers, len(jobs))
    if workers == 1:
        made = map(make_town_shard, jobs)
        _watch(made, len(jobs), report)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        _watch(pool.imap_unordered(make_town_shard, jobs), len(jobs), report)


def _watch(made: Iterator[str], count: int, report: Callable[[str], None]) -> None:
    for done, name in enumerate(made, start=1):
        if done % 10 == 0 or done == count:
            report(f"{done} of {count} towns ({name})")


def town_name(seed: int) -> str:
    return f"town-{seed:07d}"


class TownJob(NamedTuple):
    """One shard to make: the frames of the town of a seed."""

    config: ModelConfig
    folder: Path
    seed: int
    frames: int
    keep_images: bool


def make_town_shard(job: TownJob) -> str:
    """Render one town and write its shard; returns the shard's name."""
    config = job.config
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    pictures = Pictures(config, np.random.default_rng([job.seed, 0x706C616E]), job.keep_images)
    for view in town_views(config, job.seed, job.frames):
        pictures.add(view)
    name = town_name(job.seed)
    pictures.write(job.folder, name, {"town": job.seed})
    return name
