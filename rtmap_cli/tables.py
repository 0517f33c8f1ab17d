"""Parquet and JSON files that state what they are, and that appear whole or not at all.

Every table carries ``rtmap.schema`` (its name) and ``rtmap.schema_version`` ("major.minor") in
the Arrow schema metadata, with ``rtmap.frame`` and ``rtmap.units`` where geometry is involved.
Readers refuse an unknown major version.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput, UsageError


@dataclass(frozen=True)
class TableSchema:
    """Name, version and columns of one kind of Parquet file.

    ``defaults``: columns that came with a later minor version, and what older files mean by
    lacking them.
    """

    name: str
    version: str
    columns: pa.Schema
    frame: str = ""
    units: str = ""
    description: str = ""
    defaults: Mapping[str, Any] = field(default_factory=dict)

    def metadata(self, extra: dict[str, str] | None = None) -> dict[str, str]:
        """The metadata written into the file."""
        base = {"rtmap.schema": self.name, "rtmap.schema_version": self.version}
        if self.frame:
            base["rtmap.frame"] = self.frame
        if self.units:
            base["rtmap.units"] = self.units
        return base | (extra or {})


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that replaces it when the block ends without an error."""
    path = Path(path)
    if path.is_dir():
        raise BadInput(path, "is a folder, not a file", "choose another output")
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: str | Path, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder beside ``path`` that becomes it when the block ends without an error."""
    import shutil

    path = Path(path)
    refuse_existing(path, overwrite)
    here = Path.cwd().resolve()
    if path.resolve() in (here, *here.parents, Path.home().resolve()):
        raise BadInput(path, "is where you are, or above it", "choose another output")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o777 & ~umask)
        if path.exists():
            _check_same_kind(path, temporary)
            retired = Path(tempfile.mkdtemp(prefix=f".{path.name}.old.", dir=path.parent))
            path.replace(retired / "old")
            temporary.replace(path)
            shutil.rmtree(retired)
        else:
            temporary.replace(path)
    finally:
        if temporary.exists():
            shutil.rmtree(temporary)


MARKERS = {
    "run.json": "a run",
    "log.json": "a log",
    "semantic.json": "a semantic map",
    "_delta_log": "a map",
}
"""What tells a run, a log, a semantic map and a map from any other folder."""


def taken_for(folder: Path) -> str:
    """ "it is a map" and the like for a folder that stands in another's place; "" if it is none."""
    kinds = [kind for name, kind in MARKERS.items() if (folder / name).exists()]
    return f"it is {kinds[0]}" if kinds else ""


def _check_same_kind(old: Path, new: Path) -> None:
    """BadInput unless ``old`` is empty or of the kind of folder that ``new`` is."""
    if old.is_dir() and not any(old.iterdir()):
        return
    kind = [name for name in MARKERS if (new / name).exists()]
    if not old.is_dir() or not all((old / name).exists() for name in kind):
        raise BadInput(old, "is something else than what would replace it", "choose another output")


def refuse_existing(
    path: Path, overwrite: bool, todo: str = "choose another output or pass --overwrite"
) -> None:
    """UsageError when an output exists and may not be replaced; an empty folder is free."""
    if path.exists() and not overwrite and (not path.is_dir() or any(path.iterdir())):
        raise UsageError(f"{path}: exists already; {todo}")


def refuse_inside(output: Path, *inputs: Path | None) -> None:
    """BadInput when an output file would lie inside (or be) one of the inputs."""
    place = output.resolve()
    for path in inputs:
        if path is not None and (place == path.resolve() or path.resolve() in place.parents):
            raise BadInput(output, f"lies inside the input {path}", "choose another output")


def refuse_over(output: Path, *inputs: Path) -> None:
    """BadInput when an output folder is one of the inputs, holds one, or lies in one."""
    place = output.resolve()
    for path in inputs:
        old = path.resolve()
        if place == old or place in old.parents or old in place.parents:
            raise BadInput(output, f"would replace the input {path}", "choose another output")


def write_table(
    table: pa.Table,
    path: str | Path,
    schema: TableSchema,
    extra: dict[str, str] | None = None,
    group: int | None = None,
) -> None:
    """Write one Parquet file with its schema's name and version; same table → same bytes.

    ``group``: rows of a row group, where readers want some rows of a long table.
    """
    merged = schema.columns.with_metadata(schema.metadata(extra))
    table = table.select(schema.columns.names).cast(schema.columns)
    with whole_file(path) as temporary:
        pq.write_table(
            table.replace_schema_metadata(merged.metadata),
            temporary,
            compression="zstd",
            row_group_size=group,
        )


def check_schema(
    metadata: dict[bytes, bytes] | None, path: str | Path, schema: TableSchema
) -> None:
    """Raise BadInput unless the metadata names ``schema`` in a major version that we know."""
    found = {k.decode(): v.decode(errors="replace") for k, v in (metadata or {}).items()}
    name = found.get("rtmap.schema")
    if name is None:
        raise BadInput(path, "not an rtmap file (no rtmap.schema in its metadata)")
    if name != schema.name:
        raise BadInput(path, f"holds {name}, expected {schema.name}")
    version = found.get("rtmap.schema_version", "?")
    if version.split(".")[0] != schema.version.split(".")[0]:
        raise BadInput(
            path,
            f"{name} version {version} is unknown to this rtmap (it reads {schema.version})",
            "use the rtmap that wrote it, or a newer one",
        )


@dataclass(frozen=True)
class Only:
    """The rows whose integer ``column`` holds one of the sorted ``values``."""

    column: str
    values: NDArray[Any]

    def groups(self, metadata: Any) -> list[int]:
        """The row groups of a file that may hold such rows, by their statistics."""
        names = [metadata.schema.column(k).path for k in range(metadata.num_columns)]
        if self.column not in names:
            return list(range(metadata.num_row_groups))
        k, out = names.index(self.column), []
        for g in range(metadata.num_row_groups):
            found = metadata.row_group(g).column(k).statistics
            if found is not None and found.has_min_max:
                a = np.searchsorted(self.values, found.min, "left")
                if a >= np.searchsorted(self.values, found.max, "right"):
                    continue
            out.append(g)
        return out

    def of(self, table: pa.Table) -> pa.Table:
        """The rows of a table."""
        if self.column not in table.column_names:
            return table
        import pyarrow.compute as pc

        column = table[self.column]
        return table.filter(pc.is_in(column, pa.array(self.values).cast(column.type)))


def read_table(path: str | Path, schema: TableSchema, only: Only | None = None) -> pa.Table:
    """Read one Parquet file, checked against ``schema``; BadInput when it cannot be trusted.

    With ``only`` some rows; row groups that hold none of them are not read.
    """
    path = Path(path)
    if not path.exists():
        raise BadInput(path, "no such file")
    try:
        with pq.ParquetFile(path) as file:
            # Threads cost more than they bring in small files, of which a map has thousands.
            threads = file.metadata.num_rows > 10_000
            if only is None:
                table = file.read(use_threads=threads)
            else:
                groups = only.groups(file.metadata)
                table = only.of(file.read_row_groups(groups, use_threads=threads))
    except (pa.ArrowException, OSError) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadInput(
            path, f"cannot be read as Parquet ({first})", "it may be truncated; copy it again"
        ) from None
    check_schema(table.schema.metadata, path, schema)
    missing = [n for n in schema.columns.names if n not in table.schema.names]
    if unknown := [n for n in missing if n not in schema.defaults]:
        raise BadInput(path, f"column {', '.join(unknown)} is missing")
    for name in missing:
        table = table.append_column(name, pa.array([schema.defaults[name]] * len(table)))
    try:
        typed = schema.columns.with_metadata(table.schema.metadata)
        return table.select(schema.columns.names).cast(typed)
    except pa.ArrowException as error:
        first = str(error).splitlines()[0]
        raise BadInput(path, f"a column has another type than {schema.name} ({first})") from None


def table_metadata(table: pa.Table) -> dict[str, str]:
    """The metadata of a table as text."""
    return {k.decode(): v.decode() for k, v in (table.schema.metadata or {}).items()}


def write_json(value: Any, path: str | Path) -> None:
    """Write JSON with sorted keys, whole or not at all."""
    text = json.dumps(value, indent=2, sort_keys=True, ensure_ascii=False) + "\n"
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_json(path: str | Path) -> Any:
    """Read a JSON file (``.gz`` allowed); BadInput when missing or broken."""
    import gzip
    import zlib

    path = Path(path)
    if not path.exists():
        raise BadInput(path, "no such file")
    try:
        if path.suffix == ".gz":
            with gzip.open(path, "rt", encoding="utf-8") as file:
                return json.load(file)
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError, EOFError, RecursionError, zlib.error) as error:
        raise BadInput(path, f"cannot be read as JSON ({error})") from None
