"""Rendering while training: new towns come, the oldest go, so that the data never ends."""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path

from rtmap_models.config import ModelConfig
from rtmap_models.data.generate import (
    FRAMES_PER_TOWN,
    TOWNS_PER_SEED,
    TownJob,
    make_town_shard,
)


class Window:
    """The towns of a folder, oldest first, at most ``keep`` frames (at least one town)."""

    def __init__(self, folder: Path, keep: int, seed: int):
        self.folder = folder
        self.most = max(1, keep // FRAMES_PER_TOWN)
        self.names = sorted(p.stem for p in folder.glob("town-*.json"))
        first = seed * TOWNS_PER_SEED
        last = int(self.names[-1].removeprefix("town-")) if self.names else first - 1
        self.next_seed = max(first, last + 1)
        self.retired: list[str] = []

    def take(self) -> int:
        """The seed of the next town."""
        self.next_seed += 1
        return self.next_seed - 1

    def add(self, name: str) -> None:
        """A town is there: let the oldest go. Readers that have just seen a town retire may still
        open its files until the next one does."""
        for old in self.retired:
            for suffix in (".npy", ".images.npy", ".npz"):
                (self.folder / f"{old}{suffix}").unlink(missing_ok=True)
        self.names.append(name)
        self.retired, self.names = self.names[: -self.most], self.names[-self.most :]
        for old in self.retired:
            (self.folder / f"{old}.json").unlink(missing_ok=True)


@contextmanager
def rendering(
    config: ModelConfig, folder: Path, keep: int, seed: int, workers: int, keep_images: bool
) -> Iterator[None]:
    """Render towns into ``folder`` with ``workers`` processes while the block runs."""
    window, stop = Window(folder, keep, seed), threading.Event()
    pool = ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), initializer=_deaf_to_interrupts
    )

    def job() -> Future[str]:
        task = TownJob(config, folder, window.take(), FRAMES_PER_TOWN, keep_images)
        return pool.submit(make_town_shard, task)

    def render() -> None:
        running = {job() for _ in range(workers)}
        while not stop.is_set():
            done, running = wait(running, timeout=1.0, return_when=FIRST_COMPLETED)
            for future in done:
                window.add(future.result())
                running.add(job())

    thread = threading.Thread(target=render, name="rendering")
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        pool.shutdown(cancel_futures=True)


def _deaf_to_interrupts() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
