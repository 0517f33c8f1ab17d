"""The policy file (TOML): when evidence becomes a change of the map.

    [delete]
    below = 0.2             # probability of existence
    traversals = 2          # k: drives that must have looked and not found it …
    of = 5                  # n: … of the newest n that had it in view (0: of all)

    [insert]
    above = 0.5
    first = 0.08            # the same where the map knows nothing yet
    traversals = 2
    of = 5

    [age]
    vanish = 0.01           # chance that an element has gone since the drives before
    half_life_days = 0      # what a map says about an element fades so fast (0: never)

    [tell]
    min_probability = 0.5
    max_false_alarms_per_km = 0.1

    [evidence]
    prior_log_odds = 2.5

Everything may be left out; what a name means stands in ``maps.evidence.Policy``.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

from rtmap_cli.errors import BadInput
from rtmap_cli.maps.evidence import Policy

INFINITY = math.inf
FIELDS: dict[str, dict[str, tuple[str, type, float, float]]] = {
    "delete": {
        "below": ("delete_below", float, 0.0, 1.0),
        "traversals": ("delete_traversals", int, 1, INFINITY),
        "of": ("delete_of", int, 0, INFINITY),
    },
    "insert": {
        "above": ("insert_above", float, 0.0, 1.0),
        "first": ("first_above", float, 0.0, 1.0),
        "traversals": ("insert_traversals", int, 1, INFINITY),
        "of": ("insert_of", int, 0, INFINITY),
    },
    "age": {
        "vanish": ("vanish", float, 0.0, 0.5),
        "half_life_days": ("half_life_days", float, 0.0, INFINITY),
    },
    "tell": {
        "min_probability": ("min_probability", float, 0.0, 1.0),
        "max_false_alarms_per_km": ("max_false_alarms_per_km", float, 0.0, INFINITY),
    },
    "evidence": {
        "prior_log_odds": ("prior_log_odds", float, -12.0, 12.0),
        "new_log_odds": ("new_log_odds", float, -12.0, 12.0),
        "first_log_odds": ("first_log_odds", float, -12.0, 12.0),
        "correlation_m": ("correlation_m", float, 0.5, INFINITY),
        "switch": ("switch", float, 0.0, INFINITY),
        "shortest_m": ("shortest_m", float, 0.0, INFINITY),
        "view_margin_m": ("view_margin_m", float, 0.0, INFINITY),
    },
}
"""Table and name in the file: field of ``Policy``, its type, and the range that it must lie in."""


def read_policy(path: Path) -> Policy:
    """The policy of a TOML file; what it leaves out is the default.

    BadInput names what cannot be read, is unknown, of another type or out of range.
    """
    if not path.is_file():
        raise BadInput(path, "no such file")
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise BadInput(path, f"cannot be read as TOML ({error})") from None
    values: dict[str, Any] = {}
    for table, rows in data.items():
        if table not in FIELDS:
            raise BadInput(path, f"[{table}] is unknown", f"known are {', '.join(FIELDS)}")
        if not isinstance(rows, dict):
            raise BadInput(path, f"{table} must be a table", f"write [{table}]")
        for name, value in rows.items():
            if name not in FIELDS[table]:
                known = ", ".join(FIELDS[table])
                raise BadInput(path, f"[{table}] {name} is unknown", f"known are {known}")
            target, kind, low, high = FIELDS[table][name]
            values[target] = _checked(path, f"[{table}] {name}", value, kind, low, high)
    policy = replace(Policy(), **values)
    _check_sense(path, policy)
    return policy


def _checked(path: Path, name: str, value: Any, kind: type, low: float, high: float) -> Any:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or (kind is int and not isinstance(value, int)) or not math.isfinite(value):
        what = "a whole number" if kind is int else "a number"
        raise BadInput(path, f"{name} must be {what}, not {value!r}")
    if not low <= value <= high:
        limits = f"at least {low:g}" if high == INFINITY else f"{low:g} to {high:g}"
        raise BadInput(path, f"{name} is {value}", f"it must be {limits}")
    return kind(value)


def _check_sense(path: Path, policy: Policy) -> None:
    """BadInput where k exceeds n, or an element could come and go with every drive."""
    for verb, k, n in (
        ("delete", policy.delete_traversals, policy.delete_of),
        ("insert", policy.insert_traversals, policy.insert_of),
    ):
        if n and k > n:
            raise BadInput(path, f"[{verb}] traversals {k} of {n}", "k must not exceed n")
    if policy.delete_below > policy.insert_above:
        raise BadInput(
            path,
            f"[delete] below {policy.delete_below:g} exceeds [insert] above "
            f"{policy.insert_above:g}",
            "what is just inserted would be deleted at once",
        )
