"""Training a network on frames: checks the request, then one process or several train."""

from __future__ import annotations

from typing import Any

from rtmap_cli.errors import BadInput, UsageError
from rtmap_models.config import ModelConfig
from rtmap_models.data.dataset import Frames
from rtmap_models.training.checkpoint import load_resumable
from rtmap_models.training.distributed import Group, pick_device, run_workers
from rtmap_models.training.trainer import Trainer, TrainOptions

__all__ = ["TrainOptions", "train"]


def train(
    config: ModelConfig,
    options: TrainOptions,
    group: Group | None = None,
    device: str = "cpu",
    workers: int = 1,
) -> dict[str, Any]:
    """Train and write a checkpoint to ``options.output`` (and a CSV with the losses beside it).

    ``group`` is what torchrun set up; without one this starts ``workers`` processes on the CPU, or
    trains here on one GPU. Returns step, progress (below 1 when it was stopped early) and the name
    of the signal that stopped it, if one did. Raises BadInput for frames or weights that cannot be
    used, UsageError for a request that cannot be meant.
    """
    if options.steps is None and options.minutes is None:
        raise UsageError("give --steps or --minutes")
    if len(Frames(options.data, config)) == 0:
        raise BadInput(options.data[0], "no training frames", "make some with --frames")
    if options.validate and len(Frames(options.validate, config)) == 0:
        raise BadInput(options.validate[0], "no frames to validate on", "make some with --frames")
    if options.resume is not None:
        load_resumable(options.resume, config)
    if group is None:
        group = Group(0, 1, pick_device(device))
        if group.device.type == "cpu" and workers > 1:
            result: dict[str, Any] = run_workers(workers, run_training, (config, options))
            return result
    return run_training(group, config, options)


def run_training(group: Group, config: ModelConfig, options: TrainOptions) -> dict[str, Any]:
    """One process of a training run, from its first step to its last."""
    return Trainer(config, options, group).run()
