"""rtmap import geojson: a GeoJSON file becomes a map."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options


@click.command("geojson")
@click.argument("file", type=options.PATH)
@options.crs
@options.output("The map folder to write.")
@options.overwrite
@options.as_json
def command(file: Path, crs: str | None, output: Path, overwrite: bool, as_json: bool) -> None:
    """Turn a GeoJSON file (RFC 7946: WGS84 longitude, latitude) into a map.

    FILE (- for stdin) holds lines and polygons with the property `class`, and if known `id`,
    `sigma_m` (a standard deviation per vertex, metres) and anything else, which is kept as
    attributes. Without --crs the UTM zone of the data's centre is taken, and named on stderr.

    \b
    Example:
      rtmap import geojson prior.geojson --crs EPSG:32617 -o map
    """
    from rtmap_cli.formats.geojson import read_geojson
    from rtmap_cli.maps.element import CLASSES
    from rtmap_cli.maps.store import write_new_map
    from rtmap_cli.output import emit, log
    from rtmap_cli.tables import refuse_existing

    refuse_existing(output, overwrite)
    vector_map = read_geojson(file, crs)
    if crs is None:
        log(f"{file}: no --crs given, the map is in {vector_map.crs}")
    names = dict.fromkeys(e.class_name for e in vector_map)
    unknown = [name for name in names if name not in CLASSES]
    if unknown:
        log(f"{file}: kept classes that the default models do not know: {', '.join(unknown)}")
    write_new_map(vector_map, output, f"import geojson {Path(file).name}", overwrite)
    counts = {name: len(vector_map.of_class(name)) for name in names}
    result = {
        "map": str(output),
        "version": 0,
        "crs": vector_map.crs,
        "elements": len(vector_map),
        "classes": counts,
    }
    told = ", ".join(f"{n} {name}" for name, n in counts.items())
    emit(result, as_json, [f"{output}: version 0, {vector_map.crs}, {told or 'no elements'}"])
