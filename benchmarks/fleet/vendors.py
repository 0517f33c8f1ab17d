"""Two vendors' maps of one area merged (`rtmap map merge`), beside one map and both in one.

    python -m benchmarks.fleet.vendors --golden DIR

From each of the benchmark's real maps two are made: A as it is, B surveyed a metre off, bent by a
decimetre, with other vertices. ``all``: both have everything; ``a quarter``: each misses another
quarter of the elements; ``halves``: A knows the west and B the east, with 40 m of both. AP over the
frames of ten drives, of A alone, of A and B in one map without merging, and of the merged map.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.fleet.chain import MAPS, Scenario, judge_map
from rtmap_cli.geometry.polylines import clip_to_box, length, resample_step
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.pieces import parts_of
from rtmap_cli.maps.store import read_map, write_new_map
from rtmap_cli.output import table

Array = NDArray[np.float64]

CASES = ("all", "a quarter", "halves")
SHIFT = np.array([0.86, 0.51])
BENT = 0.12
"""Standard deviation (m) of the field that bends B."""
NOISE = 0.04
STEP = 3.7
"""Distance (m) of B's vertices."""
MISSING = 0.25
BOTH = 20.0
FAR = 1e9


def surveyed(elements: Iterable[Element], seed: int) -> list[Element]:
    """The elements as B has them."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(0, 1, (2, 8, 4))

    def bent(xy: Array) -> Array:
        out = np.zeros_like(xy)
        for axis in (0, 1):
            for w in waves[axis]:
                direction = w[:2] / np.hypot(w[0], w[1])
                metres = 20.0 + 40.0 * abs(w[2])
                out[:, axis] += np.sin(2 * np.pi * (xy @ direction) / metres + 6 * w[3])
        return BENT * np.sqrt(2 / 8) * out

    made = []
    for e in elements:
        p = e.points.copy() if e.class_name == "ped_crossing" else resample_step(e.points, STEP)
        p[:, :2] += SHIFT + bent(p[:, :2])
        p[1:-1, :2] += rng.normal(0, NOISE, (len(p) - 2, 2))
        if e.ring:
            p[-1] = p[0]
        made.append(replace(e, element_id=f"b-{e.element_id}", points=p, covariance=None))
    return made


def parted(truth: VectorMap, case: str, seed: int) -> tuple[list[Element], list[Element]]:
    """What A and what B know of a map."""
    everything = list(truth)
    if case == "all":
        return everything, everything
    if case == "a quarter":
        lot = np.random.default_rng(seed).uniform(size=len(everything))
        pairs = list(zip(everything, lot, strict=True))
        return [e for e, u in pairs if u > MISSING], [e for e, u in pairs if u < 1 - MISSING]
    middle = float(np.median(np.concatenate([e.xy[:, 0] for e in everything])))
    return _between(everything, -FAR, middle + BOTH), _between(everything, middle - BOTH, FAR)


def _between(elements: Iterable[Element], low: float, high: float) -> list[Element]:
    out: list[Element] = []
    for e in elements:
        if e.ring:
            out += [e] if low <= e.xy[:, 0].mean() < high else []
        else:
            pieces = clip_to_box(e.points, (low, -FAR, high, FAR))
            out += parts_of(replace(e, covariance=None), pieces)
    return out


def kilometres(elements: Iterable[Element]) -> float:
    """Length of all lines and outlines."""
    return sum(length(e.points) for e in elements) / 1000


def measured(name: str, case: str, golden: Path, work: Path, seed: int) -> list[str]:
    """One row of the table."""
    scenario = Scenario(name, golden / "fleet" / name, work)
    truth, _ = scenario.truth(10)
    a, b = parted(truth, case, seed)
    b = surveyed(b, seed)
    write_new_map(VectorMap(a, truth.crs), work / "a", "A", overwrite=True)
    write_new_map(VectorMap(b, truth.crs), work / "b", "B", overwrite=True)
    scenario.command("map", "merge", work / "a", work / "b")
    merged = read_map(work / "a")
    maps = [VectorMap(a, truth.crs), VectorMap([*a, *b], truth.crs), merged]
    found = [100 * judge_map(scenario, m, 10)["frames"]["mAP"] for m in maps]
    lengths = f"{kilometres(truth):.2f} · {kilometres(merged):.2f}"
    return [name.split("/")[0], case, *(f"{v:.1f}" for v in found), lengths]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--golden", type=Path, default=os.environ.get("RTMAP_GOLDEN"))
    parser.add_argument("--seed", type=int, default=3)
    options = parser.parse_args()
    if options.golden is None:
        parser.error("--golden or $RTMAP_GOLDEN names the folder of the benchmark")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in MAPS:
            for case in CASES:
                work = Path(folder)
                golden = Path(options.golden)
                rows.append(measured(f"{name}/straight", case, golden, work, options.seed))
    head = ["map", "B and A know", "A alone", "A and B unmerged", "merged", "km: world · merged"]
    for text in table(head, rows):
        print(text)


if __name__ == "__main__":
    main()
