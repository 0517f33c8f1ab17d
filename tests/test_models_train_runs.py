"""Training runs: stopped and gone on with, over several processes, from other weights, watched."""

from __future__ import annotations

import csv
import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="torch is not installed (extra: train)")
pytest.importorskip("cv2", reason="opencv is not installed (extra: train)")

from rtmap_models.config import load_config  # noqa: E402
from rtmap_models.data.dataset import Frames  # noqa: E402
from rtmap_models.tiny.network import RTMapNet  # noqa: E402
from rtmap_models.training.checkpoint import load_checkpoint, save_checkpoint, start_from  # noqa: E402
from rtmap_models.training.distributed import Group, pick_device, run_workers  # noqa: E402
from rtmap_models.training.feed import Feed  # noqa: E402
from rtmap_models.training.recipe import Recipe  # noqa: E402
from rtmap_models.training.validate import validate  # noqa: E402
from training_frames import painted_frames, tiny_config  # noqa: E402

from rtmap_cli.errors import BadInput, UsageError  # noqa: E402

WAIT_S = 240
"""Machines may be busy."""


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_config(tmp_path_factory.mktemp("config"))


@pytest.fixture(scope="module")
def frames(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return painted_frames(tmp_path_factory.mktemp("frames"), tiny)


@pytest.fixture(scope="module")
def call(tiny: Path, frames: Path) -> tuple[object, ...]:
    """The start of a command line that trains small and reproducibly."""
    return ("--config", tiny, "--data", frames, "--batch", 2, "--device", "cpu", "-q")


def assert_same_weights(a: Path, b: Path) -> None:
    first, second = load_checkpoint(a)[1], load_checkpoint(b)[1]
    assert first["step"] == second["step"] and first["samples"] == second["samples"]
    for part in ("network", "average"):
        for name, value in first[part].items():
            assert torch.equal(value, second[part][name]), f"{part} {name}"
    for k, state in first["optimizer"]["state"].items():
        for name, value in state.items():
            assert torch.equal(value, second["optimizer"]["state"][k][name])


def test_a_stopped_run_goes_on_bit_for_bit(rtmap, call, tmp_path: Path) -> None:
    call = (*call, "--steps", 4, "--threads", 1)
    rtmap("train", "-o", tmp_path / "once.pt", *call)
    stopped = rtmap("train", "-o", tmp_path / "twice.pt", *call, "--stop-after", 2)
    assert "stopped at step 2; go on with --resume" in stopped.err
    half = load_checkpoint(tmp_path / "twice.pt")[1]
    assert half["step"] == 2 and half["samples"] == 4
    rtmap("train", "-o", tmp_path / "twice.pt", *call, "--resume", tmp_path / "twice.pt")
    assert_same_weights(tmp_path / "once.pt", tmp_path / "twice.pt")
    final = load_checkpoint(tmp_path / "once.pt")[1]["network"]
    assert any(not torch.equal(half["network"][name], v) for name, v in final.items())


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "rtmap_cli", "train", *map(str, arguments)]


def test_two_processes_of_torchrun_or_ours_stopped_or_not(rtmap, call, tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    common = {"WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2", "OMP_NUM_THREADS": "1"}
    meet = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    line = command("-o", tmp_path / "a.pt", *call, "--steps", 2)
    processes = [
        subprocess.Popen(
            line,
            env=os.environ | common | meet | {"RANK": str(k), "LOCAL_RANK": str(k)},
            stderr=subprocess.PIPE,
            text=True,
        )
        for k in range(2)
    ]
    said = [p.communicate(timeout=WAIT_S)[1] for p in processes]
    assert [p.returncode for p in processes] == [0, 0], said
    assert "written" in said[0] and "written" not in said[1]
    ours = ("train", "-o", tmp_path / "b.pt", *call, "--steps", 2, "--threads", 2)
    rtmap(*ours, "--stop-after", 1)
    rtmap(*ours, "--resume", tmp_path / "b.pt")
    assert_same_weights(tmp_path / "a.pt", tmp_path / "b.pt")


def test_a_signal_saves_and_says_so(call, tmp_path: Path) -> None:
    path = tmp_path / "w.pt"
    line = command("-o", path, *call, "--steps", 100_000, "--threads", 2)
    process = subprocess.Popen(line, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + WAIT_S
    while not path.with_suffix(".csv").exists() and time.monotonic() < deadline:
        time.sleep(0.2)
    process.send_signal(signal.SIGTERM)
    said = process.communicate(timeout=WAIT_S)[1]
    assert process.returncode == 130 and "stopped at step" in said and "Traceback" not in said
    assert load_checkpoint(path)[1]["step"] >= 50


def fail_in_one(group: Group) -> None:
    if group.rank == 1:
        raise BadInput("here", "something is wrong", "do that")
    group.barrier()


def test_an_error_in_a_worker_comes_through() -> None:
    with pytest.raises(BadInput, match="here: something is wrong; do that"):
        run_workers(2, fail_in_one, ())


def test_weights_to_start_from(rtmap, call, tiny: Path, tmp_path: Path) -> None:
    first = tmp_path / "first.pt"
    rtmap("train", "-o", first, *call, "--steps", 1, "--threads", 1)
    rtmap("train", "-o", tmp_path / "b.pt", *call, "--steps", 1, "--init", first, "--threads", 1)
    content = load_checkpoint(tmp_path / "b.pt")[1]
    assert content["step"] == 1 and content["options"]["init"] == "first.pt"
    wide = tiny_config(tmp_path, "")
    wide.write_text(wide.read_text().replace("query_width = 32", "query_width = 64"))
    other = ("--config", wide, *call[2:], "--steps", 1, "--threads", 1)
    refused = rtmap("train", "-o", tmp_path / "c.pt", *other, "--init", first, code=3)
    assert "do not fit this configuration" in refused.err
    again = rtmap("train", "-o", tmp_path / "c.pt", *other, "--resume", first, code=3)
    assert "query_width" in again.err
    said = rtmap("train", "-o", tmp_path / "c.pt", *other, "--init", first, "--init-partial")
    assert "start fresh" in said.err
    for bad in (("--init", first, "--resume", first), ("--init-partial",)):
        rtmap("train", "-o", tmp_path / "d.pt", *call, "--steps", 1, *bad, code=2)
    network = RTMapNet(load_config(tiny))
    assert start_from(network, str(first)) == []
    average = load_checkpoint(first)[1]["average"]
    assert all(torch.equal(v, average[k]) for k, v in network.state_dict().items())


def test_checkpoints_that_cannot_be_gone_on_with(rtmap, call, tiny: Path, tmp_path: Path) -> None:
    good = tmp_path / "good.pt"
    rtmap("train", "-o", good, *call, "--steps", 1, "--threads", 1)
    cut = tmp_path / "cut.pt"
    cut.write_bytes(good.read_bytes()[:5000])
    light = tmp_path / "light.pt"
    config, content = load_checkpoint(good)
    save_checkpoint(light, config, {"average": content["average"]})
    empty = tmp_path / "empty.pt"
    torch.save({"format": "rtmap.weights/1", "config": config.to_dict()}, empty)
    for path, what in (
        (cut, "not a checkpoint"),
        (light, "averaged weights only"),
        (empty, "weights missing"),
        (tmp_path / "none.pt", "no such file"),
    ):
        said = rtmap(
            "train", "-o", tmp_path / "w.pt", *call, "--steps", 2, "--resume", path, code=3
        )
        assert what in said.err and said.err.count("\n") == 1
    assert not (tmp_path / "w.pt").exists()


def test_figures_of_unseen_frames_stand_in_the_journal(
    rtmap, call, tiny: Path, tmp_path: Path
) -> None:
    unseen = painted_frames(tmp_path / "unseen", tiny, 4, seed=9)
    path = tmp_path / "w.pt"
    options = ("--steps", 4, "--threads", 1, "--validate", unseen, "--validate-every", 2)
    rtmap("train", "-o", path, *call, *options, "--keep-best", "--stop-after", 3)
    rtmap("train", "-o", path, *call, *options, "--keep-best", "--resume", path)
    with path.with_suffix(".csv").open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["mAP"]]
    assert [row["step"] for row in rows] == ["2", "4"]
    for row in rows:
        assert 0 < float(row["mAP unchanged prior"]) <= 1 and 0 <= float(row["mAP prior"]) <= 1
    best = load_checkpoint(tmp_path / "w.best.pt")[1]
    assert best["figures"]["mAP"] == pytest.approx(max(float(r["mAP"]) for r in rows), abs=1e-4)
    assert "optimizer" not in best


class Oracle(torch.nn.Module):
    """Answers with the truth of the batch, and with the prior where it belongs."""

    def __init__(self, config):
        super().__init__()
        self.config, self.weight = config, torch.nn.Parameter(torch.zeros(1))

    def predict_batch(self, batch, bf16=False):
        return batch

    def answer(self, batch, points, class_id, mask):
        from types import SimpleNamespace

        b, slots, v = mask.shape[0], mask.shape[1], self.config.vertex_count
        scores = torch.zeros(b, 12 + slots, len(self.config.classes))
        out = torch.zeros(b, 12 + slots, v, 2)
        for k in range(b):
            first, last = batch.truth_start[k : k + 2]
            for q, g in enumerate(range(first, last)):
                if batch.truth_new[g]:
                    out[k, q] = batch.truth_orders[g, 0]
                    scores[k, q, batch.truth_class[g]] = 0.9
            for p in range(slots):
                out[k, 12 + p] = batch.prior_target[k, p]
                scores[k, 12 + p, class_id[k, p]] = 0.8 * batch.prior_real[k, p]
        exists = batch.prior_real * 0.8
        return SimpleNamespace(scores=scores, points=out, prior_score=exists)


def test_validation_gives_an_oracle_full_marks(tiny: Path, frames: Path) -> None:
    config = load_config(tiny)
    figures = validate(Oracle(config), Frames(frames, config))
    assert figures["mAP"] == pytest.approx(1.0)
    assert figures["mAP prior"] == pytest.approx(1.0)
    assert 0.2 < figures["mAP unchanged prior"] < 0.95
    assert figures["AUC existence"] == 1.0


def test_batches_follow_from_seed_process_and_step(tiny: Path, frames: Path) -> None:
    config, recipe = load_config(tiny), Recipe(batch=2)
    feed = Feed([frames], config, recipe, 1, 0)
    assert len(pickle.dumps(feed)) < 5000  # frames stay on disk
    ahead = feed.batches(5, 1, torch.device("cpu"))
    for step in (5, 6):
        assert torch.equal(next(ahead).picture, feed[step].picture)
    assert not torch.equal(feed[5].picture, feed[6].picture)
    assert not torch.equal(feed[5].picture, Feed([frames], config, recipe, 1, 1)[5].picture)
    assert not torch.equal(feed[5].picture, Feed([frames], config, recipe, 2, 0)[5].picture)


def test_what_a_checkpoint_says_of_its_making(rtmap, call, frames: Path, tmp_path: Path) -> None:
    path = tmp_path / "w.pt"
    rtmap("train", "-o", path, *call, "--steps", 1, "--threads", 1, "--set", "noise.drop=0.25")
    made = load_checkpoint(path)[1]["options"]
    assert made["recipe"]["noise"]["drop"] == 0.25 and made["recipe"]["batch"] == 2
    assert made["data"] == [frames.name] and made["seed"] == 0
    assert str(tmp_path) not in json.dumps(made)


def test_requests_that_cannot_be_meant(rtmap, call, tmp_path: Path) -> None:
    out = ("train", "-o", tmp_path / "w.pt")
    rtmap(*out, *call, "--keep-best", "--steps", 1, code=2)
    rtmap(*out, *call, "--live", "--steps", 1, code=2)
    rtmap(*out, *call, "--stop-after", 1, code=2)
    if not torch.cuda.is_available():
        with pytest.raises(UsageError, match="no GPU"):
            pick_device("cuda")
        assert pick_device("auto").type == "cpu"
    with pytest.raises(BadInput, match="no such file"):
        load_checkpoint(tmp_path / "none.pt")
    if find_spec("tensorboard") is None:
        one = ("--steps", 1, "--threads", 1)
        said = rtmap(*out, *call, *one, "--tensorboard", tmp_path / "t", code=2)
        assert "tensorboard" in said.err
