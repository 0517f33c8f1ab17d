"""Training: AdamW, warm-up and cosine, averaged weights, one process per thread.

Several small processes that average their gradients learn faster on a CPU than one process with
several threads (29 against 19 samples per second where this was measured).
"""

from __future__ import annotations

import copy
import csv
import math
import os
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch import Tensor

from rtmap_cli.errors import BadInput, UsageError
from rtmap_cli.output import log
from rtmap_models.bev import normalize_picture
from rtmap_models.checkpoint import load_checkpoint, save_checkpoint
from rtmap_models.config import ModelConfig
from rtmap_models.criterion import LossWeights, compute_losses
from rtmap_models.dataset import Batch, Frames, collate, make_sample
from rtmap_models.network import Prediction, RTMapNet
from rtmap_models.samples import PriorNoise


@dataclass(frozen=True)
class TrainOptions:
    """One training run. It ends after ``steps`` steps or ``minutes`` minutes, whichever is given;
    the learning rate falls to zero there. ``workers`` processes of one thread each."""

    data: Path
    output: Path
    steps: int | None = None
    minutes: float | None = None
    seed: int = 0
    workers: int = 1
    batch: int = 8
    rate: float = 1.2e-3
    warmup: int = 150
    decay: float = 0.02
    clip: float = 10.0
    average: float = 0.998
    save_every_s: float = 120.0
    log_every: int = 50
    resume: Path | None = None
    bf16: bool = True
    quiet: bool = False
    noise: PriorNoise = field(default_factory=PriorNoise)


def learning_rate(options: TrainOptions, step: int, progress: float) -> float:
    """Linear warm-up, then a cosine that reaches zero at progress 1."""
    cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))
    return options.rate * min(1.0, (step + 1) / options.warmup) * cosine


def train(config: ModelConfig, options: TrainOptions) -> None:
    """Train and write a checkpoint to ``options.output`` (and a CSV with the losses beside it)."""
    if options.steps is None and options.minutes is None:
        raise UsageError("give --steps or --minutes")
    if len(Frames(options.data, config)) == 0:
        raise BadInput(options.data, "no training frames", "make some with rtmap train --frames")
    if options.resume is not None:
        load_checkpoint(options.resume)
    if options.workers == 1:
        Trainer(config, options, 0).run()
        return
    with tempfile.TemporaryDirectory() as folder:
        meet = str(Path(folder) / "meet")
        mp.start_processes(
            _worker, (config, options, meet), nprocs=options.workers, start_method="spawn"
        )


def _worker(rank: int, config: ModelConfig, options: TrainOptions, meet: str) -> None:
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    dist.init_process_group(
        "gloo", init_method=f"file://{meet}", rank=rank, world_size=options.workers
    )
    Trainer(config, options, rank).run()
    dist.barrier()
    _leave()


def _leave() -> None:
    """End this process at once, successfully, without taking the interpreter down.

    A thread of gloo may still hold the tensors of the last exchange. When it lets go of them while
    the interpreter is being finalised, CPython ends the thread inside a C++ destructor, and the
    process dies of "terminate called without an active exception".
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


class Trainer:
    """The loop of one process; rank 0 keeps the average, saves and reports."""

    def __init__(self, config: ModelConfig, options: TrainOptions, rank: int):
        torch.set_num_threads(1)
        torch.manual_seed(options.seed)
        self.config, self.options, self.rank = config, options, rank
        self.frames = Frames(options.data, config)
        network = RTMapNet(config)
        self.network: RTMapNet = network.to(memory_format=torch.channels_last).train()
        self.optimizer = torch.optim.AdamW(
            network.parameters(), lr=options.rate, weight_decay=options.decay, betas=(0.9, 0.98)
        )
        self.average = copy.deepcopy(network).eval() if rank == 0 else None
        self.step, self.before, self.rows = 0, 0.0, 0
        if options.resume is not None:
            self._resume(options.resume)
        self.rng = np.random.default_rng([options.seed, rank, self.step])
        self.parameters = [p for p in network.parameters() if p.requires_grad]

    def _resume(self, path: Path) -> None:
        config, content = load_checkpoint(path)
        if config != self.config:
            raise BadInput(path, "another configuration than the one to train", "start anew")
        self.network.load_state_dict(content["network"])
        self.optimizer.load_state_dict(content["optimizer"])
        if self.average is not None:
            self.average.load_state_dict(content["average"])
        self.step, self.before = int(content["step"]), float(content["seconds"])

    def run(self) -> None:
        """Train to the end of the budget."""
        options, start = self.options, time.monotonic()
        saved, shown = start, start
        sums: dict[str, float] = {}
        while True:
            seconds = self.before + time.monotonic() - start
            progress = self._agree(self._progress(seconds))
            if progress >= 1.0:
                break
            if self.step % 200 == 0:
                self.frames.refresh()
            rate = learning_rate(options, self.step, progress)
            for group in self.optimizer.param_groups:
                group["lr"] = rate
            for name, value in self._train_step().items():
                sums[name] = sums.get(name, 0.0) + value
            self.step += 1
            if self.rank:
                continue
            self._update_average()
            if self.step % options.log_every == 0:
                now = time.monotonic()
                speed = options.log_every * options.batch * options.workers / (now - shown)
                self._log(seconds, progress, rate, speed, sums)
                shown, sums = now, {}
            if time.monotonic() - saved > options.save_every_s:
                self.save(seconds)
                saved = time.monotonic()
        if self.rank == 0:
            self.save(self.before + time.monotonic() - start)

    def _progress(self, seconds: float) -> float:
        by_steps = self.step / self.options.steps if self.options.steps else 0.0
        by_time = seconds / (60 * self.options.minutes) if self.options.minutes else 0.0
        return max(by_steps, by_time)

    def _agree(self, progress: float) -> float:
        """Rank 0 decides how far the run is, so that all stop together."""
        if self.options.workers == 1:
            return progress
        value = torch.tensor([progress], dtype=torch.float64)
        dist.broadcast(value, src=0)
        return float(value)

    def batch(self) -> Batch:
        """A random batch."""
        index = self.rng.integers(len(self.frames), size=self.options.batch)
        samples = [
            make_sample(self.frames[int(k)], self.config, self.rng, self.options.noise)
            for k in index
        ]
        return collate(samples, self.config)

    def _train_step(self) -> dict[str, float]:
        batch = self.batch()
        prediction = forward(self.network, batch, self.options.bf16)
        parts = compute_losses(prediction, batch, LossWeights())
        self.optimizer.zero_grad(set_to_none=True)
        torch.stack(list(parts.values())).sum().backward()
        self._average_gradients()
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, self.options.clip)
        if torch.isfinite(norm):
            self.optimizer.step()
        return {k: float(v.detach()) for k, v in parts.items()} | {"gradient": float(norm)}

    def _average_gradients(self) -> None:
        if self.options.workers == 1:
            return
        grads = [p.grad if p.grad is not None else torch.zeros_like(p) for p in self.parameters]
        flat = torch.cat([g.reshape(-1) for g in grads])
        dist.all_reduce(flat)
        flat /= self.options.workers
        parts: list[Tensor] = list(flat.split([g.numel() for g in grads]))
        for p, part in zip(self.parameters, parts, strict=True):
            p.grad = part.reshape(p.shape)

    @torch.no_grad()
    def _update_average(self) -> None:
        assert self.average is not None
        keep = min(self.options.average, (1 + self.step) / (10 + self.step))
        pairs = zip(
            self.average.state_dict().values(), self.network.state_dict().values(), strict=True
        )
        for mean, value in pairs:
            if mean.dtype.is_floating_point:
                mean.lerp_(value, 1 - keep)
            else:
                mean.copy_(value)

    def save(self, seconds: float) -> None:
        """Write the checkpoint."""
        assert self.average is not None
        options = {k: v if isinstance(v, bool | int | float | type(None)) else str(v)
                   for k, v in asdict(self.options).items()}  # fmt: skip
        content: dict[str, Any] = {
            "average": self.average.state_dict(),
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "seconds": seconds,
            "samples": self.step * self.options.batch * self.options.workers,
            "frames": len(self.frames),
            "options": options,
        }
        save_checkpoint(self.options.output, self.config, content)

    def _log(
        self, seconds: float, progress: float, rate: float, speed: float, sums: dict[str, float]
    ) -> None:
        means = {k: v / self.options.log_every for k, v in sums.items()}
        row = {
            "step": self.step,
            "seconds": round(seconds, 1),
            "progress": round(progress, 4),
            "rate": rate,
            "samples_per_s": round(speed, 1),
            "frames": len(self.frames),
        } | {k: round(v, 4) for k, v in means.items()}
        path = self.options.output.with_suffix(".csv")
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh = not path.exists() or (self.rows == 0 and self.options.resume is None)
        with path.open("w" if fresh else "a", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, list(row))
            if fresh:
                writer.writeheader()
            writer.writerow(row)
        self.rows += 1
        if self.options.quiet:
            return
        losses = " ".join(f"{k} {v:.3f}" for k, v in means.items())
        log(f"{progress:6.1%} step {self.step} {speed:.1f}/s rate {rate:.1e} {losses}")


def forward(network: RTMapNet, batch: Batch, bf16: bool) -> Prediction:
    """The network on a batch of pictures; convolutions in bfloat16 where that is asked for."""
    picture = normalize_picture(batch.picture)
    with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
        return network.predict(
            picture, batch.prior_points, batch.prior_class, batch.prior_mask, batch.prior_visible
        )
