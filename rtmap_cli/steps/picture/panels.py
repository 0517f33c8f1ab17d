"""Draw vector maps side by side with Pillow: elements by class, marks on top, a legend, a scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.maps.element import VectorMap
from rtmap_cli.steps.picture.legend import ROW, Colour, Entry, draw_legend, rows_of

Array = NDArray[np.float64]
Bounds = tuple[float, float, float, float]

CLASS_COLOURS: dict[str, Colour] = {
    "boundary": (70, 70, 78),
    "divider": (214, 120, 0),
    "ped_crossing": (30, 110, 190),
}
OTHER: Colour = (120, 60, 150)
BACKGROUND: Colour = (250, 250, 247)
INK: Colour = (30, 30, 34)
OVERSAMPLING = 2
HEAD, GAP = 40, 12
"""Height of the titles and space between panels in pixels."""


@dataclass(frozen=True)
class Mark:
    """A line (n, 2) in the map frame drawn over a panel, with a colour and a width in pixels, and
    a ``label`` beside it."""

    points: Array
    colour: Colour
    width: int = 4
    label: str = ""


@dataclass(frozen=True)
class Panel:
    """One map with a title and marks over (or, ``under``, below) it."""

    title: str
    vector_map: VectorMap
    marks: list[Mark] = field(default_factory=list)
    under: list[Mark] = field(default_factory=list)


def class_entries() -> list[Entry]:
    """The classes in a legend: crossings are areas, the others lines."""
    names = {"ped_crossing": "crossing"}
    return [
        Entry(names.get(n, n), c, 2 if n in names else 5, None, _pale(c) if n in names else None)
        for n, c in CLASS_COLOURS.items()
    ]


def draw_panels(
    panels: Sequence[Panel], bounds: Bounds, panel_width: int = 620, legend: Sequence[Entry] = ()
) -> Any:
    """Draw the panels side by side over the same ``bounds`` (map frame, metres).

    Returns a PIL image; every panel has the same scale (written on a bar) and north is up. The
    ``legend`` follows the classes.
    """
    from PIL import Image, ImageDraw, ImageFont

    x0, y0, x1, y1 = bounds
    scale = panel_width / max(x1 - x0, 1e-6)
    height = int(np.clip((y1 - y0) * scale, 120, 1800))
    width = panel_width * len(panels) + GAP * (len(panels) + 1)
    title_font, small = ImageFont.load_default(size=20), ImageFont.load_default(size=15)
    rows = rows_of([*class_entries(), *legend], width - 2 * GAP, small)
    base = HEAD + height + 6
    total = (width, base + ROW * (len(rows) + 1) + 6)
    image = Image.new("RGB", total, (255, 255, 255))
    draw = ImageDraw.Draw(image)
    for number, panel in enumerate(panels):
        left = GAP + number * (panel_width + GAP)
        tile = _tile(panel, (panel_width, height), (x0, y1), scale * OVERSAMPLING)
        image.paste(tile.resize((panel_width, height), Image.Resampling.LANCZOS), (left, HEAD))
        draw.text((left, 9), panel.title, fill=INK, font=title_font)
        frame = (left, HEAD, left + panel_width - 1, HEAD + height - 1)
        draw.rectangle(frame, outline=(200, 200, 200))
        for mark in panel.marks:
            _label(draw, mark, (x0, y1), scale, frame, small)
    crs = panels[0].vector_map.crs
    place = f"north is up; {crs}, x {x0:.0f} to {x1:.0f}, y {y0:.0f} to {y1:.0f} m"
    end = _scale_bar(draw, (GAP, base), panel_width, scale, small)
    draw.text((end + 24, base + ROW / 2), place, fill=INK, font=small, anchor="lm")
    draw_legend(draw, rows, (GAP, base + ROW), INK, small)
    return image


def _tile(panel: Panel, size: tuple[int, int], corner: tuple[float, float], scale: float) -> Any:
    """The map and the lines of a panel, ``OVERSAMPLING`` times as large as ``size``; ``scale``:
    its pixels per metre, ``corner``: x and y of the upper left corner in the map frame."""
    from PIL import Image, ImageDraw

    k = OVERSAMPLING
    tile = Image.new("RGB", (size[0] * k, size[1] * k), BACKGROUND)
    draw = ImageDraw.Draw(tile)

    def pixels(points: Array) -> list[tuple[float, float]]:
        xy = (points[:, :2] - corner) * (scale, -scale)
        return [(float(x), float(y)) for x, y in xy]

    for mark in panel.under:
        draw.line(pixels(mark.points), fill=mark.colour, width=mark.width * k, joint="curve")
    for element in sorted(panel.vector_map, key=lambda e: e.class_name != "boundary"):
        colour = CLASS_COLOURS.get(element.class_name, OTHER)
        line = pixels(element.xy)
        if element.class_name == "ped_crossing":
            draw.polygon(line, fill=_pale(colour))
        draw.line(line, fill=colour, width=2 * k, joint="curve")
    for mark in panel.marks:
        draw.line(pixels(mark.points), fill=mark.colour, width=mark.width * k, joint="curve")
    return tile


def _label(
    draw: Any,
    mark: Mark,
    corner: tuple[float, float],
    scale: float,
    frame: tuple[int, int, int, int],
    font: Any,
) -> None:
    """The label of a mark beside its easternmost point, or left of it near the border."""
    if not mark.label:
        return
    x, y = (mark.points[np.argmax(mark.points[:, 0]), :2] - corner) * (scale, -scale)
    x, y = x + frame[0] + 6, min(max(y + frame[1], frame[1] + 10), frame[3] - 10)
    anchor = "lm"
    if x + font.getlength(mark.label) > frame[2]:
        x, anchor = x - 12, "rm"
    halo = {"stroke_width": 3, "stroke_fill": (255, 255, 255)}
    draw.text((float(x), float(y)), mark.label, fill=mark.colour, font=font, anchor=anchor, **halo)


def _scale_bar(
    draw: Any, at: tuple[float, float], panel_width: int, scale: float, font: Any
) -> float:
    """A bar of a round length with its ends and its middle marked; returns where its words end."""
    bar = _round_length(0.2 * panel_width / scale)
    x, y = at[0], at[1] + ROW / 2
    draw.line((x, y, x + bar * scale, y), fill=INK, width=3)
    for part in (0.0, 0.5, 1.0):
        end = x + part * bar * scale
        draw.line((end, y - 5, end, y + 5), fill=INK, width=2)
    draw.text((x + bar * scale + 8, y), f"{bar:g} m", fill=INK, font=font, anchor="lm")
    return float(x + bar * scale + 8 + font.getlength(f"{bar:g} m"))


def _pale(colour: Colour) -> Colour:
    r, g, b = (int(c + (255 - c) * 0.65) for c in colour)
    return r, g, b


def _round_length(metres: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not longer."""
    power = 10.0 ** np.floor(np.log10(max(metres, 1e-9)))
    return float(max(f * power for f in (1, 2, 5) if f * power <= metres))
