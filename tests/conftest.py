"""Fixtures: the sample data outside the project, and a command line that runs in-process."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest


@dataclass(frozen=True)
class Result:
    """What a command line gave."""

    code: int
    out: str
    err: str


@pytest.fixture
def rtmap(capsys: pytest.CaptureFixture[str]) -> Callable[..., Result]:
    """``rtmap("evaluate", "map", …)`` runs the command line and returns code, stdout, stderr."""
    from rtmap_cli.cli import run

    def call(*arguments: object, code: int | None = 0) -> Result:
        capsys.readouterr()
        got = run([str(a) for a in arguments])
        captured = capsys.readouterr()
        result = Result(got, captured.out, captured.err)
        if code is not None:
            assert got == code, f"exit {got}, not {code}\n{captured.out}\n{captured.err}"
        return result

    return call


def _folder(variable: str, name: str) -> Path:
    value = os.environ.get(variable)
    if not value or not Path(value).is_dir():
        pytest.skip(f"{name} folder not found, set {variable}")
    return Path(value)


@pytest.fixture(scope="session")
def rtmap_data() -> Path:
    """The folder of real sample data; the test is skipped without it."""
    return _folder("RTMAP_DATA", "sample data")


@pytest.fixture(scope="session")
def rtmap_golden() -> Path:
    """The folder of reference numbers; the test is skipped without it."""
    return _folder("RTMAP_GOLDEN", "reference numbers")


@pytest.fixture(scope="session")
def av2_log(rtmap_data: Path) -> Path:
    """The Argoverse 2 log 7fab2350; the test is skipped without it."""
    logs = sorted((rtmap_data / "av2_sensor").glob("7fab2350-*"))
    if not logs:
        pytest.skip("log 7fab2350 not found in RTMAP_DATA/av2_sensor")
    return logs[0]
