"""rtmap map ls: list the elements of a map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options

if TYPE_CHECKING:
    from rtmap_cli.maps.element import Element


@click.command("ls")
@click.argument("map_path", metavar="MAP", type=options.PATH)
@options.map_version
@options.class_names
@options.bbox
@options.lonlat
@click.option("--summary", is_flag=True, help="One line per class in place of the elements.")
@options.as_json
def command(
    map_path: Path,
    map_version: int | None,
    class_names: tuple[str, ...],
    bbox: tuple[float, float, float, float] | None,
    lonlat: bool,
    summary: bool,
    as_json: bool,
) -> None:
    """List the elements of a map with their length, uncertainty and evidence.

    sigma is the median standard deviation of an element's vertices across both axes, in metres;
    existence is a probability; seen / in view count frames.

    \b
    Example:
      rtmap map ls map --class ped_crossing
    """
    from rtmap_cli.maps.select import select
    from rtmap_cli.output import emit, log, table

    found = select(map_path, map_version, bbox, lonlat, class_names)
    rows = [_row(e) for e in found]
    classes = _totals(rows)
    result: dict[str, Any] = {
        "map": str(map_path),
        "version": found.version,
        "crs": found.crs,
        "bounds": list(found.bounds()),
        "count": len(found),
        "classes": classes,
    }
    if summary:
        header = ["class", "elements", "length m", "sigma m"]
        lines = table(
            header,
            [
                [n, c["elements"], f"{c['length_m']:.1f}", _short(c["sigma_m"])]
                for n, c in classes.items()
            ],
        )
    else:
        result["elements"] = rows
        header = [
            "id",
            "class",
            "vertices",
            "length m",
            "sigma m",
            "existence",
            "seen/in view",
            "drives",
        ]
        lines = table(header, [_cells(r) for r in rows])
    if not as_json:
        log(f"{map_path}: version {found.version}, {found.crs}, {len(found)} elements")
    emit(result, as_json, lines)


def _row(element: Element) -> dict[str, Any]:
    import numpy as np

    from rtmap_cli.geometry.polylines import length

    z = element.points[:, 2]
    known = z[np.isfinite(z)]
    sigma = np.nan
    if element.covariance is not None:
        variance = np.asarray(element.covariance, np.float64)[:, [0, 2]].mean(axis=1)
        if np.isfinite(variance).any():
            sigma = float(np.sqrt(np.nanmedian(variance)))
    return {
        "id": element.element_id,
        "class": element.class_name,
        "vertices": len(element.points),
        "length_m": length(element.points),
        "height_m": [float(known.min()), float(known.max())] if len(known) else None,
        "sigma_m": sigma,
        "existence": float(1.0 / (1.0 + np.exp(-element.existence))),
        "seen": element.seen,
        "in_view": element.in_view,
        "traversals": element.traversals,
        "attributes": element.attributes,
    }


def _totals(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    import numpy as np

    out: dict[str, dict[str, Any]] = {}
    for name in sorted({r["class"] for r in rows}):
        mine = [r for r in rows if r["class"] == name]
        sigmas = [r["sigma_m"] for r in mine if np.isfinite(r["sigma_m"])]
        out[name] = {
            "elements": len(mine),
            "length_m": float(sum(r["length_m"] for r in mine)),
            "sigma_m": float(np.median(sigmas)) if sigmas else float("nan"),
        }
    return out


def _short(value: float) -> str:
    return "-" if value != value else f"{value:.3f}"


def _cells(row: dict[str, Any]) -> list[str]:
    return [
        row["id"],
        row["class"],
        str(row["vertices"]),
        f"{row['length_m']:.1f}",
        _short(row["sigma_m"]),
        f"{row['existence']:.3f}",
        f"{row['seen']}/{row['in_view']}",
        str(row["traversals"]),
    ]
