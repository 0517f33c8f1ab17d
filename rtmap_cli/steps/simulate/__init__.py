"""Simulated worlds, drives, images, observations and changes, all seeded."""

from rtmap_cli.steps.simulate.render import render_cameras
from rtmap_cli.steps.simulate.rig import default_rig, jitter_rig
from rtmap_cli.steps.simulate.style import Style, make_style
from rtmap_cli.steps.simulate.town import Town, make_town
from rtmap_cli.steps.simulate.world import World, world_from_map
from rtmap_cli.steps.simulate.world_objects import random_occluders

__all__ = [
    "Style",
    "Town",
    "World",
    "default_rig",
    "jitter_rig",
    "make_style",
    "make_town",
    "random_occluders",
    "render_cameras",
    "world_from_map",
]
