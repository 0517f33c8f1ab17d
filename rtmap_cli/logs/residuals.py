"""What pulled at the poses of a run: one row per detected vertex that localization looked at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli.tables import TableSchema, write_table

Array = NDArray[np.float64]

RESIDUALS = TableSchema(
    name="rtmap.run.residuals",
    version="1.0",
    frame="map (CRS in rtmap.crs)",
    units="metres",
    description="One row per detected vertex that localization looked at: how far it lies from its "
    "line at the pose that came out, and what it counted.",
    columns=pa.schema(
        [
            ("frame", pa.int32()),
            ("query", pa.int32()),
            ("vertex", pa.int16()),
            ("class_name", pa.string()),
            ("element_id", pa.string()),
            ("x", pa.float64()),
            ("y", pa.float64()),
            ("normal_x", pa.float64()),
            ("normal_y", pa.float64()),
            ("across", pa.float64()),
            ("sigma", pa.float64()),
            ("weight", pa.float64()),
            ("inlier", pa.float64()),
        ]
    ),
)


@dataclass(frozen=True)
class Residuals:
    """Columns of `RESIDUALS` for n vertices: ``frame``, ``query``, ``vertex`` (n,);
    ``class_name``, ``element_id`` (n,), None where no line is near; ``at``, ``normal`` (n, 2) in
    the map frame; ``across``, ``sigma`` (n,) metres, NaN where no line is near; ``weight`` (n,)
    Huber weight of the vertex, ``inlier`` (n,) probability of its element, 0 without a line."""

    frame: NDArray[np.int32]
    query: NDArray[np.int32]
    vertex: NDArray[np.int16]
    class_name: NDArray[Any]
    element_id: NDArray[Any]
    at: Array
    normal: Array
    across: Array
    sigma: Array
    weight: Array
    inlier: Array


def write_residuals(residuals: Residuals, folder: Path, crs: str) -> None:
    """Write residuals.parquet into an existing run."""
    r = residuals
    known = np.isfinite(r.across)
    columns = {
        "frame": r.frame,
        "query": r.query,
        "vertex": r.vertex,
        "class_name": pa.array(list(r.class_name), pa.string()),
        "element_id": pa.array(list(r.element_id), pa.string()),
        "x": r.at[:, 0],
        "y": r.at[:, 1],
        "weight": r.weight,
        "inlier": r.inlier,
    }
    for name, values in (
        ("normal_x", r.normal[:, 0]),
        ("normal_y", r.normal[:, 1]),
        ("across", r.across),
        ("sigma", r.sigma),
    ):
        columns[name] = pa.array(values, pa.float64(), mask=~known)
    write_table(pa.table(columns), folder / "residuals.parquet", RESIDUALS, {"rtmap.crs": crs})
