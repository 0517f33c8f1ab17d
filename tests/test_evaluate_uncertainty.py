"""``rtmap evaluate uncertainty``: data whose true coverage is known must come out as known."""

from __future__ import annotations

import itertools
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from rtmap_cli.geometry.polylines import resample
from rtmap_cli.geometry.poses import se3_from_xyyaw, transform
from rtmap_cli.logs.run import MATCHED, Observations, Poses, Run, RunFrames, run_info, true_poses
from rtmap_cli.logs.run_files import read_run, write_observations, write_poses, write_run
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.steps.evaluate.maps.precision import evaluate_frames
from rtmap_cli.steps.evaluate.uncertainty.measure import (
    gaussian_nll,
    gaussian_ranks,
    laplace_nll,
    laplace_ranks,
    rank_figures,
    share_figures,
    share_interval,
)
from rtmap_cli.steps.evaluate.uncertainty.vertices import across, real_ones

CRS = "EPSG:32632"
ORIGIN = np.array([500_000.0, 5_000_000.0])
HEADING = 0.7
FRAMES = 60
SIGMA = np.array([0.30, 0.12])
"""Of every vertex along x and y of the ego frame, metres."""
LINES = {"divider": (-4.0, 4.0), "boundary": (-9.0, 9.0)}
EMPTY_SIDE = 14.0
"""Nothing is this far to the left of the drive."""


def road(along: Any, left: Any) -> np.ndarray:
    """Map points of a straight road; the vehicles stand on it at an angle of 0.3 rad."""
    u = np.array([np.cos(HEADING), np.sin(HEADING)])
    across_it = np.array([-u[1], u[0]])
    return ORIGIN + np.multiply.outer(along, u) + np.multiply.outer(left, across_it)


def true_map() -> VectorMap:
    along = np.linspace(-100, 400, 60)
    lines = [(name, y) for name, ys in LINES.items() for y in ys]
    return VectorMap(
        [
            Element(f"{n}{k}", n, road(along, np.full(60, y)))
            for k, (n, y) in enumerate(lines)
        ],
        CRS,
    )  # fmt: skip


WORLD = MapIndex(true_map())
RANGE = (-12.0, -18.0, 12.0, 18.0)


def drive() -> tuple[np.ndarray, np.ndarray]:
    times = 1_700_000_000_000_000_000 + np.arange(FRAMES, dtype=np.int64) * 500_000_000
    middle = road(4.0 * np.arange(FRAMES), np.zeros(FRAMES))
    return times, se3_from_xyyaw(*middle.T, np.full(FRAMES, HEADING + 0.3))


def observe(pose: np.ndarray, rng: np.random.Generator) -> dict[str, list[Any]]:
    """One frame: of every true line a detection; its score is the chance that it is really there.

    The vertices of real detections err by SIGMA in both axes of the vehicle; what is not there
    is told at EMPTY_SIDE. Prior elements likewise exist as often as stated.
    """
    out: dict[str, list[Any]] = {k: [] for k in ("class", "score", "points", "existence", "prior")}
    sides = [y for ys in LINES.values() for y in ys]
    away = np.array([-np.sin(-0.3), np.cos(-0.3)])
    for local, side in zip(WORLD.crop(pose, RANGE), sides, strict=True):
        score, stated = rng.uniform(0.02, 0.98, 2)
        there, kept = rng.uniform(size=2) < (score, stated)
        line = resample(local.points, 20)[:, :2]
        gone = line + (EMPTY_SIDE - side) * away
        out["class"].append(local.class_name)
        out["score"].append(score)
        out["points"].append((line if there else gone) + rng.normal(size=(20, 2)) * SIGMA)
        out["existence"].append(stated)
        out["prior"].append(transform(pose, line if kept else gone))
    return out


def write(folder: Path) -> Path:
    """The true map, the true poses, and a run whose uncertainties are all honest."""
    rng = np.random.default_rng(5)
    times, pose = drive()
    index = np.arange(FRAMES, dtype=np.int32)
    told = [observe(p, rng) for p in pose]
    count = len(told[0]["class"])

    def column(name: str, dtype: Any) -> np.ndarray:
        return np.array([v for frame in told for v in frame[name]], dtype)

    observations = Observations(
        frame=np.repeat(index, count),
        query=np.tile(np.arange(count, dtype=np.int32), FRAMES),
        state=np.full(FRAMES * count, MATCHED, np.int8),
        class_name=column("class", object),
        score=column("score", np.float32),
        existence=column("existence", np.float32),
        element_id=column("class", object),
        points=column("points", np.float32),
        sigma=np.tile(SIGMA.astype(np.float32), (FRAMES * count, 20, 1)),
        prior_points=column("prior", np.float64),
    )
    nan = np.full((FRAMES, 3), np.nan)
    spread = np.array([0.5, 0.5, 0.02])
    noise = rng.normal(size=(FRAMES, 3)) * spread
    initial = se3_from_xyyaw(
        pose[:, 0, 3] + noise[:, 0], pose[:, 1, 3] + noise[:, 1], HEADING + 0.3 + noise[:, 2]
    )
    frames = RunFrames(
        index, times, initial, np.tile(spread, (FRAMES, 1)), nan, nan, nan,
        np.full((FRAMES, 3, 3), np.nan), index,
    )  # fmt: skip
    box = {"x": [RANGE[0], RANGE[2]], "y": [RANGE[1], RANGE[3]]}
    info = run_info("drive", CRS, ["divider", "boundary"], box)
    (folder / "run").mkdir()
    write_run(Run(info, frames, observations), folder / "run")
    (folder / "truth").mkdir()
    write_poses(true_poses(index, times, pose), folder / "truth", CRS)
    write_new_map(true_map(), folder / "town", "made")
    return folder / "run"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("uncertainty")
    write(folder)
    return folder


def command(scene: Path, run: Path | None = None) -> list[Any]:
    pred = run or scene / "run"
    return ["evaluate", "uncertainty", pred, "--truth", scene / "town", "--poses", scene]


def bounds(p: float, n: int) -> Any:
    """What a share of n independent cases may be: four standard deviations."""
    return pytest.approx(p, abs=4 * np.sqrt(p * (1 - p) / n))


def changed(scene: Path, target: Path, **columns: Any) -> Path:
    """A copy of the run with other observations."""
    shutil.copytree(scene / "run", target)
    run = read_run(target)
    write_observations(replace(run.observations, **columns), target, CRS)
    return target


def test_honest_sigmas_hold_what_they_say(rtmap: Any, scene: Path) -> None:
    got = json.loads(rtmap(*command(scene), "--json").out)["vertices"]
    n = got["n"]
    assert n > 1500 and got["elements"]["real"] * 20 == n and got["beyond_end"] == 0
    assert got["gaussian"]["coverage"]["50"] == bounds(0.5, n)
    assert got["gaussian"]["coverage"]["90"] == bounds(0.9, n)
    for point in got["gaussian"]["calibration"]:
        assert point["empirical"] == bounds(point["nominal"], n)
    for region, nominal in (("50", 0.5), ("90", 0.9)):
        low, high = got["gaussian"]["interval_95"][region]
        assert high - low == pytest.approx(2 * 1.96 * np.sqrt(nominal * (1 - nominal) / n), rel=0.3)
    # Across the road, which the vehicle sees at 0.3 rad: sx² sin² + sy² cos².
    sigma = np.hypot(SIGMA[0] * np.sin(0.3), SIGMA[1] * np.cos(0.3))
    assert got["sigma_m"]["rms"] == pytest.approx(sigma, rel=1e-3)
    assert got["error_m"]["rms"] == pytest.approx(sigma, rel=0.07)
    assert got["scale"]["rms"] == pytest.approx(1.0, abs=0.07)
    assert got["gaussian"]["nll"] == pytest.approx(
        np.log(sigma) + 0.5 * np.log(2 * np.pi * np.e), abs=0.08
    )
    assert set(got["by_class"]) == {"divider", "boundary"}
    assert sum(b["n"] for b in got["by_sigma"]) == n


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_sigmas_too_small_or_too_large(
    rtmap: Any, scene: Path, tmp_path: Path, factor: float
) -> None:
    o = read_run(scene / "run").observations
    run = changed(scene, tmp_path / "run", sigma=(o.sigma * factor).astype(np.float32))
    got = json.loads(rtmap(*command(scene, run), "--json").out)["vertices"]
    for region, nominal in (("50", 0.5), ("90", 0.9)):
        known = 2 * norm.cdf(factor * norm.ppf((1 + nominal) / 2)) - 1
        assert got["gaussian"]["coverage"][region] == bounds(known, got["n"])
    assert got["scale"]["rms"] == pytest.approx(1 / factor, rel=0.07)
    honest = json.loads(rtmap(*command(scene), "--json").out)["vertices"]
    assert got["gaussian"]["nll"] > honest["gaussian"]["nll"] + 0.1
    assert got["gaussian"]["calibration_error"] > 0.1 > honest["gaussian"]["calibration_error"]


def test_vertices_slide_along_their_line(rtmap: Any, scene: Path, tmp_path: Path) -> None:
    """Moved along the road, a detection errs no more; what slides past a line's end is left out."""
    o = read_run(scene / "run").observations
    away = np.array([np.cos(-0.3), np.sin(-0.3)])
    run = changed(scene, tmp_path / "run", points=(o.points + 0.8 * away).astype(np.float32))
    honest = json.loads(rtmap(*command(scene), "--json").out)["vertices"]
    got = json.loads(rtmap(*command(scene, run), "--json").out)["vertices"]
    assert got["gaussian"]["coverage"] == pytest.approx(honest["gaussian"]["coverage"], abs=0.01)
    assert 0 < got["beyond_end"] == honest["n"] - got["n"]
    line = np.array([[0.0, 0], [10, 0], [10, 0], [10, 10]])
    points = np.array([[5, 0.3], [-0.5, 0.2], [9.8, 12], [10.4, -0.3]])
    error, normal, beyond = across(points, line)
    np.testing.assert_allclose(error, [0.3, 0.2, 0.2, -0.3])
    np.testing.assert_allclose(beyond, [0, 0.5, 2, 0])
    np.testing.assert_allclose(normal[[0, 2]], [[0, 1], [-1, 0]])
    ring = np.array([[0.0, 0], [4, 0], [4, 4], [0, 4], [0, 0]])
    assert across(np.array([[-3.0, -1]]), ring)[2] == 0


def test_honest_probabilities(rtmap: Any, scene: Path) -> None:
    got = json.loads(rtmap(*command(scene), "--json").out)
    for name in ("scores", "existence"):
        told = got[name]
        assert told["n"] == FRAMES * 4 and len(told["bins"]) == 10
        for b in told["bins"]:
            middle = (b["low"] + b["high"]) / 2
            assert b["true"] == bounds(middle, b["n"]), (name, b)
        assert told["brier"] < told["brier_of_base_rate"]
        assert told["base_rate"] == pytest.approx(told["mean_stated"], abs=0.12)
        assert told["ece"] < 0.12 and got["figures"][f"{name}.ece"] == told["ece"]


def test_probabilities_that_boast(rtmap: Any, scene: Path, tmp_path: Path) -> None:
    o = read_run(scene / "run").observations
    shares = {"score": np.sqrt(o.score), "existence": np.sqrt(np.sqrt(o.existence))}
    run = changed(scene, tmp_path / "run", **shares)
    got = json.loads(rtmap(*command(scene, run), "--json").out)
    # The mean of √p over [0, 1] is 2/3, that of p^(1/4) is 4/5: both should be 1/2.
    assert got["scores"]["ece"] == pytest.approx(2 / 3 - 1 / 2, abs=0.08)
    assert got["existence"]["ece"] == pytest.approx(4 / 5 - 1 / 2, abs=0.08)
    rtmap(*command(scene, run), "--fail-over", "scores.ece=0.05", code=1)
    rtmap(*command(scene), "--fail-over", "scores.ece=0.12")


def test_poses(rtmap: Any, scene: Path, tmp_path: Path) -> None:
    only = ["evaluate", "uncertainty", scene / "run", "--poses", scene, "--json"]
    got = json.loads(rtmap(*only).out)
    assert "vertices" not in got and "poses" not in got
    told = got["initial_poses"]
    assert told["n"] == FRAMES and told["worth"] > FRAMES / 2
    for name in ("all", "lateral", "longitudinal", "yaw"):
        assert told[name]["coverage"]["50"] == bounds(0.5, FRAMES)
        assert told[name]["scale"] == pytest.approx(1.0, abs=0.3)
    # Localized poses that are twice as good as they say; one frame gave no answer.
    run = tmp_path / "run"
    shutil.copytree(scene / "run", run)
    times, pose = drive()
    rng = np.random.default_rng(1)
    noise = rng.normal(size=(FRAMES, 3)) * [0.1, 0.1, 0.01]
    better = se3_from_xyyaw(
        pose[:, 0, 3] + noise[:, 0], pose[:, 1, 3] + noise[:, 1], HEADING + 0.3 + noise[:, 2]
    )
    nan = np.full((FRAMES, 3), np.nan)
    covariance = np.diag([0.2, 0.2, 1, 1, 1, 0.02]) ** 2
    status = np.array(["no-match"] + ["ok"] * (FRAMES - 1), object)
    poses = Poses(
        np.arange(FRAMES, dtype=np.int32), times, "test", better,
        np.tile(covariance, (FRAMES, 1, 1)), nan, nan, np.full(FRAMES, 9, np.int32),
        np.zeros(FRAMES), status,
    )  # fmt: skip
    write_poses(poses, run, CRS)
    only[2] = run
    told = json.loads(rtmap(*only).out)["poses"]
    assert told["n"] == FRAMES - 1
    assert told["all"]["scale"] == pytest.approx(0.5, abs=0.1)
    assert told["all"]["coverage"]["50"] > 0.8
    assert "localized poses" in rtmap(*only[:-1]).out


def fused_map(factor: float, ghosts: float = 0.3) -> VectorMap:
    """Lines in pieces of 50 m with honest full covariances times ``factor``²; of what is stated
    with 0.7 a share of ``ghosts`` is not there."""
    rng = np.random.default_rng(2)
    covariance = np.array([[0.09, 0.05], [0.05, 0.04]])
    root = np.linalg.cholesky(covariance)
    row = np.array([covariance[0, 0], covariance[0, 1], covariance[1, 1], np.nan])
    elements = []
    lines = [(name, y) for name, ys in LINES.items() for y in ys]
    for k in range(6):
        for name, y in lines:
            along = np.linspace(50 * k - 50, 50 * k, 51)
            points = road(along, np.full(51, y)) + rng.normal(size=(51, 2)) @ root.T
            points[[0, -1]] = road(along[[0, -1]], np.full(2, y))
            stated = np.tile(row * factor**2, (51, 1))
            stated[[0, -1]] = np.nan
            elements.append(Element(f"{name}{y}{k}", name, points, stated, existence=4.0))
    count = 100
    for k in range(count):
        y = EMPTY_SIDE if k < ghosts * count else 4.0
        along = -30 + np.array([0.0, 2.0]) + 2.2 * k
        points = road(along, np.full(2, y))
        elements.append(Element(f"g{k}", "divider", points, existence=float(np.log(0.7 / 0.3))))
    return VectorMap(elements, CRS)


@pytest.mark.parametrize("factor", [1.0, 0.5])
def test_covariances_of_a_map(rtmap: Any, scene: Path, tmp_path: Path, factor: float) -> None:
    write_new_map(fused_map(factor), tmp_path / "map", "made")
    line = ["evaluate", "uncertainty", tmp_path / "map", "--truth", scene / "town"]
    got = json.loads(rtmap(*line, "--json").out)
    n = got["vertices"]["n"]
    assert n > 900 and got["vertices"]["without_sigma"] > 0
    for region, nominal in (("50", 0.5), ("90", 0.9)):
        known = 2 * norm.cdf(factor * norm.ppf((1 + nominal) / 2)) - 1
        assert got["vertices"]["gaussian"]["coverage"][region] == bounds(known, n)
    assert "laplace" not in got["vertices"]
    told = got["existence"]
    assert told["n"] == 124 and told["not_stated"] == 0
    by_low = {b["low"]: b for b in told["bins"]}
    assert by_low[0.7]["n"] == 100 and by_low[0.7]["true"] == pytest.approx(0.7)
    assert by_low[0.9]["true"] == 1.0
    # Along the drive only what was in range counts, each vertex once.
    part = json.loads(rtmap(*line, "--poses", scene, "--json").out)
    assert 400 < part["vertices"]["n"] < n
    assert part["vertices"]["gaussian"]["coverage"]["50"] == pytest.approx(
        2 * norm.cdf(factor * norm.ppf(0.75)) - 1, abs=0.09
    )


def test_crossings_too(rtmap: Any, scene: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    corners = np.array([[0, -4], [4, -4], [4, 4], [0, 4], [0, -4]], float)
    true, fused = [], []
    for k in range(40):
        ring = np.concatenate([np.linspace(a, b, 6)[:-1] for a, b in itertools.pairwise(corners)])
        ring = np.concatenate([ring, ring[:1]]) + ORIGIN + [25.0 * k + 3, 40]
        moved = ring + rng.normal(size=ring.shape) * 0.05
        moved[-1] = moved[0]
        stated = np.tile([0.0025, 0.0, 0.0025, np.nan], (len(ring), 1))
        true.append(Element(f"c{k}", "ped_crossing", ring))
        fused.append(Element(f"c{k}", "ped_crossing", moved, stated, existence=3.0))
    write_new_map(VectorMap(true, CRS), tmp_path / "true", "made")
    write_new_map(VectorMap(fused, CRS), tmp_path / "fused", "made")
    line = ["evaluate", "uncertainty", tmp_path / "fused", "--truth", tmp_path / "true", "--json"]
    got = json.loads(rtmap(*line).out)
    # At a corner the nearest side decides: a little less than the whole error.
    assert got["vertices"]["n"] == pytest.approx(40 * 20, abs=60)
    assert got["vertices"]["gaussian"]["coverage"]["50"] == pytest.approx(0.53, abs=0.06)
    assert got["vertices"]["gaussian"]["coverage"]["90"] == pytest.approx(0.91, abs=0.04)
    assert got["existence"]["base_rate"] == 1.0


def test_a_map_that_states_nothing(rtmap: Any, scene: Path, tmp_path: Path) -> None:
    line = ["evaluate", "uncertainty", scene / "town", "--truth", scene / "town"]
    got = json.loads(rtmap(*line, "--plot", tmp_path / "empty.png", "--json").out)
    assert got["vertices"]["n"] == 0 and got["vertices"]["without_sigma"] == 4 * 60
    assert got["existence"]["n"] == 0 and got["existence"]["not_stated"] == 4
    assert "240 without a sigma" in rtmap(*line).out and "4 elements" in rtmap(*line).out
    rtmap(*line, "--fail-over", "vertices.nll=0", code=2)


def test_detections_meet_truth_as_in_evaluate_map() -> None:
    rng = np.random.default_rng(8)
    for _ in range(30):

        def some(count: int) -> list[Any]:
            starts, turns = rng.uniform(-15, 15, (count, 2)), rng.uniform(-0.4, 0.4, count)
            steps = np.linspace(0, 12, 9)
            lines = [
                s + np.column_stack([steps * np.cos(a), steps * np.sin(a)])
                for s, a in zip(starts, turns, strict=True)
            ]
            return [
                (str(rng.choice(["divider", "boundary"])), x, float(rng.uniform())) for x in lines
            ]

        true = some(8)
        pred = some(3) + [(n, x + rng.normal(size=2), float(rng.uniform())) for n, x, _ in true * 2]
        hits = real_ones(pred, true, 1.5)
        found = evaluate_frames([pred], [true], ["divider", "boundary"], [1.5]).classes
        for name in ("divider", "boundary"):
            mine = sum(h >= 0 and p[0] == name for h, p in zip(hits, pred, strict=True))
            assert mine == found[name].tp[1.5]


def test_mathematics() -> None:
    rng = np.random.default_rng(0)
    n = 20_000
    z = rng.normal(size=(n, 3))
    for k in (1, 3):
        ranks = gaussian_ranks((z[:, :k] ** 2).sum(axis=1), k)
        assert rank_figures(ranks, np.arange(n))["calibration_error"] < 0.01
    sigma = rng.uniform(0.5, 2, n)
    error = rng.laplace(0, sigma / np.sqrt(2))
    ranks = laplace_ranks((error / sigma) ** 2)
    assert rank_figures(ranks, np.arange(n))["calibration_error"] < 0.01
    # Entropy of both; the wrong shape is less likely.
    laplace = laplace_nll((error / sigma) ** 2, sigma)
    assert laplace == pytest.approx(float(np.log(np.sqrt(2) * sigma).mean()) + 1, abs=0.02)
    assert laplace < gaussian_nll((error / sigma) ** 2, 2 * np.log(sigma), 1) - 0.05
    assert gaussian_nll(z[:, 0] ** 2, np.zeros(n), 1) == pytest.approx(
        0.5 * np.log(2 * np.pi * np.e), abs=0.02
    )
    # Ten copies of everything say no more than one.
    inside = rng.uniform(size=500) < 0.5
    alone = share_interval(inside, np.arange(500))
    assert share_interval(np.repeat(inside, 10), np.repeat(np.arange(500), 10)) == pytest.approx(
        alone
    )
    assert alone[1] - alone[0] == pytest.approx(2 * 1.96 * 0.5 / np.sqrt(500), rel=0.02)
    assert share_interval(inside, np.zeros(500)) is None
    told = share_figures(np.array([0.2, 0.2, 0.8, 1.0]), np.array([False, True, True, True]))
    assert told["ece"] == pytest.approx(0.5 * 0.3 + 0.25 * 0.2)
    assert told["brier"] == pytest.approx((0.04 + 0.64 + 0.04) / 4)
    assert told["nll"] == pytest.approx(-np.log([0.8, 0.2, 0.8, 1]).sum() / 4, abs=1e-5)
    assert share_figures(np.zeros(0), np.zeros(0, bool)) == {"n": 0}


def test_plot(rtmap: Any, scene: Path, tmp_path: Path) -> None:
    from PIL import Image

    path = tmp_path / "curves.png"
    rtmap(*command(scene), "--plot", path)
    with Image.open(path) as image:
        assert image.format == "PNG" and image.size[0] > 800
        pixels = np.asarray(image.convert("RGB")).reshape(-1, 3)
    blue = (np.abs(pixels.astype(int) - (30, 110, 190)).max(axis=1) < 12).sum()
    assert blue > 300
    rtmap(*command(scene), "--plot", path, code=2)
    rtmap(*command(scene), "--plot", path, "--overwrite")
    rtmap(*command(scene), "--plot", tmp_path / "curves.jpg", code=2)
    rtmap(*command(scene), "--plot", scene / "run" / "x.png", code=3)


def test_bad_input(rtmap: Any, scene: Path, tmp_path: Path) -> None:
    o = read_run(scene / "run").observations
    score = o.score.copy()
    score[6] = 1.5
    run = changed(scene, tmp_path / "score", score=score)
    existence = o.existence.copy()
    existence[3] = -0.5
    gone = changed(scene, tmp_path / "existence", existence=existence)
    for bad, words in ((run, "frame 1, query 2: score 1.5"), (gone, "query 3: existence -0.5")):
        error = rtmap(*command(scene, bad), code=3).err
        assert words in error and len(error.strip().splitlines()) == 1
    base = ["evaluate", "uncertainty"]
    far = VectorMap([Element("a", "divider", road([9000.0, 9050.0], [0.0, 0.0]))], CRS)
    write_new_map(far, tmp_path / "far", "made")
    for arguments, code, words in (
        ([scene / "run"], 2, "--poses"),
        ([scene / "town"], 2, "--truth"),
        ([scene / "nothing", "--truth", scene / "town"], 3, "nothing"),
        ([scene / "run", "--truth", scene / "run", "--poses", scene], 3, "is no map"),
        ([scene / "run", "--truth", tmp_path / "far", "--poses", scene], 4, "in range"),
        ([tmp_path / "far", "--truth", scene / "town", "--poses", scene], 4, "in range"),
        ([scene / "run", "--truth", scene / "town", "--traversal", "1"], 2, "--traversal"),
    ):
        error = rtmap(*base, *arguments, code=code).err
        assert words in error and len(error.strip().splitlines()) == 1
