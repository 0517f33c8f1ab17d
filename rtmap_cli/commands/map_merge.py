"""rtmap map merge: what another map of the same area knows comes into a map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options

if TYPE_CHECKING:
    from rtmap_cli.maps.element import VectorMap
    from rtmap_cli.steps.merge_maps.merge import Merged

FEW = 0.3
"""Maps of which a smaller share of what lies near each other agrees hardly show one area."""


@click.command("merge")
@click.argument("map_path", metavar="MAP", type=options.PATH)
@click.argument("other_path", metavar="OTHER", type=options.PATH)
@click.option("-m", "--message", help="Message of the new version.")
@click.option("--dry-run", is_flag=True, help="Tell what would change and write nothing.")
@options.as_json
def command(
    map_path: Path, other_path: Path, message: str | None, dry_run: bool, as_json: bool
) -> None:
    """Commit a version of MAP with what OTHER, a map of the same or the next area, knows.

    OTHER is put onto MAP first: shifted as a whole, then from place to place. Lines that both have
    are kept once, at MAP's place, or fused where both state covariances; what only OTHER has
    is added, joined to the ends that it continues. OTHER is not changed.

    \b
    Example:
      rtmap import lanelet2 vendor_b.osm --crs EPSG:32617 -o b
      rtmap map merge map b -m "vendor B"
    """
    from rtmap_cli.errors import BadInput
    from rtmap_cli.maps.crs import check_same_crs
    from rtmap_cli.maps.store import commit_map, fused_runs, read_map
    from rtmap_cli.output import emit
    from rtmap_cli.steps.merge_maps.merge import merge_maps

    base, other = read_map(map_path), read_map(other_path)
    if map_path.resolve() == other_path.resolve():
        raise BadInput(other_path, "is MAP itself", "name another map")
    check_same_crs(other.crs, base.crs, other_path)
    known, theirs = fused_runs(map_path), fused_runs(other_path)
    twice = sorted(known & theirs)
    merged = merge_maps(base, other, once=bool(twice))
    _tell(merged, other_path, twice)
    version = base.version
    assert version is not None
    counts = merged.counts()
    if not dry_run:
        text = message or f"merge: {other_path.name}"
        info = {"merge": {"map": other_path.name, "version": other.version} | counts}
        runs = theirs - known
        version = commit_map(map_path, merged.vector_map, version, text, runs=runs, info=info)
    result = _described(merged, map_path, version, other, dry_run)
    emit(result, as_json, _lines(result, merged, len(other)))


def _tell(merged: Merged, other: Path, twice: list[str]) -> None:
    from rtmap_cli.output import log

    shared = merged.displacement.shared
    if twice:
        log(
            f"{len(twice)} runs (first: {twice[0]}) are in both maps: evidence of elements that "
            "both have is not added up"
        )
    # NaN: nowhere near each other.
    if shared < FEW:
        log(
            f"warning: of what lies near lines of MAP only {shared:.0%} of {other} is the same: "
            "are they maps of one area, in one CRS, less than 4 m apart?"
        )


def _described(
    merged: Merged, map_path: Path, version: int, other: VectorMap, dry_run: bool
) -> dict[str, Any]:
    d = merged.displacement
    return {
        "map": str(map_path),
        "version": version,
        "elements": len(merged.vector_map),
        "other_elements": len(other),
        "offset": {"east_m": d.shift[0], "north_m": d.shift[1], "up_m": d.up},
        "spread_m": d.spread,
        "shared": d.shared,
        "counts": merged.counts(),
        **{name: sorted(getattr(merged, name)) for name in merged.counts()},
        "dry_run": dry_run,
    }


def _lines(result: dict[str, Any], merged: Merged, count: int) -> list[str]:
    counts, d = merged.counts(), merged.displacement
    verb = "would get" if result["dry_run"] else "has got"
    lines = [
        f"{result['map']}: version {result['version']} {verb} {counts['inserted']} elements, "
        f"{counts['confirmed']} of its own are in the other map of {count}, too, "
        f"{counts['moved']} of these moved"
    ]
    if d.spread == d.spread:
        lines.append(
            f"the other map lay {d.shift[0]:+.2f} m east, {d.shift[1]:+.2f} m north, "
            f"{d.up:+.2f} m up; after that its lines are {d.spread:.2f} m off (median), "
            f"{d.shared:.0%} of them the same"
        )
    else:
        lines.append("the maps have no line in common: the other one was added as it is")
    return lines
