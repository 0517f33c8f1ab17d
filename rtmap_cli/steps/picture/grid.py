"""The cameras of one frame side by side, with lines that lie on the road drawn into them.

Points on the road are given in the ego frame dropped to the road: x forward, y left, metres, z = 0.
A grid on the right pixels shows at a glance that calibration, lens and poses are read as meant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.steps.picture.legend import ROW, Colour, Entry, draw_legend, rows_of
from rtmap_cli.steps.picture.panels import CLASS_COLOURS, INK, OTHER

Array = NDArray[np.float64]
Box = tuple[float, float, float, float]

STEP = 0.2
"""m between the points of a line: lenses bend it."""
FINE_REACH = 12.0
"""m from the vehicle up to which there are lines every metre; farther they fill the picture."""
ON_ROAD: dict[str, Colour] = CLASS_COLOURS | {"boundary": (190, 190, 205)}
"""Colours of the classes on asphalt, where the dark grey of the maps would not be seen."""
EDGES: dict[str, Colour] = {
    "confirmed": (0, 0, 0),
    "new": (40, 190, 80),
    "outdated": (225, 40, 40),
}
"""Edges of what a run saw, by state."""
ON_MAP = "on the map (initial pose)"
ASPHALT: Colour = (84, 82, 86)
PAPER: Colour = (240, 240, 240)
FINE: Colour = (255, 255, 255)
COARSE: Colour = (60, 220, 235)
RANGE: Colour = (255, 215, 0)
FORWARD: Colour = (240, 50, 40)
LEFT: Colour = (60, 200, 60)


@dataclass(frozen=True)
class View:
    """One camera image: ``image`` (PIL, RGB) as it is drawn, ``project`` takes points (n, 3) on
    and above the road to its pixels (n, 2), NaN where the camera does not see them."""

    name: str
    image: Any
    project: Callable[[Array], Array]


@dataclass(frozen=True)
class GroundLine:
    """A line (n, 2) or (n, 3) over the road with its colour and width in pixels, ``edge`` along
    it if any; ``name`` and ``state`` stand in the legend. A ``label`` is written in its place."""

    points: Array
    colour: Colour
    width: int = 2
    label: str = ""
    name: str = ""
    edge: Colour | None = None
    state: str = ""


def grid_lines(box: Box) -> list[GroundLine]:
    """The range ``box`` (x_min, y_min, x_max, y_max), lines every 5 m, every metre near by, and the
    axes: 5 m forward in red, 5 m left in green."""
    x0, y0, x1, y1 = box
    out = []
    near = (max(x0, -FINE_REACH), max(y0, -FINE_REACH), min(x1, FINE_REACH), min(y1, FINE_REACH))
    for spacing, (a, b, c, d), colour in ((1, near, FINE), (5, box, COARSE)):
        name = f"every {spacing} m"
        xs = np.arange(np.ceil(a / spacing), np.floor(c / spacing) + 1) * spacing
        ys = np.arange(np.ceil(b / spacing), np.floor(d / spacing) + 1) * spacing
        out += [GroundLine(np.array([[x, b], [x, d]]), colour, 1, name=name) for x in xs]
        out += [GroundLine(np.array([[a, y], [c, y]]), colour, 1, name=name) for y in ys]
    ring = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
    out.append(GroundLine(ring, RANGE, 3, name="range (numbers: m ahead)"))
    for x in np.arange(np.ceil(x0 / 5), np.floor(x1 / 5) + 1) * 5:
        out.append(GroundLine(np.array([[x, 0.0], [x, 1e-3]]), RANGE, 1, f"{x:g}"))
    out.append(GroundLine(np.array([[0.0, 0.0], [5.0, 0.0]]), FORWARD, 4, name="5 m forward"))
    out.append(GroundLine(np.array([[0.0, 0.0], [0.0, 5.0]]), LEFT, 4, name="5 m left"))
    return out


def element_lines(
    class_names: Sequence[str], points: Sequence[Array], state: str = ON_MAP
) -> list[GroundLine]:
    """Elements (n, 2) in the ego frame as lines in the colours of their classes.

    Those on a map are thin; those that a run saw have the edge of their ``state`` (of EDGES).
    """
    edge, width = EDGES.get(state), 2 if state == ON_MAP else 3
    return [
        GroundLine(
            np.asarray(p, np.float64), ON_ROAD.get(name, OTHER), width, "", name, edge, state
        )
        for name, p in zip(class_names, points, strict=True)
    ]


def legend_entries(lines: Sequence[GroundLine]) -> list[Entry]:
    """What the lines of a picture mean: their names, then the states of elements."""
    names = {x.name: Entry(x.name, x.colour, max(x.width, 2)) for x in lines if x.name}
    states = {x.state: Entry(x.state, PAPER, x.width, x.edge) for x in lines if x.state}
    return [*names.values(), *states.values()]


def draw_views(views: Sequence[View], lines: Sequence[GroundLine], title: str = "") -> Any:
    """A picture of all views, three in a row, with the lines drawn into each and a legend below;
    returns a PIL image.

    All images are shown at the size of the widest.
    """
    from PIL import Image, ImageDraw, ImageFont

    columns = min(3, len(views))
    width = max(v.image.size[0] for v in views)
    height = max(v.image.size[1] for v in views)
    head, gap = 26, 6
    rows = -(-len(views) // columns)
    wide, foot = columns * (width + gap) + gap, rows * (height + head) + gap + head
    font = ImageFont.load_default(size=16)
    small = ImageFont.load_default(size=14)
    entries = legend_entries(lines)
    legend = rows_of(entries, wide - 4 * gap, small) if entries else []
    out = Image.new("RGB", (wide, foot + ROW * len(legend) + gap * bool(legend)), (255, 255, 255))
    draw = ImageDraw.Draw(out)
    draw.text((gap, 4), title, fill=INK, font=font)
    for k, view in enumerate(views):
        left = gap + k % columns * (width + gap)
        top = head + k // columns * (height + head)
        draw.text((left, top + 4), view.name, fill=INK, font=font)
        out.paste(_drawn(view, lines), (left, top + head))
    if legend:
        draw.rectangle((gap, foot, wide - gap - 1, foot + ROW * len(legend) - 1), fill=ASPHALT)
        draw_legend(draw, legend, (2 * gap, foot), PAPER, small)
    return out


def _drawn(view: View, lines: Sequence[GroundLine]) -> Any:
    """The image of a view with the lines in it."""
    from PIL import ImageDraw, ImageFont

    image = view.image.copy()
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(size=13)
    for line in lines:
        dense = _dense(line.points)
        pixels = view.project(dense)
        if line.label:
            if np.isfinite(pixels[0]).all():
                draw.text(tuple(pixels[0]), line.label, fill=line.colour, font=font)
            continue
        for part in _visible(pixels, image.size):
            if line.edge is not None:
                draw.line(part, fill=line.edge, width=line.width + 4)
            draw.line(part, fill=line.colour, width=line.width)
    return image


def _dense(points: Array) -> Array:
    """(m, 3) points at most ``STEP`` apart along a line of (n, 2) or (n, 3); unknown heights 0."""
    if points.shape[1] == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    points = np.where(np.isnan(points), 0.0, points)
    parts = [points[:1]]
    for a, b in pairwise(points):
        count = max(1, int(np.ceil(np.linalg.norm(b - a) / STEP)))
        parts.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(parts)


def _visible(pixels: Array, size: tuple[int, int]) -> list[list[tuple[float, float]]]:
    """The stretches of a line of pixels (n, 2) that lie in an image, or half an image around it."""
    span = np.array(size, np.float64)
    with np.errstate(invalid="ignore"):
        seen = ((pixels > -span / 2) & (pixels < 1.5 * span)).all(axis=1)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(int)))
    stretches = zip(ends[::2].tolist(), ends[1::2].tolist(), strict=True)
    return [[(float(x), float(y)) for x, y in pixels[a:b]] for a, b in stretches if b - a > 1]
