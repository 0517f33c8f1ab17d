"""The report of an update: heat maps and cells as pictures and as GeoParquet."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rtmap_cli.maps.crs import parse_crs
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.steps.update.accumulate import Heat
from rtmap_cli.steps.update.cells import NEVER, UNCLEAR, Cell
from rtmap_cli.steps.update.compare import MISSING_NEW, MISSING_OLD, MOVED
from rtmap_cli.steps.update.settings import Settings
from rtmap_cli.steps.update.update import Update
from rtmap_cli.tables import TableSchema, whole_folder

if TYPE_CHECKING:
    from PIL.Image import Image

Array = NDArray[np.float64]

HEAT = TableSchema(
    name="rtmap.update.heat",
    version="1.0",
    frame="map (x east, y north; CRS in geo)",
    units="metres",
    description="One row per class and grid cell that some drive found something in: GeoParquet.",
    columns=pa.schema(
        [
            ("class_name", pa.string()),
            ("confidence", pa.float32()),
            ("drives", pa.float32()),
            ("looked", pa.float32()),
            ("geometry", pa.binary()),
        ]
    ),
)
CELLS = TableSchema(
    name="rtmap.update.cells",
    version="1.0",
    frame="map (x east, y north; CRS in geo)",
    units="metres",
    description="One row per cell: how well map and predictions agree, and why it is flagged.",
    columns=pa.schema(
        [
            ("ap", pa.float64()),
            ("flagged", pa.bool_()),
            ("reason", pa.string()),
            ("observed", pa.float64()),
            ("missing_in_old_m", pa.float64()),
            ("missing_in_new_m", pa.float64()),
            ("moved_m", pa.float64()),
            ("classes", pa.map_(pa.string(), pa.float64())),
            ("geometry", pa.binary()),
        ]
    ),
)
SHOWN = 0.02
"""Grid cells of less confidence are left out."""
COLOURS = {
    MISSING_OLD: (25, 150, 60),
    MISSING_NEW: (215, 35, 35),
    MOVED: (200, 120, 0),
    NEVER: (150, 150, 150),
    UNCLEAR: (120, 140, 200),
}
WIDEST = 2400
"""Pixels of a picture's longer side, at most."""
MARGIN = 12.0


def write_report(
    found: Update, old: VectorMap, settings: Settings, folder: Path, overwrite: bool
) -> None:
    """``heat.parquet``, ``cells.parquet``, ``heat-<class>.png`` with world files, ``cells.png``:
    the folder appears whole or not at all."""
    with whole_folder(folder, overwrite) as temporary:
        _write(_heat_table(found.heat), HEAT, ["Point"], old.crs, temporary / "heat.parquet")
        cells = _cell_table(found.cells)
        _write(cells, CELLS, ["Polygon"], old.crs, temporary / "cells.parquet")
        for name in found.heat.total:
            _heat_picture(found.heat, name, temporary / f"heat-{name}.png")
        _cell_picture(found, old, settings).save(temporary / "cells.png")


def _write(table: pa.Table, schema: TableSchema, kinds: list[str], crs: str, path: Path) -> None:
    """GeoParquet 1.1 with WKB in the map frame."""
    column = {"encoding": "WKB", "geometry_types": kinds, "crs": parse_crs(crs).to_json_dict()}
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}
    extra = {"rtmap.crs": crs, "geo": json.dumps(geo, sort_keys=True)}
    typed = table.select(schema.columns.names).cast(schema.columns)
    pq.write_table(typed.replace_schema_metadata(schema.metadata(extra)), path, compression="zstd")


def _heat_table(heat: Heat) -> pa.Table:
    import shapely

    parts: dict[str, list[Any]] = {n: [] for n in HEAT.columns.names}
    for name in heat.total:
        confidence = heat.confidence(name).ravel()
        flat = np.flatnonzero(confidence >= SHOWN)
        xy = heat.layout.centres(flat)
        parts["class_name"].append(np.full(len(flat), name, object))
        parts["confidence"].append(confidence[flat])
        parts["drives"].append(heat.drives(name).ravel()[flat])
        parts["looked"].append(heat.looked.ravel()[flat])
        parts["geometry"].append(shapely.to_wkb(shapely.points(xy)))
    return pa.table(
        {
            n: pa.array(np.concatenate(parts[n]), HEAT.columns.field(n).type)
            for n in HEAT.columns.names
        }
    )


def _cell_table(cells: Sequence[Cell]) -> pa.Table:
    import shapely

    columns: dict[str, list[Any]] = {
        "ap": [c.ap for c in cells],
        "flagged": [c.flagged for c in cells],
        "reason": [c.reason or None for c in cells],
        "observed": [c.observed for c in cells],
        "missing_in_old_m": [c.metres[MISSING_OLD] for c in cells],
        "missing_in_new_m": [c.metres[MISSING_NEW] for c in cells],
        "moved_m": [c.metres[MOVED] for c in cells],
        "classes": [sorted(c.classes.items()) for c in cells],
        "geometry": [shapely.to_wkb(shapely.Polygon(c.ring)) for c in cells],
    }
    return pa.table({n: pa.array(v, CELLS.columns.field(n).type) for n, v in columns.items()})


# ---- pictures


def _heat_picture(heat: Heat, name: str, path: Path) -> None:
    """One pixel per grid cell (per some, where there are many), north up, with a world file."""
    from PIL import Image

    confidence = heat.confidence(name).ravel()
    flat = np.flatnonzero(confidence >= SHOWN)
    every = np.flatnonzero((heat.looked.ravel() > 0) | (confidence >= SHOWN))
    cells = heat.layout.cells(every if len(every) else np.zeros(1, np.int64))
    low, high = cells.min(axis=0), cells.max(axis=0)
    scale = int(max(1, np.ceil((high - low).max() / WIDEST)))
    width, height = ((high - low) // scale + 1).tolist()
    grid = np.full((height, width), -1.0)
    place = (cells - low) // scale
    grid[place[:, 1], place[:, 0]] = 0.0
    hot = (heat.layout.cells(flat) - low) // scale
    np.maximum.at(grid, (hot[:, 1], hot[:, 0]), confidence[flat])
    Image.fromarray(_coloured(grid)[::-1].copy()).save(path)
    size = scale * heat.layout.cell
    left, top = (
        (low[0] * heat.layout.cell + size / 2),
        ((low[1] + height * scale) * heat.layout.cell),
    )
    numbers = [size, 0.0, 0.0, -size, left, top - size / 2]
    path.with_suffix(".pgw").write_text("".join(f"{v:.4f}\n" for v in numbers), encoding="utf-8")


def _coloured(grid: Array) -> NDArray[np.uint8]:
    """White to dark red over the confidence; grey where nobody looked."""
    at = np.clip(grid, 0.0, 0.8) / 0.8
    stops = np.array([0.0, 0.15, 0.4, 0.7, 1.0])
    colours = np.array(
        [[252, 252, 250], [255, 220, 130], [250, 140, 50], [200, 40, 30], [90, 0, 30]]
    )
    out = np.stack([np.interp(at, stops, colours[:, k]) for k in range(3)], axis=-1)
    out[grid < 0] = 226
    return out.astype(np.uint8)


def _cell_picture(found: Update, old: VectorMap, settings: Settings) -> Image:
    """The map with its cells: old lines grey, extracted ones blue, flags by reason, AP in each."""
    from PIL import Image, ImageDraw

    cells = found.cells
    corner = np.array([c.ring for c in cells]).reshape(-1, 2)
    if not len(corner):
        corner = np.zeros((1, 2))
    low, high = corner.min(axis=0) - MARGIN, corner.max(axis=0) + MARGIN
    scale = float(min(WIDEST / (high - low).max(), 10.0))
    width, height = (int(v) for v in np.ceil((high - low) * scale))
    picture = Image.new("RGB", (width, height + 26), (255, 255, 255))
    draw = ImageDraw.Draw(picture, "RGBA")

    def pixels(xy: Array) -> list[tuple[float, float]]:
        at = (xy - low) * scale
        return [(float(x), float(height - y)) for x, y in at]

    for c in cells:
        colour = COLOURS.get(c.reason)
        fill = None if colour is None else (*colour, 70 if c.flagged else 28)
        draw.polygon(pixels(c.ring), fill=fill, outline=(205, 205, 205))
    for e in old:
        if (e.xy.max(axis=0) >= low).all() and (e.xy.min(axis=0) <= high).all():
            draw.line(pixels(e.xy), fill=(125, 125, 125), width=2)
    for line in found.lines:
        draw.line(pixels(line.points), fill=(40, 90, 200, 170), width=2)
    for event in found.events:
        colour = COLOURS[found.reasons[event.change_id]]
        draw.line(pixels(event.points[:, :2]), fill=(*colour, 255), width=5)
    for c in cells:
        if np.isfinite(c.ap):
            x, y = pixels(np.array([[c.low[0] + 1.0, c.low[1] + c.size - 1.0]]))[0]
            draw.text((x, y), f"{c.ap:.2f}", fill=(60, 60, 60))
    x = 8
    told = {"old map": (125, 125, 125), "accumulated": (40, 90, 200)} | COLOURS
    for text, colour in told.items():
        draw.rectangle((x, height + 8, x + 12, height + 18), fill=colour)
        draw.text((x + 17, height + 7), text, fill=(30, 30, 30))
        x += 30 + int(draw.textlength(text))
    return picture
