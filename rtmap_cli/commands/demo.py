"""``rtmap demo``: the whole chain on a simulated town, cycle by cycle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from rtmap_cli import options


@click.command("demo")
@click.option(
    "-o",
    "--output",
    type=options.PATH,
    default=Path("demo_out"),
    show_default=True,
    help="The folder to write.",
)
@click.option(
    "--cycles",
    type=click.IntRange(1, 10),
    default=3,
    show_default=True,
    help="Drives, one per cycle.",
)
@click.option(
    "--frames",
    type=click.IntRange(8),
    default=64,
    show_default=True,
    help="Frames per drive, 2.5 m apart.",
)
@click.option("--model", default="rtmap-tiny", show_default=True, help="Zoo name or .onnx file.")
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=2016,
    show_default=True,
    help="Seed of town and drives.",
)
@options.overwrite
@options.as_json
def command(
    output: Path,
    cycles: int,
    frames: int,
    model: str,
    seed: int,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Simulate a town, give it an outdated map, drive, and bring the map up to date.

    Every cycle is one drive through the verbs that a user would call: simulate images, infer,
    localize, detect-changes, crowdsource, evaluate. Prints a table per cycle and writes the map,
    the changes and a picture. Towns and images are simulated.

    \b
    Example:
      rtmap demo -o demo_out --overwrite
    """  # fmt: skip
    import shutil

    from rtmap_cli.demo import run_demo
    from rtmap_cli.errors import BadInput
    from rtmap_cli.output import emit, log
    from rtmap_cli.tables import refuse_existing, write_json

    # The folder is written in place: the runs in it name the files that they came from.
    marker = output / "demo.json"
    refuse_existing(output, overwrite)
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        if not marker.exists():
            raise BadInput(output, "was not written by rtmap demo", "choose another output")
        shutil.rmtree(output)
    settings = {"cycles": cycles, "frames": frames, "model": model, "seed": seed}
    write_json(settings, marker)
    result, lines = run_demo(output, cycles, frames, model, seed, log)
    write_json(settings | result, marker)
    written: dict[str, Any] = {
        "map": str(output / "map"),
        "changes": str(output / "changes.geojson"),
        "picture": str(output / "demo.png"),
    }
    lines += ["", *(f"{name}: {path}" for name, path in written.items())]
    emit(result | written, as_json, lines)
