"""crowdsource on a cluster of this machine: the same bytes, also when a worker is killed."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fusion_scene import drive, line, save, street

from rtmap_cli.maps.store import write_new_map

pytest.importorskip("distributed", reason="dask.distributed is not installed (extra: dask)")

Call = Callable[..., Any]


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """The address of a scheduler on loopback and the processes of its two workers."""
    file = tmp_path / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    here = [sys.executable, "-m"]
    place = ["--scheduler-file", str(file), "--no-dashboard"]
    scheduler = subprocess.Popen(
        [*here, "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", *place],
        **quiet,
    )
    workers: list[subprocess.Popen[bytes]] = []
    try:
        while not file.exists():
            assert scheduler.poll() is None
            time.sleep(0.05)
        address = json.loads(file.read_text())["address"]
        # No nanny: who is killed here stays dead.
        options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory"]
        for k in range(2):
            folder = str(tmp_path / f"w{k}")
            command = [*here, "distributed.cli.dask_worker", address, *options, folder]
            workers.append(subprocess.Popen([*command, "--name", f"w{k}"], **quiet))
        yield address, workers
    finally:
        for process in (*workers, scheduler):
            process.kill()
            process.wait()


def _tiles(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in (folder / "tiles").rglob("*.parquet")}


def _busy(client: Any, name: str) -> bool:
    """True when the worker of that name has work."""
    workers = client.scheduler_info(n_workers=-1)["workers"]
    mine = [address for address, w in workers.items() if w["name"] == name]
    return bool(mine) and bool(client.processing().get(mine[0]))


def test_a_killed_worker_changes_no_byte(
    rtmap: Call, tmp_path: Path, cluster: tuple[str, list[subprocess.Popen[bytes]]]
) -> None:
    from distributed import Client

    address, workers = cluster
    long = [line("long", "boundary", 9.0, -20.0, 220.0)]
    for k in range(2):
        run = drive(street(*long), f"d{k}", seed=k, span=(0.0, 200.0))
        save(run, tmp_path / "runs" / f"d{k}")
    for name in ("here", "there"):
        write_new_map(street(), tmp_path / name, "prior")
    arguments = ["crowdsource", str(tmp_path / "runs"), "--tile", "100", "--map"]
    rtmap(*arguments, tmp_path / "here")
    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=60)
        command = [sys.executable, "-m", "rtmap_cli.cli", *arguments, str(tmp_path / "there")]
        process = subprocess.Popen(
            [*command, "--engine", "dask", "--scheduler", address], stderr=subprocess.PIPE
        )
        while not _busy(client, "w0"):
            assert process.poll() is None, "it was done before a worker could be killed"
            time.sleep(0.02)
        workers[0].kill()
        _, told = process.communicate(timeout=120)
    assert process.returncode == 0, told.decode()
    assert workers[1].poll() is None
    assert _tiles(tmp_path / "there") == _tiles(tmp_path / "here")


def test_no_scheduler_is_one_line(rtmap: Call, tmp_path: Path) -> None:
    save(drive(street(), "d0"), tmp_path / "runs" / "d0")
    told = rtmap(
        "crowdsource", tmp_path / "runs", "--map", tmp_path / "map",
        "--engine", "dask", "--scheduler", "tcp://127.0.0.1:1", code=3,
    ).err  # fmt: skip
    assert "127.0.0.1:1" in told and len(told.strip().splitlines()) == 1
    assert not (tmp_path / "map").exists()
