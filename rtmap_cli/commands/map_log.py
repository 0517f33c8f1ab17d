"""rtmap map log: list the versions of a map."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options


@click.command("log")
@click.argument("map_path", metavar="MAP", type=options.PATH)
@options.as_json
def command(map_path: Path, as_json: bool) -> None:
    """List the versions of a map, newest first: when, what, from how many runs, how many tiles.

    \b
    Example:
      rtmap map log map
    """
    from dataclasses import asdict
    from datetime import UTC, datetime

    from rtmap_cli.maps.store import history
    from rtmap_cli.output import emit, table

    entries = history(map_path)[::-1]
    times = [
        datetime.fromtimestamp(e.timestamp_ms / 1000, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        for e in entries
    ]
    versions = [asdict(e) | {"time": t} for e, t in zip(entries, times, strict=True)]

    def count(value: int | None) -> str:
        return "-" if value is None else str(value)

    rows = [
        [
            str(e.version),
            t,
            count(e.elements),
            count(e.tiles_written),
            count(e.tiles_removed),
            str(len(e.runs)),
            e.message,
        ]
        for e, t in zip(entries, times, strict=True)
    ]
    header = ["version", "time", "elements", "tiles written", "retired", "runs", "message"]
    emit({"map": str(map_path), "versions": versions}, as_json, table(header, rows))
