"""A part of a map: by version, box and class."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rtmap_cli.errors import UsageError
from rtmap_cli.maps.crs import lonlat_to
from rtmap_cli.maps.delta import Box
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import map_crs, read_map


def box_from_lonlat(crs: str, box: Box) -> Box:
    """The box of the map frame around west, south, east, north in WGS84 degrees."""
    west, south, east, north = box
    # Meridians and parallels are curves in a map frame: follow all four edges.
    t = np.linspace(0.0, 1.0, 17)
    x, y = west + t * (east - west), south + t * (north - south)
    edges = [(x, np.full(17, south)), (x, np.full(17, north))]
    edges += [(np.full(17, west), y), (np.full(17, east), y)]
    xy = lonlat_to(crs, np.concatenate([np.column_stack(e) for e in edges]))
    return (*xy.min(axis=0).tolist(), *xy.max(axis=0).tolist())


def select(
    path: str | Path,
    version: int | None = None,
    bbox: Box | None = None,
    lonlat: bool = False,
    class_names: Sequence[str] = (),
) -> VectorMap:
    """Elements of a map that touch ``bbox`` (map frame, or degrees with ``lonlat``) and are of
    one of ``class_names``. UsageError for a box that is inside out."""
    if lonlat and bbox is None:
        raise UsageError("--lonlat says what --bbox is in: pass --bbox too")
    if bbox is not None:
        if not np.isfinite(bbox).all() or bbox[0] > bbox[2] or bbox[1] > bbox[3]:
            raise UsageError("--bbox is X0 Y0 X1 Y1 with X0 ≤ X1 and Y0 ≤ Y1")
        if lonlat:
            bbox = box_from_lonlat(map_crs(path), bbox)
    found = read_map(path, version, bbox)
    if not class_names:
        return found
    return VectorMap((e for e in found if e.class_name in class_names), found.crs, found.version)
