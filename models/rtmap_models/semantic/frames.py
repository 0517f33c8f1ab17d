"""Training frames of semantic rasters: simulated drives, one shard a town."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from rtmap_cli.errors import NoAnswer
from rtmap_cli.maps.crop import MapIndex
from rtmap_models.config import SemanticConfig
from rtmap_models.data.samples import Scene
from rtmap_models.data.shards import write_shard
from rtmap_models.data.views import scene_at
from rtmap_models.semantic.domains import DOMAINS
from rtmap_models.semantic.picture import wide_picture

EVERY = 2
"""One of so many frames of a drive is kept: its neighbours show nearly the same."""

TOWNS_PER_SEED = 100_000
TRIES = 4
"""Towns that are looked at before a shard is given up: some have no way through."""


class DriveJob(NamedTuple):
    """One shard to make: a drive through the town of a seed."""

    config: SemanticConfig
    folder: Path
    domain: str
    seed: int


def shard_name(job: DriveJob) -> str:
    return f"{job.domain}-{job.seed:07d}"


def make_drive_shard(job: DriveJob) -> int:
    """Simulate one drive and write its shard; returns its number of frames."""
    from rtmap_models.semantic.drives import town_rasters

    os.environ.setdefault("OMP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    pictures: list[NDArray[np.uint8]] = []
    scenes: list[Scene] = []
    for k in range(TRIES):
        town = job.seed + k * TOWNS_PER_SEED // 10
        try:
            vector_map, frames = town_rasters(job.config, DOMAINS[job.domain], town, EVERY)
        except NoAnswer:
            continue
        index = MapIndex(vector_map, join=True)
        for seen in frames:
            pictures.append(wide_picture(seen.raster, job.config))
            scenes.append(scene_at(index, seen.map_SE3_ego, job.config))
        break
    if not pictures:
        raise NoAnswer(f"no drive through {TRIES} towns from seed {job.seed} on")
    info = {"town": town, "domain": job.domain}
    write_shard(job.folder, shard_name(job), np.stack(pictures), scenes, info)
    return len(pictures)


def generate_drives(
    config: SemanticConfig,
    domain: str,
    folder: Path,
    frames: int,
    seed: int,
    workers: int,
    report: Callable[[str], None],
) -> None:
    """Fill ``folder`` with drives through the towns ``seed · 100000 + 0, 1, …`` of a domain until
    it holds ``frames`` frames and whole drives. Shards that are there already are kept."""
    from rtmap_models.data.dataset import Frames

    folder.mkdir(parents=True, exist_ok=True)
    have = len(Frames(folder, config))
    if have >= frames:
        return
    numbers = range(seed * TOWNS_PER_SEED, seed * TOWNS_PER_SEED + TOWNS_PER_SEED // 10)
    every = (DriveJob(config, folder, domain, number) for number in numbers)
    jobs = (job for job in every if not (folder / f"{shard_name(job)}.json").exists())
    report(f"simulating {frames - have} rasters of {domain} drives into {folder}")
    if workers == 1:
        _fill(map(make_drive_shard, jobs), have, frames, report)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        _fill(pool.imap_unordered(make_drive_shard, jobs), have, frames, report)


def _fill(made: Iterator[int], have: int, wanted: int, report: Callable[[str], None]) -> None:
    for done, count in enumerate(made, start=1):
        have += count
        if done % 10 == 0 or have >= wanted:
            report(f"{have} of {wanted} frames")
        if have >= wanted:
            return
