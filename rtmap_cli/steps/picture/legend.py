"""A legend: samples of lines with words, in rows that fit into a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

Colour = tuple[int, int, int]

SAMPLE, ROW = 26, 24
"""Length of a sample and height of a row in pixels."""


@dataclass(frozen=True)
class Entry:
    """A word with a line of ``colour`` and ``width``, with an ``edge`` if any; ``area``: a filled
    box with that outline in place of the line."""

    text: str
    colour: Colour
    width: int = 5
    edge: Colour | None = None
    area: Colour | None = None


def rows_of(entries: Sequence[Entry], width: float, font: Any) -> list[list[tuple[float, Entry]]]:
    """Entries in rows of at most ``width`` pixels, each with its place from the left."""
    rows: list[list[tuple[float, Entry]]] = [[]]
    x = 0.0
    for entry in entries:
        wide = SAMPLE + 24 + font.getlength(entry.text)
        if rows[-1] and x + wide > width:
            rows.append([])
            x = 0.0
        rows[-1].append((x, entry))
        x += wide
    return rows


def draw_legend(
    draw: Any,
    rows: Sequence[Sequence[tuple[float, Entry]]],
    at: tuple[float, float],
    ink: Colour,
    font: Any,
) -> None:
    """Draw ``rows`` with the upper left corner at ``at`` (x, y); words in the colour ``ink``."""
    for k, row in enumerate(rows):
        middle = at[1] + ROW * (k + 0.5)
        for x, entry in row:
            x += at[0]
            if entry.area is not None:
                box = (x, middle - 6, x + SAMPLE, middle + 6)
                draw.rectangle(box, fill=entry.area, outline=entry.colour, width=2)
            else:
                ends = (x, middle, x + SAMPLE, middle)
                if entry.edge is not None:
                    draw.line(ends, fill=entry.edge, width=entry.width + 4)
                draw.line(ends, fill=entry.colour, width=entry.width)
            draw.text((x + SAMPLE + 6, middle), entry.text, fill=ink, font=font, anchor="lm")
