"""The map folder: tiles under a Delta Lake log, with versions.

    _delta_log/                      versions: atomic commits (https://github.com/delta-io/delta)
    tiles/<quadkey>/<sha256>.parquet immutable GeoParquet tiles (maps/tiles.py)

A commit registers new tiles and retires old ones in one transaction; tiles whose content is the
same stay the same file. Each run that was fused is recorded as an application transaction, so that
it is never counted twice. A crash before the commit leaves orphans (see ``gc``), never a broken
map.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa

from rtmap_cli import __version__
from rtmap_cli.errors import BadInput
from rtmap_cli.maps.crs import check_map_crs, check_same_crs
from rtmap_cli.maps.delta import (
    Box,
    add_action,
    app_id,
    create_table,
    element_count,
    ever_added,
    first_line,
    open_table,
    read_properties,
    read_tile,
    tile_files,
    tile_name,
    transactions,
    write_version,
)
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.place import LOG, Place
from rtmap_cli.maps.tiles import elements_to_table, table_to_elements, tile_bytes, tile_of
from rtmap_cli.tables import whole_folder

PRODUCER = f"rtmap {__version__}"
COMMIT_ATTEMPTS = 20


@dataclass(frozen=True)
class Version:
    """One entry of a map's history."""

    version: int
    timestamp_ms: int
    message: str
    producer: str
    runs: tuple[str, ...] = ()
    restored: int | None = None
    elements: int | None = None
    tiles_written: int | None = None
    tiles_removed: int | None = None
    info: dict[str, Any] = field(default_factory=dict)


def map_exists(path: str | Path) -> bool:
    """True when ``path`` is a map folder."""
    return (Place.of(path).root / LOG).is_dir()


def read_map(path: str | Path, version: int | None = None, bbox: Box | None = None) -> VectorMap:
    """The elements of a map, whole, sorted by id.

    ``bbox`` (x_min, y_min, x_max, y_max in the map frame, metres) keeps the elements whose own
    bounding box touches it. BadInput when the folder is missing, is no map, holds no such version,
    or a tile is missing or broken.
    """
    place = Place.of(path)
    table = open_table(place, version)
    properties = read_properties(place, table)
    elements: list[Element] = []
    for name in sorted(tile_files(table, bbox)):
        elements.extend(table_to_elements(read_tile(place, name, bbox), place.file(name)))
    elements.sort(key=lambda e: e.element_id)
    return VectorMap(elements, properties["crs"], table.version())


def map_crs(path: str | Path) -> str:
    """The CRS of a map's frame, without reading a tile."""
    place = Place.of(path)
    return str(read_properties(place, open_table(place))["crs"])


def write_new_map(
    vector_map: VectorMap,
    path: str | Path,
    message: str,
    overwrite: bool = False,
    producer: str = PRODUCER,
    runs: Iterable[str] = (),
    info: Mapping[str, Any] | None = None,
) -> int:
    """Write a new map folder as version 0, whole or not at all; returns 0.

    UsageError when ``path`` exists and ``overwrite`` is False; BadInput when the CRS is not metric,
    or when two elements share an id.
    """
    check_map_crs(vector_map.crs, path)
    tables = _by_tile(vector_map, path)
    runs = _unique(runs)
    final = Place.of(path)
    with whole_folder(final.root, overwrite) as folder:
        place = Place(folder)
        added = []
        for tile, table in tables.items():
            data = tile_bytes(table, vector_map.crs, tile)
            name = tile_name(tile, data)
            place.write(name, data)
            added.append(add_action(name, tile, data, table))
        metadata = _commit_metadata(
            message, producer, vector_map, runs, info, len(added), removed=0
        )
        create_table(place, vector_map.crs, added, metadata, runs)
    return 0


def commit_map(
    path: str | Path,
    new: VectorMap,
    base_version: int,
    message: str,
    runs: Iterable[str] = (),
    info: Mapping[str, Any] | None = None,
    producer: str = PRODUCER,
) -> int:
    """Commit ``new`` as the content that follows ``base_version``; returns the new version.

    Only tiles whose content differs from ``base_version`` are written. When others committed
    since, their tiles are kept if they are not ours; else BadInput says what to do. A run that was
    fused before is refused (BadInput). A version is recorded even when no tile differs.
    """
    from deltalake.exceptions import CommitFailedError

    place = Place.of(path)
    base = open_table(place, base_version)
    check_same_crs(new.crs, read_properties(place, base)["crs"], path)
    runs = _unique(runs)
    _check_runs(place, open_table(place), runs)
    change = _compare(place, base, new)
    for name, data in change.data.items():
        # Also when an orphan of this name lies there: its age would make it a case for `gc`.
        place.write(name, data)
    for _ in range(COMMIT_ATTEMPTS):
        latest = open_table(place)
        _check_runs(place, latest, runs)
        if latest.version() != base_version:
            _check_conflict(place, base, latest, change)
        metadata = _commit_metadata(
            message, producer, new, runs, info, len(change.added), len(change.removed)
        )
        try:
            return write_version(latest, change.added, change.removed, metadata, runs)
        except CommitFailedError:
            # Somebody was faster: look at what they did, and try again.
            continue
    raise BadInput(path, f"could not be committed in {COMMIT_ATTEMPTS} attempts", "try again later")


def history(path: str | Path) -> list[Version]:
    """The versions of a map, oldest first."""
    place = Place.of(path)
    out = []
    for entry in sorted(open_table(place).history(), key=lambda e: int(e["version"])):
        parameters = entry.get("operationParameters") or {}
        restored = parameters.get("version") if entry.get("operation") == "RESTORE" else None
        out.append(
            Version(
                version=int(entry["version"]),
                timestamp_ms=int(entry["timestamp"]),
                message=str(entry.get("rtmap.message", entry.get("operation", ""))),
                producer=str(entry.get("rtmap.producer", entry.get("engineInfo", ""))),
                runs=tuple(entry.get("rtmap.runs") or ()),
                restored=None if restored is None else int(restored),
                elements=entry.get("rtmap.elements"),
                tiles_written=entry.get("rtmap.tiles_written"),
                tiles_removed=entry.get("rtmap.tiles_removed"),
                info=dict(entry.get("rtmap.info") or {}),
            )
        )
    return out


def fused_runs(path: str | Path, version: int | None = None) -> set[str]:
    """Ids of the runs that the map (or an old version of it) was fused from.

    After a restore, runs that were fused later than the restored version count no more.
    """
    entries = {entry.version: entry for entry in history(path)}
    at = max(entries) if version is None else version
    out: set[str] = set()
    while at in entries:
        entry = entries[at]
        out.update(entry.runs)
        at = entry.restored if entry.restored is not None else at - 1
    return out


def restore(path: str | Path, version: int, message: str | None = None) -> int:
    """Make the content of an old version the newest one; returns the new version.

    Nothing is lost: the versions between stay in the history. Runs that were fused after
    ``version`` may be fused again.
    """
    from deltalake import CommitProperties
    from deltalake.exceptions import DeltaError

    place = Place.of(path)
    latest = open_table(place)
    target = open_table(place, version)
    if version == latest.version():
        raise BadInput(path, f"version {version} is the newest one already", "nothing to restore")
    for name in sorted(tile_files(target)):
        if not place.exists(name):
            raise BadInput(
                place.file(name),
                f"version {version} needs this tile and it is missing",
                "versions whose tiles were removed by `rtmap map gc --keep` cannot be restored",
            )
    now, then = fused_runs(path), fused_runs(path, version)
    # A txn version of 0 says that the run is not in the content any more.
    moves = transactions(sorted(now - then), 0)
    moves += transactions(sorted(then - now), latest.version() + 2)
    metadata = {
        "rtmap.message": message or f"restore version {version}",
        "rtmap.producer": PRODUCER,
        "rtmap.elements": element_count(target),
    }
    properties = CommitProperties(custom_metadata=metadata, app_transactions=moves)
    try:
        latest.restore(version, commit_properties=properties)
    except DeltaError as error:
        raise BadInput(
            path, f"version {version} cannot be restored ({first_line(error)})"
        ) from None
    return int(open_table(place).version())


def gc(
    path: str | Path,
    dry_run: bool = False,
    keep: int | None = None,
    min_age_s: float = 3600.0,
) -> list[tuple[str, int]]:
    """Remove files that no version needs (orphans of crashed commits); (name, bytes) of each.

    ``keep`` also removes tiles that only versions older than the newest ``keep`` need; those
    versions stay in the history but can be read no more. Files younger than ``min_age_s`` may
    belong to a commit under way and stay.
    """
    place = Place.of(path)
    latest = open_table(place).version()
    if keep is None:
        needed = ever_added(place)
    else:
        first = max(0, latest - keep + 1)
        needed = {n for v in range(first, latest + 1) for n in tile_files(open_table(place, v))}
    for name in needed:
        place.file(name)  # a log that names files elsewhere is not to be trusted with removals
    removed = []
    for name, size, age in place.data_files():
        if name not in needed and age >= min_age_s:
            removed.append((name, size))
            if not dry_run:
                place.remove(name)
    return removed


@dataclass
class _Change:
    """What a commit does: tiles added, names removed, and the files to write."""

    data: dict[str, bytes] = field(default_factory=dict)
    added: list[Any] = field(default_factory=list)
    removed: dict[str, str] = field(default_factory=dict)
    tiles: set[str] = field(default_factory=set)
    new_ids: set[str] = field(default_factory=set)


def _unique(runs: Iterable[str]) -> list[str]:
    return sorted(set(runs))


def _commit_metadata(
    message: str,
    producer: str,
    vector_map: VectorMap,
    runs: list[str],
    info: Mapping[str, Any] | None,
    written: int,
    removed: int,
) -> dict[str, Any]:
    return {
        "rtmap.message": message,
        "rtmap.producer": producer,
        "rtmap.crs": vector_map.crs,
        "rtmap.runs": runs,
        "rtmap.elements": len(vector_map),
        "rtmap.tiles_written": written,
        "rtmap.tiles_removed": removed,
        "rtmap.info": dict(info or {}),
    }


def _by_tile(vector_map: VectorMap, path: str | Path) -> dict[str, pa.Table]:
    """Tables of a map by quadkey, sorted; BadInput for an id that occurs twice."""
    seen: set[str] = set()
    for element in vector_map:
        if element.element_id in seen:
            raise BadInput(path, f"two elements are called {element.element_id}", "ids are unique")
        seen.add(element.element_id)
    groups: dict[str, list[Element]] = defaultdict(list)
    elements = list(vector_map)
    for element, tile in zip(elements, tile_of(elements, vector_map.crs), strict=True):
        groups[tile].append(element)
    return {tile: elements_to_table(groups[tile]) for tile in sorted(groups)}


def _compare(place: Place, base: Any, new: VectorMap) -> _Change:
    """The tiles of ``new`` that differ from the files of ``base``."""
    old: dict[str, list[str]] = defaultdict(list)
    for name, tile in tile_files(base).items():
        old[tile].append(name)
    tables = _by_tile(new, place.root)
    change = _Change()
    old_ids: set[str] = set()
    for tile, table in tables.items():
        data = tile_bytes(table, new.crs, tile)
        name = tile_name(tile, data)
        if old[tile] == [name] or _same_content(place, old[tile], table):
            continue
        change.tiles.add(tile)
        change.data[name] = data
        change.added.append(add_action(name, tile, data, table))
        change.removed |= {n: tile for n in old[tile]}
        change.new_ids.update(table["element_id"].to_pylist())
    for tile in sorted(set(old) - set(tables)):
        change.tiles.add(tile)
        change.removed |= {n: tile for n in old[tile]}
    for name in change.removed:
        old_ids.update(read_tile(place, name)["element_id"].to_pylist())
    change.new_ids -= old_ids
    return change


def _same_content(place: Place, names: list[str], table: pa.Table) -> bool:
    """True when one file holds the same rows: another pyarrow gives other bytes for them."""
    return len(names) == 1 and bool(
        read_tile(place, names[0]).replace_schema_metadata(None).equals(table)
    )


def _check_runs(place: Place, latest: Any, runs: list[str]) -> None:
    for run in runs:
        if (latest.transaction_version(app_id(run)) or 0) > 0:
            raise BadInput(place.root, f"run {run} was fused into this map before", "leave it out")


def _check_conflict(place: Place, base: Any, latest: Any, change: _Change) -> None:
    """BadInput when somebody else changed a tile of ours, or added an element of the same id."""
    before, after = tile_files(base), tile_files(latest)
    theirs = {n: t for n, t in (before | after).items() if (n in before) != (n in after)}
    both = sorted(set(theirs.values()) & change.tiles)
    todo = "start again from the newest version"
    if both:
        raise BadInput(
            place.root,
            f"tile {both[0]} was changed by version {latest.version()} meanwhile",
            todo,
        )
    for name in theirs:
        if name in after:
            same = change.new_ids.intersection(read_tile(place, name)["element_id"].to_pylist())
            if same:
                raise BadInput(
                    place.root, f"element {min(same)} was added by somebody else meanwhile", todo
                )
