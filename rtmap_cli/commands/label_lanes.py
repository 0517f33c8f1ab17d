"""rtmap label lanes: drives become a map of lanelets."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options


@click.command("lanes")
@click.argument("sources", metavar="SOURCE...", nargs=-1, required=True, type=options.PATH)
@options.output("The map folder to write.")
@click.option(
    "--width",
    type=options.FiniteRange(0.5, 20),
    default=3.048,
    show_default=True,
    help="Metres from the centre line to each side (10 ft).",
)
@click.option(
    "--widths",
    "widths_path",
    type=options.PATH,
    help="CSV x,y,radius,left,right (map frame, metres): other widths near places.",
)
@click.option(
    "--snap",
    multiple=True,
    type=options.PATH,
    help="Draw borders to the paint and curbs of a cloud, or of a run's observations (repeatable).",
)
@click.option(
    "--bound",
    type=options.FiniteRange(0, min_open=True),
    default=1.9,
    show_default=True,
    help="Metres by which --snap moves a border at most.",
)
@click.option(
    "--speed-limit",
    "limit",
    type=options.FiniteRange(0, min_open=True),
    help="km/h of every lanelet (default: what was driven there, rounded up to tens).",
)
@click.option(
    "--longest",
    type=options.FiniteRange(10),
    default=100.0,
    show_default=True,
    help="Metres of a lanelet at most.",
)
@click.option("--centrelines", type=options.PATH, help="Also write the lane graph as GeoJSON.")
@options.overwrite
@options.as_json
def command(
    sources: tuple[Path, ...],
    output: Path,
    width: float,
    widths_path: Path | None,
    snap: tuple[Path, ...],
    bound: float,
    limit: float | None,
    longest: float,
    centrelines: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Make lanes of drives: clouds (rtmap label cloud), runs or logs, all in one CRS.

    Stops and reversing are left out, drives are cut where their positions jump. What was driven
    several times becomes one lane; lanes fork and merge where drives part and meet. The result is
    a map of lanelets that rtmap export lanelet2 writes.

    \b
    Example:
      rtmap label lanes cloud --snap cloud -o first_map
    """
    from rtmap_cli.maps.store import write_new_map
    from rtmap_cli.output import emit, log
    from rtmap_cli.steps.label.lanes.borders import Widths, read_widths
    from rtmap_cli.steps.label.lanes.lanes import LaneOptions, label_lanes
    from rtmap_cli.steps.label.lanes.write import centrelines as as_geojson
    from rtmap_cli.tables import refuse_existing, refuse_inside, refuse_over, write_json

    refuse_over(output, *sources, *snap)
    refuse_existing(output, overwrite)
    if centrelines is not None:
        refuse_inside(centrelines, *sources, *snap, output)
        refuse_existing(centrelines, overwrite)
    widths = Widths(width) if widths_path is None else read_widths(widths_path, width)
    made = label_lanes(sources, LaneOptions(widths, snap, bound, limit, longest))
    for what, count in sorted(made.notes.items()):
        log(f"{count} {what} left out" if "poses" in what else f"{count} {what}: drives cut there")
    vector_map, info = made.lanelets.vector_map, made.lanelets.info
    told = [str(s) for s in sources]
    write_new_map(
        vector_map,
        output,
        f"lanes of {len(told)} drive{'s' * (len(told) > 1)}",
        overwrite,
        info={"lanelet2": info, "sources": told, "figures": made.figures},
    )
    if centrelines is not None:
        write_json(as_geojson(made.graph, vector_map.crs, limit), centrelines)
    f = made.figures
    lines = [
        f"{output}: {f['lanelets']} lanelets, {f['lanes_m']:.0f} m of lanes from "
        f"{f['driven_m']:.0f} m driven, {f['forks']} forks, {f['merges']} merges",
        "vertices of borders: " + ", ".join(f"{n} {k}" for k, n in f["vertices"].items()),
    ]
    emit(
        {"map": str(output), "crs": vector_map.crs, **f, "notes": dict(made.notes)}, as_json, lines
    )
