"""``rtmap simulate changes``: change a map, with a truth file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from rtmap_cli import options
from rtmap_cli.output import emit


@click.command("changes")
@options.map_path
@options.map_version
@click.option(
    "--change", "specs", multiple=True,
    help="KIND:CLASS or KIND:CLASS*COUNT; delete, insert, move (divider). Repeat it.",
)  # fmt: skip
@click.option(
    "--works", type=options.FiniteRange(16, 500), metavar="METRES",
    help="A construction zone of so many metres beside the drive of --near.",
)  # fmt: skip
@click.option("--near", multiple=True,
              help="Only near this drive: av2:LOG_DIR, LOG, town:. Repeat: near all.")  # fmt: skip
@click.option("--drive", type=click.IntRange(0), default=0, show_default=True,
              help="Number of the drive through the town.")  # fmt: skip
@click.option("--route", type=click.Choice(["straight", "turning"]), default="turning",
              show_default=True, help="Kind of the drive through the town.")  # fmt: skip
@click.option("--length", type=options.FiniteRange(20), default=160.0, show_default=True,
              help="Length of the drive through the town (m).")  # fmt: skip
@click.option("--world-seed", type=click.IntRange(0), default=0, show_default=True,
              help="Seed of the corridor of the town's drives.")  # fmt: skip
@click.option(
    "--outdate",
    is_flag=True,
    help="MAP is the world; write the outdated map that lacks the changes.",
)
@options.seed
@click.option("--truth", type=options.PATH, help="File for the true changes (prior → world).")
@options.output("The map folder to write.")
@options.overwrite
@options.as_json
def command(
    map_path: Path,
    map_version: int | None,
    specs: tuple[str, ...],
    works: float | None,
    near: tuple[str, ...],
    drive: int,
    route: str,
    length: float,
    world_seed: int,
    outdate: bool,
    seed: int,
    truth: Path | None,
    output: Path,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Delete, insert or move elements of MAP, or open a construction zone; the result is another
    map.

    Changes are named as a fleet sees them, from the outdated map to the world: MAP is the outdated
    map and the output the world, or with --outdate the other way round.

    \b
    Example:
      rtmap simulate changes --map town --change delete:ped_crossing --change insert:divider \\
          --near town: --outdate --seed 1 -o prior --truth truth.json
    """  # fmt: skip
    import numpy as np

    from rtmap_cli.errors import BadInput, UsageError
    from rtmap_cli.maps.store import read_map, write_new_map
    from rtmap_cli.steps.simulate.driving.drive_source import Route, find_source, town_info
    from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
    from rtmap_cli.steps.simulate.worlds.changes import (
        change_world,
        common_path,
        parse_spec,
        truth_json,
    )
    from rtmap_cli.steps.simulate.worlds.works import open_works
    from rtmap_cli.tables import refuse_existing, refuse_over, write_json

    if works is None and not specs:
        raise UsageError("name a --change, or --works")
    if works is not None and (specs or outdate or not near):
        raise UsageError("--works needs --near, and excludes --change and --outdate")
    wanted = [parse_spec(text) for text in specs]
    if truth is not None:
        refuse_existing(truth, overwrite, "choose another --truth or pass --overwrite")
    refuse_over(output, map_path)
    refuse_existing(output, overwrite)
    if truth is not None and truth.is_dir():
        raise BadInput(truth, "is a folder, not a file", "choose another --truth")
    old = read_map(map_path, map_version)
    path = None
    if near:
        key, way = DriveKey(world_seed, 0, drive), Route(route, length, 2.5)
        sources = [find_source(name, map_path, old, key, way) for name in near]
        path = common_path([s.drive.pose[:, :2, 3] for s in sources])
    rng = np.random.default_rng([seed, 61])
    info: dict[str, Any] = {"changes": list(specs), "seed": seed, "outdated": outdate}
    delineators: list[Any] = []
    if works is not None:
        assert path is not None
        site = open_works(old, path, works, rng)
        new, changes, delineators = site.world, site.changes, site.delineators
        info["works_m"] = works
    else:
        made = [s.inverse() for s in wanted] if outdate else wanted
        new, changes = change_world(old, made, rng, path)
    if outdate:
        changes = [c.flipped() for c in changes]
    known = town_info(map_path)
    if "town" in known:
        info["town"] = known["town"]
    what = f"{works:g} m of works" if works is not None else ", ".join(specs)
    write_new_map(new, output, f"simulated changes: {what}", overwrite, info=info)
    told = truth_json(changes, old.crs, delineators)
    if truth is not None:
        write_json(told, truth)
    lines = [
        f"{c['kind']} {c['class']} {c['element_id']}, {c['length_m']:.1f} m"
        for c in told["changes"]
    ]
    emit({"map": str(output), "truth": str(truth) if truth else None} | told, as_json, lines)
