"""Pictures: maps side by side, north up; the cameras of a frame with lines on the road."""

from rtmap_cli.steps.picture.grid import GroundLine, View, draw_views, element_lines, grid_lines
from rtmap_cli.steps.picture.legend import Entry
from rtmap_cli.steps.picture.panels import Mark, Panel, draw_panels

__all__ = [
    "Entry",
    "GroundLine",
    "Mark",
    "Panel",
    "View",
    "draw_panels",
    "draw_views",
    "element_lines",
    "grid_lines",
]
