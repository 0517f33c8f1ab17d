"""``rtmap infer --threads``: frames side by side, the same bytes, the same errors."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_logs import truncate, write_native_log

from rtmap_cli.logs.run_files import read_run
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.steps.infer.ahead import in_order

FRAMES = 7


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_native_log(tmp_path / "log", FRAMES)


def _bytes(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir()}


@pytest.mark.parametrize("batch", [1, 2])
def test_any_number_of_threads_gives_the_same_bytes(
    rtmap: Callable[..., Any], log: Path, tmp_path: Path, batch: int
) -> None:
    """Also where cameras come and go and the network is asked twice."""
    line = read_start(log) + np.array([[-40.0, 2.0], [60.0, 2.5]])
    write_new_map(VectorMap([Element("d", "divider", line)], "EPSG:32617"), tmp_path / "map", "t")
    call = ("infer", log, "--map", tmp_path / "map", "-q", "--looks", 2, "--batch", batch)
    for threads in (1, 2, 4):
        rtmap(*call, "--threads", threads, "-o", tmp_path / f"run{threads}")
    alone = _bytes(tmp_path / "run1")
    assert len(alone) == 4 and alone == _bytes(tmp_path / "run2") == _bytes(tmp_path / "run4")
    run = read_run(tmp_path / "run4")
    assert list(run.frames.frame) == list(range(FRAMES))
    assert (np.diff(run.observations.frame) >= 0).all() and set(run.observations.element_id) > {"d"}


def read_start(log: Path) -> np.ndarray:
    from rtmap_cli.logs.open import open_log

    return np.asarray(next(iter(open_log(str(log)).frames())).map_SE3_ego[:2, 3])


@pytest.mark.parametrize("threads", [1, 3])
def test_a_bad_image_in_the_middle_ends_it_with_nothing_written(
    rtmap: Callable[..., Any], log: Path, tmp_path: Path, threads: int
) -> None:
    for frame in (3, 5):
        truncate(log / "images" / "cam_0" / f"{frame:06d}.jpg", 400)
    call = ("infer", log, "-q", "--threads", threads, "-o", tmp_path / "run")
    told = rtmap(*call, code=3).err
    assert "000003.jpg" in told and len(told.strip().splitlines()) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["log"]
    skipped = rtmap(*call, "--skip-bad-frames").err.strip().splitlines()
    assert ["000003.jpg" in skipped[0], "000005.jpg" in skipped[1]] == [True, True]
    run = read_run(tmp_path / "run")
    assert list(run.frames.frame) == [0, 1, 2, 4, 6] and run.info["skipped_frames"] == 2


def test_results_come_in_order_and_few_are_begun() -> None:
    begun: list[int] = []
    taken = most = 0

    def items() -> Iterator[int]:
        for k in range(30):
            begun.append(k)
            yield k

    def slow_at_first(k: int) -> int:
        time.sleep(0.01 if k % 5 == 0 else 0.0)
        return k * k

    with ThreadPoolExecutor(3) as pool:
        for k, got in enumerate(in_order(slow_at_first, items(), pool, 4)):
            assert got == k * k
            taken += 1
            most = max(most, len(begun) - taken + 1)
    assert taken == 30 and 1 < most <= 4


def test_several_run_at_the_same_time() -> None:
    together = threading.Barrier(2, timeout=10)  # breaks when one waits alone

    def meet(k: int) -> int:
        together.wait()
        return k

    with ThreadPoolExecutor(2) as pool:
        assert list(in_order(meet, range(6), pool, 3)) == list(range(6))


def test_the_first_error_in_order_is_raised() -> None:
    def items() -> Iterator[int]:
        yield from range(3)
        raise ValueError("the source")

    def fails_at(where: int) -> Callable[[int], int]:
        def call(k: int) -> int:
            if k == where:
                time.sleep(0.02)
                raise ValueError(f"item {k}")
            return k

        return call

    with ThreadPoolExecutor(4) as pool:
        with pytest.raises(ValueError, match="item 2"):
            list(in_order(fails_at(2), items(), pool, 9))
        with pytest.raises(ValueError, match="the source"):
            list(in_order(fails_at(9), items(), pool, 9))
