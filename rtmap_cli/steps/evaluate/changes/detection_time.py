"""After how many traversals is a true change found, and does it stay found?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rtmap_cli.steps.evaluate.changes.elements import Change, ChangeScore


def time_to_detection(
    scores: Sequence[ChangeScore], true: Sequence[Change], traversals: Sequence[int]
) -> dict[str, Any]:
    """When each true change was first found, and from when on it stays found.

    ``scores`` in order, each of the same ``true`` changes (the very objects); ``traversals`` how
    many there had been at each. ``first`` and ``stays`` are such numbers, None for never (a change
    that the last answer lacks does not stay). Means go over the changes that were found; the
    median over all, never being the latest.
    """
    found = np.zeros((len(scores), len(true)), dtype=bool)
    row = {id(change): k for k, change in enumerate(true)}
    for i, score in enumerate(scores):
        found[i, [row[id(t)] for _, t in score.found]] = True
    # From the end: found in this and in all later answers.
    lasting = np.logical_and.accumulate(found[::-1])[::-1]
    first, stays = _first(found, traversals), _first(lasting, traversals)
    changes: list[dict[str, Any]] = [
        {
            "kind": c.kind,
            "class": c.class_name,
            "element_id": c.element_id or None,
            "first": f,
            "stays": s,
        }
        for c, f, s in zip(true, first, stays, strict=True)
    ]
    after = [
        {
            "traversals": n,
            "found": len(score.found),
            "missed": len(score.missed),
            "false": len(score.false),
            "ever_found": sum(f is not None and f <= n for f in first),
        }
        for n, score in zip(traversals, scores, strict=True)
    ]
    return {"after": after, "first": _summary(first), "stays": _summary(stays), "changes": changes}


def _first(found: Any, traversals: Sequence[int]) -> list[int | None]:
    """The traversals at which each column is first true."""
    return [int(traversals[int(column.argmax())]) if column.any() else None for column in found.T]


def _summary(times: Sequence[int | None]) -> dict[str, Any]:
    known = [t for t in times if t is not None]
    middle = float(np.median([np.inf if t is None else t for t in times])) if times else np.inf
    return {
        "mean": float(np.mean(known)) if known else None,
        "median": middle if np.isfinite(middle) else None,
        "never": len(times) - len(known),
    }
