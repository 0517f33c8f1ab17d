"""Maps as pictures: panels side by side, north up, one scale."""

from rtmap_cli.steps.picture.panels import Mark, Panel, draw_panels

__all__ = ["Mark", "Panel", "draw_panels"]
