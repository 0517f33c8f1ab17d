"""The loop of one process that trains."""

from __future__ import annotations

import copy
import math
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rtmap_cli.maps.footprint import Footprint
from rtmap_cli.output import log
from rtmap_models.architecture import build_network
from rtmap_models.config import ModelConfig
from rtmap_models.data.dataset import Batch, Frames
from rtmap_models.training.checkpoint import (
    footprint_of,
    footprint_of_source,
    load_resumable,
    save_checkpoint,
    start_from,
)
from rtmap_models.training.distributed import Group, StopSignals
from rtmap_models.training.feed import Feed
from rtmap_models.training.journal import Journal
from rtmap_models.training.recipe import Recipe
from rtmap_models.training.validate import validate


@dataclass(frozen=True)
class TrainOptions:
    """One training run over the frames of the folders ``data``.

    It ends after ``steps`` steps or ``minutes`` minutes, whichever is given; the rate falls
    to zero there. ``stop_after`` steps or ``stop_minutes`` minutes of this call it stops early, to
    be gone on with from the checkpoint ``resume``. ``init`` gives the first weights (see
    ``checkpoint.start_from``). ``validate`` are folders of frames that are never trained on: looked
    at every ``validate_every`` steps (default: ten times in the run), at most ``validate_frames``
    of them; ``keep_best`` writes the best averaged weights so far beside the output.
    """

    data: tuple[Path, ...]
    output: Path
    recipe: Recipe = field(default_factory=Recipe)
    steps: int | None = None
    minutes: float | None = None
    stop_after: int | None = None
    stop_minutes: float | None = None
    seed: int = 0
    resume: Path | None = None
    init: str | None = None
    init_partial: bool = False
    validate: tuple[Path, ...] = ()
    validate_every: int | None = None
    validate_frames: int = 64
    keep_best: bool = False
    tensorboard: Path | None = None
    loaders: int = 0
    save_every_s: float = 120.0
    log_every: int = 50
    quiet: bool = False

    def summary(self) -> dict[str, Any]:
        """What a checkpoint says of its making: plain values, names instead of paths."""
        return {
            "data": [path.name for path in self.data],
            "steps": self.steps,
            "minutes": self.minutes,
            "seed": self.seed,
            "init": Path(self.init).name if self.init else None,
            "recipe": self.recipe.as_dict(),
        }


def learning_rate(recipe: Recipe, step: int, progress: float) -> float:
    """Linear warm-up, then a cosine that reaches zero at progress 1."""
    cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))
    return recipe.rate * min(1.0, (step + 1) / recipe.warmup) * cosine


class Trainer:
    """Rank 0 also keeps the average of the weights, saves, validates and reports."""

    def __init__(self, config: ModelConfig, options: TrainOptions, group: Group):
        if group.device.type == "cpu":
            torch.set_num_threads(1)
        torch.manual_seed(options.seed)
        self.config, self.options, self.group = config, options, group
        self.recipe = options.recipe
        self.feed = Feed(options.data, config, options.recipe, options.seed, group.rank)
        network = build_network(config)
        self.footprint = Footprint()
        if options.init is not None and options.resume is None:
            self._say_fresh(start_from(network, options.init, options.init_partial))
            self.footprint = footprint_of_source(options.init)
        network = network.to(device=group.device, memory_format=torch.channels_last)
        self.network: Any = network.train()
        self.parameters = [p for p in network.parameters() if p.requires_grad]
        self.optimizer = torch.optim.AdamW(
            self.parameters,
            lr=self.recipe.rate,
            weight_decay=self.recipe.decay,
            betas=(0.9, 0.98),
            fused=group.device.type == "cuda",
        )
        self.average: Any = copy.deepcopy(network).eval() if group.rank == 0 else None
        self.step, self.samples, self.before, self.best = 0, 0, 0.0, -1.0
        if options.resume is not None:
            self._resume(options.resume)
        self.began = self.step
        self.started = time.monotonic()
        self.sums: dict[str, Tensor] = {}
        self.bf16 = self.recipe.precision == "bf16"
        if group.rank == 0:
            self.journal = self._open_journal()
            self.held_out = Frames(options.validate, config) if options.validate else None
            self.footprint |= self.feed.frames.footprint()
            if not options.quiet:
                log(f"training footprint: {self.footprint.text()}")

    def run(self) -> dict[str, Any]:
        """Train to the end of the budget; says where it stands then."""
        stop = StopSignals()
        with stop.noted():
            self._loop(stop)
        if self.group.rank == 0:
            self.save()
            self.journal.close()
        interrupted = None if stop.received is None else signal.Signals(stop.received).name
        return {"step": self.step, "progress": self.progress(), "signal": interrupted}

    def _loop(self, stop: StopSignals) -> None:
        options = self.options
        batches = self.feed.batches(self.step, options.loaders, self.group.device)
        saved = shown = self.started
        while True:
            wish = stop.received is not None or self._paused()
            progress, stopping = self.group.agree(self.progress(), wish)
            if progress >= 1.0 or stopping:
                return
            rate = learning_rate(self.recipe, self.step, progress)
            for group in self.optimizer.param_groups:
                group["lr"] = rate
            torch.manual_seed(hash((options.seed, self.group.rank, self.step)))
            self._train_step(next(batches))
            self.step += 1
            self.samples += self.recipe.batch * self.group.size
            if self.group.rank:
                continue
            self._update_average()
            if self.step % options.log_every == 0:
                now = time.monotonic()
                self._report(progress, rate, now - shown)
                shown = now
            if self._validation_due(progress):
                begin = time.monotonic()
                self._validate()
                shown += time.monotonic() - begin
            if time.monotonic() - saved > options.save_every_s:
                self.save()
                saved = time.monotonic()

    def seconds(self) -> float:
        """How long this run has trained, earlier calls included."""
        return self.before + time.monotonic() - self.started

    def progress(self) -> float:
        """The share of the budget that is spent."""
        options = self.options
        by_steps = self.step / options.steps if options.steps else 0.0
        by_time = self.seconds() / (60 * options.minutes) if options.minutes else 0.0
        return max(by_steps, by_time)

    def _paused(self) -> bool:
        """Whether this call has done what it was asked for."""
        options = self.options
        if options.stop_after is not None and self.step - self.began >= options.stop_after:
            return True
        minutes = (time.monotonic() - self.started) / 60
        return options.stop_minutes is not None and minutes >= options.stop_minutes

    def _train_step(self, batch: Batch) -> None:
        parts = self.network.losses(batch, self.bf16)
        self.optimizer.zero_grad(set_to_none=True)
        torch.stack(list(parts.values())).sum().backward()
        self.group.average_gradients(self.parameters)
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, self.recipe.clip)
        finite = bool(torch.isfinite(norm))
        if finite:
            self.optimizer.step()
        values = {name: value.detach() for name, value in parts.items()} | {"gradient": norm}
        values["skipped"] = torch.tensor(float(not finite))
        for name, value in values.items():
            self.sums[name] = self.sums[name] + value if name in self.sums else value

    @torch.no_grad()
    def _update_average(self) -> None:
        keep = min(self.recipe.average, (1 + self.step) / (10 + self.step))
        pairs = zip(
            self.average.state_dict().values(), self.network.state_dict().values(), strict=True
        )
        means, values = [], []
        for mean, value in pairs:
            if mean.dtype.is_floating_point:
                means.append(mean)
                values.append(value)
            else:
                mean.copy_(value)
        torch._foreach_lerp_(means, values, 1 - keep)

    def _validation_due(self, progress: float) -> bool:
        if self.held_out is None:
            return False
        if self.options.validate_every is not None:
            return self.step % self.options.validate_every == 0
        return int(10 * self.progress()) > int(10 * progress)

    def _validate(self) -> None:
        assert self.held_out is not None
        figures = validate(self.average, self.held_out, self.options.validate_frames)
        self.journal.add({"step": self.step} | {k: round(v, 4) for k, v in figures.items()})
        if not self.options.quiet:
            line = " ".join(f"{k} {v:.3f}" for k, v in figures.items())
            log(f"step {self.step} on unseen frames: {line}")
        if figures["mAP"] > self.best:
            self.best = figures["mAP"]
            if self.options.keep_best:
                best = self.options.output.with_suffix(".best.pt")
                save_checkpoint(best, self.config, self._average_content() | {"figures": figures})

    def _average_content(self) -> dict[str, Any]:
        self.footprint |= self.feed.frames.footprint()
        return {
            "average": self.average.state_dict(),
            "step": self.step,
            "samples": self.samples,
            "seconds": self.seconds(),
            "frames": len(self.feed.frames),
            "options": self.options.summary(),
            "footprint": self.footprint.as_json(),
        }

    def save(self) -> None:
        """Write the checkpoint."""
        content = self._average_content() | {
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "best": self.best,
        }
        save_checkpoint(self.options.output, self.config, content)

    def _resume(self, path: Path) -> None:
        content = load_resumable(path, self.config)
        self.network.load_state_dict(content["network"])
        self.optimizer.load_state_dict(content["optimizer"])
        if self.average is not None:
            self.average.load_state_dict(content["average"])
        self.step, self.before = int(content["step"]), float(content["seconds"])
        self.samples, self.best = int(content["samples"]), float(content.get("best", -1.0))
        self.footprint = footprint_of(content, path)

    def _open_journal(self) -> Journal:
        resume = self.options.resume
        before = resume.with_suffix(".csv") if resume is not None else None
        path = self.options.output.with_suffix(".csv")
        return Journal(path, self.step, before, self.options.tensorboard)

    def _report(self, progress: float, rate: float, seconds: float) -> None:
        every = self.options.log_every
        sums, self.sums = {k: float(v) for k, v in self.sums.items()}, {}
        means = {k: v if k == "skipped" else v / every for k, v in sums.items()}
        speed = every * self.recipe.batch * self.group.size / max(seconds, 1e-9)
        row = {
            "step": self.step,
            "seconds": round(self.seconds(), 1),
            "progress": round(progress, 4),
            "rate": rate,
            "samples_per_s": round(speed, 1),
            "frames": len(self.feed.frames),
        } | {k: round(v, 4) for k, v in means.items()}
        self.journal.add(row)
        if not self.options.quiet:
            losses = " ".join(f"{k} {v:.3f}" for k, v in means.items() if v or k != "skipped")
            log(f"{progress:6.1%} step {self.step} {speed:.1f}/s rate {rate:.1e} {losses}")

    def _say_fresh(self, names: list[str]) -> None:
        if names and self.group.rank == 0:
            log(f"--init: {len(names)} tensors do not fit and start fresh, e.g. {names[0]}")
