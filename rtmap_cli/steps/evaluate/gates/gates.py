"""What every ``rtmap evaluate`` offers CI: limits, an earlier report as baseline, Markdown.

A command gives its result, its figures by name and its settings (what must be alike for two
reports to be comparable); the verdict is the same for all of them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtmap_cli.errors import Findings, UsageError
from rtmap_cli.output import plain, table
from rtmap_cli.steps.evaluate.gates.baseline import (
    Baseline,
    Change,
    Drops,
    parse_drops,
    read_baseline,
    say_setting,
)
from rtmap_cli.steps.evaluate.gates.limits import (
    Figures,
    check_directions,
    parse_limits,
    past_limits,
    show,
)


@dataclass(frozen=True)
class Gates:
    """What the user asked for; `parse_gates` makes it before anything is computed."""

    under: dict[str, float]
    over: dict[str, float]
    baseline: Baseline | None
    drops: Drops
    markdown: bool

    def verdict(
        self,
        verb: str,
        result: Mapping[str, Any],
        figures: Figures,
        settings: Mapping[str, Any],
        more: Iterable[str] = (),
    ) -> Verdict:
        """The result with ``settings``, ``figures`` and the comparison in it, and what is past a
        limit (``more``: what the command itself found).

        ``verb`` is the subcommand. BadInput when the baseline is of another evaluation, UsageError
        for a name that is no figure.
        """
        check_directions(self.under, self.over, figures)
        stated = json.loads(json.dumps(plain({"verb": verb, **settings})))
        findings = past_limits(self.under, self.over, figures)
        out = dict(result) | {"settings": stated}
        out["figures"] = {name: figure.value for name, figure in figures.items()}
        changes = None
        if self.baseline is not None:
            self.baseline.check_comparable(stated)
            changes = self.baseline.changes(figures, self.drops)
            fallen = [c for c in changes if c.fell]
            findings += [c.sentence(self.drops.allowed(c.name)) for c in fallen]
            out["baseline"] = {
                "report": str(self.baseline.path),
                "fell": [c.name for c in fallen],
                "figures": {
                    c.name: {"baseline": c.before, "now": c.now, "difference": c.difference}
                    for c in changes
                },
            }
        return Verdict(out, figures, changes, [*findings, *more], self.markdown)


def parse_gates(
    as_json: bool,
    markdown: bool,
    fail_under: Sequence[str],
    fail_over: Sequence[str],
    baseline: Path | None,
    max_drop: Sequence[str],
) -> Gates:
    """The options of ``options.gates``; UsageError for what cannot be meant, BadInput for a
    baseline that is no report."""
    if as_json and markdown:
        raise UsageError("--json and --markdown: give one of them")
    if max_drop and baseline is None:
        raise UsageError("--max-drop needs --baseline")
    return Gates(
        parse_limits(fail_under, "--fail-under"),
        parse_limits(fail_over, "--fail-over"),
        read_baseline(baseline) if baseline is not None else None,
        parse_drops(max_drop),
        markdown,
    )


@dataclass(frozen=True)
class Verdict:
    """One evaluation, ready to be printed and judged."""

    result: dict[str, Any]
    figures: Figures
    changes: list[Change] | None
    findings: list[str]
    as_markdown: bool

    def lines(self, text: Sequence[str]) -> list[str]:
        """Markdown where it was asked for; else the command's own ``text``, with the comparison."""
        if self.as_markdown:
            return self._markdown()
        if self.changes is None:
            return list(text)
        return [*text, "", *table(*_compared(self.changes))]

    def enforce(self) -> None:
        """Findings (exit 1) naming everything that is past a limit."""
        if self.findings:
            raise Findings("; ".join(self.findings))

    def _markdown(self) -> list[str]:
        settings = dict(self.result["settings"])
        title = f"**rtmap evaluate {settings.pop('verb')}**"
        said = [f"{name} {say_setting(value)}" for name, value in settings.items() if value]
        header, rows = ["figure", "value"], [[n, show(f.value)] for n, f in self.figures.items()]
        if self.changes is not None:
            header, rows = _compared(self.changes)
        out = [title + (": " if said else "") + "; ".join(said), "", _row(header)]
        out += [_row(["---", *["---:"] * (len(header) - 1)]), *map(_row, rows)]
        return out + ([""] if self.findings else []) + [f"* {f}" for f in self.findings]


def _compared(changes: Sequence[Change]) -> tuple[list[str], list[list[str]]]:
    """Header and rows: a figure then and now, with the sign of the difference."""

    def signed(value: float | None) -> str:
        return "-" if value is None else f"{value:+.4f}"

    rows = [[c.name, show(c.before), show(c.now), signed(c.difference)] for c in changes]
    return ["figure", "baseline", "now", "difference"], rows


def _row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
