"""Batches by step: the same step of the same process always gives the same batch."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from rtmap_cli.errors import BadInput
from rtmap_models.config import ModelConfig
from rtmap_models.data.dataset import Batch, Frames, collate, make_sample
from rtmap_models.training.recipe import Recipe

REFRESH_STEPS = 200
"""After so many steps the folders are looked at again: they may grow while training runs."""


class Feed(Dataset[Batch | BadInput]):
    """``feed[step]`` is the batch of a step, drawn from (seed, rank, step)."""

    def __init__(
        self, folders: Sequence[Path], config: ModelConfig, recipe: Recipe, seed: int, rank: int
    ):
        self.frames = Frames(folders, config)
        self.config, self.recipe, self.seed, self.rank = config, recipe, seed, rank
        self.looked = 0

    def __getitem__(self, step: int) -> Batch | BadInput:
        try:
            return self._batch(step)
        except BadInput as error:  # a loading process hands it on
            return error

    def _batch(self, step: int) -> Batch:
        if step - self.looked >= REFRESH_STEPS:
            self.frames.refresh()
            self.looked = step
        if len(self.frames) == 0:
            raise BadInput(self.frames.folder, "no training frames", "render some with --frames")
        rng = np.random.default_rng([self.seed, self.rank, step])
        samples = [
            make_sample(
                self.frames[int(k)],
                self.config,
                rng,
                self.recipe.noise,
                augmentation=self.recipe.augmentation,
            )
            for k in rng.integers(len(self.frames), size=self.recipe.batch)
        ]
        return collate(samples, self.config)

    def batches(self, first: int, loaders: int, device: torch.device) -> Iterator[Batch]:
        """The batches from step ``first`` on, on ``device``, without end; ``loaders`` processes
        prepare them ahead (0: this one does)."""
        steps = range(first, 2**62)
        self.looked = first
        source: Iterator[Batch | BadInput]
        if loaders == 0:
            source = (self[step] for step in steps)
        else:
            source = iter(
                DataLoader(
                    self,
                    batch_size=None,
                    sampler=steps,
                    num_workers=loaders,
                    prefetch_factor=4,
                    pin_memory=device.type == "cuda",
                    worker_init_fn=_quiet_worker,
                    multiprocessing_context="spawn",
                )
            )
        for batch in source:
            if isinstance(batch, BadInput):
                raise batch
            yield batch.to(device)


def _quiet_worker(_: int) -> None:
    """One thread, and deaf to Ctrl-C: the process that trains decides when to stop."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
