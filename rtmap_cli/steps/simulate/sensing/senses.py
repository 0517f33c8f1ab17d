"""Sweeps and masks of a drive, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import invert, transform, xyyaw_of, yaw_of
from rtmap_cli.logs.log import Occluder, Rig
from rtmap_cli.logs.sensor_times import part_of_step
from rtmap_cli.steps.simulate.driving.drives import Drive
from rtmap_cli.steps.simulate.images.style import make_style
from rtmap_cli.steps.simulate.perceiving.noise import generator
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
from rtmap_cli.steps.simulate.sensing.ground_labels import LABELS, GroundLabels
from rtmap_cli.steps.simulate.sensing.lidar import LIDARS, sweep
from rtmap_cli.steps.simulate.sensing.masks import draw_mask, spoil
from rtmap_cli.steps.simulate.sensing.scene import scene_at
from rtmap_cli.steps.simulate.worlds.world_ground import opencv

if TYPE_CHECKING:
    from rtmap_cli.steps.simulate.driving.drive_source import Source

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Senses:
    """What a vehicle records besides images: ``lidar`` (a key of `LIDARS` or None), ``masks`` of
    its cameras, a share ``errors`` of them wrong (see `spoil`); cameras expose ``delay`` seconds
    after the sweep, which is taken at the frame's time.
    """

    lidar: str | None = None
    masks: bool = False
    delay: float = 0.0
    errors: float = 0.0


def label_list() -> dict[str, list[dict[str, str]]]:
    """labels.json of simulated masks."""
    return {"labels": [{"name": name} for name in LABELS]}


def exposed(path: Drive, delay: float) -> Drive:
    """The drive ``delay`` seconds later, with its boxes standing still: where cameras see it from.

    The body leans as it did at the frame's time; the last frame goes on as the one before it did.
    """
    if not delay or len(path) < 2:
        return path
    steps = xyyaw_of(invert(path.pose[:-1]) @ path.pose[1:])
    share = delay * 1e9 / np.diff(path.timestamp_ns)
    rows = np.minimum(np.arange(len(path)), len(path) - 2)
    dx, dy, dyaw = steps.T.tolist()
    moves = np.stack([part_of_step(dx[k], dy[k], dyaw[k], share[k]) for k in rows.tolist()])
    boxes = None
    if path.occluders is not None:
        boxes = [
            tuple(_moved(o, back) for o in found)
            for found, back in zip(path.occluders, invert(moves), strict=True)
        ]
    later = path.timestamp_ns + round(delay * 1e9)
    return replace(path, timestamp_ns=later, pose=path.pose @ moves, occluders=boxes)


def _moved(box: Occluder, move: Array) -> Occluder:
    x, y, z = transform(move, np.array([[box.x, box.y, box.z]]))[0]
    return replace(box, x=float(x), y=float(y), z=float(z), yaw=box.yaw + float(yaw_of(move)))


def sweeps_of(
    ground: GroundLabels, path: Drive, source: Source, key: DriveKey, name: str
) -> Iterator[Array]:
    """The sweep (n, 4) of every frame by the LiDAR of that name."""
    style = make_style(generator(*key.drive, "style"))
    for k, pose in enumerate(path.pose):
        scene = scene_at(
            ground.world, source, pose, path.occluders[k] if path.occluders else (), style
        )
        yield sweep(LIDARS[name], ground, scene, generator(*key.drive, "lidar", k))


def masks_of(
    ground: GroundLabels, path: Drive, rig: Rig, source: Source, key: DriveKey, errors: float
) -> Iterator[dict[str, bytes]]:
    """PNG files of every frame by camera name; ``path`` is where the cameras expose."""
    cv2 = opencv()
    style = make_style(generator(*key.drive, "style"))
    for k, pose in enumerate(path.pose):
        scene = scene_at(
            ground.world, source, pose, path.occluders[k] if path.occluders else (), style
        )
        masks = {camera.name: draw_mask(ground, scene, camera) for camera in rig}
        if errors:
            rng = generator(*key.drive, "masks", k)
            masks = {name: spoil(mask, errors, rng) for name, mask in masks.items()}
        yield {name: cv2.imencode(".png", mask)[1].tobytes() for name, mask in masks.items()}
