"""rtmap export lanelet2: a map as a Lanelet2 file."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options


@click.command("lanelet2")
@click.argument("map_path", metavar="MAP", type=options.PATH)
@options.output("The .osm file to write.")
@options.map_version
@click.option(
    "--dialect",
    type=click.Choice(["lanelet2", "autoware"]),
    help="autoware: nodes with local_x, local_y (default: as the file that was imported).",
)
@click.option(
    "--origin",
    type=float,
    nargs=2,
    metavar="X Y",
    help="Where local_x = local_y = 0 lies in the map frame (default: as imported, else the MGRS"
    " square).",
)
@options.overwrite
@options.as_json
def command(
    map_path: Path,
    output: Path,
    map_version: int | None,
    dialect: str | None,
    origin: tuple[float, float] | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write a map as Lanelet2 (OSM XML): dividers, borders, crosswalks and what was imported.

    Ways, lanelets, areas and regulatory elements that came from Lanelet2 keep their ids and tags;
    new elements get ids that stay the same in every export.

    \b
    Example:
      rtmap export lanelet2 map -o lanelet2_map.osm
    """
    from rtmap_cli.formats.lanelet2.osm import write_osm
    from rtmap_cli.formats.lanelet2.write import info_of, to_osm
    from rtmap_cli.maps.store import history, read_map
    from rtmap_cli.output import emit, log
    from rtmap_cli.tables import refuse_existing, refuse_inside

    refuse_inside(output, map_path)
    refuse_existing(output, overwrite)
    vector_map = read_map(map_path, map_version)
    info = info_of(history(map_path), map_version)
    if origin is not None:
        info |= {"origin": origin, "local": True}
    osm, notes = to_osm(vector_map, info, dialect)
    for what, count in sorted(notes.items()):
        log(f"{map_path}: {count} {what}")
    write_osm(osm, output)
    counts = {"nodes": len(osm.nodes), "ways": len(osm.ways), "relations": len(osm.relations)}
    result = {"file": str(output), "map": str(map_path), "version": vector_map.version, **counts}
    told = ", ".join(f"{count} {what}" for what, count in counts.items())
    emit(result | {"notes": dict(sorted(notes.items()))}, as_json, [f"{output}: {told}"])
