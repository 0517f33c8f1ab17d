"""rtmap export geojson: a map as GeoJSON in WGS84."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options


@click.command("geojson")
@click.argument("map_path", metavar="MAP", type=options.PATH)
@options.output("The GeoJSON file to write; - for stdout.")
@options.map_version
@options.class_names
@options.bbox
@options.lonlat
@options.overwrite
@options.as_json
def command(
    map_path: Path,
    output: Path,
    map_version: int | None,
    class_names: tuple[str, ...],
    bbox: tuple[float, float, float, float] | None,
    lonlat: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write a map, or a part of it, as GeoJSON (RFC 7946: WGS84 longitude, latitude, height).

    One feature a line, with id, class, attributes, sigma_m and the evidence as properties.

    \b
    Example:
      rtmap export geojson map --class divider -o dividers.geojson
    """
    from rtmap_cli.errors import UsageError
    from rtmap_cli.formats.geojson import write_geojson
    from rtmap_cli.maps.select import select
    from rtmap_cli.output import emit
    from rtmap_cli.tables import refuse_existing, refuse_inside

    stream = str(output) == "-"
    if stream and as_json:
        raise UsageError("--json and -o - both want stdout: choose one")
    if not stream:
        refuse_inside(output, map_path)
        refuse_existing(output, overwrite)
    vector_map = select(map_path, map_version, bbox, lonlat, class_names)
    write_geojson(vector_map, output)
    if stream:
        return
    result = {
        "file": str(output),
        "map": str(map_path),
        "version": vector_map.version,
        "elements": len(vector_map),
    }
    line = f"{output}: {len(vector_map)} elements of version {vector_map.version}"
    emit(result, as_json, [line])
