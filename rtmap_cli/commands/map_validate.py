"""rtmap map validate: check a map folder."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options


@click.command("validate")
@click.argument("map_path", metavar="MAP", type=options.PATH)
@options.map_version
@click.option(
    "--fail-on",
    type=click.Choice(["error", "warning"]),
    help="Exit with 1 when there is a finding of this severity or worse.",
)
@options.as_json
def command(map_path: Path, map_version: int | None, fail_on: str | None, as_json: bool) -> None:
    """Check a map: files, CRS, geometry, ids, covariances, evidence. Nothing is ever written.

    \b
    Example:
      rtmap map validate map --fail-on error
    """
    from dataclasses import asdict

    from rtmap_cli.errors import Findings
    from rtmap_cli.maps.validate import SEVERITIES, validate_map
    from rtmap_cli.output import emit, table

    count, found = validate_map(map_path, map_version)
    counts = {s: sum(f.severity == s for f in found) for s in SEVERITIES}
    result = {
        "map": str(map_path),
        "elements": count,
        "counts": counts,
        "findings": [asdict(f) for f in found],
    }
    rows = [[f.severity, f.code, f.element_id or "-", f.tile or "-", f.message] for f in found]
    lines = table(["severity", "code", "element", "tile", "what"], rows) if rows else []
    told = f"{count} elements, {counts['error']} errors, {counts['warning']} warnings"
    emit(result, as_json, [*lines, f"{map_path}: {told}"])
    worst = counts["error"] + (counts["warning"] if fail_on == "warning" else 0)
    if fail_on and worst:
        raise Findings(f"{map_path}: {told}")
