"""rtmap import av2: the vector map of an Argoverse 2 log becomes a map."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options


@click.command("av2")
@click.argument("log_dir", type=options.PATH)
@options.output("The map folder to write.")
@click.option("--city", help="ATX, DTW, MIA, PAO, PIT or WDC, where no file names it.")
@options.overwrite
@options.as_json
def command(log_dir: Path, output: Path, city: str | None, overwrite: bool, as_json: bool) -> None:
    """Turn the vector map of an Argoverse 2 sensor log or forecasting scenario into a map.

    LOG_DIR is the folder as it lies on disk. Crossings become ped_crossing, painted lane
    boundaries divider (shared ones once, joined), the outline of the drivable areas boundary. The
    map frame is the UTM zone of the city. What is odd in the file is counted on stderr.

    \b
    Example:
      rtmap import av2 av2/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede -o map
    """
    from rtmap_cli.errors import BadInput
    from rtmap_cli.formats.av2.vector_map import read_av2_archive, vector_map_of
    from rtmap_cli.maps.element import CLASSES
    from rtmap_cli.maps.store import write_new_map
    from rtmap_cli.output import emit, log
    from rtmap_cli.tables import refuse_existing

    refuse_existing(output, overwrite)
    archive = read_av2_archive(log_dir, city)
    vector_map = vector_map_of(archive)
    if not len(vector_map):
        raise BadInput(archive.path, "holds no crossing, painted line or drivable area")
    for what, count in sorted(archive.notes.items()):
        if count:
            log(f"{archive.path.name}: {count} {what}")
    if archive.ground is None:
        log(f"{log_dir}: no ground-height raster (unknown heights stay unknown)")
    write_new_map(
        vector_map,
        output,
        f"imported {archive.path.name}",
        overwrite,
        info={"source": archive.path.name, "source_format": "Argoverse 2", "city": archive.city},
    )
    counts = {name: len(vector_map.of_class(name)) for name in CLASSES}
    result = {
        "map": str(output),
        "version": 0,
        "crs": vector_map.crs,
        "city": archive.city,
        "elements": counts,
        "notes": {what: count for what, count in sorted(archive.notes.items()) if count},
    }
    told = ", ".join(f"{count} {name}" for name, count in counts.items())
    emit(result, as_json, [f"{output}: version 0, {vector_map.crs} ({archive.city}), {told}"])
