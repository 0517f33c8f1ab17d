"""Lanelet2 maps (OSM XML), as Lanelet2 and Autoware write them; ``docs/formats/lanelet2.md``."""
