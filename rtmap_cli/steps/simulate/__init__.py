"""Simulated worlds, drives, images, observations and changes, all seeded."""

from rtmap_cli.steps.simulate.images.render import render_cameras
from rtmap_cli.steps.simulate.images.rig import default_rig, jitter_rig
from rtmap_cli.steps.simulate.images.style import Style, make_style
from rtmap_cli.steps.simulate.towns.town import Town, make_town
from rtmap_cli.steps.simulate.worlds.world import World, world_from_map
from rtmap_cli.steps.simulate.worlds.world_objects import random_occluders

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
