"""The course of a training run: a CSV file that lines up after --resume, and TensorBoard."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from rtmap_cli.errors import UsageError
from rtmap_cli.tables import whole_file


class Journal:
    """Rows of figures by step. A resumed run keeps the rows up to its step, whatever a killed run
    had written after its last checkpoint."""

    def __init__(
        self,
        path: Path,
        step: int = 0,
        before: Path | None = None,
        tensorboard: Path | None = None,
    ):
        """``before`` is the CSV of the run that is gone on with at ``step``."""
        self.path = path
        self.columns: list[str] = []
        self.rows: list[dict[str, Any]] = []
        if before is not None and before.is_file():
            with before.open(newline="", encoding="utf-8") as stream:
                reader = csv.DictReader(stream)
                self.rows = [row for row in reader if _step(row) <= step]
                self.columns = list(reader.fieldnames or [])
        self.board = _summary_writer(tensorboard, step) if tensorboard is not None else None
        if self.rows:
            self._rewrite()

    def add(self, row: dict[str, Any]) -> None:
        """Write one row; ``step`` must be in it. New columns are added to the file."""
        fresh = [name for name in row if name not in self.columns]
        self.columns += fresh
        self.rows.append(row)
        if fresh:
            self._rewrite()
        else:
            with self.path.open("a", newline="", encoding="utf-8") as stream:
                csv.DictWriter(stream, self.columns).writerow(row)
        if self.board is not None:
            for name, value in row.items():
                if name != "step" and isinstance(value, int | float):
                    self.board.add_scalar(name.replace(" ", "/", 1), value, row["step"])
            self.board.flush()

    def close(self) -> None:
        """Finish the TensorBoard file."""
        if self.board is not None:
            self.board.close()

    def _rewrite(self) -> None:
        with (
            whole_file(self.path) as temporary,
            temporary.open("w", newline="", encoding="utf-8") as stream,
        ):
            writer = csv.DictWriter(stream, self.columns)
            writer.writeheader()
            writer.writerows(self.rows)


def _step(row: dict[str, Any]) -> float:
    try:
        return float(row["step"])
    except (KeyError, TypeError, ValueError):
        return float("inf")


def _summary_writer(folder: Path, step: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise UsageError("--tensorboard needs the package tensorboard: pip install it") from None
    return SummaryWriter(str(folder), purge_step=step + 1)
