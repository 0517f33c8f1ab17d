"""The benchmark of the paper's ablations: its figures, and a run of it cut down to seconds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed (extra: train)")
pytest.importorskip("cv2", reason="opencv is not installed (extra: train)")

from rtmap_models.config import PaperConfig, load_config  # noqa: E402
from rtmap_models.training.validate import area_under_curve  # noqa: E402

from benchmarks.paper import ablation_figures  # noqa: E402
from benchmarks.paper import ablations as paper_ablations  # noqa: E402
from benchmarks.paper import tables as paper_tables  # noqa: E402
from rtmap_cli.steps.evaluate.maps.precision import Scorer  # noqa: E402

SMALL = """
base = "rtmap-raster-small"
name = "test"
image_size = [32, 64]
cell_m = 0.75
supersample = 1
vertex_count = 10
new_queries = 8
width = 16
heads = 2
layers = 1
"""


def scorer_of(frames: int, seed: int = 0) -> Scorer:
    """Lines that are found a little beside where they are, some of them twice or not at all."""
    rng = np.random.default_rng(seed)
    scorer = Scorer(("divider", "boundary"), protocol="rtmap")
    for _ in range(frames):
        truth, found = [], []
        for name in ("divider", "boundary", "boundary"):
            y = rng.uniform(-15, 15)
            line = np.column_stack([np.linspace(-30, 30, 10), np.full(10, y)])
            truth.append((name, line, 1.0))
            for _ in range(rng.integers(0, 3)):
                found.append((name, line + [0, rng.normal(0, 0.7)], rng.random()))
        scorer.add(found, truth)
    return scorer


def test_a_weight_of_one_is_the_evaluators_map() -> None:
    scorer = scorer_of(12)
    weights = np.ones((1, 12))
    assert ablation_figures.mean_precision(scorer, weights)[0] == pytest.approx(
        scorer.result().mAP, abs=1e-12
    )
    some = np.arange(12) % 3 > 0
    left = ablation_figures.mean_precision(scorer, some[None].astype(float))[0]
    assert left == pytest.approx(scorer.result(some).mAP, abs=1e-12)
    assert left != pytest.approx(scorer.result().mAP, abs=1e-3)


def test_existence_is_the_validations_area() -> None:
    rng = np.random.default_rng(0)
    rows = np.column_stack([np.arange(60) // 3, rng.random(60), rng.random(60) < 0.7])
    pairs = [(score, bool(real)) for _, score, real in rows]
    area = ablation_figures.area(rows, np.ones((1, 20)))[0]
    assert area == pytest.approx(area_under_curve(pairs), abs=1e-12)


def test_whole_towns_are_drawn() -> None:
    towns = np.repeat(np.arange(5), 4)
    weights = ablation_figures.resampled(towns, 50)
    assert (weights[0] == 1).all() and (weights.sum(axis=1) == 20).all()
    by_town = weights.reshape(-1, 5, 4)
    assert (by_town == by_town[..., :1]).all() and len(np.unique(by_town)) > 2


def test_differences_are_paired() -> None:
    rng = np.random.default_rng(0)
    weights = ablation_figures.resampled(np.arange(40), 200)
    error = rng.uniform(0, 5, 40)  # frames differ by metres, variants by centimetres
    one, other = ({"m": weights @ (error + k) / 40} for k in (0.02 + 0.01 * rng.random(40), 0.0))
    gap, low, high = ablation_figures.differences(one, other)["m"]
    assert 0.02 < low < gap < high < 0.03


def test_the_shipped_configuration() -> None:
    config = load_config("rtmap-raster-small")
    assert isinstance(config, PaperConfig) and not config.needs_images
    assert config.vertex_count == 20 and config.raster_channels == 4
    assert config.pre_attribution and config.use_nll and config.use_pose_loss


def test_a_run_of_a_few_steps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "small.toml").write_text(SMALL, encoding="utf-8")
    words = ["--config", str(tmp_path / "small.toml"), "--data", str(tmp_path / "data")]
    words += ["--frames", "6", "--test-frames", "9", "--steps", "3", "--encoder-steps", "2"]
    words += ["--set", "batch=2", "--json", str(tmp_path / "out.json")]
    words += ["--only", "full", "without L_pose"]
    paper_ablations.main(words)
    said = capsys.readouterr().out
    kept = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    made, rows = kept["made"], kept["variants"]
    assert made["test towns"] == 2 and made["steps"] == 3 and made["batch"] == 2
    assert set(rows) == {"full", "without L_pose"}
    assert "learned head" in rows["full"]["poses"]
    assert "learned head" not in rows["without L_pose"]["poses"]
    assert rows["full"]["poses"]["start"] == rows["without L_pose"]["poses"]["start"]
    gap, low, high = rows["without L_pose"]["against full"]["only Q_map 0"]
    assert low <= gap <= high
    weights = {p: p.stat().st_mtime_ns for p in (tmp_path / "data").glob("*.pt")}
    assert len(weights) == 3  # the encoder and two variants
    encoder, full = (
        torch.load(tmp_path / "data" / f"{n}.pt", weights_only=True) for n in ("encoder", "full")
    )
    name = "encoder.stem.0.0.weight"
    assert not torch.equal(encoder["average"][name], full["network"][name])
    (tmp_path / "data" / "full.figures.json").unlink()  # one is read again, one is as it was kept
    paper_ablations.main(words)  # nothing is trained again, and the figures are the same
    assert {p: p.stat().st_mtime_ns for p in weights} == weights
    assert json.loads((tmp_path / "out.json").read_text(encoding="utf-8")) == kept
    # The tables print them beside the paper's.
    capsys.readouterr()
    tables = ["--tables", "4", "--places", "0", "--work", str(tmp_path / "work"), "--towns"]
    paper_tables.main([*tables, "--ablations", str(tmp_path / "out.json")])
    again = capsys.readouterr().out
    assert "| full, only Q_map |" in said and "Tab. 4: .121 / .257" in said
    assert said.strip().splitlines()[-1] in again
