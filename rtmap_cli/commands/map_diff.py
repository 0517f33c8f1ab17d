"""rtmap map diff: what changed between two versions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options

if TYPE_CHECKING:
    from rtmap_cli.maps.difference import Difference


@click.command("diff")
@click.argument("map_path", metavar="MAP", type=options.PATH)
@click.argument("before", type=int)
@click.argument("after", type=int)
@click.option("--with", "other", type=options.PATH, help="Take AFTER from this map folder.")
@click.option(
    "--tolerance",
    type=options.FiniteRange(0),
    default=1e-3,
    show_default=True,
    help="Metres below which geometry counts as the same.",
)
@options.output(
    "Also write the differences as GeoJSON; - for stdout, in place of the table.", False
)
@options.overwrite
@options.as_json
def command(
    map_path: Path,
    before: int,
    after: int,
    other: Path | None,
    tolerance: float,
    output: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Tell which elements were added, removed or modified from version BEFORE to AFTER of MAP.

    "updated" elements have other evidence or covariance only. The displacement is the largest
    one of any vertex, in metres.

    \b
    Example:
      rtmap map diff map 0 1
    """
    from rtmap_cli.errors import UsageError
    from rtmap_cli.maps.crs import check_same_crs
    from rtmap_cli.maps.difference import compare_maps, count_kinds
    from rtmap_cli.maps.store import read_map
    from rtmap_cli.output import emit, log, table
    from rtmap_cli.tables import refuse_existing, refuse_inside

    stream = str(output) == "-"
    if stream and as_json:
        raise UsageError("--json and -o - both want stdout: choose one")
    if output is not None and not stream:
        refuse_inside(output, map_path, other)
        refuse_existing(output, overwrite)
    old, new = read_map(map_path, before), read_map(other or map_path, after)
    check_same_crs(new.crs, old.crs, other or map_path)
    found = compare_maps(old, new, tolerance)
    if output is not None:
        _write(found, new.crs, output)
    counts = count_kinds(found)
    told = ", ".join(f"{n} {kind}" for kind, n in counts.items())
    if not as_json:
        log(f"{map_path}: version {before} to {after}: {told}")
    result = {
        "map": str(map_path),
        "before": before,
        "after": after,
        "counts": counts,
        "differences": [_properties(d) for d in found],
    }
    if not stream:
        header = ["id", "kind", "class", "moved m", "what"]
        emit(result, as_json, table(header, [_cells(d) for d in found]))


def _properties(difference: Difference) -> dict[str, Any]:
    d = difference
    return {
        "id": d.element_id,
        "kind": d.kind,
        "class": d.class_name,
        "displacement_m": round(d.displacement, 4) if d.displacement == d.displacement else None,
        "fields": list(d.fields),
    }


def _cells(difference: Difference) -> list[str]:
    d = difference
    moved = "-" if d.displacement != d.displacement else f"{d.displacement:.3f}"
    return [d.element_id, d.kind, d.class_name, moved, " ".join(d.fields) or "-"]


def _write(differences: list[Difference], crs: str, output: Path) -> None:
    from rtmap_cli.formats.features import feature, write_features
    from rtmap_cli.maps.element import RING_CLASSES

    def one(d: Difference) -> dict[str, Any]:
        polygon = d.class_name in RING_CLASSES and d.shown.ring
        return feature(d.shown.points, crs, polygon, _properties(d))

    write_features((one(d) for d in differences), output)
