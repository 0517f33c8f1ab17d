"""``rtmap simulate degrade``: a map less exact than the world."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options


@click.command("degrade")
@options.map_path
@options.map_version
@click.option(
    "--sigma",
    type=options.FiniteRange(0, min_open=True),
    default=0.15,
    show_default=True,
    help="Standard deviation of the error, metres per axis.",
)
@click.option(
    "--correlation",
    type=options.FiniteRange(0, min_open=True),
    default=12.0,
    show_default=True,
    help="Distance over which errors are alike, metres.",
)
@options.seed
@options.output("The map folder to write.")
@options.overwrite
@options.as_json
def command(
    map_path: Path,
    map_version: int | None,
    sigma: float,
    correlation: float,
    seed: int,
    output: Path,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Displace a map by a smooth random error, as surveys and old versions have it.

    The covariance of every vertex states the error; ids, attributes and heights stay. With
    rtmap simulate changes it makes an outdated prior.

    \b
    Example:
      rtmap simulate degrade --map town --sigma 0.2 --seed 1 -o prior
    """  # fmt: skip
    from rtmap_cli.maps.store import read_map, write_new_map
    from rtmap_cli.output import emit
    from rtmap_cli.steps.simulate.worlds.degrade import degrade_map
    from rtmap_cli.tables import refuse_existing, refuse_over

    refuse_over(output, map_path)
    refuse_existing(output, overwrite)
    exact = read_map(map_path, map_version)
    degraded = degrade_map(exact, sigma, seed, correlation)
    message = f"simulate degrade: sigma {sigma:g} m, seed {seed}"
    write_new_map(degraded, output, message, overwrite)
    result = {"map": str(output), "elements": len(degraded), "sigma_m": sigma, "seed": seed}
    emit(result, as_json, [f"{output}: {len(degraded)} elements, sigma {sigma:g} m"])
