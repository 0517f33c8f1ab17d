"""``rtmap label merge``: edits made by hand come into newly generated labels."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options

if TYPE_CHECKING:
    from rtmap_cli.steps.label.merge.merge import Conflict


@click.command("merge")
@click.argument("base", type=options.PATH)
@click.argument("edited", type=options.PATH, nargs=-1, required=True)
@click.option(
    "--into", "new", type=options.PATH, required=True, metavar="MAP", help="The new labels."
)
@click.option(
    "--tolerance",
    type=options.FiniteRange(0, 10),
    default=0.02,
    show_default=True,
    help="Smaller moves are no edits (m).",
)
@click.option(
    "--drift",
    type=options.FiniteRange(0, 2),
    default=0.5,
    show_default=True,
    help="New lines so near the base (m) are the same line seen again: no conflict.",
)
@click.option(
    "--prefer",
    type=click.Choice(["edited", "new"]),
    default="edited",
    show_default=True,
    help="Which side a conflict takes.",
)
@click.option("--partial", is_flag=True, help="EDITED is a part of BASE: what it lacks stays.")
@click.option("--conflicts", type=options.PATH, help="File for the conflicts (GeoJSON).")
@click.option("--fail-on-conflict", is_flag=True, help="Exit 1 and commit nothing on a conflict.")
@click.option("-m", "--message", help="Message of the new version.")
@click.option("--dry-run", is_flag=True, help="Tell what would change and write nothing.")
@options.overwrite
@options.as_json
def command(
    base: Path,
    edited: tuple[Path, ...],
    new: Path,
    tolerance: float,
    drift: float,
    prefer: str,
    partial: bool,
    conflicts: Path | None,
    fail_on_conflict: bool,
    message: str | None,
    dry_run: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Commit a version of the labels in MAP with what was changed by hand from BASE to EDITED.

    Each is a map folder, a Lanelet2 file (.osm) or GeoJSON; MAP is a map folder, BASE itself or
    labels that were generated anew. Lines that were moved move the new lines by as much, so that
    lanelets stay connected; crossings, stop lines and tags are added. What both sides changed is a
    conflict.

    \b
    Example:
      rtmap export lanelet2 labels -o labels.osm     # edit it as edited.osm
      rtmap label merge labels.osm edited.osm --into labels2 --conflicts conflicts.geojson
    """
    from rtmap_cli.errors import Findings, UsageError
    from rtmap_cli.maps.store import commit_map, read_map
    from rtmap_cli.output import emit, log
    from rtmap_cli.steps.label.merge.edits import edits_between
    from rtmap_cli.steps.label.merge.merge import merge_edits
    from rtmap_cli.steps.label.merge.sources import joins_ways, read_labels
    from rtmap_cli.tables import refuse_existing, refuse_over

    if new in edited:
        raise UsageError(f"{new} is both edited and merged into")
    if conflicts is not None:
        refuse_over(conflicts, base, *edited, new)
        refuse_existing(conflicts, overwrite)
    latest = read_map(new)
    join = joins_ways(latest if base.is_file() else read_map(base))
    before = read_labels(base, latest.crs, join)
    edits = [
        e
        for path in edited
        for e in edits_between(
            before, read_labels(path, latest.crs, join), path.name, tolerance, partial
        )
    ]
    made = merge_edits(before, edits, latest, tolerance, drift, prefer)
    if conflicts is not None:
        _write(made.conflicts, conflicts, latest.crs)
    for c in made.conflicts:
        log(f"conflict: {c.edit.shown.class_name} {c.edit.element_id}: {c.why}")
    stopped = fail_on_conflict and bool(made.conflicts)
    version = latest.version
    assert version is not None
    counts = dict(sorted(made.counts.items()))
    if edits and not dry_run and not stopped:
        text = message or f"merge: {len(edits)} edits of {', '.join(p.name for p in edited)}"
        info = {"merge": {"base": base.name, "edited": [p.name for p in edited], **counts}}
        version = commit_map(new, made.vector_map, version, text, info=info)
    result: dict[str, Any] = {
        "map": str(new), "version": version, "edits": len(edits), **counts,
        "conflicts": [{"element_id": c.edit.element_id, "why": c.why} for c in made.conflicts],
        "committed": bool(edits) and not dry_run and not stopped,
    }  # fmt: skip
    told = ", ".join(f"{n} {what}" for what, n in counts.items()) or "nothing to do"
    emit(
        result,
        as_json,
        [f"{new}: version {version}, {len(edits)} edits: {told}, {len(made.conflicts)} conflicts"],
    )
    if stopped:
        raise Findings(f"{len(made.conflicts)} conflicts; nothing was committed")


def _write(conflicts: list[Conflict], path: Path, crs: str) -> None:
    """The conflicts as GeoJSON: the line of the edit, and the new one where there is any."""
    from rtmap_cli.formats.features import feature, write_features

    out = []
    for number, c in enumerate(conflicts):
        for side, element in (("edited", c.edit.shown), ("new", c.new)):
            if element is None:
                continue
            properties = {
                "id": f"conflict-{number}-{side}", "conflict": number, "side": side,
                "element_id": element.element_id, "class": element.class_name,
                "why": c.why, "source": c.edit.source,
            }  # fmt: skip
            out.append(feature(element.points, crs, False, properties))
    write_features(out, path)
