"""``rtmap semantic-map``: masks and LiDAR of a log become a semantic raster of the ground."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from rtmap_cli import options
from rtmap_cli.output import emit, log, progress

POSITIVE = options.FiniteRange(0, min_open=True)


@click.command("semantic-map")
@click.argument("log_path", metavar="LOG")
@click.option(
    "--masks",
    type=options.PATH,
    help="Folder of label PNGs: CAMERA/FRAME.png and labels.json [default: LOG/masks].",
)
@click.option("--segmenter", type=options.PATH, help="A segmentation network (ONNX) instead.")
@click.option("--labels", type=options.PATH, help="Label list [default: labels.json of the masks].")
@click.option("--confusion", type=options.PATH, help="Confusion matrix of the masks (JSON).")
@click.option(
    "--poses",
    type=options.PATH,
    help="Poses to lay frames down with: a run, or a poses.parquet [default: the log's, smoothed].",
)
@click.option(
    "--cell",
    type=options.FiniteRange(0.05, 5),
    default=0.2,
    show_default=True,
    help="Size of a cell (m).",
)
@click.option(
    "--window",
    type=options.FiniteRange(2, 200),
    nargs=2,
    default=(36.0, 18.0),
    show_default=True,
    metavar="X Y",
    help="Half length and half width of the ego window (m).",
)
@click.option(
    "--windows",
    type=click.Choice(["past", "all", "none"]),
    default="past",
    show_default=True,
    help="Each window from what was seen up to its frame, or in the whole drive.",
)
@click.option(
    "--range",
    "reach",
    type=options.FiniteRange(2, 150),
    default=40.0,
    show_default=True,
    help="Points farther away are left out (m).",
)
@click.option(
    "--distance-scale",
    "distance",
    type=POSITIVE,
    default=20.0,
    show_default=True,
    help="A point at this distance weighs half (m).",
)
@click.option(
    "--intensity-weight",
    "intensity",
    type=options.FiniteRange(0, 1),
    default=0.5,
    show_default=True,
    help="How much the LiDAR's intensity says about paint.",
)
@click.option(
    "--max-delay",
    type=POSITIVE,
    default=0.2,
    show_default=True,
    help="LiDAR and cameras may be so far apart (s).",
)
@click.option("--ground-plane", is_flag=True, help="Use the plane under the vehicle, no LiDAR.")
@options.threads
@options.output("The semantic map folder to write.")
@options.overwrite
@options.as_json
@options.quiet
def command(
    log_path: str,
    window: tuple[float, float],
    output: Path,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
    **chosen: Any,
) -> None:
    """Lay the classes that masks give to LiDAR points into a raster of the ground: road,
    crosswalk, marking, curb, sidewalk, terrain, with a probability each.

    OUT holds an ego window per frame for networks, cells.parquet, and pictures with world files.

    \b
    Example:
      rtmap semantic-map logs/monday -o semantic/monday
      rtmap semantic-map logs/monday -o logs/monday/semantic
      rtmap semantic-map logs/monday --segmenter seg.onnx --labels mapillary.json -o semantic/monday
    """  # fmt: skip
    from rtmap_cli.errors import UsageError
    from rtmap_cli.logs.open import folder_of, open_log
    from rtmap_cli.steps.semantic.semantic_map import Builder, Settings
    from rtmap_cli.tables import refuse_existing, refuse_over, whole_folder

    if chosen["masks"] and chosen["segmenter"]:
        raise UsageError("--masks and --segmenter: give one of them")
    log_folder = folder_of(log_path)
    # A log may carry its rasters; it is not touched otherwise.
    carried = output.resolve() == (log_folder / "semantic").resolve()
    given = [] if carried else [log_folder]
    given += [p for k in ("masks", "segmenter", "poses") if (p := chosen[k]) is not None]
    refuse_over(output, *given)
    refuse_existing(output, overwrite)
    settings = Settings(half_x=window[0], half_y=window[1], **chosen)
    builder = Builder(open_log(log_path), settings)
    with whole_folder(output, overwrite) as folder:
        result = builder.write(folder, lambda k, n: progress(k, "frames", n, quiet))
    for note in result["notes"]:
        if not quiet:
            log(f"note: {note}")
    seen = ", ".join(f"{n} {v:,}" for n, v in result["points"].items() if v)
    lines = [
        f"{output}: {result['windows']} windows, {result['cells']:,} cells, "
        f"{result['tiles']} tiles",
        f"points from the {result['points_from']}: {seen}",
        f"picture: {output / 'overview.png'}",
    ]
    emit({"semantic": str(output), **result}, as_json, lines)
