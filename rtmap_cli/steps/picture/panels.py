"""Draw vector maps side by side with Pillow: elements by class, marks on top, a scale bar."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.maps.element import VectorMap

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

CLASS_COLOURS: dict[str, Colour] = {
    "boundary": (70, 70, 78),
    "divider": (214, 120, 0),
    "ped_crossing": (30, 110, 190),
}
OTHER: Colour = (120, 60, 150)
BACKGROUND: Colour = (250, 250, 247)
INK: Colour = (30, 30, 34)
OVERSAMPLING = 2


@dataclass(frozen=True)
class Mark:
    """A line (n, 2) in the map frame drawn over a panel, with a colour and a width in pixels."""

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


def draw_panels(
    panels: list[Panel],
    bounds: tuple[float, float, float, float],
    panel_width: int = 620,
    legend: list[tuple[str, Colour]] | None = None,
) -> Any:
    """Draw the panels side by side over the same ``bounds`` (map frame, metres).

    Returns a PIL image; every panel has the same scale (written on a bar) and north is up.
    """
    from PIL import Image, ImageDraw, ImageFont

    x0, y0, x1, y1 = bounds
    scale = panel_width / max(x1 - x0, 1e-6)
    height = int(np.clip((y1 - y0) * scale, 120, 1800))
    head, foot, gap = 40, 46, 12
    total = (panel_width * len(panels) + gap * (len(panels) + 1), head + height + foot)
    k = OVERSAMPLING
    image = Image.new("RGB", (total[0] * k, total[1] * k), (255, 255, 255))
    for number, panel in enumerate(panels):
        tile = Image.new("RGB", (panel_width * k, height * k), BACKGROUND)
        draw = ImageDraw.Draw(tile)

        def pixels(points: Array, s: float = scale * k) -> list[tuple[float, float]]:
            xy = np.column_stack([points[:, 0] - x0, y1 - points[:, 1]]) * s
            return [(float(x), float(y)) for x, y in xy]

        for mark in panel.under:
            draw.line(pixels(mark.points), fill=mark.colour, width=mark.width * k, joint="curve")
        for element in sorted(panel.vector_map, key=lambda e: e.class_name != "boundary"):
            colour = CLASS_COLOURS.get(element.class_name, OTHER)
            line = pixels(element.xy)
            if element.class_name == "ped_crossing":
                fill = tuple(int(c + (255 - c) * 0.65) for c in colour)
                draw.polygon(line, fill=fill)
            draw.line(line, fill=colour, width=2 * k, joint="curve")
        for mark in panel.marks:
            draw.line(pixels(mark.points), fill=mark.colour, width=mark.width * k, joint="curve")
        image.paste(tile, ((gap + number * (panel_width + gap)) * k, head * k))
    image = image.resize(total, Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(image)
    title_font, small = ImageFont.load_default(size=20), ImageFont.load_default(size=15)
    for number, panel in enumerate(panels):
        left = gap + number * (panel_width + gap)
        draw.text((left, 9), panel.title, fill=INK, font=title_font)
        draw.rectangle(
            (left, head, left + panel_width - 1, head + height - 1), outline=(200, 200, 200)
        )
    base = head + height + 16
    bar = _round_length(0.2 * panel_width / scale)
    draw.line((gap, base + 8, gap + bar * scale, base + 8), fill=INK, width=3)
    draw.text((gap + bar * scale + 8, base), f"{bar:g} m", fill=INK, font=small)
    x = gap + bar * scale + 90
    for text, colour in legend or [(n, CLASS_COLOURS[n]) for n in CLASS_COLOURS]:
        draw.line((x, base + 8, x + 26, base + 8), fill=colour, width=5)
        draw.text((x + 32, base), text, fill=INK, font=small)
        x += 50 + draw.textlength(text, font=small)
    return image


def _round_length(metres: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not longer."""
    power = 10.0 ** np.floor(np.log10(max(metres, 1e-9)))
    return float(max(f * power for f in (1, 2, 5) if f * power <= metres))
