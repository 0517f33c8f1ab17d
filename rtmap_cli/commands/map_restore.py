"""rtmap map restore: make an old version the newest one."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options


@click.command("restore")
@click.argument("map_path", metavar="MAP", type=options.PATH)
@click.argument("version", type=int)
@click.option("-m", "--message", help="Message of the new version.")
@options.as_json
def command(map_path: Path, version: int, message: str | None, as_json: bool) -> None:
    """Commit a new version of MAP with the content of the old VERSION.

    Nothing is lost: the versions between stay readable. Runs that were fused after VERSION are
    forgotten and may be fused again.

    \b
    Example:
      rtmap map restore map 0 -m "back to the import"
    """
    from rtmap_cli.maps.store import fused_runs, restore
    from rtmap_cli.output import emit

    before = fused_runs(map_path)
    new = restore(map_path, version, message)
    forgotten = sorted(before - fused_runs(map_path))
    result = {"map": str(map_path), "version": new, "restored": version, "forgotten": forgotten}
    line = f"{map_path}: version {new} has the content of version {version}"
    if forgotten:
        line += f"; {len(forgotten)} runs may be fused again"
    emit(result, as_json, [line])
