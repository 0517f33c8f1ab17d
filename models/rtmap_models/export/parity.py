"""Does the exported graph say what torch says? Per execution provider, at several sizes.

New queries are the best of all proposals: where two are equally good their order is a matter of
the last bit. They are therefore compared in pairs, each with the nearest answer of the other side.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from torch import nn

from rtmap_cli.output import table
from rtmap_models.config import ModelConfig, SemanticConfig
from rtmap_models.export.example import example_inputs

INPUTS = ("images", "ego_to_image", "prior_points", "prior_class", "prior_mask")
RASTER_INPUTS = ("raster", *INPUTS[2:])
OUTPUTS = ("scores", "points", "sigma", "prior_score", "pose_delta", "pose_covariance")

SIZES = ((1, 7, 9), (3, 5, 1))
"""Batch, cameras, prior slots; other ones than the graph is traced at."""

CPU = "CPUExecutionProvider"
SURE = 0.05
"""In half precision only new queries with at least this score are compared: ``rtmap infer`` drops
the others."""

ELSEWHERE_M = 1.0
"""A new query whose nearest partner is farther away, on average, was replaced by another."""

Array = NDArray[Any]


@dataclass(frozen=True)
class Tolerance:
    """Largest difference per output, absolute up to 1 and relative above it (``others``: of the
    outputs that are not named), and the share of new queries that may be other ones."""

    others: float
    named: dict[str, float]
    replaced: float

    def of(self, name: str) -> float:
        """The tolerance of one output."""
        return self.named.get(name, self.others)


SINGLE = Tolerance(1e-3, {}, 0.0)
HALF = Tolerance(0.02, {"points": 0.1, "sigma": 0.1, "pose_delta": 0.05}, 0.05)


@dataclass(frozen=True)
class Row:
    """Largest differences of one provider at one size (batch, cameras, prior slots)."""

    provider: str
    size: tuple[int, int, int]
    differences: dict[str, float]
    replaced: float


@dataclass(frozen=True)
class ParityReport:
    """All comparisons of one model; ``notes`` says which providers could not be used."""

    rows: list[Row]
    notes: list[str]
    tolerance: Tolerance

    @property
    def within(self) -> bool:
        """True when every figure is known and within the tolerance."""
        return not self.miss()

    def miss(self) -> str:
        """The first figure that is too large, in words; empty when none is."""
        for row in self.rows:
            where = f"on {row.provider} at {_by(row.size)}"
            for name, value in row.differences.items():
                if not value <= self.tolerance.of(name):  # NaN is a miss
                    limit = self.tolerance.of(name)
                    return f"{name} differs from torch by {value:.2g} {where}, {limit:g} allowed"
            if row.replaced > self.tolerance.replaced:
                return f"{row.replaced:.0%} of the new queries are other ones {where}"
        return ""

    def worst(self) -> dict[str, float]:
        """Largest difference per output over all rows."""
        return {n: max(row.differences[n] for row in self.rows) for n in OUTPUTS}

    def lines(self) -> list[str]:
        """A table for people."""
        head = ("provider", "B×N×P", *OUTPUTS, "replaced")
        cells = [
            (
                r.provider,
                _by(r.size),
                *(f"{r.differences[n]:.1e}" for n in OUTPUTS),
                f"{r.replaced:.0%}",
            )
            for r in self.rows
        ]
        limits = [f"{self.tolerance.of(n):.0e}" for n in OUTPUTS]
        allowed = ("allowed", "", *limits, f"{self.tolerance.replaced:.0%}")
        return [*table(head, [*cells, allowed]), *self.notes]

    def as_json(self) -> dict[str, Any]:
        """The same as plain values."""
        return {
            "within": self.within,
            "rows": [
                {
                    "provider": r.provider,
                    **dict(zip(("batch", "cameras", "prior_slots"), r.size, strict=True)),
                    "differences": r.differences,
                    "replaced": r.replaced,
                }
                for r in self.rows
            ],
            "tolerance": {n: self.tolerance.of(n) for n in OUTPUTS}
            | {"replaced": self.tolerance.replaced},
            "notes": self.notes,
        }


def inputs_of(config: ModelConfig) -> tuple[str, ...]:
    """The inputs of the graph of a configuration, in their order."""
    return RASTER_INPUTS if isinstance(config, SemanticConfig) else INPUTS


def parity_report(
    network: nn.Module,
    path: Path,
    tolerance: Tolerance = SINGLE,
    sizes: Sequence[tuple[int, int, int]] = SIZES,
) -> ParityReport:
    """Compare a network (float32, CPU) with its ONNX file on every provider that runs a part of
    it, at each size (batch, cameras, prior slots)."""
    rows: list[Row] = []
    notes: list[str] = []
    assert isinstance(network.config, ModelConfig)
    sure = 0.0 if tolerance.replaced == 0 else SURE
    expected = []
    for seed, size in enumerate(sizes):
        inputs = example_inputs(network.config, *size, seed + 1)
        with torch.no_grad():
            out = [x.cpu().numpy() for x in network(*inputs)]
        feed = {name: x.numpy() for name, x in zip(inputs_of(network.config), inputs, strict=True)}
        expected.append((size, feed, dict(zip(OUTPUTS, out, strict=True))))
    for provider in onnxruntime.get_available_providers():
        try:
            session, reason = _session(path, provider, expected[0][1])
        except Exception as error:  # onnxruntime raises its own untyped errors
            if provider == CPU:
                raise
            session, reason = None, str(error).splitlines()[0]
        if session is None:
            notes.append(f"{provider} left out: {reason}")
            continue
        for size, feed, want in expected:
            got = dict(zip(OUTPUTS, session.run(list(OUTPUTS), feed), strict=True))
            rows.append(Row(provider, size, *compare(want, got, sure)))
    return ParityReport(rows, notes, tolerance)


def parity(
    network: nn.Module, path: Path, sizes: Sequence[tuple[int, int, int]] = SIZES
) -> dict[str, float]:
    """Largest difference torch against onnxruntime per output over all providers and sizes."""
    return parity_report(network, path, SINGLE, sizes).worst()


def _session(
    path: Path, provider: str, feed: dict[str, Array]
) -> tuple[onnxruntime.InferenceSession | None, str]:
    """A session, or None and why not: a provider counts only when it runs a part of the graph."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    if provider == CPU:
        return onnxruntime.InferenceSession(str(path), options, providers=[CPU]), ""
    with tempfile.TemporaryDirectory() as folder:
        options.enable_profiling = True
        options.profile_file_prefix = str(Path(folder) / "profile")
        session = onnxruntime.InferenceSession(str(path), options, providers=[provider, CPU])
        if provider not in session.get_providers():
            return None, "cannot be created here"
        session.run(None, feed)
        events = json.loads(Path(session.end_profiling()).read_text(encoding="utf-8"))
    ran = {e["args"].get("provider") for e in events if e.get("cat") == "Node" and "args" in e}
    return (session, "") if provider in ran else (None, "runs no part of the graph")


def compare(
    want: dict[str, Array], got: dict[str, Array], sure: float = 0.0
) -> tuple[dict[str, float], float]:
    """Largest difference per output and the share of new queries that were replaced.

    Points and sigmas are compared in units of their query's largest sigma where that is more than
    a metre. Only new queries of at least the score ``sure`` count. With ``sure`` 0 nothing counts
    as replaced: every query must have its partner.
    """
    worst = dict.fromkeys(OUTPUTS, 0.0)
    for name in ("prior_score", "pose_delta", "pose_covariance"):
        worst[name] = _difference(want[name], got[name])
    first = want["scores"].shape[1] - want["prior_score"].shape[1]
    count = replaced = 0
    for b in range(len(want["scores"])):
        a, z = ({n: x[n][b] for n in ("scores", "points", "sigma")} for x in (want, got))
        rows, partner = _pairs(a, z, first)
        keep = np.ones(len(rows), bool)
        if sure > 0:
            keep[:first] = a["scores"][:first].max(axis=1) >= sure
            gap = np.abs(a["points"][rows] - z["points"][partner]).mean(axis=(1, 2))
            other = keep & (gap > ELSEWHERE_M) & (rows < first)
            count, replaced = count + int(keep[:first].sum()), replaced + int(other.sum())
            keep &= ~other
        # What nobody knows to a metre need not agree to a millimetre.
        vague = np.maximum(1.0, a["sigma"].reshape(len(rows), -1).max(axis=1))
        for name in a:
            unit = np.ones(len(rows)) if name == "scores" else vague
            difference = _difference(a[name][rows[keep]], z[name][partner[keep]], unit[rows[keep]])
            worst[name] = float(np.maximum(worst[name], difference))
    return worst, replaced / max(1, count)


def _pairs(a: dict[str, Array], z: dict[str, Array], first: int) -> tuple[Array, Array]:
    """Every query and its partner: prior slots by place, new queries by what they say."""
    rows = np.arange(len(a["scores"]))
    said = [
        np.nan_to_num(
            np.concatenate([x["points"][:first].reshape(first, -1), x["scores"][:first]], axis=1)
        )
        for x in (a, z)
    ]
    cost = np.abs(said[0][:, None] - said[1][None]).sum(axis=2)
    partner = rows.copy()
    partner[:first] = linear_sum_assignment(cost)[1]
    return rows, partner


def _difference(a: Array, b: Array, unit: Array | None = None) -> float:
    """Largest difference, absolute up to 1 and relative above it (a variance may be large), or in
    the ``unit`` (n,) of its row where that is larger."""
    if a.size == 0:
        return 0.0
    size = np.maximum(1.0, np.abs(a))
    if unit is not None:
        size = np.maximum(size, unit.reshape(-1, *[1] * (a.ndim - 1)))
    return float((np.abs(a - b) / size).max())


def _by(size: tuple[int, int, int]) -> str:
    return "×".join(map(str, size))
