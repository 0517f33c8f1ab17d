"""Which reader reads a log: the native folder here, other formats by name.

Readers of other formats live above this package (``rtmap_cli.formats``); as with the commands of
the command line, they are named in a table and imported when a log of theirs is opened.
"""

from __future__ import annotations

import importlib
from pathlib import Path

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.log import Log
from rtmap_cli.tables import taken_for

READERS = {
    "av2": ("rtmap_cli.formats.av2.log", "Av2Log"),
    "nuscenes": ("rtmap_cli.formats.nuscenes.log", "open_nuscenes"),
    "dgp": ("rtmap_cli.formats.dgp", "DgpLog"),
    "sweeps": ("rtmap_cli.formats.sweeps", "SweepFolder"),
}
"""Prefix of a log argument → module and class (or function) of its reader."""

MARKS = {
    # First: among the tables of nuScenes there is a log.json too.
    "nuscenes": ("v1.0-*/sample_data.json", "sample_data.json"),
    "native": ("log.json", "frames.parquet"),
    "av2": ("city_SE3_egovehicle.feather", "annotations.feather", "annotations_with_ego.feather"),
    "dgp": ("scene_dataset*.json", "scene_*.json"),
}
"""Files that tell a format, so that a log which lacks one of them is still named as what it is."""

OF_MANY = frozenset({"nuscenes", "dgp"})
"""Formats whose folders hold many drives: ``DIR#SCENE`` names one."""


def log_format(spec: str | Path) -> tuple[str, Path]:
    """(``native`` or a key of READERS, folder) of a log argument.

    ``av2:DIR``, ``nuscenes:DIR#SCENE`` or ``dgp:DIR#SCENE`` force a reader; without a prefix the
    folder (or an info file ``.pkl`` of nuScenes) tells what it is. ``#SCENE`` stays in the path.
    BadInput when there is no such folder or it is no log of a known format.
    """
    text = str(spec)
    prefix, _, rest = text.partition(":")
    if rest and prefix in READERS:
        return prefix, Path(rest)
    folder = Path(text)
    scene = ""
    if not folder.exists() and "#" in text:
        folder, scene = Path(text.rpartition("#")[0]), text.rpartition("#")[2]
    if not folder.exists():
        raise BadInput(folder, "no such log folder")
    if folder.is_file() and folder.suffix == ".pkl":
        return "nuscenes", folder
    if not folder.is_dir():
        raise BadInput(folder, "is a file, a log is a folder")
    for kind, marks in MARKS.items():
        if any(next(folder.glob(mark), None) for mark in marks):
            if scene and kind not in OF_MANY:
                raise BadInput(text, f"a {kind} log has no scenes", f"give {folder}")
            return kind, Path(text)
    what = "is an empty folder" if not any(folder.iterdir()) else "is not a log"
    raise BadInput(
        folder,
        f"{what} (neither log.json nor city_SE3_egovehicle.feather in it)",
        taken_for(folder) or "see docs/log-format.md",
    )


def folder_of(spec: str | Path) -> Path:
    """The folder (or info file) of a log argument, without prefix and scene."""
    text = str(spec)
    prefix, _, rest = text.partition(":")
    path = Path(rest if rest and prefix in READERS else text)
    return path if path.exists() or "#" not in str(path) else Path(str(path).rpartition("#")[0])


def open_log(spec: str | Path) -> Log:
    """The reader of a log argument (see ``log_format``), opened."""
    kind, folder = log_format(spec)
    if kind == "native":
        from rtmap_cli.logs.native import NativeLog

        return NativeLog(folder)
    module, name = READERS[kind]
    log: Log = getattr(importlib.import_module(module), name)(folder)
    return log


def notes_of(log: Log) -> list[str]:
    """What a log lacks or assumes, one sentence each (native logs say it in their files)."""
    return list(getattr(log, "notes", ()))
