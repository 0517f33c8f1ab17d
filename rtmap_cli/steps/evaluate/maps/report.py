"""The report of a map evaluation: scores, scenarios, intervals, shape, and what to warn of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import UsageError
from rtmap_cli.maps.crop import Range
from rtmap_cli.maps.element import RING_CLASSES, VectorMap
from rtmap_cli.output import table
from rtmap_cli.steps.evaluate.drives import Drive
from rtmap_cli.steps.evaluate.gates.limits import Figure
from rtmap_cli.steps.evaluate.maps.compare import Comparison, Side, label_frames
from rtmap_cli.steps.evaluate.maps.intervals import FEW, Intervals, blocks_of, bootstrap
from rtmap_cli.steps.evaluate.maps.precision import MapScore
from rtmap_cli.steps.evaluate.maps.shape import Shape

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Wanted:
    """What is asked for besides the AP of all frames: masks (frames,) by scenario, ``draws`` of
    blocks of ``block`` frames (0: no intervals), smoothness and topology."""

    labels: dict[str, Bools] | None = None
    draws: int = 0
    block: int = 20
    seed: int = 0
    shape: bool = False


@dataclass(frozen=True)
class Part:
    """All frames, or those of one scenario."""

    score: MapScore
    intervals: Intervals | None

    def as_json(self) -> dict[str, Any]:
        """The score, with ``intervals`` where there are some."""
        more = {"intervals": self.intervals.as_json()} if self.intervals else {}
        return self.score.as_json() | more


@dataclass(frozen=True)
class Report:
    """One evaluation, ready for printing and for limits; maps were cropped to ``box`` (m)."""

    whole: Part
    box: Range | None
    scenarios: dict[str, Part] | None
    shapes: dict[str, Shape] | None
    notes: list[str]

    @property
    def settings(self) -> dict[str, Any]:
        """What must be alike for two reports to be comparable."""
        score = self.whole.score
        thresholds = [list(c.ap) for c in score.classes.values()]
        return {
            "protocol": score.protocol,
            "classes": list(score.classes),
            "thresholds": thresholds[0] if thresholds else [],
            "range": None if self.box is None else list(self.box),
            "frames": score.frames,
        }

    @property
    def figures(self) -> dict[str, Figure]:
        """``mAP``, ``AP.divider``, ``mAP.turning``, ``AP.turning.divider``; then shape."""
        out = _figures("", self.whole.score)
        for name, part in (self.scenarios or {}).items():
            if part.score.frames:
                out |= _figures(f".{name}", part.score)
        for name, shape in (self.shapes or {}).items():
            excess = shape.smoothness()["excess_deg_per_m"]
            out[f"excess_deg_per_m.{name}"] = Figure(excess, "lower")
            if name not in RING_CLASSES:
                out[f"joints_f1.{name}"] = Figure(shape.topology()["joints"]["f1"])
        return out

    @property
    def result(self) -> dict[str, Any]:
        """The JSON object of docs/evaluate-map.md."""
        out = self.whole.as_json()
        if self.scenarios is not None:
            out["scenarios"] = {name: part.as_json() for name, part in self.scenarios.items()}
        if self.shapes is not None:
            out["smoothness"] = {name: s.smoothness() for name, s in self.shapes.items()}
            lines = {name: s for name, s in self.shapes.items() if name not in RING_CLASSES}
            out["topology"] = {name: s.topology() for name, s in lines.items()}
        return out

    def lines(self) -> list[str]:
        """The tables that people read."""
        score = self.whole.score
        out = [*_class_table(self.whole), ""] if self.scenarios or self.shapes else []
        out = out or _class_table(self.whole)
        total = f"mAP {score.mAP:.4f}{_told(self.whole.intervals)}"
        out.append(f"{total} ({score.protocol}, {score.frames} frames)")
        if self.scenarios is not None:
            out += ["", *_scenario_table(self.scenarios)]
        if self.shapes is not None:
            out += ["", *_shape_table(self.shapes)]
        return out


def report(compared: Comparison, wanted: Wanted) -> Report:
    """Rank everything, and each scenario by itself."""
    scorer = compared.scorer
    blocks = blocks_of(compared.keys, wanted.block) if wanted.draws else None
    rankings = scorer.rankings() if wanted.draws else {}

    def part(frames: Bools | None = None) -> Part:
        intervals = None
        if blocks is not None and (frames is None or frames.any()):
            intervals = bootstrap(rankings, blocks, wanted.draws, wanted.seed, frames)
        return Part(scorer.result(frames), intervals)

    labels = wanted.labels
    whole = part()
    notes = list(compared.notes)
    if whole.score.without_truth:
        names = ", ".join(whole.score.without_truth)
        notes.append(f"no true element of {names}: its AP is 0 by the protocol's rule")
    if whole.intervals and whole.intervals.blocks < FEW:
        count = whole.intervals.blocks
        notes.append(f"intervals from {count} blocks of frames say little; see --block")
    return Report(
        whole,
        compared.box,
        None if labels is None else {name: part(mask) for name, mask in labels.items()},
        scorer.shapes() if wanted.shape else None,
        notes,
    )


def scenario_labels(compared: Comparison, drives: list[Drive], true_map: Side) -> dict[str, Bools]:
    """Masks (frames,) by scenario; UsageError when the map that tells them is not one."""
    if not isinstance(true_map, VectorMap):
        raise UsageError("--by scenario needs a map: --truth is none, name one by --scenario-map")
    return label_frames(compared.keys, drives, true_map)


def _figures(suffix: str, score: MapScore) -> dict[str, Figure]:
    out = {f"mAP{suffix}": Figure(score.mAP)}
    return out | {f"AP{suffix}.{name}": Figure(c.mean) for name, c in score.classes.items()}


def _told(intervals: Intervals | None) -> str:
    return "" if intervals is None else f" [{intervals.mean[0]:.4f}, {intervals.mean[1]:.4f}]"


def _class_table(part: Part) -> list[str]:
    thresholds = [str(t) for t in next(iter(part.score.classes.values())).ap]
    rows = []
    for name, c in part.score.classes.items():
        row = [name, *(f"{v:.4f}" for v in c.ap.values()), f"{c.mean:.4f}"]
        if part.intervals is not None:
            row += [f"{v:.4f}" for v in part.intervals.classes[name]]
        rows.append([*row, c.num_gt, c.num_pred])
    bounds = [] if part.intervals is None else ["2.5 %", "97.5 %"]
    header = ["class", *(f"AP@{t}" for t in thresholds), "AP", *bounds, "true", "predicted"]
    return table(header, rows)


def _scenario_table(scenarios: dict[str, Part]) -> list[str]:
    rows = []
    classes = list(next(iter(scenarios.values())).score.classes)
    for name, part in scenarios.items():
        score = part.score
        if not score.frames:
            rows.append([name, 0, *["-"] * (len(classes) + 1), *["-", "-"] * bool(part.intervals)])
            continue
        values = ["-" if c.num_gt == 0 else f"{c.mean:.4f}" for c in score.classes.values()]
        row = [name, score.frames, f"{score.mAP:.4f}"]
        if part.intervals is not None:
            row += [f"{v:.4f}" for v in part.intervals.mean]
        rows.append([*row, *values])
    bounds = ["2.5 %", "97.5 %"] if any(p.intervals for p in scenarios.values()) else []
    rows = [r + ["-"] * (3 + len(bounds) + len(classes) - len(r)) for r in rows]
    return table(["scenario", "frames", "mAP", *bounds, *classes], rows)


def _shape_table(shapes: dict[str, Shape]) -> list[str]:
    def show(value: float | None, digits: int = 3) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    smooth, joints = [], []
    for name, shape in shapes.items():
        smooth.append([name, *(show(v, 2) for v in shape.smoothness().values())])
        if name not in RING_CLASSES:
            for kind, found in shape.topology().items():
                counts = [found[k] for k in ("true", "predicted", "found")]
                rates = [show(found[k]) for k in ("precision", "recall", "f1")]
                joints.append([f"{name} {kind}", *counts, *rates])
    header = ["smoothness (not part of mAP)", "° per m", "true", "excess", "zigzags per 100 m"]
    out = table([*header, "true"], smooth)
    header = ["topology (not part of mAP)", "true", "predicted", "found"]
    return [*out, "", *table([*header, "precision", "recall", "F1"], joints)] if joints else out
