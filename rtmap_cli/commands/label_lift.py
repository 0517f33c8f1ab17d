"""``rtmap label lift``: the vertices of a map get the height of the ground."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options
from rtmap_cli.output import emit


@click.command("lift")
@click.argument("map_path", metavar="MAP", type=options.PATH)
@click.option("--cloud", type=options.PATH, required=True, help="The cloud folder.")
@options.map_version
@click.option(
    "-o",
    "--output",
    type=options.PATH,
    help="Write a new map there [default: the next version of MAP].",
)
@click.option("--message", help="Message of the version.")
@options.overwrite
@options.as_json
def command(
    map_path: Path,
    cloud: Path,
    map_version: int | None,
    output: Path | None,
    message: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Give every vertex of MAP the height of the ground under it, from the point cloud of a drive,
    with its variance. Where the cloud does not tell, the height is unknown.

    \b
    Example:
      rtmap label lift map --cloud cloud
    """
    import numpy as np

    from rtmap_cli.errors import BadInput, NoAnswer, UsageError
    from rtmap_cli.logs.cloud import CloudFolder
    from rtmap_cli.maps.crs import check_same_crs
    from rtmap_cli.maps.element import VectorMap
    from rtmap_cli.maps.store import commit_map, read_map, write_new_map
    from rtmap_cli.steps.label.lift.lift import lift
    from rtmap_cli.tables import refuse_existing, refuse_over

    if output is None and overwrite:
        raise UsageError("--overwrite is for -o OUTPUT")
    if output is not None:
        refuse_over(output, map_path, cloud)
        refuse_existing(output, overwrite)
    found = CloudFolder(cloud)
    vector_map = read_map(map_path, map_version)
    check_same_crs(found.crs, vector_map.crs, cloud)
    if not len(vector_map):
        raise BadInput(map_path, "holds no element")
    elements, lifted = lift(vector_map.elements, found)
    count = int(np.isfinite(lifted.z).sum())
    if not count:
        raise NoAnswer(f"{cloud} tells the ground at none of the {len(lifted.z)} vertices")
    new = VectorMap(elements, vector_map.crs)
    text = message or f"heights from {cloud.name}"
    info = {"lift": {"cloud": str(found.info.get("log")), "vertices": count}}
    if output is not None:
        write_new_map(new, output, text, overwrite, info=info)
        version = 0
    else:
        version = commit_map(map_path, new, int(vector_map.version or 0), text, info=info)
    sigma = float(np.nanmedian(lifted.sigma))
    result = {
        "map": str(output or map_path), "version": version, "vertices": len(lifted.z),
        "lifted": count, "unknown": len(lifted.z) - count, "sigma_m": sigma,
    }  # fmt: skip
    told = f"{result['map']}: version {version}, {count:,} of {len(lifted.z):,} vertices lifted"
    emit(result, as_json, [f"{told}, median sigma {sigma:.3f} m"])
