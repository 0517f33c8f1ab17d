"""Tiles: elements as immutable GeoParquet 1.1 files, one per quadkey.

A tile holds whole elements, never pieces: an element belongs to the tile in which the middle of its
bounding box lies, so that a reader finds elements by the ``bbox`` column alone. Geometry is ISO WKB
in the map frame: a Polygon for closed elements of ring classes, else a LineString (a closed
boundary is a closed LineString). A height that is unknown is NaN; an element without any known
height is written in two dimensions. The same elements give the same bytes.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.maps.crs import parse_crs, to_lonlat
from rtmap_cli.maps.element import RING_CLASSES, Element
from rtmap_cli.tables import TableSchema

Array = NDArray[np.float64]

ZOOM = 16
"""Web-mercator zoom of the tiles: about 610 m at the equator, 465 m at 40° north."""

MAX_LATITUDE = 85.051128779806592
"""Where the square of web mercator ends, degrees."""

BBOX = ("xmin", "ymin", "xmax", "ymax")
COVARIANCE = ("cov_xx", "cov_xy", "cov_yy", "cov_zz")

TILE = TableSchema(
    name="rtmap.map.tile",
    version="1.0",
    frame="map (x east, y north, z up; CRS in rtmap.crs and in geo)",
    units="metres, square metres, nanoseconds since 1970-01-01T00:00:00Z",
    description="One row per map element: a GeoParquet 1.1 file, immutable, named by its SHA-256.",
    columns=pa.schema(
        [
            ("element_id", pa.string()),
            ("class_name", pa.string()),
            ("geometry", pa.binary()),
            ("bbox", pa.struct([(name, pa.float64()) for name in BBOX])),
        ]
        + [(name, pa.list_(pa.float64())) for name in COVARIANCE]
        + [
            ("existence", pa.float64()),
            ("seen", pa.int64()),
            ("in_view", pa.int64()),
            ("traversals", pa.int64()),
            ("first_seen_ns", pa.int64()),
            ("last_seen_ns", pa.int64()),
            ("attributes", pa.map_(pa.string(), pa.string())),
            ("runs", pa.list_(pa.string())),
            ("model_sha256", pa.string()),
        ]
    ),
)

_LINE, _POLYGON, _Z = 2, 3, 1000


def quadkeys(lonlat: Array, zoom: int = ZOOM) -> list[str]:
    """Quadkeys of (n, 2) WGS84 longitudes and latitudes in degrees, ``zoom`` digits each.

    The tile grid of web mercator ("Bing Maps tile system");
    the bits of column and row are interleaved, row first.
    """
    lon = np.asarray(lonlat, np.float64)[:, 0]
    lat = np.radians(np.clip(np.asarray(lonlat, np.float64)[:, 1], -MAX_LATITUDE, MAX_LATITUDE))
    size = 1 << zoom
    x = (lon + 180.0) / 360.0
    y = 0.5 - np.arcsinh(np.tan(lat)) / (2.0 * np.pi)
    column = np.clip(np.floor(x * size), 0, size - 1).astype(np.int64)
    row = np.clip(np.floor(y * size), 0, size - 1).astype(np.int64)
    shifts = np.arange(zoom - 1, -1, -1)
    digits = ((column[:, None] >> shifts) & 1) + 2 * ((row[:, None] >> shifts) & 1)
    text = (digits + ord("0")).astype(np.uint8)
    return [bytes(line).decode("ascii") for line in text]


def boxes(elements: Sequence[Element]) -> Array:
    """(n, 4) planar bounding boxes x_min, y_min, x_max, y_max in the map frame."""
    found = [(*e.xy.min(axis=0), *e.xy.max(axis=0)) for e in elements]
    return np.array(found, dtype=np.float64).reshape(-1, 4)


def tile_of(elements: Sequence[Element], crs: str, zoom: int = ZOOM) -> list[str]:
    """The quadkey that owns each element: where the middle of its bounding box lies."""
    if not elements:
        return []
    box = boxes(elements)
    return quadkeys(to_lonlat(crs, (box[:, :2] + box[:, 2:]) / 2), zoom)


def geometry_wkb(element: Element) -> bytes:
    """The element as little-endian ISO WKB, coordinates bit for bit."""
    points = element.points
    polygon = element.class_name in RING_CLASSES and element.ring
    if polygon and (points[0, :2] != points[-1, :2]).any():
        # WKB rings close exactly; is_ring allows a micrometre.
        points = points.copy()
        points[-1, :2] = points[0, :2]
    kind = _POLYGON if polygon else _LINE
    if np.isfinite(points[:, 2]).any():
        kind += _Z
    else:
        points = points[:, :2]
    head = struct.pack("<BI", 1, kind) + (struct.pack("<I", 1) if polygon else b"")
    return head + struct.pack("<I", len(points)) + points.astype("<f8").tobytes()


def _covariance_column(elements: Sequence[Element], k: int) -> pa.Array:
    """One entry of the covariance per vertex; null where nothing of it is known."""
    parts: list[Array] = []
    for e in elements:
        values = np.zeros(0) if e.covariance is None else np.asarray(e.covariance, np.float64)[:, k]
        parts.append(values if np.isfinite(values).any() else np.zeros(0))
    sizes = [len(p) for p in parts]
    null = [not size for size in sizes]
    offsets = pa.array(np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32), pa.int32())
    flat = np.concatenate(parts) if parts else np.zeros(0)
    values = pa.array(flat, pa.float64(), from_pandas=True)
    return pa.ListArray.from_arrays(offsets, values, mask=pa.array(null, pa.bool_()))


def elements_to_table(elements: Sequence[Element]) -> pa.Table:
    """Elements as a table of ``TILE``, sorted by id."""
    rows = sorted(elements, key=lambda e: e.element_id)
    box = boxes(rows)
    columns: dict[str, Any] = {
        "element_id": [e.element_id for e in rows],
        "class_name": [e.class_name for e in rows],
        "geometry": [geometry_wkb(e) for e in rows],
        "bbox": pa.StructArray.from_arrays(
            [pa.array(box[:, k], pa.float64()) for k in range(4)], names=list(BBOX)
        ),
    }
    columns |= {name: _covariance_column(rows, k) for k, name in enumerate(COVARIANCE)}
    columns |= {
        name: [getattr(e, name) for e in rows]
        for name in ("existence", "seen", "in_view", "traversals", "first_seen_ns", "last_seen_ns")
    }
    columns |= {
        "attributes": [sorted(e.attributes.items()) for e in rows],
        "runs": [list(e.runs) for e in rows],
        "model_sha256": [e.model_sha256 for e in rows],
    }
    schema = TILE.columns
    arrays = [
        columns[f.name]
        if isinstance(columns[f.name], pa.Array)
        else pa.array(columns[f.name], f.type)
        for f in schema
    ]
    return pa.Table.from_arrays(arrays, schema=schema)


def _covariances(table: pa.Table, sizes: NDArray[np.int64], path: str | Path) -> list[Array | None]:
    """(n, 4) per element or None, from the four list columns."""
    out: list[Array | None] = [None] * table.num_rows
    for k, name in enumerate(COVARIANCE):
        column = table[name].combine_chunks()
        valid = np.asarray(column.is_valid())
        if not valid.any():
            continue
        flat = column.drop_null().flatten().to_numpy(zero_copy_only=False).astype(np.float64)
        lengths = column.value_lengths().fill_null(0).to_numpy(zero_copy_only=False)
        wrong = np.flatnonzero(valid & (lengths != sizes))
        if len(wrong):
            raise BadInput(
                path,
                f"element {table['element_id'][int(wrong[0])]}: {name} holds "
                f"{lengths[wrong[0]]} values for {sizes[wrong[0]]} vertices",
            )
        start = 0
        for i in np.flatnonzero(valid):
            whole = out[i]
            if whole is None:
                whole = out[i] = np.full((int(sizes[i]), 4), np.nan)
            whole[:, k] = flat[start : start + sizes[i]]
            start += int(sizes[i])
    return out


def _vertices(table: pa.Table, path: str | Path) -> list[Array]:
    """(n, 3) vertices per element from the WKB column; BadInput for what is no line or ring."""
    import shapely

    blobs = table["geometry"].to_pylist()
    try:
        shapes = shapely.from_wkb(np.array(blobs, dtype=object))
    except (shapely.errors.GEOSException, TypeError) as error:
        raise BadInput(path, f"a geometry is not WKB ({error})") from None
    kinds = shapely.get_type_id(shapes)
    holes = shapely.get_num_interior_rings(shapes) > 0
    bad = ~np.isin(kinds, (1, 3)) | holes | shapely.is_empty(shapes)
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        raise BadInput(
            path,
            f"element {table['element_id'][i]}: its geometry is neither a line "
            "nor a polygon without holes",
        )
    points, index = shapely.get_coordinates(shapes, include_z=True, return_index=True)
    return np.split(points, np.flatnonzero(np.diff(index)) + 1) if len(points) else []


def table_to_elements(table: pa.Table, path: str | Path) -> list[Element]:
    """The elements of a tile's table; ``path`` names the file in errors."""
    if table.num_rows == 0:
        return []
    for name in ("element_id", "class_name", "geometry"):
        if table[name].null_count:
            raise BadInput(path, f"column {name} has an empty row")
    points = _vertices(table, path)
    sizes = np.array([len(p) for p in points])
    covariances = _covariances(table, sizes, path)
    names = ("existence", "seen", "in_view", "traversals", "first_seen_ns", "last_seen_ns")
    plain = {n: table[n].to_pylist() for n in ("element_id", "class_name", "model_sha256", *names)}
    attributes, runs = table["attributes"].to_pylist(), table["runs"].to_pylist()
    out = []
    for i in range(table.num_rows):
        row = {name: values[i] for name, values in plain.items()}
        for name, default in (("existence", 0.0), ("seen", 0), ("in_view", 0), ("traversals", 0)):
            row[name] = default if row[name] is None else row[name]
        try:
            out.append(
                Element(
                    points=points[i],
                    covariance=covariances[i],
                    attributes={k: v or "" for k, v in attributes[i] or []},
                    runs=tuple(runs[i] or ()),
                    **row,
                )
            )
        except ValueError as error:
            raise BadInput(path, str(error)) from None
    return out


@lru_cache(maxsize=16)
def _projjson(crs: str) -> Any:
    return parse_crs(crs).to_json_dict()


def geo_metadata(table: pa.Table, crs: str) -> str:
    """The ``geo`` metadata of GeoParquet 1.1 (https://geoparquet.org/releases/v1.1.0/)."""
    kinds = {struct.unpack_from("<I", blob, 1)[0] for blob in table["geometry"].to_pylist()}
    names = {_LINE: "LineString", _POLYGON: "Polygon"}
    column: dict[str, Any] = {
        "encoding": "WKB",
        "geometry_types": sorted(names[k % _Z] + (" Z" if k >= _Z else "") for k in kinds),
        "crs": _projjson(crs),
        "edges": "planar",
        "covering": {"bbox": {name: ["bbox", name] for name in BBOX}},
    }
    if table.num_rows:
        box = _box_columns(table)
        column["bbox"] = [*box[:, :2].min(axis=0).tolist(), *box[:, 2:].max(axis=0).tolist()]
    value = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}
    return json.dumps(value, sort_keys=True)


def _box_columns(table: pa.Table) -> Array:
    """(n, 4) the bbox column."""
    box = table["bbox"].combine_chunks()
    return np.stack([box.field(n).to_numpy(zero_copy_only=False) for n in BBOX], axis=1)


def tile_bytes(table: pa.Table, crs: str, tile: str) -> bytes:
    """The whole Parquet file of a table from ``elements_to_table``; same table → same bytes."""
    import pyarrow.parquet as pq

    extra = {"rtmap.crs": crs, "rtmap.tile": tile, "geo": geo_metadata(table, crs)}
    sink = pa.BufferOutputStream()
    pq.write_table(
        table.replace_schema_metadata(TILE.metadata(extra)),
        sink,
        compression="zstd",
        write_statistics=True,
    )
    return bytes(sink.getvalue())


def tile_statistics(table: pa.Table) -> str:
    """Statistics of a tile for the Delta log: what readers skip whole files by."""
    box = _box_columns(table)
    low = dict(zip(BBOX, box.min(axis=0).tolist(), strict=True))
    high = dict(zip(BBOX, box.max(axis=0).tolist(), strict=True))
    ids = table["element_id"].to_pylist()
    return json.dumps(
        {
            "numRecords": table.num_rows,
            "minValues": {"element_id": min(ids), "bbox": low},
            "maxValues": {"element_id": max(ids), "bbox": high},
            "nullCount": {"element_id": 0, "class_name": 0, "geometry": 0},
        }
    )
