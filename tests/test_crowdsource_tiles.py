"""Tiles: one region is the whole, borders leave lines whole, workers and orders change nothing."""

from __future__ import annotations

import hashlib
import json
import os
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from fusion_scene import CRS, ORIGIN, crossing, drive, line, save, shifted

from rtmap_cli.logs.tracks import read_stretch, read_track
from rtmap_cli.maps.crop import joined
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import read_map, write_new_map
from rtmap_cli.steps.crowdsource.engines import in_processes
from rtmap_cli.steps.crowdsource.stitch import _lines_apart, stitch
from rtmap_cli.steps.crowdsource.tiling import plan

Call = Callable[..., Any]

SPAN = (0.0, 240.0)


def _street(low: float = -20.0, high: float = 260.0, piece: float = 56.0) -> VectorMap:
    """A long street in pieces that share their end vertices."""
    out = []
    lines = [("left", "boundary", 7.0), ("right", "boundary", -7.0), ("mid", "divider", 0.0)]
    for name, kind, y in lines:
        for k, x in enumerate(np.arange(low, high - 1, piece)):
            out.append(line(f"{name}{k}", kind, y, x, min(x + piece, high)))
    return VectorMap([*out, crossing("zebra", 30.0), crossing("stripes", 190.0)], CRS)


def _drives(folder: Path, world: VectorMap, seeds: Sequence[int], **how: Any) -> Path:
    for k in seeds:
        save(drive(world, f"d{k}", seed=k, span=SPAN, **how), folder / f"d{k}")
    return folder


def _content(folder: Path) -> str:
    """Digest of the tiles, whose names are those of their contents."""
    return hashlib.sha256(
        b"".join(p.name.encode() for p in sorted((folder / "tiles").rglob("*.parquet")))
    ).hexdigest()


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three drives along the long street."""
    return _drives(tmp_path_factory.mktemp("drives"), _street(), range(3))


def test_a_stretch_of_a_run_is_read_without_the_rest(runs: Path) -> None:
    track = read_track(runs / "d1")
    whole = read_stretch(runs / "d1")
    part = read_stretch(runs / "d1", track.frame[20:41])
    assert len(part.pose) == 21 and np.array_equal(part.pose, whole.pose[20:41])
    mine = (whole.frame >= 20) & (whole.frame <= 40)
    assert np.array_equal(part.points, whole.points[mine])
    assert np.array_equal(part.frame, whole.frame[mine] - 20)


def test_the_plan_covers_all_and_owns_every_element_once(runs: Path) -> None:
    tracks = [read_track(runs / f"d{k}") for k in range(3)]
    prior = [*_street(), line("far", "divider", 0.0, 900, 960)]
    assert len(plan(tracks, prior, 512.0)) == 1
    regions = plan(tracks, prior, 100.0)
    assert len(regions) > 2
    owned = [name for r in regions for name in r.owned]
    assert sorted(owned) == sorted(e.element_id for e in prior if e.element_id != "far")
    for r in regions:
        known = {e.element_id for e in r.known}
        assert r.owned <= known
        # Every frame that could see an owned element is read.
        frames = {path.name: set(f.tolist()) for path, f in r.parts if f is not None}
        for e in r.known:
            if e.element_id not in r.owned:
                continue
            for t in tracks:
                d = np.hypot(*(t.xy[:, None] - e.xy).transpose(2, 0, 1)).min(axis=1)
                near = set(t.frame[d < t.reach].tolist())
                assert near <= frames.get(t.path.name, near)
    # The same plan whatever the order of the runs.
    again = plan(tracks[::-1], prior, 100.0)
    assert [r.owned for r in again] == [r.owned for r in regions]


@pytest.mark.parametrize("with_prior", [False, True])
def test_lines_are_whole_over_the_borders_of_tiles(
    rtmap: Call, runs: Path, tmp_path: Path, with_prior: bool
) -> None:
    maps = []
    for name, side in (("one", 512), ("many", 100)):
        if with_prior:
            write_new_map(shifted(_street(), 0.1, 0.2), tmp_path / name, "prior")
        rtmap("crowdsource", runs, "--map", tmp_path / name, "--tile", side)
        maps.append(read_map(tmp_path / name))
    one, many = maps
    for kind, places in (("boundary", [-7, 7]), ("divider", [0])):
        whole = [e for e in joined(many) if e.class_name == kind]
        assert sorted(round(float(np.median(e.xy[:, 1] - ORIGIN[1]))) for e in whole) == places
        for e in whole:
            x, y = (e.xy - ORIGIN).T
            # Nothing doubled and nothing missing: the line runs once from end to end.
            turn = np.sign(x[-1] - x[0]) * np.diff(x)
            assert (turn > -0.05).all() and np.ptp(x) > 255
            assert np.abs(y - np.round(np.median(y))).max() < 0.25
    assert len(many.of_class("ped_crossing")) == len(one.of_class("ped_crossing")) == 2
    if with_prior:
        pairs = many.by_id()
        assert set(pairs) == set(one.by_id())
        far = [np.abs(pairs[e.element_id].xy - e.xy).max() for e in one]
        assert max(far) < 0.03


def _island(x0: float, x1: float, y0: float, y1: float) -> Element:
    """An island with a vertex every 5 m or so."""
    x = np.linspace(x0, x1, 21)
    there, back = (np.stack([x, np.full_like(x, y)], axis=-1) for y in (y0, y1))
    return Element("island", "boundary", ORIGIN + np.concatenate([there, back[::-1], there[:1]]))


def test_pairs_and_islands_are_whole_over_the_borders_of_tiles(rtmap: Call, tmp_path: Path) -> None:
    """Two lines a foot apart stay two, an island over a border keeps both of its sides."""
    pair = [line(f"y{y}", "divider", y, -20, 260) for y in (-5.0, -4.6)]
    world = VectorMap([*pair, _island(60, 140, 1.0, 3.0)], CRS)
    runs = _drives(tmp_path / "runs", world, range(3), noise=0.03)
    for name, side in (("one", 512), ("many", 100)):
        rtmap("crowdsource", runs, "--map", tmp_path / name, "--tile", side)
        made = joined(read_map(tmp_path / name))
        lines = [e.xy - ORIGIN for e in made if e.class_name == "divider"]
        assert sorted(round(float(np.median(y)), 1) for _, y in (p.T for p in lines)) == [
            -5.0,
            -4.6,
        ]
        for p in lines:
            assert np.ptp(p[:, 0]) > 255 and np.ptp(p[:, 1]) < 0.25
        (island,) = [e.xy - ORIGIN for e in made if e.class_name == "boundary"]
        assert np.array_equal(island[0], island[-1])
        away = shapely.hausdorff_distance(
            *(
                shapely.segmentize(shapely.LineString(xy), 1.0)
                for xy in (island, world.elements[-1].xy - ORIGIN)
            )
        )
        assert away < 1.0


def test_cut_lines_go_onto_ends_of_their_own() -> None:
    """Two lines 0.4 m apart that lie 0.25 m beside those of the neighbour keep their order."""

    def some(name: str, y: float, x0: float, x1: float) -> Element:
        return line(name, "divider", y, x0, x1)

    others = [some("a", 0.0, 0, 60), some("b", 0.4, 0, 60)]
    mended = _lines_apart([some("c", 0.25, 50, 100), some("d", 0.65, 50, 100)], others)
    starts = {e.element_id: tuple((e.xy[0] - ORIGIN).round(6)) for e in mended}
    assert starts == {"c": (60.0, 0.0), "d": (60.0, 0.4)}


def test_workers_change_no_byte(rtmap: Call, runs: Path, tmp_path: Path) -> None:
    digests = set()
    for name, more in (("a", []), ("b", ["--jobs", 2])):
        write_new_map(shifted(_street(), 0.1, 0.2), tmp_path / name, "prior")
        rtmap("crowdsource", runs, "--map", tmp_path / name, "--tile", 100, *more)
        digests.add(_content(tmp_path / name))
    assert len(digests) == 1


def _die_once(marker: str) -> str:
    """A job whose worker is killed the first time."""
    path = Path(marker)
    if not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return path.name


def test_a_worker_that_dies_is_replaced(tmp_path: Path) -> None:
    items = [str(tmp_path / f"m{k}") for k in range(4)]
    for done in (items[0], items[1], items[3]):
        Path(done).touch()
    assert list(in_processes(_die_once, items, 2)) == ["m0", "m1", "m2", "m3"]


def test_a_tile_that_holds_all_is_the_untiled_result(
    rtmap: Call, runs: Path, tmp_path: Path
) -> None:
    from rtmap_cli.commands.crowdsource import fuse_region
    from rtmap_cli.logs.traversal import find_runs, read_traversals

    traversals, crs = read_traversals(find_runs(runs))
    fusion, _ = fuse_region(
        traversals, VectorMap((), crs), ["ped_crossing", "divider", "boundary"], ()
    )
    write_new_map(fusion.vector_map, tmp_path / "plain", "plain")
    rtmap("crowdsource", runs, "--map", tmp_path / "map")
    assert _content(tmp_path / "plain") == _content(tmp_path / "map")


def test_towns_apart_are_fused_apart(rtmap: Call, runs: Path, tmp_path: Path) -> None:
    """A fleet in two towns is two regions, each as if it were alone."""
    both = tmp_path / "both"
    _drives(both, _street(), range(3))
    far = VectorMap([e.with_points(e.points + [5000.0, 0, 0]) for e in _street()], CRS)
    for k in (7, 8):
        save(drive(far, f"d{k}", seed=k, span=(5000.0, 5240.0)), both / f"d{k}")
    rtmap("crowdsource", both, "--map", tmp_path / "map")
    rtmap("crowdsource", runs, "--map", tmp_path / "alone")
    made, alone = read_map(tmp_path / "map"), read_map(tmp_path / "alone").by_id()
    near = {e.element_id: e for e in made if e.xy[0, 0] < ORIGIN[0] + 2000}
    assert set(near) == set(alone) and len(made) > len(near)
    for name, e in near.items():
        assert np.array_equal(e.points, alone[name].points, equal_nan=True)


def test_nothing_is_stitched_from_nothing() -> None:
    prior = VectorMap([Element("a", "divider", ORIGIN + np.array([[0.0, 0], [5, 0]]))], CRS)
    fusion = stitch(prior, [])
    assert fusion.untouched == ["a"] and list(fusion.vector_map) == list(prior)


def test_a_dry_run_over_tiles_tells_the_same(rtmap: Call, runs: Path, tmp_path: Path) -> None:
    told = [
        json.loads(
            rtmap(
                "crowdsource",
                runs,
                "--map",
                tmp_path / "none",
                "--dry-run",
                "--json",
                "--tile",
                side,
            ).out
        )
        for side in (512, 100)
    ]
    assert not (tmp_path / "none").exists()
    assert told[0]["runs"] == told[1]["runs"] == ["d0", "d1", "d2"]
    assert told[0]["counts"]["waiting"] == told[1]["counts"]["waiting"]
