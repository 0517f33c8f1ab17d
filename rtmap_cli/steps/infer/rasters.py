"""The semantic rasters of a log as a network wants them: checked against what both say."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.log import Log
from rtmap_cli.logs.semantic import EVIDENCE, SemanticMap

MAKE = "run rtmap semantic-map LOG -o LOG/semantic, or name its folder with --semantic"


@dataclass(frozen=True)
class RasterSpec:
    """The rasters that a network reads: ``planes`` in their order, the last one of evidence;
    ``cell`` (m); ``half_x`` and ``half_y``, half the extent (m)."""

    planes: tuple[str, ...]
    cell: float
    half_x: float
    half_y: float

    @property
    def shape(self) -> tuple[int, int, int]:
        """Planes, rows (y), columns (x)."""
        rows, columns = (round(2 * half / self.cell) for half in (self.half_y, self.half_x))
        return len(self.planes), rows, columns


class LogRasters:
    """The semantic map of a log, by default its folder ``semantic``. BadInput when there is none,
    when it is another log's, and when its planes, cells or window are not those of ``spec``."""

    def __init__(self, log: Log, spec: RasterSpec, folder: Path | None = None) -> None:
        place = folder
        if place is None:
            place = log.path / "semantic"
            if not (place / "semantic.json").exists():
                raise BadInput(log.path, "the log carries no semantic rasters", MAKE)
        self.rasters = SemanticMap(place)
        if self.rasters.log_id != log.log_id or self.rasters.crs != log.crs:
            what = f"rasters of the log {self.rasters.log_id}, not of {log.log_id}"
            raise BadInput(place, what, MAKE)
        self._check(place, spec)
        self.times = dict(
            zip(self.rasters.frame.tolist(), self.rasters.timestamp_ns.tolist(), strict=True)
        )
        if not self.times:
            raise BadInput(place, "has no window of any frame", "leave out --windows none")
        self.path = place

    def _check(self, place: Path, spec: RasterSpec) -> None:
        planes = (*self.rasters.classes, EVIDENCE)
        if planes != spec.planes:
            raise BadInput(
                place,
                f"has the planes {', '.join(planes)}; the model reads {', '.join(spec.planes)}",
                "use a model of these classes, or make the rasters anew",
            )
        have = self.rasters.window
        if any(
            abs(a - b) > 1e-6
            for a, b in (
                (have.cell, spec.cell), (have.half_x, spec.half_x), (have.half_y, spec.half_y)
            )
        ):  # fmt: skip
            raise BadInput(
                place,
                f"has windows of ±{have.half_x:g} × ±{have.half_y:g} m in cells of "
                f"{have.cell:g} m; the model reads ±{spec.half_x:g} × ±{spec.half_y:g} m in "
                f"cells of {spec.cell:g} m",
                f"run rtmap semantic-map --cell {spec.cell:g} --window {spec.half_x:g} "
                f"{spec.half_y:g}",
            )

    def read(self, frame: int, timestamp_ns: int) -> NDArray[np.uint8]:
        """(K, rows, columns) of a frame of the log; BadInput when there is no such raster or it was
        made of another time."""
        raster = self.rasters.read_window(frame)
        if self.times[frame] != timestamp_ns:
            raise BadInput(self.path, f"frame {frame} has another time there", "another log's?")
        return raster

    def __contains__(self, frame: int) -> bool:
        return frame in self.times

    def pose(self, frame: int) -> NDArray[np.float64]:
        """(4, 4) map_SE3_ego that the raster of a frame was laid down with."""
        row = int(np.flatnonzero(self.rasters.frame == frame)[0])
        return np.asarray(self.rasters.map_SE3_ego[row], np.float64)
