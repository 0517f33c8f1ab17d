"""``rtmap label cloud``: the sweeps of a log become a trajectory and a point cloud."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from rtmap_cli import options
from rtmap_cli.output import emit, log, progress


@click.command("cloud")
@click.argument("log_path", metavar="LOG")
@click.option(
    "--method",
    type=click.Choice(["vgicp", "gicp", "ndt"]),
    default="vgicp",
    show_default=True,
    help="Scan matching: small_gicp's voxelised GICP, its GICP, or NDT (needs no extra).",
)
@click.option(
    "--voxel",
    type=options.FiniteRange(0.02, 2),
    default=0.1,
    show_default=True,
    help="Size of a voxel of the map (m).",
)
@click.option(
    "--leaf",
    type=options.FiniteRange(0.05, 3),
    help="Sweeps are thinned to cells of this size to match them (m) [default: by the first].",
)
@click.option(
    "--range",
    "reach",
    type=options.FiniteRange(5, 120),
    default=60.0,
    show_default=True,
    help="Points farther away stay out of the map (m).",
)
@click.option("--no-gnss", is_flag=True, help="Start at the log's first pose, use no other.")
@click.option("--no-odometry", is_flag=True, help="Expect the last motion to go on.")
@click.option("--no-loops", is_flag=True, help="Close no loops.")
@click.option("--laz", is_flag=True, help="cloud.laz as well (extra: label).")
@click.option("--ply", is_flag=True, help="cloud.ply as well.")
@options.output("The cloud folder to write.")
@options.overwrite
@options.as_json
@options.quiet
def command(
    log_path: str,
    method: str,
    voxel: float,
    leaf: float | None,
    reach: float,
    no_gnss: bool,
    no_odometry: bool,
    no_loops: bool,
    laz: bool,
    ply: bool,
    output: Path,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Register the LiDAR sweeps of LOG: motion within a turn taken out, matched with a local map,
    loops closed, laid over GNSS. OUT holds the trajectory with covariances and the dense map.

    LOG may be a plain folder of .bin, .ply or .pcd files: sweeps:DIR (docs/label.md).

    \b
    Example:
      rtmap label cloud logs/monday -o cloud
      rtmap label cloud sweeps:velodyne --method ndt --ply -o cloud
    """  # fmt: skip
    from rtmap_cli.logs.cloud import CloudFolder
    from rtmap_cli.logs.open import folder_of, open_log
    from rtmap_cli.steps.label.cloud.build import Builder
    from rtmap_cli.steps.label.cloud.exports import write_laz_of, write_overview, write_ply_of
    from rtmap_cli.steps.label.cloud.track import Settings
    from rtmap_cli.tables import refuse_existing, refuse_over, whole_folder

    refuse_over(output, folder_of(log_path))
    refuse_existing(output, overwrite)
    settings = Settings(method, voxel, leaf, not no_gnss, not no_odometry, not no_loops, reach)
    builder = Builder(open_log(log_path), settings)

    def shown(items: Iterator[Any], what: str, total: int) -> Iterator[Any]:
        return progress(items, what, total, quiet)

    with whole_folder(output, overwrite) as folder:
        result = builder.write(folder, shown)
        cloud = CloudFolder(folder)
        write_overview(cloud, folder / "overview.png")
        if laz:
            write_laz_of(cloud, folder / "cloud.laz")
        if ply:
            write_ply_of(cloud, folder / "cloud.ply")
    for note in result["notes"]:
        log(f"note: {note}")
    lines = [
        f"{output}: {result['frames']} sweeps over {result['length_m']:.0f} m, "
        f"{result['keyframes']} keyframes, {result['loops']} loops, {result['voxels']:,} voxels",
        f"picture: {output / 'overview.png'}",
    ]
    emit({"cloud": str(output), **result}, as_json, lines)
