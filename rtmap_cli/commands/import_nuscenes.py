"""rtmap import nuscenes: the map expansion of nuScenes becomes a map."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options


@click.command("nuscenes")
@click.argument("folder", metavar="DIR", type=options.PATH)
@options.output("The map folder to write.")
@click.option("--location", help="Which map, e.g. singapore-onenorth (default: the only one).")
@options.overwrite
@options.as_json
def command(
    folder: Path, output: Path, location: str | None, overwrite: bool, as_json: bool
) -> None:
    """Turn a vector map of nuScenes (map expansion) into a map.

    DIR holds maps/expansion/<location>.json. Crossings that touch become one ped_crossing, lane
    and road dividers divider, the outline of road segments and lanes boundary. Coordinates stay
    those of nuScenes. What is odd in the file is counted on stderr.

    \b
    Example:
      rtmap import nuscenes /data/nuscenes --location singapore-onenorth -o map
    """
    from rtmap_cli.errors import BadInput
    from rtmap_cli.formats.nuscenes.vector_map import read_expansion, vector_map_of
    from rtmap_cli.maps.crs import check_map_crs
    from rtmap_cli.maps.element import CLASSES
    from rtmap_cli.maps.store import write_new_map
    from rtmap_cli.output import emit, log
    from rtmap_cli.tables import refuse_existing, refuse_over

    refuse_over(output, folder)
    refuse_existing(output, overwrite)
    source = read_expansion(folder, location)
    check_map_crs(source.crs, source.path)
    vector_map = vector_map_of(source)
    if not len(vector_map):
        raise BadInput(source.path, "holds no crossing, divider or road")
    notes = {what: count for what, count in sorted(source.notes.items()) if count}
    for what, count in notes.items():
        log(f"{source.path.name}: {count} {what}")
    write_new_map(
        vector_map,
        output,
        f"imported {source.path.name}",
        overwrite,
        info={
            "source": source.path.name,
            "source_format": "nuScenes map expansion",
            "location": source.location,
        },
    )
    counts = {name: len(vector_map.of_class(name)) for name in CLASSES}
    result = {
        "map": str(output),
        "version": 0,
        "crs": vector_map.crs,
        "location": source.location,
        "elements": counts,
        "notes": notes,
    }
    told = ", ".join(f"{count} {name}" for name, count in counts.items())
    emit(result, as_json, [f"{output}: version 0, {source.location}, {told}"])
