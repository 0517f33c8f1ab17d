"""Checks of a map folder: what is wrong with it, tile by tile and element by element."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.polylines import length
from rtmap_cli.maps.crs import check_map_crs, same_crs
from rtmap_cli.maps.delta import open_table, read_properties, read_tile, tile_files
from rtmap_cli.maps.element import RING_CLASSES, Element
from rtmap_cli.maps.place import Place
from rtmap_cli.maps.tiles import BBOX, boxes, table_to_elements, tile_of
from rtmap_cli.tables import table_metadata

Array = NDArray[np.float64]

SEVERITIES = ("warning", "error")
MIN_LENGTH = 1e-3
"""Metres below which an element is no line."""


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong; ``element_id`` is None for findings about a whole tile."""

    severity: str
    code: str
    element_id: str | None
    tile: str | None
    message: str


def validate_map(path: str | Path, version: int | None = None) -> tuple[int, list[Finding]]:
    """Number of readable elements and all findings of a map; nothing is written.

    BadInput only when the folder is no map or its log cannot be read.
    """
    place = Place.of(path)
    table = open_table(place, version)
    crs = str(read_properties(place, table)["crs"])
    out: list[Finding] = []
    try:
        check_map_crs(crs, path)
    except BadInput as error:
        return 0, [Finding("error", "crs", None, None, error.what)]
    seen: dict[str, str] = {}
    for name, tile in sorted(tile_files(table).items()):
        try:
            rows = read_tile(place, name)
        except BadInput as error:
            out.append(Finding("error", "tile-unreadable", None, tile, f"{name}: {error.what}"))
            continue
        out += _check_file(place, name, tile, rows, crs)
        elements, broken = _elements(rows, place.file(name), tile)
        out += broken
        out += check_elements(elements, tile)
        out += _check_placement(elements, rows, crs, tile) if not broken else []
        for element in elements:
            if element.element_id in seen:
                other = seen[element.element_id]
                out.append(_about(element, tile, "error", "duplicate-id", f"also in tile {other}"))
            seen[element.element_id] = tile
    return len(seen), out


def check_elements(elements: Sequence[Element], tile: str | None = None) -> list[Finding]:
    """Findings about geometry, covariance and evidence of single elements."""
    return [f for e in elements for check in _CHECKS for f in check(e, tile)]


def _about(element: Element, tile: str | None, severity: str, code: str, message: str) -> Finding:
    return Finding(severity, code, element.element_id, tile, message)


def _check_file(place: Place, name: str, tile: str, rows: pa.Table, crs: str) -> Iterator[Finding]:
    """The file is what its name and the log say."""
    if hashlib.sha256(place.read(name)).hexdigest() != PurePosixPath(name).stem:
        yield Finding("error", "tile-altered", None, tile, f"{name}: not the bytes it is named by")
    metadata = table_metadata(rows)
    found = metadata.get("rtmap.crs", "none")
    if found != crs and (found == "none" or not same_crs(found, crs)):
        yield Finding("error", "tile-crs", None, tile, f"{name}: its CRS is {found}, not {crs}")
    if "geo" not in metadata:
        yield Finding("warning", "tile-geo", None, tile, f"{name}: no GeoParquet metadata")


def _elements(rows: pa.Table, path: Path, tile: str) -> tuple[list[Element], list[Finding]]:
    """Elements that can be read, and what is wrong with the others."""
    try:
        return table_to_elements(rows, path), []
    except BadInput:
        pass
    elements, out = [], []
    for k in range(rows.num_rows):
        try:
            elements += table_to_elements(rows.slice(k, 1), path)
        except BadInput as error:
            name = rows["element_id"][k].as_py()
            out.append(Finding("error", "element-unreadable", name, tile, error.what))
    return elements, out


def _check_placement(
    elements: list[Element], rows: pa.Table, crs: str, tile: str
) -> Iterator[Finding]:
    """Readers find an element by its tile and its bbox column: both must be true."""
    for element, where in zip(elements, tile_of(elements, crs), strict=True):
        if where != tile:
            yield _about(element, tile, "warning", "wrong-tile", f"belongs to tile {where}")
    box = rows["bbox"].combine_chunks()
    stored = np.stack([box.field(n).to_numpy(zero_copy_only=False) for n in BBOX], axis=1)
    off = np.abs(stored - boxes(elements)).max(axis=1) if elements else np.zeros(0)
    for k in np.flatnonzero(~(off <= 1e-6)):
        yield _about(elements[k], tile, "error", "bbox", "its bbox column is not its bounding box")


def _check_geometry(element: Element, tile: str | None) -> Iterator[Finding]:
    import shapely

    if not element.element_id:
        yield _about(element, tile, "error", "no-id", "its id is empty")
    if length(element.points) < MIN_LENGTH:
        yield _about(element, tile, "error", "zero-length", "its length is zero")
        return
    steps = np.hypot(*np.diff(element.xy, axis=0).T)
    if (steps == 0).any():
        count = int((steps == 0).sum())
        yield _about(
            element, tile, "warning", "repeated-vertex", f"{count} vertices repeat the one before"
        )
    if element.class_name not in RING_CLASSES:
        if not shapely.is_simple(shapely.linestrings(element.xy)):
            yield _about(element, tile, "warning", "self-crossing", "the line crosses itself")
        return
    if not element.ring:
        yield _about(element, tile, "error", "open-ring", "the ring is not closed")
        return
    polygon = shapely.polygons(np.concatenate([element.xy[:-1], element.xy[:1]]))
    if not shapely.is_valid(polygon):
        reason = str(shapely.is_valid_reason(polygon)).split("[")[0]
        yield _about(element, tile, "error", "self-crossing", f"invalid polygon: {reason}")


def _check_covariance(element: Element, tile: str | None) -> Iterator[Finding]:
    if element.covariance is None:
        return
    xx, xy, yy, zz = np.asarray(element.covariance, np.float64).T
    partly = np.isfinite(xx) & np.isfinite(xy) & np.isfinite(yy)
    with np.errstate(invalid="ignore"):
        positive = (xx > 0) & (yy > 0) & (xx * yy - xy**2 > 0)
    if (partly & ~positive).any():
        k = int(np.flatnonzero(partly & ~positive)[0])
        yield _about(element, tile, "error", "covariance", f"not positive definite at vertex {k}")
    if np.isinf(element.covariance).any() or (zz <= 0).any():
        yield _about(element, tile, "error", "covariance", "infinite, or no height variance > 0")
    if (partly != (np.isfinite(xx) | np.isfinite(xy) | np.isfinite(yy))).any():
        yield _about(element, tile, "warning", "covariance", "partly unknown at a vertex")


def _check_evidence(element: Element, tile: str | None) -> Iterator[Finding]:
    if not np.isfinite(element.existence):
        yield _about(element, tile, "error", "existence", "its existence is not finite")
    if min(element.seen, element.in_view, element.traversals) < 0:
        yield _about(element, tile, "error", "counts", "a count is negative")
    elif element.seen > element.in_view:
        yield _about(
            element,
            tile,
            "warning",
            "counts",
            f"seen {element.seen} times but in view only {element.in_view}",
        )
    first, last = element.first_seen_ns, element.last_seen_ns
    if first is not None and last is not None and first > last:
        yield _about(element, tile, "error", "times", "first seen after it was last seen")


_CHECKS = (_check_geometry, _check_covariance, _check_evidence)
