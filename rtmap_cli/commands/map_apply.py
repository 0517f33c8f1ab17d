"""rtmap map apply: make the accepted changes of a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rtmap_cli import options

if TYPE_CHECKING:
    from rtmap_cli.formats.change_file import ChangeFeature, ReviewFile
    from rtmap_cli.maps.edits import Edit
    from rtmap_cli.maps.element import VectorMap


@click.command("apply")
@click.argument("map_path", metavar="MAP", type=options.PATH)
@click.argument("changes", metavar="FILE", type=options.PATH)
@click.option("--all", "everything", is_flag=True, help="Also what nobody decided on.")
@click.option(
    "--map-version",
    type=click.IntRange(0),
    help="Version that FILE is about, if it does not say so.",
)
@click.option(
    "--rebase",
    is_flag=True,
    help="FILE is about an older version: go on if nobody touched its elements since.",
)
@click.option("-m", "--message", help="Message of the new version.")
@click.option("--dry-run", is_flag=True, help="Tell what would change and write nothing.")
@options.as_json
def command(
    map_path: Path,
    changes: Path,
    everything: bool,
    map_version: int | None,
    rebase: bool,
    message: str | None,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Commit a version of MAP with the accepted changes of FILE; all of them or none.

    FILE is what detect-changes or update wrote, reviewed with `rtmap map review` or edited in an
    editor (QGIS, JOSM). It must be about the newest version of MAP. Elements that no change names
    stay byte for byte; `rtmap map revert` undoes it.

    \b
    Example:
      rtmap map apply map changes.geojson -m "review of week 12"
    """
    from rtmap_cli.formats.change_file import edits_of, read_review_file
    from rtmap_cli.maps.edits import apply_edits
    from rtmap_cli.maps.store import commit_map, read_map
    from rtmap_cli.output import emit

    file = read_review_file(changes)
    latest = read_map(map_path)
    wanted = _wanted(file, everything)
    edits = edits_of(file, wanted, latest.crs)
    _check_version(file, edits, map_path, latest, map_version, rebase)
    made = apply_edits(latest, edits, changes)
    counts = {name: len(getattr(made, name)) for name in ("inserted", "deleted", "modified")}
    version = latest.version
    assert version is not None
    if not dry_run:
        text = message or f"apply: {len(edits)} changes of {changes.name}"
        info = {"apply": {"file": changes.name, "changes": [e.change_id for e in edits]} | counts}
        version = commit_map(map_path, made.vector_map, version, text, info=info)
    result = {
        "map": str(map_path),
        "version": version,
        "applied": [e.change_id for e in edits],
        "left_out": [c.change_id for c in file.changes if c not in wanted],
        "inserted": made.inserted,
        "deleted": made.deleted,
        "modified": made.modified,
        "elements": len(made.vector_map),
        "dry_run": dry_run,
    }
    told = ", ".join(f"{n} {name}" for name, n in counts.items())
    head = f"{map_path}: version {version}" + (" would get" if dry_run else " has")
    emit(result, as_json, [f"{head} {len(edits)} of {len(file.changes)} changes: {told}"])


def _wanted(file: ReviewFile, everything: bool) -> list[ChangeFeature]:
    """The changes to make; BadInput when there is none."""
    from rtmap_cli.errors import BadInput
    from rtmap_cli.formats.change_file import ACCEPTED, REJECTED

    out = [c for c in file.changes if c.review == ACCEPTED or (everything and c.review != REJECTED)]
    if not out:
        what = f"none of its {len(file.changes)} changes is accepted"
        raise BadInput(file.path, what, "accept some with `rtmap map review`, or pass --all")
    return out


def _check_version(
    file: ReviewFile,
    edits: list[Edit],
    map_path: Path,
    latest: VectorMap,
    stated: int | None,
    rebase: bool,
) -> None:
    """BadInput when the file is about another version than the newest one, or (``rebase``) when an
    element that it names is another one by now."""
    from rtmap_cli.errors import BadInput
    from rtmap_cli.maps.difference import compare_maps
    from rtmap_cli.maps.store import read_map

    found = file.map_version
    if found is None:
        found = stated
    elif stated is not None and stated != found:
        raise BadInput(file.path, f"is about version {found} of the map, not {stated}")
    if found is None:
        todo = "pass --map-version with the version that it was made of"
        raise BadInput(file.path, "does not say which version of the map it is about", todo)
    if found == latest.version:
        return
    if latest.version is not None and found > latest.version:
        raise BadInput(
            file.path,
            f"is about version {found}, {map_path} has no newer one than {latest.version}",
            "is it the changes of another map?",
        )
    if not rebase:
        raise BadInput(
            file.path,
            f"is about version {found} of the map, which has version {latest.version} by now",
            "make it anew, or pass --rebase if its elements were not touched since",
        )
    touched = {d.element_id for d in compare_maps(read_map(map_path, found), latest, 0.0)}
    if clash := sorted(touched & {e.element_id for e in edits if e.element_id}):
        raise BadInput(
            file.path, f"{clash[0]} is another one since version {found}", "make it anew"
        )
