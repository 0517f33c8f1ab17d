"""Figures of an evaluation by name, and limits that they must keep: ``NAME=VALUE``."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from rtmap_cli.errors import UsageError


@dataclass(frozen=True)
class Figure:
    """One number of a result: what it is (None where unknown) and which way it gets better.

    ``neither`` is for numbers that should lie near something (a coverage, a χ²): ``target``, where
    that can be said.
    """

    value: float | None
    better: Literal["higher", "lower", "neither"] = "higher"
    target: float | None = None

    def worse(self, before: float) -> float | None:
        """By how much it is worse than ``before`` (negative: better); None where not known."""
        if self.value is None or (self.better == "neither" and self.target is None):
            return None
        if self.target is not None:
            return abs(self.value - self.target) - abs(before - self.target)
        return before - self.value if self.better == "higher" else self.value - before


Figures = Mapping[str, Figure]
"""By name, in the order in which people should read them."""


def show(value: float | None) -> str:
    """A figure as people read it; a dash where unknown."""
    return "-" if value is None else f"{value:.4f}"


def parse_limits(specs: Sequence[str], option: str = "--fail-under") -> dict[str, float]:
    """``("mAP=0.5", "AP.divider=0.6")`` → values by name; UsageError when one is malformed."""
    out = {}
    for spec in specs:
        name, equals, text = spec.partition("=")
        value = number(text)
        if not equals or not name.strip() or value is None or not math.isfinite(value):
            raise UsageError(f"{option} {spec}: expected NAME=VALUE, e.g. mAP=0.5")
        out[name.strip()] = value
    return out


def number(text: str) -> float | None:
    """The number that a text is, infinity included; None when it is none."""
    try:
        value = float(text)
    except ValueError:
        return None
    return None if math.isnan(value) else value


def check_names(names: Iterable[str], known: Sequence[str], option: str = "--fail-under") -> None:
    """UsageError when an option names a figure that does not exist."""
    for name in names:
        if name not in known:
            raise UsageError(f"{option} {name}: unknown figure (known: {', '.join(known)})")


def check_directions(under: Iterable[str], over: Iterable[str], figures: Figures) -> None:
    """UsageError for an unknown figure, or a limit on the side to which a figure gets better."""
    for names, option, wrong, other in (
        (under, "--fail-under", "lower", "--fail-over"),
        (over, "--fail-over", "higher", "--fail-under"),
    ):
        names = list(names)
        check_names(names, list(figures), option)
        for name in names:
            if figures[name].better == wrong:
                raise UsageError(f"{option} {name}: there {wrong} is better, use {other}")


def past_limits(
    under: Mapping[str, float], over: Mapping[str, float], figures: Figures
) -> list[str]:
    """One sentence per figure past its limit; a figure without a value is past any."""
    out = []
    for name, limit in under.items():
        value = figures[name].value
        if value is None or value < limit:
            out.append(f"{name} is {_or_unknown(value)}, under {limit}")
    for name, limit in over.items():
        value = figures[name].value
        if value is None or value > limit:
            out.append(f"{name} is {_or_unknown(value)}, over {limit}")
    return out


def _or_unknown(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.4f}"
