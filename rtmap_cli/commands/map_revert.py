"""rtmap map revert: undo one version."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options


@click.command("revert")
@click.argument("map_path", metavar="MAP", type=options.PATH)
@click.argument("version", type=click.IntRange(0), required=False)
@click.option("-m", "--message", help="Message of the new version.")
@options.as_json
def command(map_path: Path, version: int | None, message: str | None, as_json: bool) -> None:
    """Commit a version of MAP without what VERSION (default: the newest one) changed.

    Of the newest version this is the content before it, byte for byte. Of an older one its
    elements get back what they were, if nobody touched them since; later changes stay.

    \b
    Example:
      rtmap map revert map
    """
    from rtmap_cli.maps.revert import revert
    from rtmap_cli.output import emit

    done = revert(map_path, version, message)
    result = {
        "map": str(map_path),
        "version": done.version,
        "reverted": done.reverted,
        "elements": list(done.elements),
    }
    line = f"{map_path}: version {done.version} undoes version {done.reverted}"
    emit(result, as_json, [f"{line}: {len(done.elements)} elements as they were"])
