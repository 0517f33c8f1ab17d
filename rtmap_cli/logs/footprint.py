"""Where a log was driven, as the footprint that training on it leaves."""

from __future__ import annotations

import numpy as np

from rtmap_cli.logs.log import Array, Log
from rtmap_cli.maps.crop import Range
from rtmap_cli.maps.footprint import LOCAL, TOWNS, Footprint, footprint_of_poses


def footprint_of_log(log: Log, range_m: Range, poses: Array | None = None) -> Footprint:
    """The cells that the frames of a log see, at its poses or at better ones, (n, 4, 4).

    A simulated drive through a town has no place on earth, whatever CRS it lies in; over a real
    map it has.
    """
    creation = getattr(log, "info", {}).get("creation")
    made = creation if isinstance(creation, dict) and creation.get("simulated") else {}
    if str(made.get("log", "")).startswith("town:"):
        return TOWNS
    if poses is None:
        poses = np.array([f.map_SE3_ego for f in log.frames()]).reshape(-1, 4, 4)
    found = footprint_of_poses(poses, log.crs, range_m)
    return TOWNS if made and LOCAL in found.origins else found
