"""Calibration curves as a picture: what was stated against what came true."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtmap_cli.tables import whole_file

Colour = tuple[int, int, int]

SIDE, LEFT, TOP, BELOW, RIGHT = 360, 64, 44, 56, 24
"""A square of curves and the margins around it, pixels."""
ROW = 24
OVERSAMPLING = 2
INK: Colour = (30, 30, 34)
GRID: Colour = (224, 224, 220)
COLOURS: tuple[Colour, ...] = (
    (30, 110, 190),
    (214, 120, 0),
    (40, 140, 80),
    (150, 60, 150),
    (110, 110, 116),
)


@dataclass(frozen=True)
class Curve:
    """Points (stated, true) in [0, 1]; ``weights`` are shares of the data, drawn as dots."""

    name: str
    points: Sequence[tuple[float, float]]
    weights: Sequence[float] = ()


@dataclass(frozen=True)
class Chart:
    """One square with its words."""

    title: str
    x: str
    y: str
    curves: list[Curve]


def charts_of(result: dict[str, Any]) -> list[Chart]:
    """The curves of a result of ``rtmap evaluate uncertainty``."""
    vertices = result.get("vertices", {})
    regions = {
        "vertices, read as Gaussian": vertices.get("gaussian"),
        "vertices, read as Laplace": vertices.get("laplace"),
        "localized poses": result.get("poses", {}).get("all"),
        "initial poses": result.get("initial_poses", {}).get("all"),
        "network's poses": result.get("end_to_end_poses", {}).get("all"),
    }
    if "laplace" not in vertices:
        regions = {"vertices": vertices.get("gaussian")} | regions
        del regions["vertices, read as Gaussian"]
    curves = [
        Curve(name, [(p["nominal"], p["empirical"]) for p in told["calibration"]])
        for name, told in regions.items()
        if told
    ]
    shares = []
    for name in ("scores", "existence"):
        bins = [b for b in result.get(name, {}).get("bins", ()) if b["n"]]
        points = [(b["stated"], b["true"]) for b in bins]
        claim = result.get(name, {}).get("claim", "")
        weights = [b["n"] / result[name]["n"] for b in bins]
        shares.append(Curve(f"{name}: {claim} (a dot's area is its share)", points, weights))
    charts = [
        Chart("Regions", "nominal content", "share of truths inside", curves),
        Chart("Probabilities", "stated probability", "share that is true", shares),
    ]
    kept = [Chart(c.title, c.x, c.y, [k for k in c.curves if k.points]) for c in charts]
    return [c for c in kept if c.curves]


def write_plot(result: dict[str, Any], path: Path) -> None:
    """Draw the charts side by side into a PNG, whole or not at all."""
    from PIL import Image, ImageFont

    charts = charts_of(result)
    cell = LEFT + SIDE + RIGHT
    legend = ROW * max((len(c.curves) for c in charts), default=0)
    size = (cell * max(1, len(charts)), TOP + SIDE + BELOW + legend)
    k = OVERSAMPLING
    image = Image.new("RGB", (size[0] * k, size[1] * k), (255, 255, 255))
    fonts = [ImageFont.load_default(size=points * k) for points in (16, 12)]
    for column, chart in enumerate(charts):
        _draw(image, chart, column * cell, fonts)
    with whole_file(path) as temporary:
        image.resize(size, Image.Resampling.LANCZOS).save(temporary, "PNG")


def _draw(image: Any, chart: Chart, x0: int, fonts: Sequence[Any]) -> None:
    from PIL import ImageDraw

    draw, k = ImageDraw.Draw(image), OVERSAMPLING
    left, base = (x0 + LEFT) * k, (TOP + SIDE) * k

    def at(x: float, y: float) -> tuple[float, float]:
        return left + x * SIDE * k, base - y * SIDE * k

    for tick in (0.0, 0.25, 0.5, 0.75, 1.0):
        draw.line([at(tick, 0), at(tick, 1)], fill=GRID, width=k)
        draw.line([at(0, tick), at(1, tick)], fill=GRID, width=k)
        x, y = at(tick, 0)
        draw.text((x, y + 6 * k), f"{tick:g}", fill=INK, font=fonts[1], anchor="ma")
        x, y = at(0, tick)
        draw.text((x - 8 * k, y), f"{tick:g}", fill=INK, font=fonts[1], anchor="rm")
    draw.line([at(0, 0), at(1, 1)], fill=(150, 150, 150), width=k)
    draw.text((left, 14 * k), f"{chart.title}: honest is the diagonal", fill=INK, font=fonts[0])
    middle = left + SIDE * k / 2
    draw.text((middle, base + 24 * k), chart.x, fill=INK, font=fonts[1], anchor="ma")
    _upwards(image, chart.y, (x0 + 6) * k, base - SIDE * k // 2, fonts[1])
    for row, curve in enumerate(chart.curves):
        colour = COLOURS[row % len(COLOURS)]
        points = [at(*p) for p in curve.points]
        draw.line(points, fill=colour, width=3 * k, joint="curve")
        for (x, y), weight in zip(points, curve.weights, strict=False):
            r = max(2.5, 14 * weight**0.5) * k
            draw.ellipse([x - r, y - r, x + r, y + r], fill=colour)
        y = base + (BELOW + ROW * row) * k
        draw.line([left, y, left + 26 * k, y], fill=colour, width=3 * k)
        draw.text((left + 34 * k, y), curve.name, fill=INK, font=fonts[1], anchor="lm")


def _upwards(image: Any, text: str, x: int, middle: int, font: Any) -> None:
    """Text that reads upwards, its left side at ``x``."""
    from PIL import Image, ImageDraw

    box = font.getbbox(text)
    label = Image.new("RGB", (int(box[2]) + 2, int(box[3]) + 2), (255, 255, 255))
    ImageDraw.Draw(label).text((0, 0), text, fill=INK, font=font)
    turned = label.rotate(90, expand=True)
    image.paste(turned, (x, middle - turned.height // 2))
