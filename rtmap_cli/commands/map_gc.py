"""rtmap map gc: remove files that no kept version needs."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options


@click.command("gc")
@click.argument("map_path", metavar="MAP", type=options.PATH)
@click.option("--dry-run", is_flag=True, help="Only say what would be removed.")
@click.option(
    "--keep",
    type=click.IntRange(1),
    help="Keep the tiles of the newest N versions only; older versions can be read no more.",
)
@click.option(
    "--older-than",
    type=options.FiniteRange(0),
    default=60.0,
    show_default=True,
    metavar="MINUTES",
    help="Leave younger files: they may belong to a commit under way.",
)
@options.as_json
def command(
    map_path: Path, dry_run: bool, keep: int | None, older_than: float, as_json: bool
) -> None:
    """Remove tile files that no version of MAP needs, e.g. of a commit that crashed.

    Every version stays readable unless --keep says otherwise.

    \b
    Example:
      rtmap map gc map --dry-run
    """
    from rtmap_cli.maps.store import gc
    from rtmap_cli.output import emit

    removed = gc(map_path, dry_run, keep, older_than * 60.0)
    size = sum(n for _, n in removed)
    result = {
        "map": str(map_path),
        "dry_run": dry_run,
        "files": [name for name, _ in removed],
        "bytes": size,
    }
    verb = "would remove" if dry_run else "removed"
    lines = [name for name, _ in removed]
    emit(result, as_json, [*lines, f"{map_path}: {verb} {len(removed)} files, {size} bytes"])
