"""An earlier report of the same evaluation: is it comparable, and which figures got worse?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rtmap_cli.errors import BadInput, UsageError
from rtmap_cli.steps.evaluate.gates.limits import Figures, number, show
from rtmap_cli.tables import read_json

MAX_DROP = 0.01
"""How much worse a figure may get, in its own unit, unless the user says otherwise."""

ROUNDING = 1e-9


@dataclass(frozen=True)
class Drops:
    """How much worse than the baseline figures may be: ``every`` one, and some by name."""

    every: float = MAX_DROP
    named: Mapping[str, float] = field(default_factory=dict)

    def allowed(self, name: str) -> float:
        """For a figure: what is said of it, or of its group (``yaw_deg`` of ``yaw_deg.mean``)."""
        while name:
            if name in self.named:
                return self.named[name]
            name = name.rpartition(".")[0]
        return self.every


def parse_drops(specs: Sequence[str]) -> Drops:
    """``("0.01", "lateral_m=0.02")`` → Drops; UsageError when one is malformed or negative."""
    every, named = MAX_DROP, {}
    for spec in specs:
        name, _, text = spec.rpartition("=")
        value = number(text)
        if value is None or value < 0 or (not name.strip() and "=" in spec):
            raise UsageError(f"--max-drop {spec}: expected VALUE or NAME=VALUE, not negative")
        if name:
            named[name.strip()] = value
        else:
            every = value
    return Drops(every, named)


@dataclass(frozen=True)
class Change:
    """A figure then and now; ``worse`` by how much (negative: better), None where not judged."""

    name: str
    before: float | None
    now: float | None
    worse: float | None
    fell: bool

    @property
    def difference(self) -> float | None:
        """Now less then."""
        return None if self.before is None or self.now is None else self.now - self.before

    def sentence(self, allowed: float) -> str:
        """What happened, with both values."""
        if self.now is None:
            return f"{self.name} was {show(self.before)}, now it is unknown"
        way = "fell" if (self.difference or 0) < 0 else "rose"
        return (
            f"{self.name} {way} from {show(self.before)} to {show(self.now)} "
            f"(more than {allowed:g})"
        )


@dataclass(frozen=True)
class Baseline:
    """What a report written with ``--json`` says: how it was made, and its figures by name."""

    path: Path
    settings: dict[str, Any]
    figures: dict[str, float | None]

    def check_comparable(self, settings: Mapping[str, Any]) -> None:
        """BadInput naming the first setting (plain values, as JSON has them) in which the two
        evaluations differ."""
        for name in [*settings, *(k for k in self.settings if k not in settings)]:
            if settings.get(name) != self.settings.get(name):
                then, now = (say_setting(s.get(name)) for s in (self.settings, settings))
                what = f"is of another evaluation ({name}: {then} there, {now} here)"
                raise BadInput(self.path, what, "compare what was made alike")

    def changes(self, figures: Figures, drops: Drops) -> list[Change]:
        """Every figure of now, and those of the baseline that are gone, then and now."""
        names = [*figures, *(name for name in self.figures if name not in figures)]
        known = {*names, *(group for n in names for group in _groups(n))}
        for name in drops.named:
            if name not in known:
                raise UsageError(f"--max-drop {name}: unknown figure (known: {', '.join(names)})")
        return [self._change(name, figures, drops) for name in names]

    def _change(self, name: str, figures: Figures, drops: Drops) -> Change:
        figure, before = figures.get(name), self.figures.get(name)
        now = figure.value if figure is not None else None
        if before is None:
            return Change(name, None, now, None, False)
        if now is None or figure is None:
            return Change(name, before, None, None, True)
        worse = figure.worse(before)
        fell = worse is not None and worse > drops.allowed(name) + ROUNDING
        return Change(name, before, now, worse, fell)


def _groups(name: str) -> list[str]:
    parts = name.split(".")
    return [".".join(parts[:k]) for k in range(1, len(parts))]


def read_baseline(path: Path) -> Baseline:
    """The report of an earlier ``rtmap evaluate … --json``; BadInput when it is none."""
    data = read_json(path)
    todo = "write one with rtmap evaluate … --json"
    if not isinstance(data, dict):
        raise BadInput(path, "is no report of rtmap evaluate", todo)
    settings, figures = data.get("settings"), data.get("figures")
    if not isinstance(settings, dict) or not isinstance(figures, dict):
        raise BadInput(path, "is no report of rtmap evaluate (no settings or figures in it)", todo)
    for name, value in figures.items():
        numeric = isinstance(value, int | float) and not isinstance(value, bool)
        if value is not None and not (numeric and abs(value) < float("inf")):
            raise BadInput(path, f"its figure {name} is {value!r}, not a number", todo)
    return Baseline(path, settings, figures)


def say_setting(value: Any) -> str:
    """A setting as people read it."""
    if value is None:
        return "not stated"
    if isinstance(value, list):
        return ", ".join(map(say_setting, value)) or "none"
    if isinstance(value, dict):
        return ", ".join(f"{k} {_span(v)}" for k, v in value.items())
    return str(value)


def _span(value: Any) -> str:
    pair = isinstance(value, list) and len(value) == 2
    return f"{value[0]:g} … {value[1]:g}" if pair else say_setting(value)
