"""The process is killed at random instants: the map is always whole, the old one or the new."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fusion_scene import drive, save, shifted, street

from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import fused_runs, history, map_exists, read_map, write_new_map

Call = Callable[..., Any]

KILLS = 50

# A child of this server is the command line of rtmap with everything imported already (a dry run
# sees to that): a fork costs milliseconds where a new interpreter costs a second.
SERVER = """
import os, signal, sys, time
from rtmap_cli.cli import run
import deltalake, pyarrow
pyarrow.set_cpu_count(1)
pyarrow.set_io_thread_count(1)
sys.stdout.flush()
out = os.dup(1)
os.dup2(2, 1)
run(["crowdsource", sys.argv[1], "--map", sys.argv[1] + ".none", "--dry-run"])
os.dup2(out, 1)
for line in sys.stdin:
    seconds, *arguments = line.rstrip("\\n").split("\\t")
    begin, child = time.perf_counter(), os.fork()
    if not child:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os._exit(run(arguments))
    if float(seconds):
        time.sleep(float(seconds))
        # It may have ended, but nobody has waited for it: its number is still its own.
        os.kill(child, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    print(code, time.perf_counter() - begin, flush=True)
"""


class Server:
    """Runs command lines in forked processes, and kills them after a while."""

    def __init__(self, runs: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", SERVER, str(runs)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )

    def run(self, *arguments: object, kill_after: float = 0.0) -> tuple[int, float]:
        """Exit code (negative: the signal) and seconds of one command line; 0: let it live."""
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write("\t".join(map(str, (kill_after, *arguments))) + "\n")
        self.process.stdin.flush()
        code, seconds = self.process.stdout.readline().split()
        return int(code), float(seconds)

    def close(self) -> None:
        """End the server."""
        self.process.kill()
        self.process.wait()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """One server for all kills."""
    if not hasattr(os, "fork"):
        pytest.skip("processes cannot be forked here")
    warm = tmp_path_factory.mktemp("warm")
    save(drive(street(), "d0", span=(0.0, 15.0)), warm / "runs/d0")
    made = Server(warm / "runs")
    yield made
    made.close()


def _same(one: VectorMap, other: VectorMap) -> bool:
    pairs = zip(one, other, strict=True)
    return len(one) == len(other) and all(
        a.element_id == b.element_id
        and np.array_equal(a.points, b.points, equal_nan=True)
        and a.existence == b.existence
        for a, b in pairs
    )


@pytest.mark.parametrize("first", [False, True], ids=["next version", "first version"])
def test_killed_at_random_instants_no_map_is_broken(
    rtmap: Call, tmp_path: Path, server: Server, first: bool
) -> None:
    save(drive(street(), "d0", span=(0.0, 15.0)), tmp_path / "runs/d0")
    prior = tmp_path / "prior"
    write_new_map(shifted(street(), 0.1, 0.2), prior, "prior")
    goal, target = tmp_path / "goal", tmp_path / "maps" / "map"
    if not first:
        shutil.copytree(prior, goal)
        shutil.copytree(prior, target)
    arguments = ["crowdsource", tmp_path / "runs", "--map"]
    code, seconds = server.run(*arguments, goal)
    assert code == 0
    end, before = read_map(goal), read_map(prior)
    rng, killed = random.Random(5 + first), 0
    for k in range(KILLS // 2):
        # Half of the kills fall upon the writing at the end.
        share = rng.uniform(0.0, 1.0) if k % 2 else rng.uniform(0.7, 1.1)
        code, spent = server.run(*arguments, target, kill_after=share * seconds)
        assert code in (0, -signal.SIGKILL)
        killed += code != 0
        # A machine that was busy when the time was taken would be done before every kill.
        seconds = seconds if code else min(seconds, spent)
        if not map_exists(target):
            assert first and not target.exists()
            continue
        now = read_map(target)
        done = fused_runs(target) == {"d0"}
        assert _same(now, end if done else before)
        assert len(history(target)) == (1 if first or not done else 2)
        if done:
            shutil.rmtree(target)
            if not first:
                shutil.copytree(prior, target)
    assert killed >= KILLS // 5
    rtmap("map", "validate", target) if map_exists(target) else None
    # What was left behind disturbs nobody: the next run ends where an undisturbed one does.
    code, _ = server.run(*arguments, target)
    assert code == 0 and _same(read_map(target), end)
