"""Errors that a user sees, each with the documented exit code (docs/cli.md)."""

from __future__ import annotations

from pathlib import Path


class RtmapError(Exception):
    """Something that ends a command with one clear line and an exit code; never a traceback."""

    exit_code = 1


class Findings(RtmapError):
    """Findings past a threshold that the user set (exit 1)."""

    exit_code = 1


class UsageError(RtmapError):
    """The command line asks for something that cannot be meant (exit 2)."""

    exit_code = 2


class BadInput(RtmapError):
    """Bad or missing input (exit 3): which file, what is wrong, what to do."""

    exit_code = 3

    def __init__(self, where: str | Path, what: str, todo: str = "") -> None:
        self.where, self.what, self.todo = str(where), what, todo
        super().__init__(f"{where}: {what}" + (f"; {todo}" if todo else ""))

    def __reduce__(self) -> tuple[type[BadInput], tuple[str, str, str]]:
        """How it travels from a worker process."""
        return type(self), (self.where, self.what, self.todo)


class NoAnswer(RtmapError):
    """The input is fine but no answer is possible, e.g. a degenerate pose (exit 4)."""

    exit_code = 4
