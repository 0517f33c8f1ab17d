"""Where jobs run: here one after the other, in processes of this machine, or on a dask cluster.

The answers come in the order of the jobs, whoever gives them: the number of workers, their speed
and the death of one of them change no byte of a map.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from rtmap_cli.errors import BadInput, UsageError

Item = TypeVar("Item")
Answer = TypeVar("Answer")
Work = Callable[[Item], Answer]

PATIENCE = 5
"""Seconds to wait for a scheduler."""
LIVES = 3
"""So often a pool that lost a worker is set up again before the jobs are given up."""


def in_process(work: Work[Item, Answer], items: Sequence[Item]) -> Iterator[Answer]:
    """One job after the other."""
    return map(work, items)


def in_processes(work: Work[Item, Answer], items: Sequence[Item], jobs: int) -> Iterator[Answer]:
    """Jobs in ``jobs`` processes of this machine. A worker that dies is replaced and what it had
    not answered is done again."""
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool

    # A fork would copy the threads of pyarrow in whatever state they are.
    context = multiprocessing.get_context("spawn")
    done = 0
    for life in range(LIVES):
        try:
            with ProcessPoolExecutor(jobs, mp_context=context) as pool:
                for answer in pool.map(work, items[done:]):
                    yield answer
                    done += 1
            return
        except BrokenProcessPool:
            if life == LIVES - 1:
                raise BadInput(
                    "--jobs",
                    f"workers died {LIVES} times",
                    "they may lack memory: use fewer jobs or a smaller --tile",
                ) from None


def on_dask(work: Work[Item, Answer], items: Sequence[Item], scheduler: str) -> Iterator[Answer]:
    """Jobs on a dask.distributed cluster; its workers need rtmap and the same paths."""
    try:
        from distributed import Client
    except ImportError:
        raise UsageError(
            "--engine dask needs dask.distributed: install rtmap with the extra dask "
            "(pip install 'rtmap[dask]')"
        ) from None
    from distributed.scheduler import KilledWorker

    try:
        client = Client(scheduler, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadInput(scheduler, f"no scheduler answers ({first})", "start one") from None
    with client:
        for task in [client.submit(work, item, pure=False) for item in items]:
            try:
                yield task.result()
            except KilledWorker:
                raise BadInput(
                    scheduler,
                    "a job killed one worker after the other",
                    "they may lack memory: use a smaller --tile",
                ) from None
            task.release()
