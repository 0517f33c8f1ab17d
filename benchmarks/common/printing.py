"""Bars, verdicts and tables in Markdown, as all benchmarks print them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

INSIDE_90 = (0.85, 0.95)
"""What an honest 90 % region holds."""
COLUMN = (1, 0, 2)
"""Where lateral, longitudinal and yaw stand in the errors."""


@dataclass(frozen=True)
class Verdict:
    """A figure against its bar; ``low`` and ``high`` are what it must lie between."""

    text: str
    value: float
    low: float
    high: float

    @property
    def holds(self) -> bool:
        """True inside the limits, which belong to it."""
        return self.low <= self.value <= self.high

    @property
    def word(self) -> str:
        """PASS or FAIL."""
        return "PASS" if self.holds else "FAIL"

    @property
    def line(self) -> str:
        """PASS or FAIL, what, the figure, the bar."""
        bar = f"≤ {self.high:g}" if self.low == -np.inf else f"{self.low:g} to {self.high:g}"
        return f"{self.word}  {self.text}: {self.value:.4g} (bar {bar})"


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(str(c) for c in line) + " |" for line in lines] + [""]
