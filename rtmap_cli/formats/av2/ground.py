"""The ground-height raster of an Argoverse 2 log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.tables import read_json

Array = NDArray[np.float64]


class GroundHeight:
    """Heights of the ground in the map frame, metres, NaN where unknown.

    ``cells`` (rows, columns) float32; cell (column, row) = s (R (xy - origin) + t): cells are
    points at integers, 0.3 m apart (the Sim2 file gives R, t and s).
    """

    def __init__(self, cells: Array, rotation: Array, shift: Array, scale: float, origin: Array):
        self.cells = np.asarray(cells, np.float32)
        self.rotation, self.shift, self.scale = rotation, shift, float(scale)
        self.origin = origin

    def at(self, xy: Array) -> Array:
        """(n,) heights under (n, 2) points of the map frame, bilinear.

        NaN outside the raster and where one of the four cells around is unknown.
        """
        local = np.asarray(xy, np.float64)[:, :2] - self.origin
        grid = (local @ self.rotation.T + self.shift) * self.scale
        rows, columns = self.cells.shape
        inside = (grid >= 0).all(axis=1) & (grid[:, 0] <= columns - 1) & (grid[:, 1] <= rows - 1)
        out = np.full(len(grid), np.nan)
        g = grid[inside]
        low = np.minimum(np.floor(g).astype(np.int64), [columns - 2, rows - 2])
        u, v = (g - low).T
        c, r = low.T
        z = self.cells
        corners = [z[r + j, c + i].astype(np.float64) for j in (0, 1) for i in (0, 1)]
        weights = [(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v]
        out[inside] = sum(w * corner for w, corner in zip(weights, corners, strict=True))
        return out

    @property
    def unknown_share(self) -> float:
        """Share of the cells without a height."""
        return float(np.isnan(self.cells).mean())


def read_ground(folder: Path, origin: Array) -> GroundHeight | None:
    """The raster in ``folder``/map, or None; ``origin`` is the city origin in UTM metres."""
    rasters = sorted((folder / "map").glob("*ground_height_surface*.npy"))
    if not rasters:
        return None
    frames = sorted((folder / "map").glob("*img_Sim2_city.json"))
    if not frames:
        raise BadInput(folder / "map", "the ground raster has no *_img_Sim2_city.json beside it")
    try:
        cells = np.load(rasters[0], allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise BadInput(rasters[0], f"cannot be read as a height raster ({error})") from None
    if cells.ndim != 2 or min(cells.shape) < 2 or cells.dtype.kind != "f":
        raise BadInput(rasters[0], f"not a raster of heights (shape {cells.shape}, {cells.dtype})")
    sim2 = read_json(frames[0])
    try:
        rotation = np.array(sim2["R"], np.float64).reshape(2, 2)
        shift = np.array(sim2["t"], np.float64).reshape(2)
        scale = float(sim2["s"])
    except (KeyError, TypeError, ValueError):
        raise BadInput(frames[0], "not a Sim2 (R, t and s)") from None
    return GroundHeight(cells, rotation, shift, scale, origin)
