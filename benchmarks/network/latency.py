"""How long a frame takes: onnxruntime against torch, and the whole of ``rtmap infer``.

    python -m benchmarks.network.latency                       the shipped model, a simulated log
    python -m benchmarks.network.latency --model m.onnx --log logs/monday --map map

Needs the extras ``train`` and ``simulate``. All sides take turns within one run, so that a busy
machine slows all; figures are medians, ratios are medians of the ratios of neighbours.

With N threads a frame can have them all, or N frames are read side by side on one each, as
``rtmap infer`` does it with onnxruntime. torch eager is timed both ways, side by side in processes
of their own (its Python would hold one thread up for the other); the ratio that counts is against
the better of the two. Prints one JSON object; ``infer`` is a new process with everything: start,
imports, reading and decoding the JPEGs, the network, writing the run.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from rtmap_models.architecture import build_network
from rtmap_models.config import config_from_dict, load_config
from rtmap_models.export.example import example_inputs
from rtmap_models.export.onnx_file import INPUTS, read_configuration, read_weights
from torch import nn

from rtmap_cli.logs.open import open_log
from rtmap_cli.steps.infer import MapModel
from rtmap_cli.steps.infer.model import find_model

PRIORS = 20
"""Prior slots in use: about what a 72 × 36 m crop of a real map holds."""

FRAMES_A_TURN = 4
"""Frames of each of those side by side in one turn: starting and waiting then hardly count."""

BARS = {"onnxruntime against torch": 1.5, "infer, frames per second": 10.0}


def twin(path: Path, config: str) -> nn.Module:
    """The torch network of a model file; with fresh weights, which take the same time, if the
    file does not hold its own."""
    values = read_configuration(path)
    settings = config_from_dict(values, path) if values else load_config(config)
    network = build_network(settings).eval()
    state = read_weights(path)
    if state is not None:
        network.load_state_dict(state)
    return network


def take_turns(sides: dict[str, Callable[[], Any]], runs: int, warm: int = 3) -> dict[str, Any]:
    """Milliseconds of each side, called in turns: all of them, without the first few."""
    times: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(runs + warm):
        for name, call in sides.items():
            start = time.perf_counter()
            call()
            times[name].append((time.perf_counter() - start) * 1e3)
    return {name: np.array(values[warm:]) for name, values in times.items()}


def network(path: Path, torch_side: nn.Module, cameras: int, threads: int, runs: int) -> Any:
    """One frame at a time through onnxruntime and through torch eager, same threads."""
    model = MapModel(str(path), threads)
    torch.set_num_threads(threads)
    inputs = example_inputs(torch_side.config, 1, cameras, PRIORS)
    feed = [x.numpy() for x in inputs]

    def eager() -> Any:
        with torch.inference_mode():
            return torch_side(*inputs)

    ms = take_turns({"onnxruntime": lambda: model(*feed), "torch": eager}, runs)
    return {
        **{f"{name} ms": float(np.median(values)) for name, values in ms.items()},
        **{f"{name} 90 % ms": float(np.quantile(values, 0.9)) for name, values in ms.items()},
        "ratio": float(np.median(ms["torch"] / ms["onnxruntime"])),
    }


def side_by_side(
    path: Path, config: str, torch_side: nn.Module, cameras: int, threads: int, runs: int
) -> Any:
    """Frames per second with so many threads in all: onnxruntime as ``rtmap infer`` runs it (one
    session, a frame per thread) against torch eager with all threads on a frame, and with a frame
    on one thread in each of so many processes."""
    model = MapModel(str(path), 1)
    inputs = example_inputs(torch_side.config, 1, cameras, PRIORS)
    feed = [x.numpy() for x in inputs]
    frames = threads * FRAMES_A_TURN
    torch.set_num_threads(threads)

    def one_after_the_other() -> None:
        with torch.inference_mode():
            for _ in range(frames):
                torch_side(*inputs)

    with ThreadPoolExecutor(threads) as pool, _processes(path, config, cameras, threads) as turn:
        sides = {
            "onnxruntime, side by side": lambda: list(
                pool.map(lambda _: model(*feed), range(frames))
            ),
            "torch, all threads on a frame": one_after_the_other,
            "torch, side by side": turn,
        }
        ms = take_turns(sides, runs, warm=2)
    ours, *others = ms
    best = np.minimum(*(ms[name] for name in others))
    return {
        **{f"{name}, frames/s": float(np.median(frames * 1e3 / ms[name])) for name in ms},
        "ratio to the better of torch": float(np.median(best / ms[ours])),
    }


@contextmanager
def _processes(path: Path, config: str, cameras: int, count: int) -> Iterator[Callable[[], None]]:
    """Processes that run torch on one thread; the call lets each read `FRAMES_A_TURN` frames."""
    context = multiprocessing.get_context("spawn")
    pipes = [context.Pipe() for _ in range(count)]
    call = ((path, config, cameras, theirs) for _, theirs in pipes)
    workers = [context.Process(target=_work, args=one, daemon=True) for one in call]
    for worker in workers:
        worker.start()

    def turn() -> None:
        for ours, _ in pipes:
            ours.send(FRAMES_A_TURN)
        for ours, _ in pipes:
            ours.recv()

    try:
        turn()  # all are ready when the first turn is over
        yield turn
    finally:
        for ours, _ in pipes:
            ours.send(0)
        for worker in workers:
            worker.join()


def _work(path: Path, config: str, cameras: int, pipe: Any) -> None:
    """One of `_processes`: reads as many frames as it is told to, until that is none."""
    torch.set_num_threads(1)
    network = twin(path, config)
    inputs = example_inputs(network.config, 1, cameras, PRIORS)
    while frames := pipe.recv():
        with torch.inference_mode():
            for _ in range(frames):
                network(*inputs)
        pipe.send(True)


def operators(path: Path, config: Any, cameras: int, runs: int = 10, most: int = 8) -> Any:
    """Shares of onnxruntime's time by operator, from its own profiler, one thread."""
    inputs = example_inputs(config, 1, cameras, PRIORS)
    feed = dict(zip(INPUTS, [x.numpy() for x in inputs], strict=True))
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 4
    options.enable_mem_reuse = False  # as `MapModel`
    options.enable_profiling = True
    with tempfile.TemporaryDirectory() as folder:
        options.profile_file_prefix = str(Path(folder) / "profile")
        session = onnxruntime.InferenceSession(str(path), options, ["CPUExecutionProvider"])
        for _ in range(runs):
            session.run(None, feed)
        events = json.loads(Path(session.end_profiling()).read_text(encoding="utf-8"))
    spent: Counter[str] = Counter()
    for event in events:
        if event.get("cat") == "Node" and event["name"].endswith("kernel_time"):
            spent[event["args"]["op_name"]] += event["dur"]
    return {name: us / spent.total() for name, us in spent.most_common(most)}


def simulate(folder: Path, frames: int) -> tuple[Path, Path]:
    """A drive through a simulated town with the default rig: its log and its map."""
    town, log = folder / "town", folder / "log"
    _rtmap("simulate", "town", "--seed", 5, "-o", town)
    more = ("--log", "town:", "--frames", frames, "--length", 2.5 * frames, "--seed", 5)
    _rtmap("simulate", "images", "--map", town, "-o", log, *more)
    return log, town


def infer(path: Path, log: Path, vector_map: Path, threads: int, runs: int) -> dict[str, Any]:
    """Frames per second of ``rtmap infer``: of the whole process, and as the command says it
    (without start and imports)."""
    whole, said, frames = [], [], 0
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(runs):
            start = time.perf_counter()
            call = ("--model", path, "--map", vector_map, "-o", Path(folder) / "run", "--overwrite")
            out = _rtmap("infer", log, *call, "--threads", threads, "-q")
            frames = out["frames"]
            whole.append(frames / (time.perf_counter() - start))
            said.append(out["frames_per_second"])
    return {
        "frames": frames,
        "frames per second": float(np.median(said)),
        "frames per second, whole process": float(np.median(whole)),
    }


def reading(path: Path, log_path: Path) -> dict[str, float]:
    """Milliseconds per frame to read, decode and fit the images, one thread."""
    from rtmap_cli.steps.infer.images import FittedCamera

    log, info = open_log(str(log_path)), MapModel(str(path), 1).info
    if log.rig is None:
        raise SystemExit(f"{log_path}: the log has no calibration")
    cameras = {
        c.name: FittedCamera(c, info.image_size, info.horizon, log.ground_z) for c in log.rig
    }
    times = []
    for frame in log.frames():
        start = time.perf_counter()
        for name, image in frame.images.items():
            cameras[name].load(image)
        times.append((time.perf_counter() - start) * 1e3)
    return {"cameras": len(cameras), "median ms": float(np.median(times))}


def _rtmap(*words: object) -> Any:
    call = [sys.executable, "-m", "rtmap_cli", *map(str, words), "--json"]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr or done.stdout)
    return json.loads(done.stdout)


def main() -> None:
    """Measure and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="rtmap-tiny", help="zoo name or .onnx file")
    parser.add_argument("--config", default="rtmap-tiny", help="where the file states none")
    parser.add_argument("--log", type=Path, help="default: one is simulated")
    parser.add_argument("--map", type=Path, help="the prior map, with --log")
    parser.add_argument("--frames", type=int, default=32, help="of the simulated log")
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--infer-runs", type=int, default=5)
    a = parser.parse_args()
    if (a.log is None) != (a.map is None):
        parser.error("--log and --map go together")
    path = find_model(a.model)
    side = twin(path, a.config)
    report: dict[str, Any] = {"model": str(path), "network": {}}
    for cameras in (6, 7):
        for threads in (1, 2):
            key = f"{cameras} cameras, {threads} threads"
            report["network"][key] = network(path, side, cameras, threads, a.runs)
    report["side by side"] = {
        f"{cameras} cameras, 2 threads": side_by_side(
            path, a.config, side, cameras, 2, max(2, a.runs // 3)
        )
        for cameras in (6, 7)
    }
    report["operators"] = operators(path, side.config, 7)
    with tempfile.TemporaryDirectory() as folder:
        log, vector_map = (a.log, a.map) if a.log else simulate(Path(folder), a.frames)
        report["reading images"] = reading(path, log)
        report["infer, 2 threads"] = infer(path, log, vector_map, 2, a.infer_runs)
    report["bars"] = BARS
    print(json.dumps(report, indent=1, ensure_ascii=False))


if __name__ == "__main__":
    main()
