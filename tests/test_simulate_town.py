"""Procedural towns: geometry that a real map would have, lanes that can be driven."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from rtmap_cli.geometry.polylines import arc_length, is_ring, tangents
from rtmap_cli.steps.simulate.driving.drive import linked
from rtmap_cli.steps.simulate.driving.routes import find_routes
from rtmap_cli.steps.simulate.towns.town import Town, make_town
from rtmap_cli.steps.simulate.worlds.world import even_odd_surface


@pytest.fixture(scope="module")
def town() -> Town:
    return make_town(4)


def test_same_seed_same_town():
    a, b, c = make_town(3, 200), make_town(3, 200), make_town(5, 200)
    assert len(a.vector_map) == len(b.vector_map)
    for x, y in zip(a.vector_map, b.vector_map, strict=True):
        assert x.element_id == y.element_id
        assert np.array_equal(x.points, y.points)
    assert len(a.vector_map) != len(c.vector_map)


def test_classes_and_attributes(town):
    assert town.vector_map.crs == "EPSG:32632"
    assert len(town.vector_map.of_class("ped_crossing")) > 10
    for element in town.vector_map:
        assert np.isfinite(element.points).all()
        if element.class_name == "divider":
            assert element.attributes["mark"].endswith(("WHITE", "YELLOW"))
            assert arc_length(element.points)[-1] >= 3
        else:
            assert is_ring(element.points), element.element_id


def test_paint_lies_on_asphalt(town):
    surface = even_odd_surface(town.vector_map)
    lines = [shapely.linestrings(e.xy) for e in town.vector_map.of_class("divider")]
    outside = sum(shapely.difference(line, surface.buffer(0.05)).length for line in lines)
    assert outside < 0.5
    crossings = shapely.union_all(
        [shapely.polygons(e.xy) for e in town.vector_map.of_class("ped_crossing")]
    )
    painted = sum(shapely.intersection(line, crossings).length for line in lines)
    assert painted < 0.5, "paint runs over crossings"


def test_a_large_town_has_a_roundabout(town):
    islands = [
        shapely.polygons(e.xy)
        for e in town.vector_map.of_class("boundary")
        if 150 < shapely.polygons(e.xy).area < 700
    ]
    roundness = [4 * np.pi * p.area / p.length**2 for p in islands]
    assert max(roundness) > 0.95


def test_lanes_stay_on_asphalt_and_are_smooth(town):
    surface = even_odd_surface(town.vector_map)
    points = np.concatenate(town.lanes)
    assert shapely.contains_xy(surface, points[:, 0], points[:, 1]).mean() > 0.97
    steps = np.concatenate([np.hypot(*np.diff(lane, axis=0).T) for lane in town.lanes])
    assert steps.max() <= 2.001
    for lane in town.lanes:
        t = tangents(lane)
        cross = t[:-1, 0] * t[1:, 1] - t[:-1, 1] * t[1:, 0]
        bend = np.abs(np.arctan2(cross, (t[:-1] * t[1:]).sum(axis=1)))
        assert bend.max() < np.radians(75)


@pytest.mark.parametrize("kind", ["straight", "turning"])
def test_drives_of_150_metres_exist(town, kind):
    routes = find_routes(linked(town.lanes), kind, 150.0)
    assert len(routes) >= 3
    assert all(arc_length(r)[-1] > 140 for r in routes)


def test_small_scenes_come_out_for_many_seeds():
    for seed in range(12):
        scene = make_town(seed, 200)
        assert len(scene.lanes) >= 4
        assert scene.vector_map.of_class("boundary")
        assert not shapely.is_empty(even_odd_surface(scene.vector_map))
