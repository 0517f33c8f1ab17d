"""``rtmap simulate lidar``: drive with a spinning LiDAR into a native log."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options
from rtmap_cli.output import emit, progress

LOG_RATE, TOWN_SPACING = 5.0, 2.0
POSITIVE = options.FiniteRange(0, min_open=True)


@click.command("lidar")
@options.map_path
@options.map_version
@options.drive_path
@options.seed
@click.option(
    "--world-seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Seed of what stays in place over all drives: houses, walls, the corridor.",
)
@click.option(
    "--drive", type=click.IntRange(0), default=0, show_default=True, help="Number of the drive."
)
@click.option(
    "--route",
    type=click.Choice(["straight", "turning", "tour"]),
    default="tour",
    show_default=True,
    help="Kind of a drive through a town; a tour comes back to places that it knows.",
)
@options.town_length(400.0)
@click.option("--spacing", type=POSITIVE, help="Metres between sweeps [default: 2 in a town].")
@click.option("--rate", type=POSITIVE, help="Sweeps per second of a log [default: 5].")
@click.option("--frames", type=click.IntRange(1), help="At most so many frames [default: all].")
@click.option(
    "--lidar",
    type=click.Choice(["vlp16", "hdl32", "os64", "hdl64"]),
    default="vlp16",
    show_default=True,
    help="What turns on the roof.",
)
@click.option(
    "--gnss",
    type=click.Choice(["metre", "rtk"]),
    default="metre",
    show_default=True,
    help="How well the vehicle knows its place: to about 0.9 m, or to 4 cm.",
)
@click.option(
    "--gnss-jumps",
    "jumps",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Stretches of 20 s where GNSS is 5 to 30 m off.",
)
@click.option(
    "--curb",
    type=options.FiniteRange(0, 0.5),
    default=0.12,
    show_default=True,
    help="Height of the curbs (m).",
)
@click.option("--still", is_flag=True, help="The vehicle stands still while the LiDAR turns.")
@options.traffic
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
    lidar: str,
    gnss: str,
    jumps: int,
    curb: float,
    still: bool,
    traffic: str | None,
    output: Path,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Drive through the world of MAP with a spinning LiDAR: a native log of sweeps with the time
    of every point, rough poses and odometry, the true poses apart in truth/. It is all simulated.

    The same seeds give the same bytes.

    \b
    Example:
      rtmap simulate lidar --map town --log town: --route tour --length 400 -o log
    """  # fmt: skip
    from rtmap_cli.logs.native import NativeLogWriter
    from rtmap_cli.logs.open import folder_of
    from rtmap_cli.maps.store import read_map
    from rtmap_cli.steps.simulate.driving.drive import first_frames
    from rtmap_cli.steps.simulate.driving.drive_source import TOWN, Route, find_source
    from rtmap_cli.steps.simulate.images.drive_images import poses_of, with_vehicles
    from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
    from rtmap_cli.steps.simulate.sensing.ground_labels import GroundLabels
    from rtmap_cli.steps.simulate.sensing.lidar_drive import (
        Recording,
        frames_of_drive,
        steady,
        sweeps_of_drive,
        with_walls,
    )
    from rtmap_cli.steps.simulate.worlds.world import world_from_map
    from rtmap_cli.tables import refuse_existing, refuse_over, whole_folder

    in_town = log_path.startswith(TOWN)
    place = Path(log_path.partition(":")[2] or log_path) if in_town else folder_of(log_path)
    refuse_over(output, map_path, place)
    refuse_existing(output, overwrite)
    vector_map = read_map(map_path, map_version)
    key = DriveKey(world_seed, seed, drive)
    way = Route(route, length, spacing or TOWN_SPACING)
    source = find_source(log_path, map_path, vector_map, key, way)
    steps = None if in_town or spacing else rate or LOG_RATE
    path = first_frames(source.drive, None if in_town else spacing, steps, frames or 0)
    recording = Recording(lidar, gnss, jumps, curb, not still)
    world = with_walls(world_from_map(vector_map, world_seed), world_seed)
    path = steady(with_vehicles(path, source, world.surface, key, traffic), source, key)
    said = {
        "command": "rtmap simulate lidar", "map": str(map_path),
        "map_version": vector_map.version, "log": log_path, "seed": seed,
        "world_seed": world_seed, "drive": drive, "route": route, "length": length,
        "spacing": way.spacing, "lidar": lidar, "gnss": gnss, "gnss_jumps": jumps, "curb": curb,
        "still": still, "simulated": True,
    }  # fmt: skip
    points = 0
    with whole_folder(output, overwrite) as folder:
        name = f"{path.name}-{lidar}-w{world_seed}-s{seed}-d{drive}"
        writer = NativeLogWriter(folder, name, path.crs, None, source.ground_z, creation=said)
        sweeps = sweeps_of_drive(GroundLabels(world), path, source, key, recording)
        shown = progress(sweeps, "sweeps", len(path), quiet)
        for frame, points_seen in zip(frames_of_drive(path, key, recording), shown, strict=True):
            writer.add(frame, {}, sweep=points_seen)
            points += len(points_seen)
        writer.write_truth(poses_of(path))
        writer.close()
    result = {"log": str(output), "frames": len(path), "points": points, "lidar": lidar}
    told = f"{output}: {len(path)} sweeps of a {lidar}, {points:,} points; truth in truth/"
    emit(result, as_json, [told])
