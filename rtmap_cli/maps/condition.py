"""Conditions on properties: ``probability > 0.95 and class in (divider, boundary)``.

    condition  = and-part {"or" and-part}
    and-part   = not-part {"and" not-part}
    not-part   = "not" not-part | "(" condition ")" | comparison
    comparison = NAME (">" | ">=" | "<" | "<=" | "==" | "=" | "!=") value
               | NAME ["not"] "in" "(" value {"," value} ")"
    value      = number | 'text' | "text" | word | null | true | false

A parser of its own: nothing of the text is ever run as code. A comparison with what a record does
not have, or has as null, is false (but for ``!= value`` and ``== null``).
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from rtmap_cli.errors import UsageError

Record = Mapping[str, Any]
Test = Callable[[Record], bool]

_TOKEN = re.compile(
    r"\s*(?:(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?![\w.])"
    r"|'(?P<single>[^']*)'|\"(?P<double>[^\"]*)\""
    r"|(?P<sign>>=|<=|==|!=|=|>|<|\(|\)|,)|(?P<word>[^\W\d][\w.:-]*))"
)
_ORDER: dict[str, Callable[[Any, Any], bool]] = {
    ">": operator.gt,
    ">=": operator.ge,
    "<": operator.lt,
    "<=": operator.le,
}
_CONSTANTS: dict[str, Any] = {"null": None, "none": None, "true": True, "false": False}
_DEEPEST = 50


@dataclass(frozen=True)
class Condition:
    """A parsed condition: call it with a record; ``names`` are the properties that it asks for."""

    text: str
    names: frozenset[str]
    test: Test

    def __call__(self, record: Record) -> bool:
        return self.test(record)

    def check_names(self, known: Iterable[str]) -> None:
        """UsageError when it asks for a property that no record has."""
        there = set(known)
        if unknown := sorted(self.names - there):
            told = ", ".join(sorted(there))
            raise UsageError(f"condition {self.text!r}: no change has {unknown[0]}; known: {told}")


def parse_condition(text: str) -> Condition:
    """The condition of a text; UsageError names the place where it cannot be read."""
    parser = _Parser(text)
    test = parser.either()
    if parser.kind:
        parser.fail("ends too late")
    return Condition(text, frozenset(parser.names), test)


class _Parser:
    """Recursive descent over the tokens of one text."""

    def __init__(self, text: str) -> None:
        self.text, self.at, self.start, self.depth = text, 0, 0, 0
        self.names: set[str] = set()
        self.kind, self.value = "", ""
        self.advance()

    def advance(self) -> None:
        """To the next token; ``kind`` is empty behind the last one."""
        self.start = self.at
        if not self.text[self.at :].strip():
            self.kind, self.value = "", ""
            return
        found = _TOKEN.match(self.text, self.at)
        if found is None:
            self.fail("cannot be read")
        assert found is not None and found.lastgroup is not None
        self.kind, self.value, self.at = found.lastgroup, found[found.lastgroup], found.end()

    def fail(self, what: str) -> None:
        """UsageError at the token under way."""
        rest = self.text[self.start :].strip()
        raise UsageError(
            f"condition {self.text!r} {what} at {rest[:20]!r}; write e.g. "
            "'probability>0.95 and class==divider'"
        )

    def takes(self, *words: str) -> str:
        """The sign or word that comes, if it is one of these, and past it; else empty."""
        if self.kind in ("sign", "word") and self.value.lower() in words:
            word = self.value.lower()
            self.advance()
            return word
        return ""

    def either(self) -> Test:
        """Parts joined by ``or``."""
        parts = [self.both()]
        while self.takes("or"):
            parts.append(self.both())
        return parts[0] if len(parts) == 1 else lambda record: any(p(record) for p in parts)

    def both(self) -> Test:
        """Parts joined by ``and``."""
        parts = [self.one()]
        while self.takes("and"):
            parts.append(self.one())
        return parts[0] if len(parts) == 1 else lambda record: all(p(record) for p in parts)

    def one(self) -> Test:
        """A comparison, or something in brackets, or what is not."""
        self.depth += 1
        if self.depth > _DEEPEST:
            self.fail("is nested too deeply")
        try:
            if self.takes("not"):
                inner = self.one()
                return lambda record: not inner(record)
            if self.takes("("):
                inside = self.either()
                if not self.takes(")"):
                    self.fail("lacks a )")
                return inside
            return self.comparison()
        finally:
            self.depth -= 1

    def comparison(self) -> Test:
        """NAME, sign, value; or NAME in (values)."""
        if self.kind != "word":
            self.fail("lacks a property")
        name = self.value
        self.names.add(name)
        self.advance()
        negated = bool(self.takes("not"))
        if self.takes("in"):
            values = self.values()
            return lambda record: any(_equal(record.get(name), v) for v in values) != negated
        sign = "" if negated else self.takes(*_ORDER, "==", "=", "!=")
        if not sign:
            self.fail("lacks a comparison")
        value = self.constant()
        if sign in _ORDER:
            return lambda record: _ordered(record.get(name), value, _ORDER[sign])
        unequal = sign == "!="
        return lambda record: _equal(record.get(name), value) != unequal

    def values(self) -> list[Any]:
        """A list in brackets."""
        if not self.takes("("):
            self.fail("lacks a (")
        out = [self.constant()]
        while self.takes(","):
            out.append(self.constant())
        if not self.takes(")"):
            self.fail("lacks a )")
        return out

    def constant(self) -> Any:
        """A number, a text, or a word that stands for itself."""
        kind, value = self.kind, self.value
        if kind not in ("number", "single", "double", "word"):
            self.fail("lacks a value")
        self.advance()
        if kind == "number":
            return float(value)
        return _CONSTANTS.get(value.lower(), value) if kind == "word" else value


def _equal(found: Any, value: Any) -> bool:
    number = _number(found)
    if isinstance(value, float):
        return number == value
    return bool(found == value) and isinstance(found, bool) == isinstance(value, bool)


def _ordered(found: Any, value: Any, order: Callable[[Any, Any], bool]) -> bool:
    if isinstance(value, float):
        number = _number(found)
        return number is not None and order(number, value)
    return isinstance(found, str) and isinstance(value, str) and order(found, value)


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
