"""Bootstrap intervals of average precision: blocks of consecutive frames drawn with replacement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.steps.evaluate.maps.frames import split_key
from rtmap_cli.steps.evaluate.maps.precision import Ranking

Array = NDArray[np.float64]

BLOCK = 20
"""Frames of a block: neighbours on a drive see the same elements and are no votes of their own."""
FEW = 10
"""With fewer blocks an interval says little."""
LEVEL = 0.95
_CELLS = 2_000_000
"""Draws times predictions that are ranked at once, for memory."""


@dataclass(frozen=True)
class Intervals:
    """Percentile intervals (low, high) of mAP and of the AP of each class."""

    mean: tuple[float, float]
    classes: dict[str, tuple[float, float]]
    draws: int
    blocks: int

    def as_json(self) -> dict[str, Any]:
        """``{"level", "draws", "blocks", "mAP": [low, high], "classes": {name: [low, high]}}``."""
        return {
            "level": LEVEL,
            "draws": self.draws,
            "blocks": self.blocks,
            "mAP": list(self.mean),
            "classes": {name: list(pair) for name, pair in self.classes.items()},
        }


def blocks_of(keys: Sequence[str], size: int = BLOCK) -> NDArray[np.int64]:
    """(frames,) the block of each frame: consecutive frames of one log, ``size`` or a little fewer.

    Frames are consecutive by the time in their key, by their order where keys have none.
    """
    by_log: dict[str, list[tuple[int, int]]] = {}
    for k, key in enumerate(keys):
        log, time = split_key(key)
        by_log.setdefault("" if time is None else log, []).append((k if time is None else time, k))
    out, count = np.zeros(len(keys), np.int64), 0
    for log in sorted(by_log):
        rows = [k for _, k in sorted(by_log[log])]
        for part in np.array_split(rows, -(-len(rows) // size)):
            out[part] = count
            count += 1
    return out


def bootstrap(
    rankings: dict[str, Ranking],
    blocks: NDArray[np.int64],
    draws: int,
    seed: int,
    frames: NDArray[np.bool_] | None = None,
) -> Intervals:
    """Intervals over ``draws`` samples, each of as many blocks as there are.

    A frame that is drawn w times counts w times: its predictions and its true elements. A mask
    ``frames`` keeps the blocks of some frames only, and those frames of them.
    """
    kept = np.ones(len(blocks), bool) if frames is None else frames
    names, index = np.unique(blocks[kept], return_inverse=True)
    rng = np.random.default_rng([seed, 31])
    n = len(names)
    drawn = rng.multinomial(n, np.full(n, 1 / n), size=draws) if n else np.zeros((draws, 0), int)
    weights = np.zeros((draws, len(blocks)), np.int32)
    weights[:, kept] = drawn[:, index]
    by_class = {name: _average_precisions(r, weights) for name, r in rankings.items()}
    mean = np.mean(list(by_class.values()), axis=0) if by_class else np.zeros(draws)
    return Intervals(_interval(mean), {k: _interval(v) for k, v in by_class.items()}, draws, n)


def _interval(values: Array) -> tuple[float, float]:
    low, high = np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def _average_precisions(ranking: Ranking, weights: NDArray[np.int32]) -> Array:
    """(draws,) class AP (mean over the thresholds) with every frame counted ``weights`` times."""
    order = np.argsort(-ranking.scores, kind="stable")
    frame, hits = ranking.frame[order], ranking.hits[order]
    num_gt = weights @ ranking.num_gt.astype(np.int64)
    out = np.zeros(len(weights))
    parts = max(1, -(-len(weights) * max(1, len(frame)) // _CELLS))
    for rows in np.array_split(np.arange(len(weights)), min(parts, len(weights))):
        counts = weights[rows][:, frame]
        seen = np.cumsum(counts, axis=1)
        for k in range(hits.shape[1]):
            found = np.flatnonzero(hits[:, k])
            # Copies of a hit stand together, so that the precision after the last is the highest.
            w = counts[:, found]
            precision = np.cumsum(w, axis=1) / np.maximum(seen[:, found], 1)
            envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
            out[rows] += (w * envelope).sum(axis=1) / np.maximum(num_gt[rows], 1)
    return out / max(1, hits.shape[1])
