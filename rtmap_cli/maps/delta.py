"""The Delta Lake log of a map: opening it, its files, its actions (package deltalake)."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterable
from typing import Any

import numpy as np
import pyarrow as pa

from rtmap_cli.errors import BadInput
from rtmap_cli.maps.place import LOG, TILES, Place
from rtmap_cli.maps.tiles import TILE, ZOOM, tile_statistics
from rtmap_cli.tables import read_table, taken_for

MAP_FORMAT = "rtmap.map"
MAP_VERSION = "1.0"

Box = tuple[float, float, float, float]


def table_schema() -> pa.Schema:
    """Columns of the Delta table: those of a tile and the partition."""
    return TILE.columns.append(pa.field("tile", pa.string()))


def first_line(error: Exception) -> str:
    """An error of a library as one line."""
    text = str(error).strip()
    return text.splitlines()[0] if text else type(error).__name__


def transactions(runs: Iterable[str], version: int) -> list[Any]:
    """Application transactions of runs: ``version`` > 0 says fused, 0 that it is so no more."""
    from deltalake.transaction import Transaction

    return [Transaction(app_id(run), version) for run in runs]


def app_id(run: str) -> str:
    """Name of the application transaction of a run."""
    return f"rtmap.run:{run}"


def tile_name(tile: str, data: bytes) -> str:
    """Where a tile lies in the map folder: named by its content."""
    return f"{TILES}/{tile}/{hashlib.sha256(data).hexdigest()}.parquet"


def add_action(name: str, tile: str, data: bytes, table: pa.Table) -> Any:
    """The registration of a tile file."""
    from deltalake.transaction import AddAction

    now = int(time.time() * 1000)
    return AddAction(name, len(data), {"tile": tile}, now, True, tile_statistics(table))


def create_table(
    place: Place, crs: str, added: list[Any], metadata: dict[str, Any], runs: Iterable[str]
) -> None:
    """Write version 0 of a map."""
    from deltalake import CommitProperties, Schema
    from deltalake.transaction import create_table_with_add_actions

    properties = {"format": MAP_FORMAT, "version": MAP_VERSION, "crs": crs, "tile_zoom": ZOOM}
    create_table_with_add_actions(
        place.uri,
        Schema.from_arrow(table_schema()),
        added,
        partition_by=["tile"],
        description=json.dumps(properties, sort_keys=True),
        # Old versions stay readable: only `gc` takes anything away.
        configuration={"delta.enableExpiredLogCleanup": "false"},
        commit_properties=CommitProperties(
            custom_metadata=metadata, app_transactions=transactions(runs, 1)
        ),
    )


def write_version(
    table: Any,
    added: Iterable[Any],
    removed: dict[str, str],
    metadata: dict[str, Any],
    runs: Iterable[str],
) -> int:
    """Commit added files and removed ones (name → quadkey); returns the new version.

    Raises deltalake's CommitFailedError when somebody else committed after ``table`` was opened.
    """
    from deltalake import CommitProperties, Schema
    from deltalake.transaction import RemoveAction

    now = int(time.time() * 1000)
    actions = list(added)
    actions += [RemoveAction(n, True, now, None, {"tile": tile}) for n, tile in removed.items()]
    version = int(table.version()) + 1
    table.create_write_transaction(
        actions,
        "append",
        Schema.from_arrow(table_schema()),
        partition_by=["tile"],
        commit_properties=CommitProperties(
            custom_metadata=metadata,
            max_commit_retries=0,
            app_transactions=transactions(runs, version + 1),
        ),
    )
    return version


def open_table(place: Place, version: int | None = None) -> Any:
    """The Delta table at a version (default: the newest)."""
    from deltalake import DeltaTable
    from deltalake.exceptions import DeltaError

    if not place.root.exists():
        raise BadInput(place.root, "no such map folder", "make one with `rtmap import`")
    if not (place.root / LOG).is_dir():
        raise BadInput(place.root, f"not a map (there is no {LOG} in it)", taken_for(place.root))
    try:
        table = DeltaTable(place.uri)
        if version is not None and not 0 <= version <= table.version():
            raise BadInput(place.root, f"has no version {version} (newest: {table.version()})")
        if version is not None and version != table.version():
            table.load_as_version(version)
    except (DeltaError, OSError, ValueError) as error:
        raise BadInput(
            place.root / LOG,
            f"the versions cannot be read ({first_line(error)})",
            "copy the map again",
        ) from None
    return table


def read_properties(place: Place, table: Any) -> dict[str, Any]:
    """Format, CRS and zoom of a map; BadInput when it is another Delta table or too new."""
    try:
        properties = json.loads(table.metadata().description or "{}")
    except ValueError:
        properties = {}
    if not isinstance(properties, dict) or properties.get("format") != MAP_FORMAT:
        raise BadInput(place.root, "a Delta table, but not an rtmap map")
    found = str(properties.get("version", "?"))
    if found.split(".")[0] != MAP_VERSION.split(".")[0]:
        raise BadInput(
            place.root,
            f"map version {found} is unknown to this rtmap (it reads {MAP_VERSION})",
            "use the rtmap that wrote it, or a newer one",
        )
    if not isinstance(properties.get("crs"), str):
        raise BadInput(place.root, "the map's description names no CRS")
    return properties


def _actions(table: Any) -> pa.Table:
    return pa.table(table.get_add_actions(flatten=True))


def tile_files(table: Any, bbox: Box | None = None) -> dict[str, str]:
    """Quadkey by file name, of the files that may hold something in ``bbox``."""
    actions = _actions(table)
    if actions.num_rows == 0:
        return {}
    files = dict(
        zip(actions["path"].to_pylist(), actions["partition.tile"].to_pylist(), strict=True)
    )
    if bbox is None or "min.bbox.xmin" not in actions.column_names:
        return files
    names = ("min.bbox.xmin", "min.bbox.ymin", "max.bbox.xmax", "max.bbox.ymax")
    # Without statistics (NaN) a file may hold anything.
    low_x, low_y, high_x, high_y = (actions[n].to_numpy().astype(np.float64) for n in names)
    apart = (low_x > bbox[2]) | (low_y > bbox[3]) | (high_x < bbox[0]) | (high_y < bbox[1])
    return {name: tile for (name, tile), off in zip(files.items(), apart, strict=True) if not off}


def element_count(table: Any) -> int:
    """Number of elements, from the statistics of the files."""
    actions = _actions(table)
    return sum(n or 0 for n in actions["num_records"].to_pylist()) if actions.num_rows else 0


def read_tile(place: Place, name: str, bbox: Box | None = None) -> pa.Table:
    """The rows of one tile whose bounding boxes touch ``bbox``."""
    if not place.exists(name):
        raise BadInput(
            place.file(name),
            "this tile is missing",
            "copy the map again, or read a version that `rtmap map gc --keep` left whole",
        )
    table = read_table(place.file(name), TILE)
    if bbox is None or table.num_rows == 0:
        return table
    box = table["bbox"].combine_chunks()
    x0, y0, x1, y1 = (
        box.field(n).to_numpy(zero_copy_only=False) for n in ("xmin", "ymin", "xmax", "ymax")
    )
    touch = (x0 <= bbox[2]) & (y0 <= bbox[3]) & (x1 >= bbox[0]) & (y1 >= bbox[1])
    return table.filter(pa.array(touch))


def ever_added(place: Place) -> set[str]:
    """Names of all files that any version registered."""
    out = set()
    for name in place.log_files():
        for line in place.read(name).splitlines():
            action = json.loads(line)
            if "add" in action:
                out.add(action["add"]["path"])
    return out
