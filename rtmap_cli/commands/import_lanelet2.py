"""rtmap import lanelet2: a Lanelet2 map becomes a map."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options


@click.command("lanelet2")
@click.argument("file", type=options.PATH)
@options.crs
@click.option(
    "--origin",
    type=float,
    nargs=2,
    metavar="X Y",
    help="Where local_x = local_y = 0 lies in --crs, for files without latitude and longitude.",
)
@click.option(
    "--untyped",
    type=click.Choice(["keep", "divider", "boundary", "by-place"]),
    default="keep",
    show_default=True,
    help="What the bounds of lanelets are that have no type.",
)
@click.option(
    "--join/--no-join",
    default=True,
    show_default=True,
    help="Join dividers and boundaries end to end, or make each way an element.",
)
@options.output("The map folder to write.")
@options.overwrite
@options.as_json
def command(
    file: Path,
    crs: str | None,
    origin: tuple[float, float] | None,
    untyped: str,
    join: bool,
    output: Path,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Turn a Lanelet2 map (OSM XML, as Lanelet2, JOSM and Autoware write it) into a map.

    Painted lines become divider, road borders and curbs boundary, crosswalks ped_crossing. Other
    lines, lanelets, areas and regulatory elements are kept, so that rtmap export lanelet2 writes
    them again under their ids. Without --crs the UTM zone of the data's centre is taken.

    \b
    Example:
      rtmap import lanelet2 lanelet2_map.osm -o map
    """
    from rtmap_cli.formats.lanelet2.read import read_lanelet2
    from rtmap_cli.maps.store import write_new_map
    from rtmap_cli.output import emit, log
    from rtmap_cli.tables import refuse_existing, refuse_over

    refuse_existing(output, overwrite)
    refuse_over(output, file)
    found = read_lanelet2(file, crs, origin, untyped, join)
    for what, count in sorted(found.notes.items()):
        log(f"{file.name}: {count} {what}")
    if crs is None:
        log(f"{file.name}: no --crs given, the map is in {found.frame.crs}")
    info = {"source": file.name, "source_format": "Lanelet2", "lanelet2": found.info}
    vector_map = found.vector_map
    write_new_map(vector_map, output, f"imported {file.name}", overwrite, info=info)
    names = sorted({e.class_name for e in vector_map})
    counts = {name: len(vector_map.of_class(name)) for name in names}
    result = {
        "map": str(output),
        "version": 0,
        "crs": vector_map.crs,
        "origin": found.frame.origin,
        "elements": counts,
        "notes": dict(sorted(found.notes.items())),
    }
    told = ", ".join(f"{count} {name}" for name, count in counts.items())
    emit(result, as_json, [f"{output}: version 0, {vector_map.crs}, {told}"])
