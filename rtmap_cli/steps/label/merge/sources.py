"""Maps as merging reads them: map folders, Lanelet2 files, GeoJSON files."""

from __future__ import annotations

import json
from pathlib import Path

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.lanelet2.tags import WAYS
from rtmap_cli.maps.crs import check_same_crs
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import map_exists, read_map


def read_labels(path: Path, crs: str, join: bool) -> VectorMap:
    """A map in ``crs`` from a map folder, a Lanelet2 file (``.osm``) or a GeoJSON file; ``join``:
    ways in a row become one element, as in the map that was exported."""
    if path.is_dir():
        if not map_exists(path):
            raise BadInput(path, "is a folder but no map", "give a map folder, .osm or .geojson")
        found = read_map(path)
        check_same_crs(found.crs, crs, path)
        return found
    if path.suffix.lower() == ".osm":
        from rtmap_cli.formats.lanelet2.read import read_lanelet2

        return read_lanelet2(path, crs, join=join).vector_map
    if path.name.lower().endswith((".geojson", ".json", ".geojson.gz", ".json.gz")):
        from rtmap_cli.formats.geojson import read_geojson

        return read_geojson(path, crs)
    todo = "give a map folder, .osm or .geojson"
    raise BadInput(path, "no such file" if not path.exists() else "is no map that is read", todo)


def joins_ways(vector_map: VectorMap) -> bool:
    """Whether elements of a map are made of several ways."""
    return any(len(json.loads(e.attributes.get(WAYS, "[]"))) > 1 for e in vector_map)
