"""Coordinate reference systems: which may carry a map frame, and conversions between them.

A map frame is a projected CRS with metres on both axes (a UTM zone by default). Longitude and
latitude are WGS84 degrees, always in this order. Everything is vectorised: a scalar call of PROJ
costs as much as some hundred points.
"""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput

if TYPE_CHECKING:
    from pyproj import CRS, Transformer

Array = NDArray[np.float64]

WGS84 = "EPSG:4326"

CITY_ORIGINS: dict[str, tuple[str, float, float]] = {
    "ATX": ("EPSG:32614", 30.27464237939507, -97.7404457407424),
    "DTW": ("EPSG:32617", 42.29993066912924, -83.17555750783717),
    "MIA": ("EPSG:32617", 25.77452579915163, -80.19656914449405),
    "PAO": ("EPSG:32610", 37.416065, -122.13571963362166),
    "PIT": ("EPSG:32617", 40.44177902989321, -80.01294377242584),
    "WDC": ("EPSG:32618", 38.889377, -77.0355047439081),
}
"""CRS, latitude and longitude of the origins of Argoverse 2's city frames (av2 package)."""

CITY_NAMES = {
    "austin": "ATX",
    "dearborn": "DTW",
    "miami": "MIA",
    "palo-alto": "PAO",
    "pittsburgh": "PIT",
    "washington-dc": "WDC",
}
"""Names of the cities in Argoverse 2 motion-forecasting scenarios."""


@lru_cache(maxsize=64)
def _crs(crs: str) -> CRS:
    from pyproj import CRS

    return CRS.from_user_input(crs)


def parse_crs(crs: str, where: str | Path = "CRS") -> CRS:
    """The CRS that a text names; BadInput when PROJ does not know it."""
    from pyproj.exceptions import CRSError

    try:
        return _crs(crs)
    except CRSError:
        raise BadInput(where, f"{crs!r} is not a CRS", "name one as EPSG:32617") from None


def check_map_crs(crs: str, where: str | Path = "--crs") -> str:
    """``crs`` when it can carry a map frame: projected, metres on both axes; else BadInput."""
    found = parse_crs(crs, where)
    todo = "use a projected CRS in metres, e.g. the UTM zone (EPSG:326xx north, EPSG:327xx south)"
    if found.is_engineering:
        raise BadInput(where, f"{found.name} is a local frame without a place on earth", todo)
    if not found.is_projected:
        kind = "geographic (degrees)" if found.is_geographic else "not projected"
        raise BadInput(where, f"{crs} is {kind}, a map frame is not", todo)
    units = {axis.unit_name for axis in found.axis_info[:2]}
    if units != {"metre"}:
        names = ", ".join(sorted(units))
        raise BadInput(where, f"{crs} is in {names}, a map frame is in metres", todo)
    operation = found.coordinate_operation
    if operation is not None and "Pseudo Mercator" in operation.method_name:
        raise BadInput(where, f"{crs} (web Mercator) stretches metres with the latitude", todo)
    return crs


def local_crs(name: str) -> str:
    """An engineering CRS (WKT): metres from an origin whose place on earth nobody states.

    Logs and runs may lie in one; a map folder cannot, its tiles have a place on earth.
    """
    safe = re.sub(r"[^\w .:+-]", "_", name)
    return (
        f'ENGCRS["{safe}",EDATUM["origin of {safe}"],CS[Cartesian,2],'
        'AXIS["x",unspecified,ORDER[1]],AXIS["y",unspecified,ORDER[2]],LENGTHUNIT["metre",1]]'
    )


def is_local(crs: str) -> bool:
    """True for an engineering CRS: coordinates without a place on earth."""
    return bool(parse_crs(crs).is_engineering)


def check_log_crs(crs: str, where: str | Path = "CRS") -> str:
    """``crs`` when it can carry the poses of a log: a map frame, or a local one in metres."""
    found = parse_crs(crs, where)
    if found.is_engineering and {a.unit_name for a in found.axis_info[:2]} == {"metre"}:
        return crs
    return check_map_crs(crs, where)


def same_crs(first: str, second: str) -> bool:
    """True when both texts name one horizontal CRS (axis order aside)."""
    if first == second:
        return True
    return bool(_horizontal(parse_crs(first)).equals(_horizontal(parse_crs(second)), True))


def _horizontal(crs: CRS) -> CRS:
    return crs.sub_crs_list[0] if crs.sub_crs_list else crs


def check_same_crs(crs: str, expected: str, where: str | Path) -> None:
    """BadInput naming both when ``crs`` (of the file ``where``) is not ``expected``."""
    if not same_crs(crs, expected):
        names = [parse_crs(c).name if is_local(c) else c for c in (crs, expected)]
        raise BadInput(
            where, f"its CRS is {names[0]}, expected {names[1]}", f"reproject it to {names[1]}"
        )


@lru_cache(maxsize=64)
def transformer(source: str, target: str) -> Transformer:
    """The best transformation between two CRS, x (east, longitude) first.

    A "ballpark" transformation, which PROJ takes silently when a grid is missing and which may be
    off by a hundred metres, is refused (BadInput).
    """
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    for crs in (source, target):
        if is_local(crs):
            raise BadInput(
                parse_crs(crs).name, "is a local frame without a place on earth", "georeference it"
            )
    try:
        return Transformer.from_crs(
            parse_crs(source),
            parse_crs(target),
            always_xy=True,
            only_best=True,
            allow_ballpark=False,
        )
    except ProjError as error:
        raise BadInput(
            f"{source} to {target}",
            f"no transformation of known accuracy ({error})",
            "install the PROJ grid of this region or choose another CRS",
        ) from None


def convert(source: str, target: str, xy: Array) -> Array:
    """(n, 2) coordinates from one CRS to another; BadInput when one cannot be converted."""
    from pyproj.exceptions import ProjError

    xy = np.asarray(xy, dtype=np.float64)
    flat = xy.reshape(-1, 2)
    try:
        x, y = transformer(source, target).transform(flat[:, 0], flat[:, 1])
    except ProjError as error:
        raise BadInput(f"{source} to {target}", f"cannot be transformed ({error})") from None
    out = np.stack([x, y], axis=-1)
    bad = ~np.isfinite(out).all(axis=1)
    if bad.any():
        point = ", ".join(f"{v:.6g}" for v in flat[bad][0])
        raise BadInput(f"{source} to {target}", f"the point ({point}) lies outside the CRS")
    return out.reshape(xy.shape)


def lonlat_to(crs: str, lonlat: Array) -> Array:
    """(n, 2) WGS84 longitude, latitude in degrees → (n, 2) x, y of ``crs``."""
    return convert(WGS84, crs, lonlat)


def to_lonlat(crs: str, xy: Array) -> Array:
    """(n, 2) x, y of ``crs`` → (n, 2) WGS84 longitude, latitude in degrees."""
    return convert(crs, WGS84, xy)


def city_code(city: str, where: str | Path = "city") -> str:
    """The three-letter code of a city (code or name as in scenarios); BadInput lists the known."""
    code = CITY_NAMES.get(city.lower(), city.upper())
    if code not in CITY_ORIGINS:
        raise BadInput(
            where, f"unknown city {city!r}", f"known cities are {', '.join(CITY_ORIGINS)}"
        )
    return code


def city_crs(city: str, where: str | Path = "city") -> tuple[str, Array]:
    """UTM CRS of an Argoverse 2 city and its origin (easting, northing) in metres.

    City coordinates + origin = UTM coordinates (WGS84, north); heights stay as they are.
    """
    crs, latitude, longitude = CITY_ORIGINS[city_code(city, where)]
    return crs, lonlat_to(crs, np.array([longitude, latitude]))


def utm_crs(longitude: float, latitude: float) -> str:
    """EPSG code of the UTM zone (WGS84) of a place in degrees."""
    zone = int((longitude + 180.0) // 6.0) % 60 + 1
    return f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"
