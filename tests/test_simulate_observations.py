"""rtmap simulate observations: presets, seeds, correlations, honest sigmas, prior queries."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtmap_cli.geometry.polylines import is_ring, project
from rtmap_cli.geometry.poses import invert, se3_from_xyyaw, transform, xyyaw_of
from rtmap_cli.logs.log import Frame, Occluder
from rtmap_cli.logs.native import NativeLogWriter
from rtmap_cli.logs.run import MATCHED, NEW, OUTDATED, Run, true_poses
from rtmap_cli.logs.run_files import read_poses, read_run
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.element import CLASSES, Element, VectorMap
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.steps.simulate.driving.drives import Drive, drive_over_route, thinned, with_traffic
from rtmap_cli.steps.simulate.driving.routes import (
    Lane,
    corridor,
    find_routes,
    matches,
    route_of,
    turn,
)
from rtmap_cli.steps.simulate.driving.traffic import generated_traffic
from rtmap_cli.steps.simulate.perceiving.noise import FirstOrder, generator, smooth_field
from rtmap_cli.steps.simulate.perceiving.observations import observe
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey, stretch, visible_runs
from rtmap_cli.steps.simulate.perceiving.presets import PRESETS, Preset, PriorPreset, find_preset

CRS = "EPSG:32632"
X0, Y0 = 500_000.0, 5_400_000.0


def street(length: float = 200.0, without: frozenset[str] = frozenset()) -> VectorMap:
    """A straight road along +x: two boundaries, three dividers, a crossing every 60 m."""
    s = np.arange(0.0, length + 1, 5.0)

    def line(y: float) -> np.ndarray:
        return np.stack([X0 + s, np.full_like(s, Y0 + y)], axis=-1)

    elements = [Element(f"b{y:+.1f}", "boundary", line(y)) for y in (-8.0, 8.0)] + [
        Element(f"d{y:+.1f}", "divider", line(y)) for y in (-3.5, 0.0, 3.5)
    ]
    for x in np.arange(30.0, length, 60.0):
        ring = np.array([[x, -8], [x + 4, -8], [x + 4, 8], [x, 8], [x, -8]]) + [X0, Y0]
        elements.append(Element(f"c{x:.0f}", "ped_crossing", ring))
    return VectorMap([e for e in elements if e.element_id not in without], CRS)


def along(count: int = 40, spacing: float = 3.0, start: float = 40.0) -> Drive:
    """A drive along the street in its right lane."""
    x = X0 + start + spacing * np.arange(count)
    pose = se3_from_xyyaw(x, np.full(count, Y0 - 1.75), np.zeros(count))
    times = 10**18 + (np.arange(count) * 5e8).astype(np.int64)
    return Drive("street", CRS, times, pose)


def simulated(preset: Preset, key: DriveKey | None = None, **more: object) -> Run:
    """A run over the street."""
    drive = more.pop("drive", along())
    return observe(street(), drive, preset, key or DriveKey(0, 1, 0), "x", **more)[0]


def digest(folder: Path) -> dict[str, str]:
    """Bytes of every file of a run."""
    files = sorted(p for p in folder.iterdir() if p.is_file())
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def native_log(folder: Path, drive: Drive, truth: bool = True) -> Path:
    """A native log without cameras over a drive."""
    folder.mkdir()
    writer = NativeLogWriter(folder, "street-log", CRS, None)
    for i, (time, pose) in enumerate(zip(drive.timestamp_ns, drive.pose, strict=True)):
        rough = pose.copy()
        rough[:2, 3] += [0.7, -0.4]
        boxes = (Occluder(8.0, 3.5, 0.0, 4.5, 1.9),) if i % 2 else ()
        sigma = np.array([1.0, 1.0, 0.02])
        writer.add(Frame(i, int(time), rough, sigma, occluders=boxes), {})
    if truth:
        frames = np.arange(len(drive), dtype=np.int32)
        writer.write_truth(true_poses(frames, drive.timestamp_ns, drive.pose))
    writer.close()
    return folder


@pytest.fixture
def world(tmp_path: Path) -> Path:
    """The street as a map folder."""
    write_new_map(street(), tmp_path / "map", "street")
    return tmp_path / "map"


# --- the command ---------------------------------------------------------------------------


def test_a_run_and_its_true_poses_are_written_apart(rtmap, tmp_path, world):
    log = native_log(tmp_path / "log", along())
    run_folder = tmp_path / "runs" / "one"
    call = ("simulate", "observations", "--map", world, "--log", log, "--seed", 1, "-o", run_folder)
    assert "frames" in rtmap(*call, "--json").out
    run = read_run(run_folder)
    truth = read_poses(tmp_path / "runs" / "one.truth.parquet")
    assert sorted(p.name for p in (tmp_path / "runs").iterdir()) == ["one", "one.truth.parquet"]
    assert len(run.frames) == len(truth) and truth.method == "truth"
    assert run.info["simulated"] is True and run.info["preset_name"] == "rtmap-straight"
    assert set(run.observations.class_name) <= set(CLASSES)
    assert (run.observations.state == NEW).all() and len(run.occluders)
    off = xyyaw_of(run.frames.initial) - xyyaw_of(truth.pose)
    assert 0.1 < np.abs(off[:, :2]).mean() < 3.0


def test_same_seed_same_bytes_another_seed_another_drive(rtmap, tmp_path, world):
    log = native_log(tmp_path / "log", along(12))
    base = ("simulate", "observations", "--map", world, "--log", log, "--rate", 1, "-q")
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        rtmap(*base, "--seed", seed, "-o", tmp_path / name)
    a, b, c = (digest(tmp_path / n) for n in "abc")
    assert a == b
    assert a["observations.parquet"] != c["observations.parquet"]
    assert read_run(tmp_path / "a").log_id != read_run(tmp_path / "c").log_id


def test_bad_input_is_one_line_and_leaves_nothing(rtmap, tmp_path, world):
    drive = along(6)
    log = native_log(tmp_path / "log", drive)
    blind = native_log(tmp_path / "blind", drive, truth=False)
    far = replace(drive, pose=se3_from_xyyaw(np.full(6, X0 + 9e3), np.full(6, Y0), np.zeros(6)))
    away = native_log(tmp_path / "away", far)
    other = VectorMap([replace_crs(e) for e in street()], "EPSG:32633")
    write_new_map(other, tmp_path / "other", "street")
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("nose = 3\n")
    out = tmp_path / "out" / "run"
    base = ["simulate", "observations", "-o", out, "--map", world]
    rtmap(*base[:4], "--map", tmp_path / "no", "--log", log, code=3)
    assert "true poses" in rtmap(*base, "--log", blind, code=3).err
    assert "out of range" in rtmap(*base, "--log", away, code=3).err
    assert "CRS" in rtmap(*base[:4], "--map", tmp_path / "other", "--log", log, code=3).err
    assert "nose" in rtmap(*base, "--log", log, "--preset", wrong, code=3).err
    assert "no such preset" in rtmap(*base, "--log", log, "--preset", "good", code=3).err
    assert "--route" in rtmap(*base, "--log", log, "--route", "straight", code=2).err
    rtmap(*base, "--log", log, "--rate", 1, "--spacing", 2, code=2)
    assert not out.exists() and not list(tmp_path.glob("out/*"))
    rtmap(*base, "--log", log)
    assert "exists already" in rtmap(*base, "--log", log, code=2).err
    rtmap(*base, "--log", log, "--overwrite")


def replace_crs(element: Element) -> Element:
    """The same element (the map it goes into has another CRS)."""
    return Element(element.element_id, element.class_name, element.points)


def test_with_a_prior_elements_are_matched_outdated_or_new(rtmap, tmp_path, world):
    log = native_log(tmp_path / "log", along(24))
    # Of the prior: a divider that is gone from the world; the middle divider is new in the world.
    s = np.arange(0.0, 201.0, 5.0)
    gone = Element("gone", "divider", np.stack([X0 + s, np.full_like(s, Y0 + 6.0)], axis=-1))
    kept = [e for e in street() if e.element_id != "d+0.0"]
    write_new_map(VectorMap([*kept, gone], CRS), tmp_path / "prior", "outdated")
    base = ("simulate", "observations", "--map", world, "--log", log, "--traffic", "none")
    rtmap(*base, "--prior", tmp_path / "prior", "--preset", "mild", "-o", tmp_path / "run")
    o = read_run(tmp_path / "run").observations
    on_gone = o.element_id == "gone"
    assert on_gone.any() and (o.state[on_gone] == OUTDATED).mean() > 0.9
    asked = np.array([e is not None for e in o.element_id])
    assert (o.state[asked & ~on_gone] == MATCHED).mean() > 0.8
    assert np.isfinite(o.prior_points[asked]).all() and np.isnan(o.prior_points[~asked]).all()
    assert np.isfinite(o.existence[asked]).all() and np.isnan(o.existence[~asked]).all()
    new = o.state == NEW
    found = new & (o.class_name == "divider") & (np.abs(o.points[:, :, 1] - 1.75).mean(1) < 1.0)
    assert len(set(o.frame[found])) > 12


def test_av2_routes_through_the_command_line(rtmap, tmp_path, av2_log):
    from rtmap_cli.formats.av2.vector_map import read_av2_map

    write_new_map(read_av2_map(av2_log), tmp_path / "map", "av2")
    base = ("simulate", "observations", "--map", tmp_path / "map", "--log", f"av2:{av2_log}")
    rtmap(*base, "--preset", "rtmap-straight", "--seed", 1, "-o", tmp_path / "log")
    assert 20 < len(read_run(tmp_path / "log").frames) < 40
    rtmap(*base, "--route", "turning", "--route-length", 60, "-o", tmp_path / "route")
    truth = read_poses(tmp_path / "route.truth.parquet")
    assert len(truth) == 25 and np.ptp(np.unwrap(xyyaw_of(truth.pose)[:, 2])) > np.radians(60)


# --- the perception model ------------------------------------------------------------------


def test_perfect_observes_exactly_what_is_in_range():
    run = simulated(PRESETS["perfect"])
    o, index, drive = run.observations, MapIndex(street(), join=True), along()
    for i in (0, 20):
        rows = np.flatnonzero(o.frame == i)
        assert len(rows) == len(index.crop(drive.pose[i]))
        for k in rows:
            points = transform(drive.pose[i], o.points[k].astype(float))
            same = [e for e in street() if e.class_name == o.class_name[k]]
            nearest = np.min([project(points, e.points)[1] for e in same], axis=0)
            assert nearest.max() < 1e-3


def test_stated_sigma_is_the_true_one():
    """Errors across the dividers over many worlds and drives, divided by sigma, have sd 1."""
    preset = replace(
        PRESETS["mild"], ghosts_per_drive=0.0, false_per_frame=dict.fromkeys(CLASSES, 0)
    )
    z = []
    for n in range(60):
        run = simulated(preset, DriveKey(n, n, 0), drive=along(2, 20.0))
        o = run.observations
        rows = o.class_name == "divider"
        y = o.points[rows, :, 1] - 1.75
        error = y - np.array([-3.5, 0.0, 3.5])[np.abs(y[..., None] - [-3.5, 0, 3.5]).argmin(-1)]
        z.append((error / o.sigma[rows, :, 1]).ravel())
    assert 0.88 < np.concatenate(z).std() < 1.12


def test_errors_of_a_place_are_the_same_in_all_drives_of_a_world():
    """With all of the offset fixed to the place two drives agree; other worlds differ."""
    preset = replace(PRESETS["mild"], shares=(1.0, 0.0, 0.0), vertex_scale=0.0, end_cut=0.0,
                     drive_shift=(0.0, 0.0), spread=(0.0, 0.0), false_per_frame={},
                     ghosts_per_drive=0.0, detected=dict.fromkeys(CLASSES, 1.0), range_loss=0.0,
                     hardness_loss=0.0)  # fmt: skip
    drive = replace(along(1), occluders=[()])

    def points(world: int, seed: int) -> np.ndarray:
        o = simulated(preset, DriveKey(world, seed, 0), drive=drive).observations
        # Scores are drawn per drive: bring the rows into the order of their places.
        lines = o.points[o.class_name != "ped_crossing"]
        return lines[np.argsort(lines[:, :, 1].mean(1))]

    np.testing.assert_allclose(points(0, 1), points(0, 2), atol=1e-5)
    assert np.abs(points(0, 1) - points(1, 1)).max() > 0.05


def test_noise_grows_with_the_multiplier_and_detections_fall_with_hidden_lines():
    quiet, loud = (
        simulated(replace(PRESETS["mild"], noise=dict.fromkeys(CLASSES, m))) for m in (0.3, 3.0)
    )
    assert np.median(loud.observations.sigma) > 4 * np.median(quiet.observations.sigma)
    wall = (Occluder(0.0, 6.0, 0.0, 60.0, 1.0), Occluder(0.0, -6.5, 0.0, 60.0, 1.0))
    hidden = simulated(PRESETS["mild"], drive=replace(along(), occluders=[wall] * 40))
    open_road = simulated(PRESETS["mild"], drive=replace(along(), occluders=[()] * 40))
    edges = [(r.observations.class_name == "boundary").sum() for r in (hidden, open_road)]
    assert edges[0] < 0.6 * edges[1]


def test_a_drive_does_not_depend_on_what_else_is_in_the_world():
    """Removing an element leaves the other detections as they are (draws hang on the element)."""
    preset = replace(PRESETS["mild"], false_per_frame={}, ghosts_per_drive=0.0)
    key, drive = DriveKey(0, 1, 0), along(5)
    whole = observe(street(), drive, preset, key, "x")[0].observations
    less = observe(street(without=frozenset({"d+0.0"})), drive, preset, key, "x")[0].observations
    rows = {p.tobytes() for p in whole.points}
    assert len(less) < len(whole) and {p.tobytes() for p in less.points} < rows


def test_queries_slide_along_lines_with_the_initial_pose_but_not_across():
    preset = replace(PRESETS["perfect"], gnss=(1.5, 0.0, 0.0), gnss_yaw_deg=(0.0, 0.0),
                     prior=replace(PRESETS["perfect"].prior, along_gain=0.25))  # fmt: skip
    run, truth = observe(street(), along(8), preset, DriveKey(0, 3, 0), "x", prior=street())
    o = run.observations
    rows = (o.class_name == "divider") & (o.state == MATCHED)
    start = transform_rows(invert(truth.pose) @ run.frames.initial, o.frame[rows])
    seen = np.stack([transform(truth.pose[f], p.astype(float))
                     for f, p in zip(o.frame[rows], o.points[rows], strict=True)])  # fmt: skip
    slide = (seen - o.prior_points[rows])[:, 5:15]
    assert np.abs(slide[..., 1]).max() < 1e-3
    # The vertex stands where the query stood, less a quarter of the initial pose's error.
    np.testing.assert_allclose(slide[..., 0].mean(1), -0.75 * start * -1, atol=0.02)
    assert (o.sigma[rows][:, :, 0] > 1.0).all()


def transform_rows(errors: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """x of true_SE3_initial of each row's frame (no yaw error: the same at every vertex)."""
    return -errors[frames, 0, 3]


# --- parts ---------------------------------------------------------------------------------


def test_smooth_field_has_unit_variance_and_its_correlation_length():
    xy = np.array([[X0, Y0], [X0 + 20.0, Y0]])
    values = np.array([smooth_field(("t", k), 20.0, 2)(xy) for k in range(1500)])
    assert abs(values.std() - 1) < 0.05
    correlation = (values[:, 0] * values[:, 1]).mean()
    assert abs(correlation - np.exp(-0.5)) < 0.08


def test_first_order_noise_remembers():
    pairs = []
    for k in range(2000):
        noise = FirstOrder(("t", k), 0.85, 1)
        pairs.append([noise.at("e", 3)[0], noise.at("e", 5)[0]])
    a, b = np.array(pairs).T
    assert abs((a * b).mean() - 0.85**2) < 0.08 and abs(b.std() - 1) < 0.06


def test_generators_hang_on_their_key_alone():
    assert generator("a", 1).normal() == generator("a", 1).normal()
    assert generator("a", 1).normal() != generator("a", 2).normal()


def test_visible_runs_bridge_short_gaps_and_split_at_long_ones():
    line = np.array([[-30.0, 6.0], [30.0, 6.0]])
    assert len(visible_runs(line, ())) == 1
    far_box, near_box = Occluder(0, 5.2, 0, 4, 1), Occluder(0, 2.5, 0, 8, 1)
    (only, share), = visible_runs(line, (far_box,))  # fmt: skip
    assert np.ptp(only[:, 0]) > 59 and 0.85 < share < 0.95
    runs = visible_runs(line, (near_box,))
    assert len(runs) == 2 and all(np.ptp(r[:, 0]) >= 10 for r, _ in runs)


def test_stretch_cuts_a_line_by_arc_length():
    line = np.array([[0.0, 0], [4, 0], [4, 4]])
    np.testing.assert_allclose(stretch(line, 1.0, 6.0), [[1, 0], [4, 0], [4, 2]])


def test_traffic_never_overlaps_the_vehicle():
    drive = along(60)
    seconds = (drive.timestamp_ns - drive.timestamp_ns[0]) / 1e9
    boxes = generated_traffic(generator("t"), xyyaw_of(drive.pose), seconds, 40.0)
    flat = [b for frame in boxes for b in frame]
    assert flat and all(abs(b.y) > b.width / 2 + 1.0 for b in flat)


def ladder() -> list[Lane]:
    """A straight road in three lanes pieces, and one that leaves it to the left."""
    road = [np.array([[x, 0.0, 1.0], [x + 60.0, 0.0, 1.0]]) for x in (0.0, 60.0, 120.0)]
    t = np.linspace(0, np.pi / 2, 20)
    bend = np.stack([60 + 20 * np.sin(t), 20 - 20 * np.cos(t), np.ones(20)], axis=-1)
    up = np.array([[80.0, 20.0, 1.0], [80.0, 150.0, 1.0]])
    return [
        Lane("a", road[0], ("b", "l")),
        Lane("b", road[1], ("c", "outside")),
        Lane("c", road[2], ()),
        Lane("l", bend, ("u",)),
        Lane("u", up, ()),
    ]


def test_routes_follow_lanes_and_are_told_by_their_shape():
    straight, turning = (find_routes(ladder(), kind, 150.0) for kind in ("straight", "turning"))
    assert len(straight) == 1 and len(turning) == 2
    assert matches("straight", straight[0]) and turn(turning[0]) > np.radians(80)
    assert len(straight[0]) == 151
    np.testing.assert_allclose(np.hypot(*np.diff(turning[0][:, :2], axis=0).T), 1.0, atol=0.02)
    assert [len(corridor(r, 0)) for r in (straight, turning)] == [1, 2]
    same = [route_of(ladder(), "straight", 100.0, w, 3) for w in (0, 0)]
    np.testing.assert_array_equal(*same)


def test_a_route_that_the_map_does_not_hold_is_no_answer():
    from rtmap_cli.errors import NoAnswer

    with pytest.raises(NoAnswer, match="no turning route of 900 m"):
        route_of(ladder(), "turning", 900.0, 0, 0)


def test_drives_keep_their_spacing_and_side():
    route = find_routes(ladder(), "straight", 150.0)[0]
    drive = drive_over_route("r", CRS, route, 2.5, 2.0, 1.5, DriveKey(0, 1, 0))
    step = np.hypot(*np.diff(drive.pose[:, :2, 3], axis=0).T)
    assert len(drive) == 61 and np.allclose(step, 2.5, atol=0.2)
    assert 0.3 < drive.pose[:, 1, 3].mean() < 2.7
    assert (np.diff(drive.timestamp_ns) > 4.9e8).all()


def test_thinning_takes_the_nearest_frames():
    drive = along(41, 1.0)
    np.testing.assert_allclose(np.diff(thinned(drive, 5.0, None).pose[:, 0, 3]), 5.0)
    assert len(thinned(drive, None, 0.5)) == 11
    standing = replace(drive, pose=np.repeat(drive.pose[:1], 41, axis=0))
    assert len(thinned(standing, 2.0, None)) == 1


def test_presets_from_toml_change_what_they_name(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('base = "mild"\nend_cut = 2\n[noise]\ndivider = 1.5\n[prior]\ngain = 0.4\n')
    mine, mild = find_preset(path), PRESETS["mild"]
    assert mine.noise == mild.noise | {"divider": 1.5} and mine.end_cut == 2.0
    assert mine.prior == replace(mild.prior, gain=0.4) and mine.shares == mild.shares
    assert isinstance(mine.prior, PriorPreset)


def test_traffic_and_rings_of_a_run_are_well_formed():
    run = simulated(
        PRESETS["rtmap-turning"], drive=with_traffic(along(), Preset(), DriveKey(0, 1, 0))
    )
    o = run.observations
    assert (o.sigma > 0).all() and np.isfinite(o.points).all()
    assert ((o.score > 0) & (o.score < 1)).all()
    assert (np.diff(o.frame) >= 0).all()
    rings = [p for p, c in zip(o.points, o.class_name, strict=True) if c == "ped_crossing"]
    assert sum(is_ring(p, 1e-3) for p in rings) > 0.8 * len(rings)
