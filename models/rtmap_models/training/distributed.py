"""Several processes that train one network: started here, or by torchrun.

On a CPU several small processes that average their gradients learn faster than one process with
several threads (29 against 19 samples per second where this was measured); on GPUs there is one
process per GPU. Gradients meet through gloo (CPU) or nccl (CUDA).
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from types import FrameType
from typing import Any

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch import Tensor, nn

from rtmap_cli.errors import BadInput, NoAnswer, RtmapError, UsageError
from rtmap_cli.output import log

PATIENCE = timedelta(hours=6)
"""How long a process waits for the others, who may be rendering or validating."""

INSIST_S = 3.0


@dataclass(frozen=True)
class Group:
    """This process among ``size`` that train together; rank 0 decides, saves and reports."""

    rank: int
    size: int
    device: torch.device

    def agree(self, progress: float, stop: bool) -> tuple[float, bool]:
        """The progress that rank 0 sees and whether any process wants to stop."""
        if self.size == 1:
            return progress, stop
        said = [progress if self.rank == 0 else 0.0, float(stop)]
        value = torch.tensor(said, dtype=torch.float64, device=self.device)
        dist.all_reduce(value, op=dist.ReduceOp.MAX)
        return float(value[0]), bool(value[1] > 0)

    def average_gradients(self, parameters: Sequence[nn.Parameter]) -> None:
        """Every gradient becomes the mean over all processes."""
        if self.size == 1:
            return
        grads = [p.grad if p.grad is not None else torch.zeros_like(p) for p in parameters]
        flat = torch.cat([g.reshape(-1) for g in grads])
        dist.all_reduce(flat)
        flat /= self.size
        parts: list[Tensor] = list(flat.split([g.numel() for g in grads]))
        for p, part in zip(parameters, parts, strict=True):
            p.grad = part.reshape(p.shape)

    def barrier(self) -> None:
        """Wait for the others."""
        self.agree(0.0, False)

    def first(self, job: Callable[[], Any]) -> Any:
        """What ``job`` returns: rank 0 does it, then the others, who find its work done."""
        error: RtmapError | None = None
        result = None
        try:
            if self.rank == 0:
                result = job()
        except RtmapError as caught:
            error = caught
        if self.agree(0.0, error is not None)[1]:
            raise error or NoAnswer("stopped: another process has said why")
        return result if self.rank == 0 else job()


def pick_device(name: str, local_rank: int = 0) -> torch.device:
    """``cpu``, ``cuda`` or ``auto`` (a GPU where there is one); UsageError where it lacks."""
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise UsageError("--device cuda: torch sees no GPU here")
    if local_rank >= torch.cuda.device_count():
        raise UsageError(f"process {local_rank} of this machine has no GPU of its own")
    return torch.device("cuda", local_rank)


@contextmanager
def torchrun(device: str) -> Iterator[Group | None]:
    """The group of torchrun, where it started this process, for a whole command: an RtmapError
    ends the process with its line and exit code, success waits for the others."""
    group = join_torchrun(device)
    if group is None or group.size == 1:
        yield group
        return
    try:
        yield group
    except RtmapError as error:
        log(f"rtmap: {error}")
        leave(error.exit_code)
    group.barrier()
    leave()


def join_torchrun(device: str) -> Group | None:
    """The group that torchrun's environment (RANK, WORLD_SIZE, LOCAL_RANK, MASTER_ADDR and
    MASTER_PORT) describes, joined; None where there is none."""
    if not {"RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"} <= set(os.environ):
        return None
    rank, size = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
    group = Group(rank, size, pick_device(device, int(os.environ.get("LOCAL_RANK", rank))))
    if os.environ.get("LOCAL_WORLD_SIZE") == str(size):
        os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    if size > 1:
        _join(group, "env://")
    return group


def _join(group: Group, meet: str) -> None:
    gpu = group.device.type == "cuda"
    if gpu:
        torch.cuda.set_device(group.device)
    dist.init_process_group(
        "nccl" if gpu else "gloo",
        init_method=meet,
        rank=group.rank,
        world_size=group.size,
        timeout=PATIENCE,
    )


def leave(code: int = 0) -> None:
    """End this process at once, without taking the interpreter down.

    A thread of gloo may still hold the tensors of the last exchange. When it lets go of them while
    the interpreter is being finalised, CPython ends the thread inside a C++ destructor, and the
    process dies of "terminate called without an active exception".
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def run_workers(count: int, work: Callable[..., Any], arguments: Sequence[Any]) -> Any:
    """``work(group, *arguments)`` in ``count`` processes of one CPU thread each; what it returned
    in rank 0 (a plain value). An RtmapError of a process is raised here; SIGINT and SIGTERM are
    passed on to the processes, whose work is to end soon then."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        context: Any = mp.start_processes(
            _worker, (count, str(folder), work, tuple(arguments)), nprocs=count, join=False,
            start_method="spawn",
        )  # fmt: skip
        try:
            with passed_on([p.pid for p in context.processes]):
                while not context.join():
                    pass
        except (mp.ProcessExitedException, mp.ProcessRaisedException):
            _raise_noted(folder)
            raise
        result = folder / "result.json"
        return json.loads(result.read_text(encoding="utf-8")) if result.exists() else None


def _worker(rank: int, count: int, folder: str, work: Callable[..., Any], arguments: Any) -> None:
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    group = Group(rank, count, torch.device("cpu"))
    _join(group, f"file://{Path(folder) / 'meet'}")
    try:
        result = work(group, *arguments)
        if rank == 0:
            (Path(folder) / "result.json").write_text(json.dumps(result), encoding="utf-8")
        group.barrier()
    except BadInput as error:
        _note(folder, rank, [type(error).__name__, error.where, error.what, error.todo])
        leave(error.exit_code)
    except RtmapError as error:
        _note(folder, rank, [type(error).__name__, str(error)])
        leave(error.exit_code)
    leave()


def _note(folder: str, rank: int, error: list[str]) -> None:
    (Path(folder) / f"error-{rank}.json").write_text(json.dumps(error), encoding="utf-8")


def _raise_noted(folder: Path) -> None:
    """Raise the error that a process wrote down, if one did."""
    known = {kind.__name__: kind for kind in (BadInput, NoAnswer, UsageError)}
    for path in sorted(folder.glob("error-*.json")):
        name, *parts = json.loads(path.read_text(encoding="utf-8"))
        raise known.get(name, RtmapError)(*parts)


@contextmanager
def passed_on(pids: Sequence[int]) -> Iterator[None]:
    """SIGINT and SIGTERM go to other processes as SIGTERM while the block runs."""

    def forward(number: int, frame: FrameType | None) -> None:
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGTERM)

    with _handled(forward):
        yield


@contextmanager
def _handled(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle SIGINT and SIGTERM while the block runs; only the main thread can."""
    before: dict[int, Any] = {}
    with suppress(ValueError):
        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for caught, old in before.items():
            signal.signal(caught, old)


class StopSignals:
    """Notes SIGINT and SIGTERM while its block runs, so that a step can be finished first.

    A terminal and the parent may both pass on one wish; who insists later is obeyed at once.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self.since = 0.0

    @contextmanager
    def noted(self) -> Iterator[None]:
        """The block."""
        with _handled(self._note):
            yield

    def _note(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if self.received is None:
            self.received, self.since = number, now
        elif now - self.since > INSIST_S:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
