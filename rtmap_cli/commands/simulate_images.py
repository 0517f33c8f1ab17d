"""``rtmap simulate images``: render the cameras of a drive into a native log."""

from __future__ import annotations

from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options
from rtmap_cli.output import emit, log, progress

if TYPE_CHECKING:
    from rtmap_cli.logs.log import Rig
    from rtmap_cli.maps.element import VectorMap
    from rtmap_cli.steps.simulate.driving.drive_source import Source
    from rtmap_cli.steps.simulate.driving.drives import Drive
    from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
    from rtmap_cli.steps.simulate.sensing.senses import Senses

LOG_RATE, TOWN_SPACING = 2.0, 2.5
POSITIVE = options.FiniteRange(0, min_open=True)


@click.command("images")
@options.map_path
@options.map_version
@options.drive_path
@options.seed
@click.option(
    "--world-seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Seed of what stays in place over all drives: wear, houses, the corridor.",
)
@click.option(
    "--drive",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Number of the drive: other lanes, weather, traffic and errors.",
)
@click.option(
    "--route",
    type=click.Choice(["straight", "turning", "tour"]),
    default="turning",
    show_default=True,
    help="Kind of a drive through a town; a tour comes back to places that it knows.",
)
@options.town_length(160.0)
@click.option("--spacing", type=POSITIVE, help="Metres between frames [default: 2.5 in a town].")
@click.option("--rate", type=POSITIVE, help="Frames per second of a log [default: 2].")
@click.option("--frames", type=click.IntRange(1), help="At most so many frames [default: all].")
@click.option(
    "--rig",
    "rig_name",
    type=click.Choice(["log", "default", "campus"]),
    default=None,
    help="The log's calibration, a default ring of seven cameras or a cart's two [default: log].",
)
@click.option(
    "--lidar", type=click.Choice(["vlp16", "hdl32", "os64"]), help="Sweeps of such a LiDAR as well."
)
@click.option("--masks", is_flag=True, help="Label masks of every image as well.")
@click.option(
    "--mask-errors",
    type=options.FiniteRange(0, 0.5),
    default=0.0,
    show_default=True,
    help="Share of the masks that is wrong: borders off, paint missed.",
)
@click.option(
    "--camera-delay",
    "delay",
    type=options.FiniteRange(0, 1),
    default=0.0,
    show_default=True,
    help="Cameras expose so long after the frame's time, which is the LiDAR's (s).",
)
@click.option(
    "--width",
    type=click.IntRange(32, 4096),
    default=512,
    show_default=True,
    help="Width of the images (px); each camera keeps its aspect.",
)
@click.option(
    "--quality", type=click.IntRange(10, 100), default=92, show_default=True, help="JPEG quality."
)
@options.traffic
@click.option(
    "--change",
    "specs",
    multiple=True,
    help="Change the world near the drive first, e.g. delete:ped_crossing. Repeat it.",
)
@options.output("The log folder to write.")
@options.overwrite
@options.as_json
@options.quiet
def command(
    map_path: Path,
    map_version: int | None,
    log_path: str,
    seed: int,
    world_seed: int,
    drive: int,
    route: str,
    length: float,
    spacing: float | None,
    rate: float | None,
    frames: int | None,
    rig_name: str | None,
    width: int,
    quality: int,
    traffic: str | None,
    lidar: str | None,
    masks: bool,
    mask_errors: float,
    delay: float,
    specs: tuple[str, ...],
    output: Path,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Drive through the world of MAP and photograph it: a native log with rough poses and
    odometry, the true poses apart in truth/. The images are simulated.

    The same seeds give the same bytes.

    \b
    Example:
      rtmap simulate images --map map --log av2:LOG_DIR --seed 1 -o log
    """  # fmt: skip
    from rtmap_cli.logs.open import folder_of
    from rtmap_cli.maps.store import read_map
    from rtmap_cli.steps.simulate.driving.drive import first_frames
    from rtmap_cli.steps.simulate.driving.drive_source import TOWN, Route, find_source
    from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
    from rtmap_cli.steps.simulate.sensing.senses import Senses
    from rtmap_cli.steps.simulate.worlds.changes import parse_spec
    from rtmap_cli.tables import refuse_existing, refuse_over, whole_folder

    wanted = [parse_spec(text) for text in specs]
    in_town = log_path.startswith(TOWN)
    place = Path(log_path.partition(":")[2] or log_path) if in_town else folder_of(log_path)
    refuse_over(output, map_path, place)
    refuse_existing(output, overwrite)
    vector_map = read_map(map_path, map_version)
    key = DriveKey(world_seed, seed, drive)
    way = Route(route, length, spacing or TOWN_SPACING)
    source = find_source(log_path, map_path, vector_map, key, way)
    for note in source.notes:
        log(f"{source.drive.name}: {note}")
    if in_town:
        path = first_frames(source.drive, None, None, frames or 0)
    else:
        steps = rate if rate or spacing else LOG_RATE
        path = first_frames(source.drive, spacing, steps, frames or 0)
    rig = _rig(source, rig_name, width, log_path)
    world_map, truth = _changed(vector_map, wanted, path, seed)
    said: dict[str, Any] = {
        "command": "rtmap simulate images", "map": str(map_path),
        "map_version": vector_map.version, "log": log_path, "seed": seed,
        "world_seed": world_seed, "drive": drive, "width": width, "quality": quality,
        "rig": rig_name or ("log" if source.rig else "default"), "changes": list(specs),
        "simulated": True,
    }  # fmt: skip
    if in_town:
        said |= {"route": route, "length": length, "spacing": way.spacing}
    senses = Senses(lidar, masks, delay, mask_errors)
    if senses != Senses():
        said |= {"lidar": lidar, "masks": masks, "camera_delay": delay, "mask_errors": mask_errors}
    with whole_folder(output, overwrite) as folder:
        count = _write(
            folder, source, path, rig, key, (vector_map, world_map, truth), traffic, quality,
            said, senses, quiet,
        )  # fmt: skip
    result = {
        "log": str(output), "frames": len(path), "images": count, "cameras": len(rig),
        "changes": [] if truth is None else truth["changes"],
    }  # fmt: skip
    told = f"{output}: {len(path)} frames, {count} images of {len(rig)} cameras"
    told += "".join(f", {n}" for n, given in (("sweeps", lidar), ("masks", masks)) if given)
    emit(result, as_json, [told + "; truth in truth/"])


def _rig(source: Source, name: str | None, width: int, log_path: str) -> Rig:
    """The cameras at the wanted width."""
    from rtmap_cli.errors import BadInput
    from rtmap_cli.logs.log import Rig
    from rtmap_cli.steps.simulate.images.rig import campus_rig, default_rig, scale_camera

    if name == "campus":
        return campus_rig(width, round(width * 0.66), source.ground_z)
    if name != "default" and source.rig is not None:
        for camera in source.rig:
            if camera.model != "pinhole" or len(camera.distortion) != 3 or any(camera.tangential):
                raise BadInput(
                    log_path,
                    f"{camera.name} has a lens that is not simulated (only k1, k2, k3 are)",
                    "pass --rig default",
                )
        return Rig(tuple(scale_camera(c, width) for c in source.rig))
    if name != "default" and source.lanes is None:
        raise BadInput(log_path, "has no calibration", "pass --rig default for a default rig")
    if name == "log":
        raise BadInput(log_path, "a town has no calibration of its own", "leave out --rig log")
    return default_rig(width, round(width * 0.66), ground_z=source.ground_z)


def _changed(
    vector_map: VectorMap, specs: list[Any], path: Drive, seed: int
) -> tuple[VectorMap, dict[str, Any] | None]:
    """The map of the world after --change, and the truth about it."""
    import numpy as np

    from rtmap_cli.steps.simulate.worlds.changes import change_world, truth_json

    if not specs:
        return vector_map, None
    rng = np.random.default_rng([seed, 61])
    world_map, changes = change_world(vector_map, specs, rng, path.pose[:, :2, 3])
    return world_map, truth_json(changes, vector_map.crs)


def _write(
    folder: Path,
    source: Source,
    path: Drive,
    rig: Rig,
    key: DriveKey,
    maps: tuple[VectorMap, VectorMap, dict[str, Any] | None],
    traffic: str | None,
    quality: int,
    said: dict[str, Any],
    senses: Senses,
    quiet: bool,
) -> int:
    """Render every frame into the folder; returns the number of images."""
    from rtmap_cli.logs.native import NativeLogWriter
    from rtmap_cli.steps.simulate.images.drive_images import (
        frames_of,
        images_of,
        on_springs,
        poses_of,
        with_vehicles,
    )
    from rtmap_cli.steps.simulate.sensing.ground_labels import GroundLabels
    from rtmap_cli.steps.simulate.sensing.senses import exposed, label_list, masks_of, sweeps_of
    from rtmap_cli.steps.simulate.worlds.world import world_from_map
    from rtmap_cli.tables import write_json

    vector_map, world_map, truth = maps
    world = world_from_map(world_map, key.world_seed, surface_map=vector_map if truth else None)
    path = on_springs(with_vehicles(path, source, world.surface, key, traffic), source, key)
    name = f"{path.name}-images-w{key.world_seed}-s{key.seed}-d{key.traversal}"
    writer = NativeLogWriter(folder, name, path.crs, rig, source.ground_z, creation=said)
    seen, ground = exposed(path, senses.delay), GroundLabels(world)
    pictures = images_of(world, seen, rig, source, key, quality)
    shown = progress(pictures, "frames", len(path), quiet)
    sweeps = sweeps_of(ground, path, source, key, senses.lidar) if senses.lidar else repeat(None)
    masks = (
        masks_of(ground, seen, rig, source, key, senses.errors) if senses.masks else repeat(None)
    )
    for k, (frame, images) in enumerate(zip(frames_of(path, key), shown, strict=True)):
        times = dict.fromkeys(images, int(seen.timestamp_ns[k]))
        writer.add(frame, images, times, next(sweeps), next(masks))
    if senses.masks:
        write_json(label_list(), folder / "masks" / "labels.json")
    writer.write_truth(poses_of(path), truth)
    writer.close()
    if not path.occluders and traffic != "none" and not quiet:
        log("note: nothing is known of vehicles, none is drawn")
    return len(path) * len(rig)
