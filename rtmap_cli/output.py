"""What commands print: data on stdout, log and progress on stderr."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TypeVar

import click

T = TypeVar("T")


def plain(value: Any) -> Any:
    """A value that json can write: numpy scalars and arrays become Python's, NaN becomes null."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def emit(result: dict[str, Any], as_json: bool, lines: Iterable[str] = ()) -> None:
    """Print a command's result: one JSON object, or the lines meant for people."""
    if as_json:
        click.echo(json.dumps(plain(result), ensure_ascii=False))
        return
    for line in lines:
        click.echo(line)


def log(message: str) -> None:
    """One line on stderr."""
    click.echo(message, err=True)


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[str]:
    """A plain text table: columns of numbers to the right, columns of text to the left."""
    body = [list(map(str, row)) for row in rows]
    cells = [list(map(str, header)), *body]
    widths = [max(len(row[k]) for row in cells) for k in range(len(header))]
    numeric = [bool(body) and all(_number(row[k]) for row in body) for k in range(len(header))]
    return [
        "  ".join(
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(row, widths, numeric, strict=True)
        ).rstrip()
        for row in cells
    ]


def _number(text: str) -> bool:
    """True for what stands in a column of numbers: figures, shares, a dash for nothing."""
    return re.fullmatch(r"[-–—]?|[-+−]?[\d,]*\.?\d+\s?(%|°|m|s)?", text.strip()) is not None


def progress(
    items: Iterable[T], what: str, total: int | None = None, quiet: bool = False
) -> Iterator[T]:
    """Yield the items with a progress bar on a terminal; one line at the end elsewhere."""
    if quiet:
        yield from items
        return
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import track

        yield from track(
            items, description=what, total=total, console=Console(stderr=True), transient=True
        )
        return
    count = 0
    for item in items:
        yield item
        count += 1
    log(f"{what}: {count} done")
