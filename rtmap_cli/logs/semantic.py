"""Semantic map folders: what `rtmap semantic-map` writes and networks read (docs/semantic-map.md).

semantic.json          classes, cell size, window, planes, how it was made
windows.parquet        one row per frame: time, pose, raster file
windows/<frame>.png    the raster of one frame: planes one below the other, 8 bits
cells.parquet          every observed cell of the map frame
tiles/<i>_<j>.png      the same as pictures, each with a world file and its CRS
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.native import paths_inside
from rtmap_cli.logs.tables import POSE, TIME, load, poses_of_table
from rtmap_cli.tables import TableSchema, read_json

Array = NDArray[np.float64]

SEMANTIC_SCHEMA, SEMANTIC_VERSION = "rtmap.semantic", "1.0"

CLASSES = ("road", "crosswalk", "marking", "curb", "sidewalk", "terrain")
"""What a cell of the ground can be, in the order of the planes of a raster."""

COLOURS = {
    "road": (96, 96, 104),
    "crosswalk": (66, 135, 245),
    "marking": (255, 236, 80),
    "curb": (220, 60, 60),
    "sidewalk": (214, 120, 200),
    "terrain": (84, 150, 84),
}
"""RGB of each class in pictures."""

EVIDENCE = "evidence"
"""Last plane of a raster: 255 · (1 − exp(−w)), w the weight of all that was seen in the cell."""

WINDOWS = TableSchema(
    name="rtmap.semantic.windows",
    version="1.0",
    frame="map_SE3_ego: ego (x forward, y left, z up) to map (CRS in rtmap.crs)",
    units=f"metres, {TIME}; unit quaternions w, x, y, z",
    description="One row per frame: the pose that its points were laid down with, and its raster.",
    columns=pa.schema(
        [("frame", pa.int32()), ("timestamp_ns", pa.int64())]
        + [(n, pa.float64()) for n in POSE]
        + [("points", pa.int32()), ("path", pa.string())]
    ),
)

CELLS = TableSchema(
    name="rtmap.semantic.cells",
    version="1.0",
    frame="map (CRS in rtmap.crs): x east, y north, z up; centres of cells",
    units="metres; probabilities in [0, 1]",
    description="One row per observed cell of the ground: its likeliest class and what speaks for "
    "it.",
    columns=pa.schema(
        [("x", pa.float64()), ("y", pa.float64()), ("z", pa.float32())]
        + [("class_name", pa.string())]
        + [(f"p_{n}", pa.float32()) for n in CLASSES]
        + [("weight", pa.float32()), ("frames", pa.int32())]
    ),
)


@dataclass(frozen=True)
class Window:
    """The ego window of a raster: ``columns`` × ``rows`` cells of ``cell`` metres. Column 0 begins
    at ego x = −``half_x``, row 0 at ego y = −``half_y``: columns go forward, rows to the left."""

    half_x: float
    half_y: float
    cell: float

    @property
    def rows(self) -> int:
        """Cells from right to left."""
        return round(2 * self.half_y / self.cell)

    @property
    def columns(self) -> int:
        """Cells from rear to front."""
        return round(2 * self.half_x / self.cell)

    def centres(self) -> Array:
        """(rows, columns, 2) ego x, y of the cells' centres, metres."""
        x = (np.arange(self.columns) + 0.5) * self.cell - self.half_x
        y = (np.arange(self.rows) + 0.5) * self.cell - self.half_y
        return np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1)


class SemanticMap:
    """Reads a semantic map folder: tables at once, rasters when asked for."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.info = read_semantic_info(self.path)
        self.log_id, self.crs = str(self.info["log_id"]), str(self.info["crs"])
        self.classes = tuple(self.info["classes"])
        window = self.info["window"]
        self.window = Window(window["half_x"], window["half_y"], window["cell"])
        self._file = self.path / "windows.parquet"
        table = load(self._file, WINDOWS)
        self.frame = table["frame"].to_numpy().astype(np.int64)
        self.timestamp_ns = table["timestamp_ns"].to_numpy()
        self.map_SE3_ego = poses_of_table(table, self._file)
        files = paths_inside(self.path, table["path"].to_pylist(), self._file)
        self._files = dict(zip(self.frame.tolist(), files, strict=True))

    def __len__(self) -> int:
        return len(self.frame)

    def read_window(self, frame: int) -> NDArray[np.uint8]:
        """(K + 1, rows, columns) of one frame: the probability of each class times 255, then
        `EVIDENCE`; all planes are 0 where nothing was seen. BadInput when it is missing or has
        another size."""
        from PIL import Image

        if frame not in self._files:
            raise BadInput(self._file, f"has no raster of frame {frame}")
        path = self._files[frame]
        shape = (len(self.classes) + 1, self.window.rows, self.window.columns)
        try:
            with Image.open(path) as image:
                planes = np.asarray(image)
        except FileNotFoundError:
            raise BadInput(path, "no such raster") from None
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            raise BadInput(
                path, "cannot be read as a PNG", "run rtmap semantic-map again"
            ) from None
        if planes.shape != (shape[0] * shape[1], shape[2]) or planes.dtype != np.uint8:
            raise BadInput(path, f"is not the 8-bit raster of {shape} that semantic.json states")
        return planes.reshape(shape)


def read_semantic_info(folder: Path) -> dict[str, Any]:
    """semantic.json of a folder, checked (BadInput says what is missing)."""
    path = folder / "semantic.json"
    if not path.exists():
        raise BadInput(folder, "is not a semantic map (no semantic.json)", "rtmap semantic-map LOG")
    info = read_json(path)
    if not isinstance(info, dict) or info.get("schema") != SEMANTIC_SCHEMA:
        raise BadInput(path, f"not a semantic map (schema is not {SEMANTIC_SCHEMA})")
    version = str(info.get("schema_version", "?"))
    if version.split(".")[0] != SEMANTIC_VERSION.split(".")[0]:
        raise BadInput(path, f"version {version} is unknown (this rtmap reads {SEMANTIC_VERSION})")
    for key in ("log_id", "crs", "classes", "window"):
        if key not in info:
            raise BadInput(path, f"{key} is missing")
    return info
