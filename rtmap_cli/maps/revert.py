"""One version of a map undone, the others kept."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rtmap_cli.errors import BadInput
from rtmap_cli.maps.difference import compare_maps
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import commit_map, history, read_map, restore


@dataclass(frozen=True)
class Reverted:
    """The new ``version``, the one that it undoes, and the ids of elements that are as before."""

    version: int
    reverted: int
    elements: tuple[str, ...]


def revert(path: str | Path, version: int | None = None, message: str | None = None) -> Reverted:
    """Commit a version without what ``version`` (None: the newest) changed.

    The newest one is undone by restoring the one before it: the same tile files, and runs that it
    fused may be fused again. Of an older one, elements that it added, removed or changed get their
    former content. BadInput for the first version, a version that fused runs and is not the newest,
    and one whose elements were touched since.
    """
    entries = history(path)
    newest = entries[-1].version
    wanted = newest if version is None else version
    if wanted > newest:
        raise BadInput(path, f"has no version {wanted} (newest: {newest})")
    if wanted == 0:
        raise BadInput(path, "version 0 is the first one", "there is nothing before it")
    text = message or f"revert version {wanted}"
    before, after = read_map(path, wanted - 1), read_map(path, wanted)
    changed = compare_maps(before, after, 0.0)
    names = tuple(sorted(d.element_id for d in changed))
    if wanted == newest:
        return Reverted(restore(path, wanted - 1, text), wanted, names)
    entry = next(e for e in entries if e.version == wanted)
    if entry.runs or entry.restored is not None:
        what = "fused runs" if entry.runs else "restored another one"
        todo = f"`rtmap map restore MAP {wanted - 1}` takes back all that came after, too"
        raise BadInput(path, f"version {wanted} {what} and is not the newest", todo)
    now = read_map(path)
    since = {d.element_id for d in compare_maps(after, now, 0.0)}
    if clash := sorted(since & set(names)):
        raise BadInput(path, f"element {clash[0]} was changed again after version {wanted}")
    old = before.by_id()
    kept = [e for e in now if e.element_id not in set(names)]
    kept += [old[name] for name in names if name in old]
    kept.sort(key=lambda e: e.element_id)
    made = commit_map(path, VectorMap(kept, now.crs), newest, text, info={"revert": wanted})
    return Reverted(made, wanted, names)
