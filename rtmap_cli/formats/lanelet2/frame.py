"""Where the nodes of a Lanelet2 file lie: latitude and longitude, or Autoware's local_x, local_y.

Autoware takes ``local_x``, ``local_y`` (metres) for the truth where a node has them; they are a
projected frame (UTM, MGRS) minus an offset, and latitude and longitude beside them may be empty or
rounded to a metre. A height is ``ele``; a node without one has none (NaN), which is not 0.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.geojson import check_area
from rtmap_cli.formats.lanelet2.osm import Node, OsmFile, Tags
from rtmap_cli.maps.crs import check_map_crs, lonlat_to, to_lonlat, utm_crs

Array = NDArray[np.float64]

LOCAL = ("local_x", "local_y")
PLACE_TAGS = frozenset({"ele", *LOCAL, "mgrs_code"})
"""Tags of a node that say where it is: they are coordinates, not attributes."""

SHIFT_TOLERANCE = 2.0
"""Metres by which local coordinates may differ from shifted latitudes and longitudes: more than
the metre that some tools round to, less than what another projection would do to a map."""
MGRS_SQUARE = 100_000.0
METRE_DIGITS = 6


@dataclass(frozen=True)
class Frame:
    """The map frame ``crs`` and, where the file has local coordinates, their ``origin`` in it:
    map xy = local xy + origin."""

    crs: str
    origin: tuple[float, float] | None = None

    def as_info(self) -> dict[str, Any]:
        """For the map's history."""
        return {"crs": self.crs, "origin": self.origin}


def node_points(
    osm: OsmFile,
    path: Path,
    crs: str | None,
    origin: tuple[float, float] | None,
    notes: Counter[str],
) -> tuple[dict[int, Array], Frame]:
    """(3,) map coordinates of every node, and the frame. z is NaN where a node has no ``ele``.

    Without ``crs``: the UTM zone (WGS84) of the nodes' middle. ``origin``: where local 0, 0 lies
    in ``crs``, for files that do not tell it by latitudes and longitudes. BadInput when a node has
    no coordinates, or when nothing tells the place on earth.
    """
    ids = list(osm.nodes)
    nodes = [osm.nodes[i] for i in ids]
    lonlat = np.array([(n.longitude, n.latitude) for n in nodes]).reshape(-1, 2)
    local = _tag_columns(nodes, ids, LOCAL, path)
    height = _tag_columns(nodes, ids, ("ele",), path)
    placed = np.isfinite(local).all(axis=1)
    # Some tools write 0, 0 where they know no latitude and longitude.
    lonlat[placed & (lonlat == 0).all(axis=1)] = np.nan
    on_earth = np.isfinite(lonlat).all(axis=1)
    if not (on_earth | placed).all():
        lost = ids[int(np.flatnonzero(~(on_earth | placed))[0])]
        raise BadInput(path, f"node {lost} has neither latitude and longitude nor local_x, local_y")
    if origin is not None and crs is None:
        raise BadInput(path, "an origin without the CRS that it is in", "pass --crs too")
    if not on_earth.any() and origin is None:
        raise BadInput(
            path,
            "its nodes have no latitude and longitude, so their place on earth is unknown",
            "pass --crs and --origin (where local 0, 0 lies in it, metres)",
        )
    if crs is None:
        middle = (lonlat[on_earth].min(axis=0) + lonlat[on_earth].max(axis=0)) / 2
        crs = utm_crs(float(middle[0]), float(middle[1]))
    crs = check_map_crs(crs)
    check_area(crs, lonlat[on_earth], path)
    xy = np.full((len(ids), 2), np.nan)
    xy[on_earth] = lonlat_to(crs, lonlat[on_earth])
    frame = Frame(crs, origin or _origin(xy, local, on_earth & placed, notes))
    if frame.origin is not None:
        xy[placed] = local[placed] + frame.origin
    if not np.isfinite(xy).all():
        lost = ids[int(np.flatnonzero(~np.isfinite(xy).all(axis=1))[0])]
        raise BadInput(
            path,
            f"node {lost} has local_x, local_y alone, and the others do not tell their origin",
            "pass --crs and --origin",
        )
    if origin is not None:
        check_area(crs, to_lonlat(crs, xy), path)
    return dict(zip(ids, np.column_stack([xy, height]), strict=True)), frame


def _origin(
    xy: Array, local: Array, both: NDArray[np.bool_], notes: Counter[str]
) -> tuple[float, float] | None:
    """Where local 0, 0 lies in the map frame, from the nodes that have ``both``.

    None where the local frame is no shifted map frame (turned, scaled): then latitude and longitude
    count. Latitudes that are rounded to a metre move the median by half a metre: an origin near a
    corner of an MGRS square is that corner.
    """
    if not both.any():
        return None
    apart = xy[both] - local[both]
    origin = np.median(apart, axis=0)
    if np.hypot(*(apart - origin).T).max() > SHIFT_TOLERANCE:
        notes["nodes whose local_x, local_y are of another frame (latitude, longitude taken)"] += (
            int(both.sum())
        )
        return None
    for grid, near in ((MGRS_SQUARE, 1.0), (1.0, 1e-3)):
        snapped = np.round(origin / grid) * grid
        if np.abs(snapped - origin).max() <= near:
            origin = snapped
            break
    return float(origin[0]), float(origin[1])


def _tag_columns(nodes: list[Node], ids: list[int], keys: tuple[str, ...], path: Path) -> Array:
    """(n, len(keys)) numbers among the tags; NaN where absent or empty."""
    out = np.full((len(nodes), len(keys)), np.nan)
    for i, node in enumerate(nodes):
        for k, key in enumerate(keys):
            text = node.tags.get(key, "").strip()
            if not text:
                continue
            try:
                out[i, k] = float(text)
            except ValueError:
                out[i, k] = math.inf
            if not math.isfinite(out[i, k]):
                raise BadInput(path, f"node {ids[i]}: {key} is {text[:40]!r}, not a number")
    return out


def placed_nodes(
    points: dict[int, Array], tags: dict[int, Tags], frame: Frame, local: bool
) -> dict[int, Node]:
    """Nodes from (3,) map coordinates, the reverse of ``node_points``.

    With ``local`` they get local_x and local_y too, from the frame's origin (0, 0 without one).
    """
    if not points:
        return {}
    ids = sorted(points)
    xyz = np.stack([points[i] for i in ids])
    lonlat = to_lonlat(frame.crs, xyz[:, :2])
    place = xyz[:, :2] - (frame.origin or (0.0, 0.0))
    out = {}
    for k, number in enumerate(ids):
        own: Tags = {}
        if local:
            own = {key: _metres(v) for key, v in zip(LOCAL, place[k], strict=True)}
        if np.isfinite(xyz[k, 2]):
            own["ele"] = _metres(xyz[k, 2])
        out[number] = Node(float(lonlat[k, 1]), float(lonlat[k, 0]), own | tags.get(number, {}))
    return out


def _metres(value: float) -> str:
    text = f"{value:.{METRE_DIGITS}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
