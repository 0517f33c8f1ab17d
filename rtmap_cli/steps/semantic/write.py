"""The folder of a semantic map: rasters for networks, cells and pictures for people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from rtmap_cli import __version__
from rtmap_cli.logs.semantic import (
    CELLS,
    CLASSES,
    COLOURS,
    EVIDENCE,
    SEMANTIC_SCHEMA,
    SEMANTIC_VERSION,
    WINDOWS,
    Window,
)
from rtmap_cli.logs.tables import pose_columns
from rtmap_cli.steps.semantic.evidence import Weighting
from rtmap_cli.steps.semantic.raster import FRAMES, HEIGHT, TILE, K, Raster
from rtmap_cli.tables import write_json, write_table

Array = NDArray[np.float64]

PALETTE = np.array([COLOURS[n] for n in CLASSES], np.uint8)
CONFIDENT = 1.0
"""Weight from which a cell is drawn in full colour."""
OVERVIEW = 2400
"""Longest side of the overview picture (px)."""


def write_window(folder: Path, frame: int, planes: NDArray[np.uint8]) -> str:
    """Write a raster (K + 1, rows, columns) as one PNG, its planes one below the other; returns its
    path in the folder."""
    relative = f"windows/{frame:06d}.png"
    path = folder / relative
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(planes.reshape(-1, planes.shape[2])).save(path, compress_level=2)
    return relative


def write_windows_table(
    folder: Path, crs: str, rows: Sequence[tuple[int, int, int, str]], poses: Array
) -> None:
    """windows.parquet of rows (frame, time, points, path) and their poses (n, 4, 4)."""
    frame, time, points, path = zip(*rows, strict=True) if rows else ((), (), (), ())
    columns: dict[str, Any] = {"frame": list(frame), "timestamp_ns": list(time)}
    columns |= pose_columns(poses) | {"points": list(points)}
    columns["path"] = pa.array(list(path), pa.string())
    write_table(pa.table(columns), folder / "windows.parquet", WINDOWS, {"rtmap.crs": crs})


def write_cells(folder: Path, crs: str, raster: Raster, weighting: Weighting) -> int:
    """cells.parquet, tile by tile; returns the number of cells."""
    parts: list[dict[str, NDArray[Any]]] = []
    for (ti, tj), tile in raster:
        j, i = np.nonzero(tile[..., FRAMES])
        values = tile[j, i]
        weight = values[:, :K].sum(axis=1)
        share = weighting.probabilities(values[:, :K])
        part: dict[str, NDArray[Any]] = {
            "x": (ti * TILE + i + 0.5) * raster.cell,
            "y": (tj * TILE + j + 0.5) * raster.cell,
            "z": values[:, HEIGHT] / weight,
            "class_name": share.argmax(axis=1).astype(np.int8),
            "weight": weight,
            "frames": values[:, FRAMES].astype(np.int32),
        }
        parts.append(part | {f"p_{n}": share[:, k] for k, n in enumerate(CLASSES)})
    columns: dict[str, Any] = {n: np.concatenate([p[n] for p in parts]) for n in parts[0]}
    names = pa.DictionaryArray.from_arrays(pa.array(columns["class_name"]), pa.array(CLASSES))
    columns["class_name"] = names.cast(pa.string())
    write_table(
        pa.table(columns), folder / "cells.parquet", CELLS, {"rtmap.crs": crs}, group=1 << 16
    )
    return len(columns["x"])


def tile_picture(tile: NDArray[np.float32], weighting: Weighting) -> NDArray[np.uint8]:
    """(TILE, TILE, 4) RGBA of a tile, north up: the colour of the likeliest class, as opaque as it
    is certain; nothing where nothing was seen."""
    counts = tile[..., :K]
    share = weighting.probabilities(counts)
    alpha = share.max(axis=-1) * np.minimum(1, counts.sum(axis=-1) / CONFIDENT)
    out = np.empty((*tile.shape[:2], 4), np.uint8)
    out[..., :3] = PALETTE[share.argmax(axis=-1)]
    out[..., 3] = np.round(255 * alpha)
    return out[::-1]


def write_tiles(folder: Path, crs: str, raster: Raster, weighting: Weighting, track: Array) -> int:
    """tiles/<i>_<j>.png with .pgw (world file) and .prj, and overview.png with the track (n, 2);
    returns the number of tiles."""
    place = folder / "tiles"
    place.mkdir()
    pictures = {key: tile_picture(tile, weighting) for key, tile in raster}
    projection = _projection(crs)
    side = TILE * raster.cell
    for (ti, tj), picture in pictures.items():
        name = f"{ti}_{tj}"
        Image.fromarray(picture, "RGBA").save(place / f"{name}.png", compress_level=4)
        (place / f"{name}.prj").write_text(projection + "\n", encoding="utf-8")
        lines = world_file(ti * side, (tj + 1) * side, raster.cell)
        (place / f"{name}.pgw").write_text(lines, encoding="ascii")
    _write_overview(folder, crs, pictures, raster.cell, track)
    return len(pictures)


def world_file(west: float, north: float, cell: float) -> str:
    """Six lines: pixel size in x, two zeros, minus pixel size in y, centre of the first pixel."""
    values = (cell, 0.0, 0.0, -cell, west + cell / 2, north - cell / 2)
    return "".join(f"{v:.10g}\n" for v in values)


def _write_overview(
    folder: Path, crs: str, pictures: dict[tuple[int, int], NDArray[np.uint8]], cell: float,
    track: Array,
) -> None:  # fmt: skip
    """overview.png: all tiles on black, cropped to what was seen, smaller where it is large."""
    keys = np.array(list(pictures))
    (i0, j0), (i1, j1) = keys.min(axis=0), keys.max(axis=0)
    step = max(1, int(np.ceil((max(i1 - i0, j1 - j0) + 1) * TILE / OVERVIEW)))
    small = TILE // step
    size = (int(i1 - i0 + 1) * small, int(j1 - j0 + 1) * small)
    canvas = Image.new("RGB", size)
    for (ti, tj), picture in pictures.items():
        part = Image.fromarray(picture, "RGBA").resize((small, small), Image.Resampling.BOX)
        canvas.paste(part, (int(ti - i0) * small, int(j1 - tj) * small), part)
    pixel = TILE * cell / small
    west, north = i0 * TILE * cell, (j1 + 1) * TILE * cell
    path = np.stack([(track[:, 0] - west) / pixel, (north - track[:, 1]) / pixel], axis=-1)
    box = canvas.getbbox() or (0, 0, *size)
    if len(path) > 1:
        ImageDraw.Draw(canvas).line([tuple(p) for p in path.tolist()], (255, 255, 255), 1)
    canvas.crop(box).save(folder / "overview.png")
    lines = world_file(west + box[0] * pixel, north - box[1] * pixel, pixel)
    (folder / "overview.pgw").write_text(lines, encoding="ascii")
    (folder / "overview.prj").write_text(_projection(crs) + "\n", encoding="utf-8")


def _projection(crs: str) -> str:
    """The CRS as GIS programs want it beside a picture; its own text where it is a local one."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        return str(CRS(crs).to_wkt("WKT1_ESRI"))
    except CRSError:
        return crs


def write_info(
    folder: Path, log_id: str, crs: str, window: Window, cell: float, said: dict[str, Any]
) -> None:
    """semantic.json; ``said`` is how the map was made."""
    write_json(
        {
            "schema": SEMANTIC_SCHEMA,
            "schema_version": SEMANTIC_VERSION,
            "log_id": log_id,
            "crs": crs,
            "classes": list(CLASSES),
            "colours": {n: list(COLOURS[n]) for n in CLASSES},
            "cell": cell,
            "window": {
                "half_x": window.half_x,
                "half_y": window.half_y,
                "cell": window.cell,
                "rows": window.rows,
                "columns": window.columns,
                "planes": [*CLASSES, EVIDENCE],
                "layout": "8-bit PNG of (planes × rows) × columns; column 0 at ego x = -half_x, "
                "row 0 at ego y = -half_y; columns go forward, rows to the left",
                "values": "class planes: probability × 255; evidence: 255 (1 - exp(-weight)); "
                "0 in all planes where nothing was seen",
            },
            "creation": {"rtmap_version": __version__, **said},
        },
        folder / "semantic.json",
    )
