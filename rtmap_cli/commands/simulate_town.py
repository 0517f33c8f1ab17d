"""``rtmap simulate town``: a procedural town becomes a map."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options
from rtmap_cli.output import emit


@click.command("town")
@options.seed
@click.option(
    "--size",
    type=options.FiniteRange(120, 2000),
    default=420.0,
    show_default=True,
    help="Width of the town (m).",
)
@click.option(
    "--style",
    type=click.Choice(["mixed", "city", "campus"]),
    default="mixed",
    show_default=True,
    help="How streets are built and painted: city has wide lanes, campus narrow ones.",
)
@options.output("The map folder to write.")
@options.overwrite
@options.as_json
def command(
    seed: int, size: float, style: str, output: Path, overwrite: bool, as_json: bool
) -> None:
    """Make a town: curved streets, junctions, a roundabout, crossings, islands. It is invented.

    The map's history records seed and size, from which ``--log town:`` of simulate images makes
    the lanes again.

    \b
    Example:
      rtmap simulate town --seed 4 -o town
    """
    from rtmap_cli.maps.element import CLASSES
    from rtmap_cli.maps.store import write_new_map
    from rtmap_cli.steps.simulate.towns.town import make_town

    town = make_town(seed, size, style=style)
    made = {"seed": seed, "size": size} | ({} if style == "mixed" else {"style": style})
    kind = "town" if style == "mixed" else f"town ({style})"
    message = f"simulated {kind}, seed {seed}, {size:g} m"
    write_new_map(town.vector_map, output, message, overwrite, info={"town": made})
    counts = {name: len(town.vector_map.of_class(name)) for name in CLASSES}
    result = {"map": str(output), "seed": seed, "size_m": size, "crs": town.vector_map.crs}
    told = ", ".join(f"{n} {name}" for name, n in counts.items())
    emit(result | {"elements": counts}, as_json, [f"{output}: {told}"])
