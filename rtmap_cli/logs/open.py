"""Which reader reads a log: the native folder here, other formats by name.

Readers of other formats live above this package (``rtmap_cli.formats``); as with the commands of
the command line, they are named in a table and imported when a log of theirs is opened.
"""

from __future__ import annotations

import importlib
from pathlib import Path

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.log import Log

READERS = {"av2": ("rtmap_cli.formats.av2", "Av2Log")}
"""Prefix of a log argument → module and class of its reader."""

MARKS = {
    "native": ("log.json", "frames.parquet"),
    "av2": ("city_SE3_egovehicle.feather", "annotations.feather", "annotations_with_ego.feather"),
}
"""Files that tell a format, so that a log which lacks one of them is still named as what it is."""


def log_format(spec: str | Path) -> tuple[str, Path]:
    """(``native`` or a key of READERS, folder) of a log argument.

    ``av2:DIR`` forces the Argoverse 2 reader; without a prefix the folder tells what it is.
    BadInput when there is no such folder or it is no log of a known format.
    """
    text = str(spec)
    prefix, _, rest = text.partition(":")
    if rest and prefix in READERS:
        return prefix, Path(rest)
    folder = Path(text)
    if not folder.exists():
        raise BadInput(folder, "no such log folder")
    if not folder.is_dir():
        raise BadInput(folder, "is a file, a log is a folder")
    for kind, marks in MARKS.items():
        if any((folder / mark).exists() for mark in marks):
            return kind, folder
    what = "is an empty folder" if not any(folder.iterdir()) else "is not a log"
    raise BadInput(
        folder,
        f"{what} (neither log.json nor city_SE3_egovehicle.feather in it)",
        "see docs/log-format.md",
    )


def open_log(spec: str | Path) -> Log:
    """The reader of a log folder (``av2:DIR`` forces Argoverse 2), opened."""
    kind, folder = log_format(spec)
    if kind == "native":
        from rtmap_cli.logs.native import NativeLog

        return NativeLog(folder)
    module, name = READERS[kind]
    log: Log = getattr(importlib.import_module(module), name)(folder)
    return log
