"""Frames judged by several processes; the answer does not depend on how many."""

from __future__ import annotations

import multiprocessing
import signal
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any

from rtmap_cli.errors import BadInput
from rtmap_cli.steps.evaluate.maps.frames import MapSide
from rtmap_cli.steps.evaluate.maps.pairs import Pairs

CHUNK = 16
"""Frames that a process takes at a time."""

Judge = Callable[[str, list[Any], list[Any]], Any]

_held: dict[str, Any] = {}
"""What a process keeps between its chunks: the judge and the maps."""


def judge_all(pairs: Pairs, judge: Judge, jobs: int = 1) -> Iterator[Any]:
    """``judge(key, predicted, true)`` of every frame, in order; errors as in one process.

    ``judge`` must be picklable. At most 2 ``jobs`` chunks are under way, so that memory does not
    grow with the frames.
    """
    if jobs <= 1 or len(pairs) <= CHUNK:
        for key, predicted, true in pairs:
            yield judge(key, predicted, true)
        return
    held = [judge, *(s if isinstance(s, MapSide) else None for s in (pairs.pred, pairs.truth))]
    pool = ProcessPoolExecutor(
        jobs, multiprocessing.get_context("spawn"), initializer=_start, initargs=tuple(held)
    )
    waiting: deque[Future[Any]] = deque()
    try:
        for start in range(0, len(pairs), CHUNK):
            part = pairs.part(start, start + CHUNK).without_maps()
            waiting.append(pool.submit(_judge_part, part))
            if len(waiting) >= 2 * jobs:
                yield from _taken(waiting.popleft())
        while waiting:
            yield from _taken(waiting.popleft())
    finally:
        pool.shutdown(cancel_futures=True)


def _start(*held: Any) -> None:
    # Ctrl-C is the parent's business, which then ends the pool.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _held.update(zip(("judge", "pred", "truth"), held, strict=True))


def _judge_part(part: Pairs) -> tuple[list[Any], tuple[str, str, str] | None]:
    """What was judged before the first bad frame, and what is wrong with that one."""
    out: list[Any] = []
    try:
        for key, predicted, true in part.with_maps(_held["pred"], _held["truth"]):
            out.append(_held["judge"](key, predicted, true))
    except BadInput as error:
        return out, (error.where, error.what, error.todo)
    return out, None


def _taken(future: Future[Any]) -> Iterator[Any]:
    found, error = future.result()
    yield from found
    if error is not None:
        raise BadInput(*error)
