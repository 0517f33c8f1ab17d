"""``--fail-under NAME=VALUE``: figures that must not be lower."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rtmap_cli.errors import Findings, UsageError


def parse_limits(specs: Sequence[str]) -> dict[str, float]:
    """``("mAP=0.5", "AP.divider=0.6")`` → values by name; UsageError when one is malformed."""
    out = {}
    for spec in specs:
        name, equals, value = spec.partition("=")
        try:
            out[name.strip()] = float(value)
        except ValueError:
            equals = ""
        if not equals or not name.strip():
            raise UsageError(f"--fail-under {spec}: expected NAME=VALUE, e.g. mAP=0.5")
    return out


def check_names(limits: Mapping[str, float], known: Sequence[str]) -> None:
    """UsageError when a limit names a figure that does not exist."""
    for name in limits:
        if name not in known:
            raise UsageError(f"--fail-under {name}: unknown figure (known: {', '.join(known)})")


def check_limits(limits: Mapping[str, float], figures: Mapping[str, float | None]) -> None:
    """Findings naming every figure below its limit; a figure without a value is below any."""
    check_names(limits, list(figures))
    low = []
    for name, limit in limits.items():
        value = figures[name]
        if value is None or value < limit:
            low.append(f"{name} is {'unknown' if value is None else f'{value:.4f}'}, under {limit}")
    if low:
        raise Findings("; ".join(low))
