"""The pose table of the fleet benchmark as Markdown: our figures, the bars, a verdict on each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.printing import COLUMN, INSIDE_90, Verdict, markdown

Array = NDArray[np.float64]

KINDS = ("straight", "turning")
AXES = ("lateral (m)", "longitudinal (m)", "yaw (°)")
PLAIN = ((0.18, 0.30), (0.51, 0.51), (0.42, 0.55))
"""Points to the nearest prior line frame by frame, Huber, GNSS prior: what anybody would do."""
BARS = {
    "single": ((0.15, 0.24), (0.36, 0.43), (0.24, 0.40)),
    "smooth": ((0.09, 0.12), (0.13, 0.16), (0.11, 0.15)),
}
AIMS = {"smooth": ((0.07, 0.09), (0.10, 0.12), (0.09, 0.12))}
REGIONS = ("50", "90")

Scores = Mapping[tuple[str, str, str], Mapping[str, Any]]
"""By map, scenario and mode (start, single, smooth): what ``figures`` made of its frames."""


def figures(drives: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """All frames of some drives together: mean, 90th percentile (lateral, longitudinal, yaw),
    shares of answered frames inside the stated regions, share answered, frames."""
    from scipy.stats import chi2

    errors = np.concatenate([np.asarray(d["errors"], float).reshape(-1, 3) for d in drives])
    square = np.concatenate([np.asarray(d["square"], float) for d in drives])
    answered = np.concatenate([np.asarray(d["answered"], bool) for d in drives])
    errors = errors[:, COLUMN]
    known = answered & np.isfinite(square)
    inside = {r: float((square[known] <= chi2.ppf(float(r) / 100, 3)).mean()) for r in REGIONS}
    return {
        "mean": errors.mean(axis=0).tolist(),
        "p90": np.percentile(errors, 90, axis=0).tolist(),
        "inside": inside if known.any() else dict.fromkeys(REGIONS, float("nan")),
        "answered": float(answered.mean()),
        "frames": len(errors),
    }


def mean_over_maps(scores: Scores, kind: str, mode: str) -> dict[str, Any]:
    """The mean of the maps' figures of one scenario and mode."""
    rows = [s for (_, k, m), s in scores.items() if (k, m) == (kind, mode)]
    return {
        "mean": np.mean([r["mean"] for r in rows], axis=0),
        "p90": np.mean([r["p90"] for r in rows], axis=0),
        "inside": {r: float(np.mean([s["inside"][r] for s in rows])) for r in REGIONS},
        "answered": float(np.mean([r["answered"] for r in rows])),
        "frames": sum(r["frames"] for r in rows),
    }


def kinds_of(scores: Scores) -> list[str]:
    """The scenarios that were measured."""
    return [k for k in KINDS if any(kind == k for _, kind, _ in scores)]


def modes_of(scores: Scores) -> list[str]:
    """The modes that were measured, ``start`` first."""
    return list(dict.fromkeys(m for _, _, m in scores))


def verdicts(scores: Scores) -> list[Verdict]:
    """Every error and every 90 % region against its bar."""
    out = []
    for mode in [m for m in modes_of(scores) if m in BARS]:
        for k, kind in enumerate(KINDS):
            if kind not in kinds_of(scores):
                continue
            found = mean_over_maps(scores, kind, mode)
            for axis, name in enumerate(AXES):
                text, bar = f"{mode}, {kind}: mean {name}", BARS[mode][axis][k]
                out.append(Verdict(text, float(found["mean"][axis]), -np.inf, bar))
            text = f"{mode}, {kind}: share inside the 90 % region"
            out.append(Verdict(text, found["inside"]["90"], *INSIDE_90))
    return out


def pose_tables(scores: Scores) -> list[str]:
    """Means beside the bars, 90th percentiles, shares inside the regions; then map by map."""
    kinds, modes = kinds_of(scores), modes_of(scores)
    over = {(k, m): mean_over_maps(scores, k, m) for k in kinds for m in modes}
    judged = {v.text: v for v in verdicts(scores)}
    frames = sum(over[k, modes[0]]["frames"] for k in kinds)
    maps = len({m for m, _, _ in scores})
    out = [f"{frames} frames; means over {maps} maps; every cell: {' · '.join(kinds)}.", ""]
    out += _means(over, judged, kinds, modes)
    rows = [
        [name, *(_cell(f"{over[k, m]['p90'][axis]:.3f}" for k in kinds) for m in modes)]
        for axis, name in enumerate(AXES)
    ]
    out += markdown(["90th percentile", *modes], rows)
    rows = []
    for mode in modes:
        shares = [_cell(f"{100 * over[k, mode]['inside'][r]:.1f}" for k in kinds) for r in REGIONS]
        words = [judged.get(f"{mode}, {k}: share inside the 90 % region") for k in kinds]
        word = _cell(w.word for w in words if w)
        answered = _cell(f"{100 * over[k, mode]['answered']:.1f}" for k in kinds)
        rows.append([mode, *shares, "85 to 95" if mode in BARS else "", word, answered])
    header = ["truth inside (%)", "50 % region", "90 % region", "bar", "", "frames answered (%)"]
    return [*out, *markdown(header, rows), *_by_map(scores, modes)]


def _means(
    over: Mapping[tuple[str, str], Mapping[str, Any]],
    judged: Mapping[str, Verdict],
    kinds: list[str],
    modes: list[str],
) -> list[str]:
    header, rows = ["mean error", "start", "plain"], []
    for mode in [m for m in modes if m in BARS]:
        header += [mode, f"bar, {mode}", ""] + ([f"aim, {mode}"] if mode in AIMS else [])
    for axis, name in enumerate(AXES):

        def fixed(table: Sequence[Sequence[float]], axis: int = axis) -> str:
            return _cell(f"{table[axis][KINDS.index(k)]:.2f}" for k in kinds)

        def ours(mode: str, axis: int = axis) -> str:
            return _cell(f"{over[k, mode]['mean'][axis]:.3f}" for k in kinds)

        row = [name, ours("start"), fixed(PLAIN)]
        for mode in [m for m in modes if m in BARS]:
            words = _cell(judged[f"{mode}, {k}: mean {name}"].word for k in kinds)
            row += [ours(mode), "≤ " + fixed(BARS[mode]), words]
            row += [fixed(AIMS[mode])] if mode in AIMS else []
        rows.append(row)
    return markdown(header, rows)


def _by_map(scores: Scores, modes: list[str]) -> list[str]:
    rows = []
    for (name, kind, mode), found in scores.items():
        errors = [f"{m:.3f} / {p:.3f}" for m, p in zip(found["mean"], found["p90"], strict=True)]
        shares = " / ".join(f"{100 * found['inside'][r]:.1f}" for r in REGIONS)
        rows.append((modes.index(mode), [f"{name} {kind}, {mode}", *errors, shares]))
    rows.sort(key=lambda r: r[0])
    header = ["map by map: mean / 90 %", *AXES, "inside 50 / 90 %"]
    return markdown(header, [r for _, r in rows])


def _cell(values: Any) -> str:
    return " · ".join(values)
