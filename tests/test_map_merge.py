"""rtmap map merge: two maps of one area become one, through the command line."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fusion_scene import CRS, ORIGIN, crossing, drive, line, save, street
from map_samples import assert_same

from rtmap_cli.geometry.polylines import clip_to_box, length, resample_step
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.pieces import parts_of
from rtmap_cli.maps.store import commit_map, fused_runs, history, read_map, write_new_map

Call = Callable[..., Any]
FAR = 1e7


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> VectorMap:
    """A simulated town."""
    from rtmap_cli.cli import run

    folder = tmp_path_factory.mktemp("town") / "map"
    assert run(["simulate", "town", "--seed", "5", "-o", str(folder)]) == 0
    return read_map(folder)


def surveyed(elements: Iterable[Element], seed: int = 1) -> list[Element]:
    """The elements as another vendor has them: 0.9 m east, 0.6 m south, 1.5 m up, bent by some
    centimetres, with other vertices, under other ids."""
    rng = np.random.default_rng(seed)
    out = []
    for e in elements:
        p = e.points if e.class_name == "ped_crossing" else resample_step(e.points, 4.3)
        p = p.copy()
        wave = np.sin(p[:, :2] / 35.0)[:, ::-1]
        p[:, :2] += [0.9, -0.6] + 0.1 * wave
        p[1:-1, :2] += rng.normal(0, 0.03, (len(p) - 2, 2))
        p[:, 2] += 1.5
        if e.ring:
            p[-1] = p[0]
        out.append(replace(e, element_id=f"b-{e.element_id}", points=p, covariance=None))
    return out


def merged(rtmap: Call, folder: Path, a: VectorMap, b: Iterable[Element]) -> Any:
    """What the command tells; the maps are ``folder``/a and /b."""
    write_new_map(a, folder / "a", "vendor A")
    write_new_map(VectorMap(b, a.crs), folder / "b", "vendor B")
    before = read_map(folder / "b")
    told = json.loads(rtmap("map", "merge", folder / "a", folder / "b", "--json").out)
    assert_same(read_map(folder / "b"), before)
    return told


def metres(elements: Iterable[Element], name: str) -> float:
    """Length of the lines of a class."""
    return float(sum(length(e.points) for e in elements if e.class_name == name))


def open_joints(truth: VectorMap, found: VectorMap, name: str) -> int:
    """Vertices where two lines of a class meet in one map and not in the other."""

    def nodes(elements: Iterable[Element]) -> np.ndarray[Any, Any]:
        ends = np.array([e.xy[at] for e in elements if not e.ring for at in (0, -1)])
        key, number = np.unique(np.round(ends, 3), axis=0, return_counts=True)
        return key[number == 2]

    there = nodes(found.of_class(name))
    far = [np.hypot(*(there - p).T).min() for p in nodes(truth.of_class(name))]
    return int((np.array(far) > 0.5).sum())


def test_the_same_town_twice_is_that_town(rtmap: Call, tmp_path: Path, town: VectorMap) -> None:
    told = merged(rtmap, tmp_path, town, surveyed(town))
    assert told["counts"] == {"inserted": 0, "confirmed": len(town), "moved": 0}
    offset = told["offset"]
    assert abs(offset["east_m"] - 0.9) < 0.1 and abs(offset["north_m"] + 0.6) < 0.1
    assert told["shared"] > 0.98 and told["spread_m"] < 0.1
    after = read_map(tmp_path / "a").by_id()
    assert after.keys() == town.by_id().keys()
    for e in town:
        assert np.array_equal(after[e.element_id].points, e.points, equal_nan=True)
        # Two maps without evidence are none.
        assert after[e.element_id].existence == e.existence == 0.0
    last = history(tmp_path / "a")[-1]
    assert last.version == 1 and last.message == "merge: b"
    assert last.info["merge"]["confirmed"] == len(town)


def test_what_only_one_has_is_there_and_joined(
    rtmap: Call, tmp_path: Path, town: VectorMap
) -> None:
    """Each vendor misses another fifth of the elements."""
    lot = np.random.default_rng(3).uniform(size=len(town))
    a = [e for e, u in zip(town, lot, strict=True) if u > 0.2]
    b = [e for e, u in zip(town, lot, strict=True) if u < 0.8]
    told = merged(rtmap, tmp_path, VectorMap(a, town.crs), surveyed(b))
    after = read_map(tmp_path / "a")
    missing = {f"b-{e.element_id}" for e, u in zip(town, lot, strict=True) if u <= 0.2}
    assert len(missing - set(told["inserted"])) <= 0.1 * len(missing)
    for name in ("divider", "boundary"):
        assert metres(after, name) == pytest.approx(metres(town, name), rel=0.02)
    assert len(after.of_class("ped_crossing")) == len(town.of_class("ped_crossing"))
    assert open_joints(town, after, "boundary") <= 2


def test_maps_of_two_halves_become_one(rtmap: Call, tmp_path: Path, town: VectorMap) -> None:
    """They overlap by forty metres; lines go on from one to the other in one vertex."""
    x0, _, x1, _ = town.bounds()
    middle = (x0 + x1) / 2

    def part(elements: Iterable[Element], low: float, high: float) -> list[Element]:
        out = []
        for e in elements:
            if e.ring:
                out += [e] if low <= e.xy[:, 0].mean() < high else []
            else:
                box = (low, -FAR, high, FAR)
                out += parts_of(replace(e, covariance=None), clip_to_box(e.points, box))
        return out

    west = VectorMap(part(town, -FAR, middle + 20), town.crs)
    merged(rtmap, tmp_path, west, surveyed(part(town, middle - 20, FAR)))
    after = read_map(tmp_path / "a")
    # Boundaries of a town are rings, which are whole in either half.
    assert metres(after, "boundary") == pytest.approx(metres(town, "boundary"), rel=0.02)
    assert metres(after, "divider") == pytest.approx(metres(town, "divider"), rel=0.02)
    border = middle + 20
    cut = [e.xy[at] for e in west.of_class("divider") for at in (0, -1)]
    cut = [p for p in cut if abs(p[0] - border) < 1e-6]
    ends = np.array([e.xy[at] for e in after.of_class("divider") for at in (0, -1)])
    met = [(np.hypot(*(ends - p).T) < 1e-6).sum() == 2 for p in cut]
    assert len(met) > 2 and np.mean(met) >= 0.8


def test_lines_a_foot_apart(rtmap: Call, tmp_path: Path) -> None:
    """Both have a double line: nothing is added. One has a single one: the second comes in."""
    pair = street(line("second", "divider", 0.4))
    told = merged(rtmap, tmp_path / "1", pair, surveyed(pair))
    assert told["counts"]["inserted"] == 0
    told = merged(rtmap, tmp_path / "2", street(), surveyed(pair))
    assert told["inserted"] == ["b-second"]
    new = read_map(tmp_path / "2/a").by_id()["b-second"]
    assert np.abs(new.xy[:, 1] - ORIGIN[1] - 0.4).max() < 0.2


def test_both_state_covariances(rtmap: Call, tmp_path: Path) -> None:
    """Lines are fused by Eq. 5; a vertex where two of them meet stays one."""

    def with_sigma(e: Element, dy: float, sigma: float) -> Element:
        covariance = np.tile([sigma**2, 0, sigma**2, np.nan], (len(e.points), 1))
        return e.with_points(e.points + [0.0, dy, 0.0], covariance)

    first = [line("half", "divider", 0.0, -20, 50), line("rest", "divider", 0.0, 50, 120)]
    around = [e for e in street() if e.element_id != "middle"]
    a = VectorMap([with_sigma(e, 0.0, 0.2) for e in [*first, *around]], CRS)
    off = [with_sigma(e, 0.3 if e.element_id in ("half", "rest") else 0.0, 0.1) for e in a]
    told = merged(rtmap, tmp_path, a, [replace(e, element_id=f"b-{e.element_id}") for e in off])
    after = read_map(tmp_path / "a").by_id()
    assert {"half", "rest"} <= set(told["moved"])
    assert np.array_equal(after["half"].points[-1], after["rest"].points[0], equal_nan=True)
    # The shift of all lines is the frame's, what is left goes with the variances (4 : 1).
    left = after["half"].xy[4:-4, 1] - ORIGIN[1]
    assert 0.05 < left.mean() < 0.3 and np.ptp(left) < 0.02
    middle = after["half"].covariance
    assert middle is not None and middle[5, 2] < 0.2**2 / 3


def test_heights_and_attributes_are_taken_over(rtmap: Call, tmp_path: Path) -> None:
    b = []
    for e in street():
        p = e.points.copy()
        p[:, 2] = 200.0 + 0.01 * (p[:, 0] - ORIGIN[0])
        more = {"colour": "white", "vendor": "B"}
        b.append(replace(e, element_id=f"b-{e.element_id}", points=p, attributes=more))
    mine = [replace(e, attributes={"vendor": "A"}) for e in street()]
    merged(rtmap, tmp_path, VectorMap(mine, CRS), b)
    lane = read_map(tmp_path / "a").by_id()["lane"]
    assert lane.attributes == {"vendor": "A", "colour": "white"}
    assert np.allclose(lane.points[:, 2], 200.0 + 0.01 * (lane.xy[:, 0] - ORIGIN[0]), atol=0.02)


def test_runs_of_both_are_known_later(rtmap: Call, tmp_path: Path) -> None:
    """What one map was fused from is not counted again; shared runs do not count twice."""
    for name, keys in (("a", (0, 1)), ("b", (1, 2))):
        for k in keys:
            save(drive(street(), f"d{k}", seed=k), tmp_path / f"runs-{name}/d{k}")
        rtmap("crowdsource", tmp_path / f"runs-{name}", "--map", tmp_path / name)
    before, other = (read_map(tmp_path / name) for name in ("a", "b"))
    told = rtmap("map", "merge", tmp_path / "a", tmp_path / "b", "-m", "two fleets")
    assert "1 runs (first: d1) are in both maps" in told.err
    assert fused_runs(tmp_path / "a") == {"d0", "d1", "d2"}
    after = read_map(tmp_path / "a")
    most = max(e.existence for e in [*before, *other])
    assert len(after) == len(before) and max(e.existence for e in after) <= most
    assert {r for e in after for r in e.runs} == {"d0", "d1", "d2"}
    again = rtmap("crowdsource", tmp_path / "runs-b", "--map", tmp_path / "a")
    assert "all runs are in the map already" in again.out


def test_a_merged_map_is_maintained(rtmap: Call, tmp_path: Path) -> None:
    """Two vendors' maps, of which each misses a line, merged and driven: the street, once."""
    a = VectorMap([e for e in street() if e.element_id != "lane"], CRS)
    b = [e for e in street() if e.element_id != "left"]
    merged(rtmap, tmp_path, a, surveyed(b))
    for k in range(3):
        save(drive(street(), f"d{k}", seed=k), tmp_path / f"runs/d{k}")
    told = rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "a", "--json")
    counts = json.loads(told.out)["counts"]
    assert counts["inserted"] == counts["deleted"] == 0
    after = read_map(tmp_path / "a")
    assert len(after) == len(street())
    lane = after.by_id()["b-lane"]
    assert np.abs(lane.xy[2:-2, 1] - ORIGIN[1] - 3.5).mean() < 0.15 and lane.traversals == 3


def test_dry_run_writes_nothing(rtmap: Call, tmp_path: Path) -> None:
    write_new_map(street(), tmp_path / "a", "A")
    more = street(line("third", "divider", -3.5))
    write_new_map(VectorMap(surveyed(more), CRS), tmp_path / "b", "B")
    told = rtmap("map", "merge", tmp_path / "a", tmp_path / "b", "--dry-run").out
    assert "version 0 would get 1 elements, 6 of its own are in the other map of 7, too" in told
    assert "m east, -0.59 m north" in told or "m east, -0.60 m north" in told
    assert len(history(tmp_path / "a")) == 1


def test_ids_that_both_use(rtmap: Call, tmp_path: Path) -> None:
    """Another element under the same id gets a number; what is the same is not confused by ids."""
    a = VectorMap([e for e in street() if e.element_id != "lane"], CRS)
    names = {"lane": "middle", "middle": "lane"}
    b = [replace(e, element_id=names.get(e.element_id, e.element_id)) for e in street()]
    told = merged(rtmap, tmp_path, a, b)
    assert told["inserted"] == ["middle.1"] and set(told["confirmed"]) == set(a.by_id())


def test_halves_of_a_crossing_are_that_crossing(rtmap: Call, tmp_path: Path) -> None:
    halves = [crossing("south", 20.0), crossing("north", 20.0)]
    cut = [
        replace(e, points=np.column_stack([np.clip(e.xy, *limits), e.points[:, 2]]))
        for e, limits in zip(
            halves,
            (([-np.inf] * 2, [np.inf, ORIGIN[1]]), ([-np.inf, ORIGIN[1]], [np.inf] * 2)),
            strict=True,
        )
    ]
    rest = [e for e in street() if e.element_id != "west"]
    told = merged(rtmap, tmp_path, street(), [*rest, *cut])
    assert told["counts"]["inserted"] == 0 and told["confirmed"].count("west") == 1


def test_maps_side_by_side(rtmap: Call, tmp_path: Path) -> None:
    """Nothing in common: the other one is added as it is."""
    far = [e.with_points(e.points + [5000.0, 0.0, 0.0]) for e in street()]
    far = [replace(e, element_id=f"b-{e.element_id}") for e in far]
    write_new_map(street(), tmp_path / "a", "A")
    write_new_map(VectorMap(far, CRS), tmp_path / "b", "B")
    told = rtmap("map", "merge", tmp_path / "a", tmp_path / "b").out
    assert "no line in common" in told
    assert_same(read_map(tmp_path / "a"), VectorMap([*street(), *far], CRS))


def test_maps_that_do_not_fit(rtmap: Call, tmp_path: Path) -> None:
    """Turned by some degrees, as a wrong CRS turns a map: told in one line."""
    turn = np.radians(25)
    c, s = np.cos(turn), np.sin(turn)
    off = []
    for e in street():
        p = e.points.copy()
        p[:, :2] = ORIGIN + (e.xy - ORIGIN) @ np.array([[c, s], [-s, c]])
        off.append(replace(e, element_id=f"b-{e.element_id}", points=p))
    write_new_map(street(), tmp_path / "a", "A")
    write_new_map(VectorMap(off, CRS), tmp_path / "b", "B")
    told = rtmap("map", "merge", tmp_path / "a", tmp_path / "b").err
    assert told.startswith("warning:") and "in one CRS" in told and told.count("\n") == 1


def test_bad_input(rtmap: Call, tmp_path: Path) -> None:
    write_new_map(street(), tmp_path / "a", "A")
    write_new_map(VectorMap(street().elements, "EPSG:32618"), tmp_path / "zone", "Z")
    for other, what in (
        ("a", "is MAP itself"),
        ("zone", "its CRS is EPSG:32618, expected EPSG:32617"),
        ("nowhere", "nowhere"),
    ):
        told = rtmap("map", "merge", tmp_path / "a", tmp_path / other, code=3).err
        assert what in told and told.count("\n") == 1
    assert len(history(tmp_path / "a")) == 1


def test_an_empty_map(rtmap: Call, tmp_path: Path) -> None:
    """Either side may hold nothing."""
    write_new_map(street(), tmp_path / "a", "A")
    commit_map(tmp_path / "a", VectorMap([], CRS), 0, "emptied")
    write_new_map(street(), tmp_path / "b", "B")
    rtmap("map", "merge", tmp_path / "a", tmp_path / "b")
    assert_same(read_map(tmp_path / "a"), street())
    commit_map(tmp_path / "b", VectorMap([], CRS), 0, "emptied")
    rtmap("map", "merge", tmp_path / "a", tmp_path / "b")
    assert_same(read_map(tmp_path / "a"), street())
