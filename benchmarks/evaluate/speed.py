"""How fast maps are evaluated, beside a plain implementation that goes pair by pair.

    RTMAP_GOLDEN=DIR python -m benchmarks.evaluate.speed         on the reference files
    python -m benchmarks.evaluate.speed --synthetic              on invented lines

The plain one does what the published MapTR evaluation does, written anew: shapely resamples every
line point by point and widens it, and for each threshold every pair whose bands touch goes
through one distance matrix. Both get the same lists and must give the same AP. A frame holds the
elements of two frames of the files, so that 160 frames have as many as those on which the
reference evaluation took 27 s of CPU. CPU time of this process, the least of ``--repeat`` runs;
memory is what Python and numpy hold at most beyond the frame at hand.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from scipy.spatial.distance import cdist

from rtmap_cli.formats.map_frames import read_map_frames
from rtmap_cli.geometry.polylines import resample
from rtmap_cli.output import log, table
from rtmap_cli.steps.evaluate.maps.precision import THRESHOLDS, Detection, Scorer

CLASSES = ("ped_crossing", "divider", "boundary")
BAR = 20.0
"""The plain implementation takes at least this many times our CPU time."""
Frame = tuple[list[Detection], list[Detection]]


def plain(frames: Sequence[Frame], thresholds: Sequence[float]) -> dict[str, list[float]]:
    """AP by class and threshold, one pair and one threshold after the other."""
    lines = [
        [[(name, _points(points), score) for name, points, score in side] for side in frame]
        for frame in frames
    ]
    return {
        name: [_plain_class(lines, name, threshold) for threshold in thresholds] for name in CLASSES
    }


def _points(points: Any) -> Any:
    line = shapely.LineString(points)
    at = np.linspace(0, line.length, 100)
    return np.array([line.interpolate(d).coords[0] for d in at])


def _plain_class(frames: Sequence[Any], name: str, threshold: float) -> float:
    scores, hits, true_count = [], [], 0
    for pred, true in frames:
        p = [e for e in pred if e[0] == name]
        t = [e for e in true if e[0] == name]
        true_count += len(t)
        distance = _plain_distances([e[1] for e in p], [e[1] for e in t])
        taken = [False] * len(t)
        order = sorted(range(len(p)), key=lambda k: -p[k][2])
        hit = [False] * len(p)
        for k in order if t else ():
            j = int(distance[k].argmin())
            if distance[k, j] <= threshold and not taken[j]:
                taken[j] = hit[k] = True
        scores += [e[2] for e in p]
        hits += hit
    if not true_count or not scores:
        return 0.0
    ranked = np.array(hits)[np.argsort(-np.array(scores), kind="stable")]
    recall = np.cumsum(ranked) / true_count
    precision = np.cumsum(ranked) / np.arange(1, len(ranked) + 1)
    area, last = 0.0, 0.0
    for k in np.flatnonzero(ranked).tolist():
        area += (recall[k] - last) * precision[k:].max()
        last = recall[k]
    return float(area)


def _plain_distances(pred: Sequence[Any], true: Sequence[Any]) -> Any:
    out = np.full((len(pred), len(true)), np.inf)
    bands = [
        [shapely.LineString(x).buffer(2, cap_style="flat", join_style="mitre") for x in side]
        for side in (pred, true)
    ]
    tree = shapely.STRtree(bands[0])
    for j, band in enumerate(bands[1]):
        for i in tree.query(band):
            if bands[0][i].intersects(band):
                matrix = cdist(pred[i], true[j])
                out[i, j] = (matrix.min(axis=1).mean() + matrix.min(axis=0).mean()) / 2
    return out


def ours(frames: Sequence[Frame], thresholds: Sequence[float]) -> dict[str, list[float]]:
    """The same with what ``rtmap evaluate map`` uses."""
    scorer = Scorer(CLASSES, thresholds)
    for pred, true in frames:
        scorer.add(pred, true)
    return {name: list(c.ap.values()) for name, c in scorer.result().classes.items()}


def golden_frames(golden: Path) -> list[Frame]:
    """The reference frames, each with the elements of another one of the files added."""
    pred = read_map_frames(golden / "evaluate" / "pred.json.gz", scored=True).frames
    true = read_map_frames(golden / "evaluate" / "gt.json.gz", scored=False).frames
    single = [(pred[k], true[k]) for k in true]
    turned = single[len(single) // 2 :] + single[: len(single) // 2]
    return [(a[0] + b[0], a[1] + b[1]) for a, b in zip(single, turned, strict=True)]


def synthetic_frames(count: int = 80, seed: int = 0) -> list[Frame]:
    """Gently bent lines of 24 true elements per frame, seen 0.1 to 1.5 m off, and inventions."""
    rng = np.random.default_rng(seed)
    out: list[Frame] = []
    for _ in range(count):
        true: list[Detection] = []
        for k in range(24):
            x = np.linspace(rng.uniform(-36, 0), rng.uniform(5, 36), 12)
            y = rng.uniform(-18, 18) + rng.uniform(-4, 4) * np.sin(x / 20)
            true.append((CLASSES[k % 3], np.column_stack([x, y]), 1.0))
        pred = [
            (name, resample(p, 20) + rng.normal(0, 0.5, 2), float(rng.uniform()))
            for name, p, _ in true + true[:3]
        ]
        out.append((pred, true))
    return out


def many(frames: Sequence[Frame], count: int) -> Iterator[Frame]:
    """``count`` frames, the given ones over and over."""
    while count > 0:
        yield from islice(frames, count)
        count -= len(frames)


def cpu(call: Callable[[], Any], repeat: int) -> tuple[float, Any]:
    """Least CPU seconds of some calls, and what the last one gave."""
    least, result = np.inf, None
    for _ in range(repeat):
        start = time.process_time()
        result = call()
        least = min(least, time.process_time() - start)
    return least, result


def memory_of(frames: Sequence[Frame], count: int) -> float:
    """Most kilobytes held while ``count`` frames pass."""
    tracemalloc.start()
    ours(many(frames, count), THRESHOLDS)  # type: ignore[arg-type]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1024


def main() -> int:
    """Print the figures; 1 when the ratio misses its bar."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=160, help="frames of the comparison")
    parser.add_argument("--repeat", type=int, default=3, help="runs of each side")
    parser.add_argument("--synthetic", action="store_true", help="invented lines")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    golden = os.environ.get("RTMAP_GOLDEN")
    if golden is None and not given.synthetic:
        log("RTMAP_GOLDEN is not set: invented lines")
    use_golden = golden is not None and not given.synthetic
    base = golden_frames(Path(golden)) if use_golden and golden else synthetic_frames()
    frames = list(many(base, given.frames))
    slow, want = cpu(lambda: plain(frames, THRESHOLDS), 1)
    fast, have = cpu(lambda: ours(frames, THRESHOLDS), given.repeat)
    worst = max(abs(a - b) for name in want for a, b in zip(want[name], have[name], strict=True))
    growth = [
        {
            "frames": n,
            "cpu_s": cpu(lambda n=n: ours(list(many(base, n)), THRESHOLDS), given.repeat)[0],  # type: ignore[misc]
            "peak_kb": memory_of(base, n),
        }
        for n in (given.frames // 4, given.frames, 4 * given.frames)
    ]
    result = {
        "load": "reference files" if use_golden else "synthetic",
        "frames": len(frames),
        "true": sum(len(f[1]) for f in frames),
        "predicted": sum(len(f[0]) for f in frames),
        "thresholds": len(THRESHOLDS),
        "plain_cpu_s": slow,
        "ours_cpu_s": fast,
        "ratio": slow / fast,
        "bar": BAR,
        "largest_difference_of_ap": worst,
        "growth": growth,
    }
    if given.json:
        print(json.dumps(result))
    else:
        print(
            f"{result['load']}: {len(frames)} frames, {result['true']} true and "
            f"{result['predicted']} predicted elements, {len(THRESHOLDS)} thresholds"
        )
        print(
            f"plain {slow:.2f} s, ours {fast:.3f} s of CPU: 1/{slow / fast:.0f} (bar 1/{BAR:.0f})"
        )
        print(f"largest difference of any AP: {worst:.1e}")
        rows = [
            [
                g["frames"],
                f"{g['cpu_s']:.3f}",
                f"{g['cpu_s'] / g['frames'] * 1e3:.2f}",
                f"{g['peak_kb']:.0f}",
            ]
            for g in growth
        ]
        print("\n".join(table(["frames", "CPU s", "ms per frame", "peak kB"], rows)))
    return int(slow / fast < BAR or worst > 1e-9)


if __name__ == "__main__":
    sys.exit(main())
