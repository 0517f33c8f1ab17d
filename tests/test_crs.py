"""CRS: city frames, conversions, and which CRS may carry a map frame."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rtmap_cli.errors import BadInput
from rtmap_cli.maps import crs

# Easting and northing of the six origins (m), from the table of the Argoverse 2 conventions.
ORIGINS = {
    "ATX": ("EPSG:32614", 621150.027, 3349890.000),
    "DTW": ("EPSG:32617", 320669.935, 4685369.999),
    "MIA": ("EPSG:32617", 580560.009, 2850960.000),
    "PAO": ("EPSG:32610", 576480.001, 4141379.935),
    "PIT": ("EPSG:32617", 583710.007, 4477260.000),
    "WDC": ("EPSG:32618", 323460.000, 4306469.987),
}


@pytest.mark.parametrize("city", ORIGINS)
def test_city_origins(city: str) -> None:
    code, origin = crs.city_crs(city)
    assert code == ORIGINS[city][0]
    np.testing.assert_allclose(origin, ORIGINS[city][1:], atol=6e-4)


def test_city_names_of_scenarios() -> None:
    assert crs.city_crs("palo-alto")[0] == "EPSG:32610"
    assert crs.city_crs("washington-dc")[0] == "EPSG:32618"


def test_unknown_city_lists_the_known_ones() -> None:
    with pytest.raises(BadInput, match="ATX, DTW, MIA, PAO, PIT, WDC"):
        crs.city_crs("SFO", "log_map_archive_x.json")


def test_origins_of_the_sample_data(rtmap_data: Path) -> None:
    file = rtmap_data / "av2_forecasting_osm" / "city_utm.json"
    if not file.exists():
        pytest.skip("av2_forecasting_osm not found in RTMAP_DATA")
    for city, origin in json.loads(file.read_text()).items():
        np.testing.assert_allclose(crs.city_crs(city)[1], origin, atol=1e-6)


def test_tbv_labels_agree_with_their_gps(rtmap_data: Path) -> None:
    """Change labels of Trust-but-Verify carry city and GPS coordinates of the same polygons."""
    file = rtmap_data / "tbv" / "tbv_val_split_annotations.json"
    if not file.exists():
        pytest.skip("tbv labels not found in RTMAP_DATA")
    errors = []
    for log in json.loads(file.read_text()):
        for event in log["events"]:
            if "GPS Coords" not in event or "City Coords" not in event:
                continue
            city = np.array(event["City Coords"], float).reshape(-1, 2)
            gps = np.array(event["GPS Coords"], float).reshape(-1, 2)
            offsets = []  # The city is not stated: it is the one that agrees.
            for code in crs.CITY_ORIGINS:
                zone, origin = crs.city_crs(code)
                utm = crs.lonlat_to(zone, gps[:, ::-1])
                offsets.append(np.abs(utm - origin - city).max())
            errors.append(min(offsets))
    assert len(errors) >= 60
    assert max(errors) < 0.06


def test_round_trip() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform([400_000, 4_000_000], [600_000, 5_000_000], (1000, 2))
    back = crs.lonlat_to("EPSG:32617", crs.to_lonlat("EPSG:32617", xy))
    np.testing.assert_allclose(back, xy, atol=1e-6)


def test_axis_order_is_longitude_first() -> None:
    np.testing.assert_allclose(
        crs.lonlat_to("EPSG:32632", np.array([[9.0, 48.0]])), [[500_000, 5_316_300]], atol=500
    )


def test_a_point_outside_is_said() -> None:
    with pytest.raises(BadInput, match="outside"):
        crs.lonlat_to("EPSG:32632", np.array([[9.0, 123.0]]))


@pytest.mark.parametrize(
    ("code", "why"),
    [
        ("EPSG:4326", "degrees"),
        ("EPSG:2263", "US survey foot"),
        ("EPSG:3857", "Mercator"),
        ("EPSG:4978", "not projected"),
        ("EPSG:999999", "not a CRS"),
        ("town", "not a CRS"),
    ],
)
def test_crs_that_cannot_carry_a_map(code: str, why: str) -> None:
    with pytest.raises(BadInput, match=why):
        crs.check_map_crs(code, "map")


@pytest.mark.parametrize("code", ["EPSG:32617", "EPSG:25832", "EPSG:32632+5773", "EPSG:31467"])
def test_crs_that_can(code: str) -> None:
    assert crs.check_map_crs(code) == code


def test_same_crs() -> None:
    assert crs.same_crs("EPSG:32617", "epsg:32617")
    assert crs.same_crs("EPSG:32632+5773", "EPSG:32632")
    assert not crs.same_crs("EPSG:32617", "EPSG:32618")
    with pytest.raises(BadInput, match=r"a\.geojson: its CRS is EPSG:32618, expected EPSG:32617"):
        crs.check_same_crs("EPSG:32618", "EPSG:32617", "a.geojson")


@pytest.mark.parametrize(
    ("lon", "lat", "code"),
    [(-80.0, 40.4, "EPSG:32617"), (18.0, -33.9, "EPSG:32734"), (180.0, 1.0, "EPSG:32601")],
)
def test_utm_zone(lon: float, lat: float, code: str) -> None:
    assert crs.utm_crs(lon, lat) == code
