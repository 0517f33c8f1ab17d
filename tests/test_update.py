"""rtmap update and crowdsource --method grid, on a street with known answers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from fusion_scene import CRS, ORIGIN, drive, line, offset_across, save, street

from rtmap_cli.geometry.blocks import Layout, cells_inside, points_along
from rtmap_cli.geometry.polylines import is_ring, length
from rtmap_cli.geometry.skeleton import thin, trace
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.evidence import Counts
from rtmap_cli.maps.store import read_map, write_new_map
from rtmap_cli.steps.update.compare import MISSING_OLD, MOVED, Stretch
from rtmap_cli.steps.update.evidence import Rates
from rtmap_cli.steps.update.moves import move_odds
from rtmap_cli.steps.update.update import _event, _named_apart

Call = Callable[..., Any]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three drives of the street, in which the map has the divider `lane` and the crossing `east`
    but not `fresh`."""
    folder = tmp_path_factory.mktemp("fleet")
    world = street(line("fresh", "divider", -3.5, 30.0, 70.0), without=("lane", "east"))
    for k in range(3):
        save(drive(world, f"run-{k}", seed=k), folder / "runs" / f"{k}")
    write_new_map(street(), folder / "map", "old")
    return folder


def _update(fleet: Path, target: Path, rtmap: Call, *more: object) -> dict[str, Any]:
    out = rtmap("update", fleet / "runs", "--map", fleet / "map", "-o", target, "--json", *more).out
    answer: dict[str, Any] = json.loads(out)
    return answer


def test_update_tells_what_changed_and_flags_its_cells(
    fleet: Path, tmp_path: Path, rtmap: Call
) -> None:
    said = _update(fleet, tmp_path / "c.geojson", rtmap)
    told = {(c["kind"], c["element_id"], c["reason"]) for c in said["changes"]}
    assert told == {
        ("delete", "lane", "missing in new"),
        ("delete", "east", "missing in new"),
        ("insert", None, "missing in old"),
    }
    flagged = [c for c in said["cells"] if c["flagged"]]
    assert flagged and all(c["ap"] < 0.95 for c in flagged)
    fresh = next(c for c in said["changes"] if c["kind"] == "insert")
    assert fresh["probability"] > 0.9 and fresh["traversals_seen"] == 3
    never = [c for c in said["cells"] if c["reason"] == "never observed"]
    assert all(c["observed"] < 0.5 and not c["flagged"] for c in never)


def test_apply_makes_the_map_right_and_revert_undoes_it(
    fleet: Path, tmp_path: Path, rtmap: Call
) -> None:
    write_new_map(street(), tmp_path / "map", "old")
    changes = tmp_path / "c.geojson"
    rtmap("update", fleet / "runs", "--map", tmp_path / "map", "-o", changes)
    rtmap("map", "apply", tmp_path / "map", changes, "--all")
    new, old = read_map(tmp_path / "map").by_id(), street().by_id()
    assert "east" not in new
    (made,) = (e for k, e in new.items() if k not in old and not k.startswith("lane"))
    assert offset_across(made, -3.5).max() < 0.3 and 30 < length(made.points) < 46
    for name in ("left", "right", "middle", "west"):
        assert np.array_equal(new[name].points, old[name].points, equal_nan=True)
    rtmap("map", "revert", tmp_path / "map")
    assert read_map(tmp_path / "map").by_id().keys() == old.keys()


def test_the_map_as_it_is_is_left_alone(tmp_path: Path, rtmap: Call) -> None:
    for k in range(3):
        save(drive(street(), f"run-{k}", seed=k), tmp_path / "runs" / f"{k}")
    write_new_map(street(), tmp_path / "map", "old")
    said = _update(tmp_path, tmp_path / "c.geojson", rtmap, "--fail-on-change")
    assert said["changes"] == [] and said["flagged"] == 0


def test_report_is_pictures_and_geoparquet(fleet: Path, tmp_path: Path, rtmap: Call) -> None:
    said = _update(fleet, tmp_path / "c.geojson", rtmap, "--report", tmp_path / "report")
    from PIL import Image

    heat = pq.read_table(tmp_path / "report/heat.parquet")
    cells = pq.read_table(tmp_path / "report/cells.parquet")
    assert json.loads(heat.schema.metadata[b"geo"])["primary_column"] == "geometry"
    assert cells["flagged"].to_pylist().count(True) == said["flagged"]
    assert len(cells) == len(said["cells"])
    assert set(heat["class_name"].to_pylist()) == {"ped_crossing", "divider", "boundary"}
    hot = np.asarray(Image.open(tmp_path / "report/heat-divider.png")).astype(int)
    assert (hot[..., 0] - hot[..., 2] > 60).any()
    size, _, _, down, east, north = map(
        float, (tmp_path / "report/heat-divider.pgw").read_text("utf-8").split()
    )
    assert size == 0.5 and down == -0.5
    row, column = np.argwhere(hot.sum(axis=2) < 400)[0]
    assert abs(east + column * size - ORIGIN[0] - 50) < 80
    assert abs(north - row * size - ORIGIN[1]) < 8
    Image.open(tmp_path / "report/cells.png").load()
    told = rtmap("update", fleet / "runs", "--map", fleet / "map", "-o", tmp_path / "d.geojson",
                 "--report", tmp_path / "report", code=2)  # fmt: skip
    assert "exists already" in told.err and not (tmp_path / "d.geojson").exists()


def test_bad_input(fleet: Path, tmp_path: Path, rtmap: Call) -> None:
    kerb = line("kerb", "kerb", 9.0)
    write_new_map(street(kerb), tmp_path / "map", "more classes")
    target = tmp_path / "c.geojson"
    words = ("update", fleet / "runs", "--map", tmp_path / "map", "-o", target)
    told = rtmap(*words, code=3)
    assert "also has kerb" in told.err and told.err.count("\n") == 1 and not target.exists()
    rtmap(*words, "--class", "divider")
    assert "does not know kerb" in rtmap(*words, "--class", "kerb", "--overwrite", code=3).err
    rtmap("update", tmp_path / "none", "--map", tmp_path / "map", "-o", tmp_path / "d", code=3)
    rtmap("update", fleet / "runs", "--map", tmp_path / "none", "-o", tmp_path / "d", code=3)
    rtmap(*words, code=2)  # exists


def test_grid_fusion_of_a_first_map(fleet: Path, tmp_path: Path, rtmap: Call) -> None:
    for name in ("one", "two"):
        rtmap("crowdsource", fleet / "runs", "--map", tmp_path / name, "--method", "grid")
    one, two = read_map(tmp_path / "one"), read_map(tmp_path / "two")
    assert [e.points.tobytes() for e in one] == [e.points.tobytes() for e in two]
    middle = [e for e in one.of_class("divider") if offset_across(e, 0.0).max() < 0.3]
    assert sum(length(e.points) for e in middle) > 85
    assert all(e.covariance is not None and (e.covariance[:, 0] > 0).all() for e in one)
    assert len(one.of_class("ped_crossing")) == 1
    (ring,) = one.of_class("ped_crossing")
    centre = ring.xy[:-1].mean(axis=0) - ORIGIN
    assert ring.ring and np.abs(centre - [22.0, 0.0]).max() < 1.0


def test_grid_fusion_over_a_prior(fleet: Path, tmp_path: Path, rtmap: Call) -> None:
    write_new_map(street(), tmp_path / "map", "old")
    told = json.loads(
        rtmap("crowdsource", fleet / "runs", "--map", tmp_path / "map", "--method", "grid",
              "--json").out
    )  # fmt: skip
    assert told["counts"]["inserted"] == 1 and "east" in told["deleted"]
    new = read_map(tmp_path / "map").by_id()
    assert np.array_equal(new["left"].points, street().by_id()["left"].points, equal_nan=True)


# ---- the mathematics


def test_deposits_keep_weight_and_place() -> None:
    rng = np.random.default_rng(3)
    xy = rng.uniform(-200, 200, (500, 2))
    weight = rng.uniform(0, 1, 500)
    layout = Layout.around(xy, 3.0, 0.5)
    raster = layout.deposit(xy, weight)
    assert raster.sum() == pytest.approx(weight.sum(), rel=1e-5)
    centres = layout.centres(np.arange(raster.size))
    mean = (raster.ravel()[:, None] * centres).sum(axis=0)
    assert np.allclose(mean, (weight[:, None] * xy).sum(axis=0), atol=0.05)
    smooth = layout.blur(raster, 1.0)
    assert smooth.sum() == pytest.approx(weight.sum(), rel=1e-2)


def test_blur_does_not_see_the_borders_of_blocks() -> None:
    for shift in (0.0, 16.0, 31.9):
        layout = Layout.around(np.array([[shift, shift]]), 40.0, 0.5)
        raster = layout.blur(layout.deposit(np.array([[shift, shift]]), np.ones(1)), 1.0)
        around = np.array([[shift + dx, shift] for dx in (-1.0, 1.0)])
        left, right = layout.value(raster, around)
        assert left == pytest.approx(right, rel=1e-4) and left > 0


def test_points_along_and_cells_inside() -> None:
    which, _, span = points_along(
        np.array([[[0, 0], [3, 4], [3, 4]], [[0, 0], [0, 1], [0, 2]]]), 0.3
    )
    assert np.bincount(which, span) == pytest.approx([5.0, 2.0])
    rings = np.array(
        [[[0, 0], [4, 0], [4, 3], [0, 3.0]], [[10, 10], [12, 12], [10, 14], [8, 12.0]]]
    )
    which, _ = cells_inside(rings, 0.25)
    assert np.bincount(which) * 0.25**2 == pytest.approx([12.0, 8.0], abs=0.3)


def test_a_skeleton_is_thin_and_its_graph_resolves_junctions() -> None:
    mask = np.zeros((120, 120), bool)
    mask[58:62, 10:110] = mask[10:110, 58:62] = True
    y, x = np.mgrid[:120, :120]
    mask |= np.abs(np.hypot(y - 25, x - 25) - 14) < 2
    y, x = np.nonzero(mask)
    cells = thin(np.stack([x, y], axis=-1))
    assert len(cells) < len(x) / 3
    lines = trace(cells, 0.5, 3.0, 0.6)
    assert len(lines) == 3 and sum(is_ring(p) for p in lines) == 1
    straight = [p for p in lines if not is_ring(p)]
    # Two lines that cross, not four that meet.
    assert all(np.ptp(p, axis=0).max() > 45 and np.ptp(p, axis=0).min() < 1.5 for p in straight)


def test_votes_saturate_and_worn_places_are_worn_for_all() -> None:
    rates = Rates(0.7)
    assert rates.log_odds([(20, 20)]) > 3 and rates.log_odds([(0, 20)]) < -1.5
    assert rates.log_odds([(200, 200)]) == rates.log_odds([(20, 20)])
    rarely = [(2, 14)] * 4
    assert rates.log_odds(rarely) > 0 > rates.log_odds([(0, 14)] * 4)
    assert rates.log_odds([]) == pytest.approx(0.0)


def test_lanes_move_together() -> None:
    def moved(name: str, y: float, by: float, aside: float) -> Stretch:
        before = np.array([[0.0, y], [30.0, y]])
        return Stretch(MOVED, "divider", name, before + [0.0, by], before=before, aside=aside)

    little, much = moved("a", 0.0, 0.4, 0.9), moved("b", 3.5, 1.4, 3.0)
    assert move_odds(little, [little]) < 0 < move_odds(little, [little, much])
    # Not beside another road's lane, or one that went the other way, or is not sure itself.
    for other in (
        moved("b", 40.0, 1.4, 3.0),
        moved("b", 3.5, -1.4, 3.0),
        moved("b", 3.5, 0.5, 1.2),
    ):
        assert move_odds(little, [little, other]) < 0
    assert move_odds(much, [much]) > 10
    assert move_odds(Stretch(MISSING_OLD, "divider", None, much.points), []) == np.inf


def test_an_empty_map_gets_everything(fleet: Path, tmp_path: Path, rtmap: Call) -> None:
    write_new_map(VectorMap([], CRS), tmp_path / "map", "empty")
    said = json.loads(
        rtmap("update", fleet / "runs", "--map", tmp_path / "map", "-o", tmp_path / "c.geojson",
              "--json").out
    )  # fmt: skip
    assert {c["kind"] for c in said["changes"]} == {"insert"}
    assert {c["class"] for c in said["changes"]} == {"ped_crossing", "divider", "boundary"}


def test_changes_in_the_same_metre_have_names_of_their_own() -> None:
    """Two stretches may have their middles in one metre; a file of changes refuses twin names."""
    ring = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 6.0], [0.0, 6.0]])
    stretches = [
        Stretch(MISSING_OLD, name, None, ring + shift)
        for name, shift in (("divider", 0.0), ("divider", 0.1), ("boundary", 0.0))
    ]
    counts = Counts(traversals_seen=2, traversals_in_view=2)
    told = _named_apart([(s, _event(s, counts, 3.0)) for s in stretches])
    names = [e.change_id for _, e in told]
    assert len(set(names)) == 3 and names[1] == f"{names[0]}-1"
    assert [s for s, _ in told] == stretches
