"""``rtmap simulate observations``: observe a map without a network."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options
from rtmap_cli.output import emit, progress

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rtmap_cli.logs.run import Poses
    from rtmap_cli.maps.element import VectorMap
    from rtmap_cli.steps.simulate.driving.drives import Drive
    from rtmap_cli.steps.simulate.perceiving.perception import DriveKey

LOG_RATE, ROUTE_SPACING = 2.0, 2.5


@click.command("observations")
@options.map_path
@options.map_version
@click.option("--log", "log_path", required=True, help="Log to drive along; av2:LOG_DIR or LOG.")
@click.option(
    "--preset",
    default="rtmap-straight",
    show_default=True,
    help="rtmap-straight, rtmap-turning, mild, perfect, or a .toml file.",
)
@options.seed
@click.option(
    "--world-seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Seed of what stays in place over all drives: worn paint, errors of places.",
)
@click.option(
    "--traversal",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Number of the drive: another one of the same seeds.",
)
@click.option(
    "--prior",
    "prior_path",
    type=options.PATH,
    help="Outdated map: its elements become prior queries.",
)
@click.option(
    "--works",
    type=options.PATH,
    help="Truth file of `simulate changes --works`: its delineators stand in the road.",
)
@click.option(
    "--route",
    type=click.Choice(["straight", "turning"]),
    help="Drive along lanes of the log's vector map instead of its own path.",
)
@click.option(
    "--route-length",
    type=options.FiniteRange(20),
    default=180.0,
    show_default=True,
    help="Length of the route (m).",
)
@click.option(
    "--spacing",
    type=options.FiniteRange(0, min_open=True),
    help="Metres between frames [default: 2.5 on a route].",
)
@click.option(
    "--rate", type=options.FiniteRange(0, min_open=True), help="Frames per second [default: 2]."
)
@click.option(
    "--lateral",
    type=float,
    default=0.0,
    show_default=True,
    help="Drive so many metres to the left of the path.",
)
@click.option(
    "--traffic",
    type=click.Choice(["log", "generated", "none"]),
    help="What hides the road [default: the log's boxes, generated on a route].",
)
@click.option(
    "--truth-poses",
    type=options.PATH,
    help="File for the true poses [default: RUN.truth.parquet beside the run].",
)
@options.output("The run folder to write.")
@options.overwrite
@options.as_json
@options.quiet
def command(
    map_path: Path,
    map_version: int | None,
    log_path: str,
    preset: str,
    seed: int,
    world_seed: int,
    traversal: int,
    prior_path: Path | None,
    works: Path | None,
    route: str | None,
    route_length: float,
    spacing: float | None,
    rate: float | None,
    lateral: float,
    traffic: str | None,
    truth_poses: Path | None,
    output: Path,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Drive through the world of MAP and write the run that a network would give: elements with
    errors, misses and inventions, rough poses, odometry. The numbers are simulated.

    The same seeds give the same bytes. Drives with one --world-seed share what stays in place.

    \b
    Example:
      rtmap simulate observations --map map --log av2:LOG_DIR --preset rtmap-straight \\
          --seed 1 -o runs/one
    """  # fmt: skip
    from rtmap_cli.logs.run import STATES
    from rtmap_cli.logs.run_files import write_run
    from rtmap_cli.maps.crs import check_same_crs
    from rtmap_cli.maps.store import read_map
    from rtmap_cli.steps.simulate.driving.drives import thinned, with_traffic
    from rtmap_cli.steps.simulate.perceiving.observations import observe
    from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
    from rtmap_cli.steps.simulate.perceiving.presets import find_preset
    from rtmap_cli.tables import refuse_existing, refuse_over, whole_folder

    model = find_preset(preset)
    key = DriveKey(world_seed, seed, traversal)
    refuse_over(output, map_path, Path(log_path.partition(":")[2] or log_path))
    refuse_existing(output, overwrite)
    truth_file = truth_poses or output.parent / f"{output.name}.truth.parquet"
    refuse_existing(truth_file, overwrite, "choose another --truth-poses or pass --overwrite")
    world = read_map(map_path, map_version)
    prior = read_map(prior_path) if prior_path is not None else None
    delineators = _delineators(works, world.crs) if works is not None else []
    drive, source = _drive(log_path, route, route_length, spacing, rate, lateral, key)
    for path, vector_map in ((map_path, world), (prior_path, prior)):
        if path is not None and vector_map is not None:
            check_same_crs(vector_map.crs, drive.crs, path)
            _check_in_reach(vector_map, drive, path)
    if route is None:
        drive = thinned(drive, spacing, rate or (None if spacing else LOG_RATE))
    if traffic == "none":
        drive = _without_traffic(drive)
    elif traffic == "generated" or drive.occluders is None:
        drive = with_traffic(drive, model, key)
    label = f"{drive.name}-{Path(preset).stem}-w{world_seed}-s{seed}-t{traversal}"
    made_by = {
        "map": str(map_path), "map_version": world.version,
        "prior": str(prior_path) if prior_path else None,
        "prior_version": prior.version if prior else None,
        "log": log_path, "preset_name": preset, **source, "works": str(works) if works else None,
    }  # fmt: skip
    with whole_folder(output, overwrite) as folder:
        run, truth = observe(
            world, drive, model, key, label, prior,
            progress=lambda frames: progress(frames, "frames", len(drive), quiet),
            made_by=made_by, delineators=delineators,
        )  # fmt: skip
        write_run(run, folder)
        _write_truth(truth, truth_file, run.crs)
    counts = {name: int((run.observations.state == k).sum()) for k, name in enumerate(STATES)}
    result = {
        "run": str(output), "log_id": run.log_id, "truth_poses": str(truth_file),
        "frames": len(run.frames), "observations": counts, "preset": preset,
    }  # fmt: skip
    told = ", ".join(f"{n} {name}" for name, n in counts.items() if n)
    emit(result, as_json, [f"{output}: {len(drive)} frames, {told}; true poses in {truth_file}"])


def _drive(
    log_path: str,
    route: str | None,
    route_length: float,
    spacing: float | None,
    rate: float | None,
    lateral: float,
    key: DriveKey,
) -> tuple[Drive, dict[str, Any]]:
    """The true drive, and what run.json should say about where it comes from."""
    from rtmap_cli.errors import BadInput, UsageError
    from rtmap_cli.formats.av2.vector_map import read_av2_archive
    from rtmap_cli.logs.native import NativeLog
    from rtmap_cli.logs.open import log_format, open_log
    from rtmap_cli.steps.simulate.driving.drives import drive_of_log, drive_over_route
    from rtmap_cli.steps.simulate.driving.routes import lanes_of_av2, route_of

    said = {"route": route, "lateral": lateral, "spacing": spacing, "rate": rate}
    if route is not None:
        kind, folder = log_format(log_path)
        if kind != "av2":
            raise UsageError(f"--route needs the lanes of an Argoverse 2 log, {folder} is not one")
        spacing, rate = spacing or ROUTE_SPACING, rate or LOG_RATE
        archive = read_av2_archive(folder)
        number = key.seed + key.traversal
        line = route_of(lanes_of_av2(archive), route, route_length, key.world_seed, number)
        name = f"{folder.resolve().name}-{route}"
        drive = drive_over_route(name, archive.crs, line, spacing, rate, lateral, key)
        said |= {"route_length": route_length, "spacing": spacing, "rate": rate}
        return drive, said
    if spacing is not None and rate is not None:
        raise UsageError("--spacing and --rate exclude each other without --route")
    log = open_log(log_path)
    truth = None
    if isinstance(log, NativeLog):
        truth = log.truth_poses()
        if truth is None:
            raise BadInput(log_path, "has no true poses", "use a simulated or an Argoverse 2 log")
    return drive_of_log(log, truth, lateral), said


def _delineators(path: Path, crs: str) -> list[NDArray[np.float64]]:
    """The rows of posts (n, 2) of a truth file, in the map frame; BadInput when it has none."""
    import numpy as np

    from rtmap_cli.errors import BadInput
    from rtmap_cli.maps.crs import lonlat_to
    from rtmap_cli.tables import read_json

    told = read_json(path)
    rows = told.get("delineators") if isinstance(told, dict) else None
    if not isinstance(rows, list) or not rows:
        raise BadInput(path, "names no delineators", "write it with `simulate changes --works`")
    out = []
    for row in rows:
        try:
            lonlat = np.asarray(row, np.float64)
        except (TypeError, ValueError):
            lonlat = np.zeros(0)
        if lonlat.ndim != 2 or lonlat.shape[1] != 2 or not np.isfinite(lonlat).all():
            raise BadInput(path, "its delineators are no lists of longitude and latitude")
        out.append(lonlat_to(crs, lonlat))
    return out


def _without_traffic(drive: Drive) -> Drive:
    from dataclasses import replace

    return replace(drive, occluders=[()] * len(drive))


def _check_in_reach(vector_map: VectorMap, drive: Drive, path: Path) -> None:
    """BadInput when the map lies nowhere near the drive."""
    from rtmap_cli.errors import BadInput

    x0, y0, x1, y1 = vector_map.bounds()
    xy = drive.pose[:, :2, 3]
    near = (xy > [x0 - 40, y0 - 40]) & (xy < [x1 + 40, y1 + 40])
    if not near.all(axis=1).any():
        place = ", ".join(f"{v:.0f}" for v in xy[0])
        raise BadInput(
            path, f"lies out of range of the drive (which starts at {place})", "use its own map"
        )


def _write_truth(truth: Poses, path: Path, crs: str) -> None:
    """The true poses as one file (rtmap.run.poses), whole or not at all."""
    from tempfile import TemporaryDirectory

    from rtmap_cli.logs.run_files import write_poses

    path.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        write_poses(truth, Path(folder), crs)
        (Path(folder) / "poses.parquet").replace(path)
