"""The fused maps and the changes of the fleet benchmark beside their bars, with verdicts."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.common.printing import INSIDE_90, Verdict, markdown
from benchmarks.fleet.poses import KINDS
from rtmap_cli.maps.element import CLASSES

ROWS = {
    "first": "first mapping: no prior, initial poses only",
    "localized": "localized on the prior, fused without it",
    "tiled": "the same in tiles of 100 m",
    "maintenance": "prior and runs fused, changes applied",
    "nightly": "the same, one drive a night on the version before",
}
GRID = {
    "first": {
        1: ((36.6, 15.4), (41.6, 20.4)),
        3: ((34.7, 17.5), (41.6, 20.7)),
        10: ((49.0, 28.7), (47.2, 26.2)),
    },
    "localized": {
        1: ((65.4, 41.1), (57.8, 34.5)),
        3: ((71.9, 47.2), (62.1, 38.3)),
        10: ((73.9, 50.3), (69.3, 44.4)),
    },
}
"""mAP (strict), straight and turning, of a plain 0.5 m grid with skeleton on the same runs."""
BARS = {
    "first": {3: ((62.0, 38.0), (55.0, 32.0)), 10: ((74.0, 50.0), (66.0, 42.0))},
    "localized": {3: ((84.0, 63.0), (76.0, 51.0)), 10: ((88.0, 70.0), (81.0, 58.0))},
    "maintenance": {3: ((94.0, 91.0), (93.0, 90.0)), 10: ((96.0, 93.0), (95.0, 92.0))},
}
BARS |= {"tiled": BARS["localized"], "nightly": BARS["maintenance"]}
FALL = 0.5
"""Points by which a class may fall from one cycle to the next."""
CHANGE_BARS = {1: 0.75, 3: 0.95}
REAL = "real_change"

Figures = Mapping[str, Mapping[str, Any]]
"""By scenario (map/kind) what was measured there."""


def _mean(figures: Figures, kind: str, *keys: str) -> float:
    """Mean over the maps of one scenario, in per cent."""
    values = []
    for name, value in figures.items():
        if name.endswith(f"/{kind}"):
            for key in keys:
                value = value[key]
            values.append(float(value))  # type: ignore[arg-type]
    return 100 * float(np.mean(values))


def _kinds(figures: Figures) -> list[str]:
    return [k for k in KINDS if any(name.endswith(f"/{k}") for name in figures)]


def _cycles(figures: Figures, row: str) -> list[str]:
    return list(next(iter(figures.values()))[row])


def _has(figures: Figures, row: str) -> bool:
    return row in next(iter(figures.values()))


def _pair(figures: Figures, kind: str, *keys: str) -> str:
    """mAP, strict in brackets."""
    loose = _mean(figures, kind, *keys, "frames", "mAP")
    return f"{loose:.1f} ({_mean(figures, kind, *keys, 'frames_strict', 'mAP'):.1f})"


def fusion_tables(figures: Figures) -> list[str]:
    """Per row of the benchmark the means over the maps, cycle by cycle; then class by class."""
    kinds = _kinds(figures)
    out = [f"Means over the maps; every cell: {' · '.join(kinds)}; strict: 0.2/0.5/1.0 m.", ""]
    for row, title in ROWS.items():
        lines = []
        for n in _cycles(figures, row):
            fixed = [
                " · ".join(f"{a:g} ({b:g})" for a, b in table[int(n)]) if int(n) in table else ""
                for table in (GRID.get(row, {}), BARS[row])
            ]
            cells = [
                " · ".join(_pair(figures, k, r, n) for k in kinds) if _has(figures, r) else "–"
                for r in (row, f"{row}, without U")
            ]
            whole = [_mean(figures, k, row, n, "cells", "mAP") for k in kinds]
            inside = [_mean(figures, k, row, n, "sigma", "inside_90") for k in kinds]
            lines.append(
                [f"cycle {n}", *cells, " · ".join(f"{w:.1f}" for w in whole), *fixed,
                 " · ".join(f"{i:.0f}" for i in inside)]
            )  # fmt: skip
        header = [title, "per frame (strict)", "without U", "whole map", "plain grid", "bar",
                  "in 90 %"]  # fmt: skip
        out += markdown(header, lines)
        lines = [
            [f"cycle {n}", *(
                " · ".join(f"{_mean(figures, k, row, n, 'frames', c):.1f}" for k in kinds)
                for c in CLASSES
            )]
            for n in _cycles(figures, row)
        ]  # fmt: skip
        out += markdown([f"{row}, AP", *CLASSES], lines)
    return out


def fusion_verdicts(figures: Figures) -> list[Verdict]:
    """Every bar of the maps: the figures, their rise, U, the honesty of sigma."""
    out = []
    for row in ROWS:
        cycles = _cycles(figures, row)
        for kind in _kinds(figures):
            place = KINDS.index(kind)
            for n in [n for n in cycles if int(n) in BARS[row]]:
                for key, bar in zip(("frames", "frames_strict"), BARS[row][int(n)][place],
                                    strict=True):  # fmt: skip
                    text = f"{row}, cycle {n}, {kind}: mAP" + (" strict" if "_" in key else "")
                    value = round(_mean(figures, kind, row, n, key, "mAP"), 2)
                    out.append(Verdict(text, value, bar, 100.0))
            out += _rises(figures, row, kind)
            if _has(figures, f"{row}, without U"):
                out.append(_sigma_helps(figures, row, kind))
            share = np.mean(
                [_mean(figures, kind, row, n, "sigma", "inside_90") / 100 for n in cycles]
            )
            text = f"{row}, {kind}: share of vertices inside their 90 % interval"
            out.append(Verdict(text, float(share), *INSIDE_90))
    return out


def _rises(figures: Figures, row: str, kind: str) -> list[Verdict]:
    """The largest fall of a class from one cycle to the next."""
    cycles, out = _cycles(figures, row), []
    for name in CLASSES:
        ap = [_mean(figures, kind, row, n, "frames", name) for n in cycles]
        fall = max((a - b for a, b in itertools.pairwise(ap)), default=0.0)
        text = f"{row}, {kind}: {name}, largest fall from cycle to cycle"
        out.append(Verdict(text, round(fall, 2), -np.inf, FALL))
    return out


def _sigma_helps(figures: Figures, row: str, kind: str) -> Verdict:
    """Gain in mAP by U, mean over the cycles and both sets of thresholds."""
    gain = [
        _mean(figures, kind, row, n, key, "mAP")
        - _mean(figures, kind, f"{row}, without U", n, key, "mAP")
        for n in _cycles(figures, row)
        for key in ("frames", "frames_strict")
    ]
    text = f"{row}, {kind}: gain by U, mean over the cycles and thresholds"
    return Verdict(text, round(float(np.mean(gain)), 2), 0.0, 100.0)


def change_scores(figures: Figures) -> dict[int, dict[str, float]]:
    """Counts and F1 over the simulated scenarios by number of drives."""
    out: dict[int, dict[str, float]] = {}
    some = [v for name, v in figures.items() if name != REAL]
    for n in next(iter(figures.values())):
        total = {k: sum(v[n][k] for v in some) for k in ("found", "missed", "false")}
        weight = 2 * total["found"] + total["missed"] + total["false"]
        out[int(n)] = total | {"F1": 2 * total["found"] / max(weight, 1)}
    return out


def change_tables(figures: Figures) -> list[str]:
    """All scenarios together, and the real pair of builds."""
    real = figures.get(REAL, {})
    rows = []
    for n, s in change_scores(figures).items():
        there = real.get(str(n), {})
        rows.append(
            [f"{n} drives", s["found"], s["missed"], s["false"], f"{s['F1']:.3f}",
             *(there.get(k, "-") for k in ("found", "missed", "false"))]
        )  # fmt: skip
    header = ["changes", "found", "missed", "false", "F1", "real: found", "missed", "false"]
    return markdown(header, rows)


def change_verdicts(figures: Figures) -> list[Verdict]:
    """F1 after one and three drives, and no false change where the world is real."""
    scores = change_scores(figures)
    out = [
        Verdict(f"element F1 of changes after {n} drives", scores[n]["F1"], bar, 1.0)
        for n, bar in CHANGE_BARS.items()
        if n in scores
    ]
    if REAL in figures:
        false = max(v["false"] for v in figures[REAL].values())
        out.append(Verdict("false changes in real_change, any cycle", false, -np.inf, 0.0))
    return out


PRINT: Mapping[str, tuple[Any, Any]] = {
    "fusion": (fusion_tables, fusion_verdicts),
    "changes": (change_tables, change_verdicts),
}
"""Tables and verdicts by part."""


def printed(part: str, figures: Figures) -> tuple[Sequence[str], list[Verdict]]:
    """Tables of a part and its verdicts."""
    tables, verdicts = PRINT[part]
    return tables(figures), verdicts(figures)
