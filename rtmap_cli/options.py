"""Options that several commands share, written once."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


class FiniteRange(click.FloatRange):
    """A number in a range; nan and inf are no numbers here."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """As FloatRange, and finite."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


# Existence is checked by the readers, which exit with 3 and say what to do.
PATH = click.Path(path_type=Path)


def output(help_text: str, required: bool = True) -> Decorator:
    """``-o / --output``: where the result goes."""
    return click.option("-o", "--output", type=PATH, required=required, help=help_text)


def town_length(default: float) -> Decorator:
    """``--length``: how far to drive through a town (m)."""
    return click.option(
        "--length",
        type=FiniteRange(20),
        default=default,
        show_default=True,
        help="Length of a drive through a town (m).",
    )


overwrite: Decorator = click.option(
    "--overwrite", is_flag=True, help="Replace the output if it exists."
)
as_json: Decorator = click.option(
    "--json", "as_json", is_flag=True, help="Print the result as one JSON object."
)
seed: Decorator = click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Seed of every random choice.",
)
crs: Decorator = click.option(
    "--crs", help="Projected metric CRS of the map frame, e.g. EPSG:32617."
)
map_path: Decorator = click.option(
    "--map", "map_path", type=PATH, required=True, help="The map folder."
)
map_version: Decorator = click.option(
    "--map-version", type=int, help="Version of the map (default: the newest)."
)
drive_path: Decorator = click.option(
    "--log",
    "log_path",
    required=True,
    help="Whose path to drive: av2:LOG_DIR, LOG, or town: (lanes of the town MAP).",
)
traffic: Decorator = click.option(
    "--traffic",
    type=click.Choice(["log", "generated", "none"]),
    help="Vehicles [default: the log's boxes, generated where it has none].",
)
quiet: Decorator = click.option("-q", "--quiet", is_flag=True, help="No progress on stderr.")
threads: Decorator = click.option(
    "--threads", type=click.IntRange(1), help="Threads (default: the processor's cores)."
)
class_names: Decorator = click.option(
    "--class", "class_names", multiple=True, metavar="NAME", help="Only this class (repeatable)."
)
bbox: Decorator = click.option(
    "--bbox",
    type=float,
    nargs=4,
    metavar="X0 Y0 X1 Y1",
    help="Only elements whose bounding box touches this one (map frame, metres).",
)
lonlat: Decorator = click.option(
    "--lonlat", is_flag=True, help="--bbox is west south east north in WGS84 degrees."
)


def gates(command: Callable[..., Any]) -> Callable[..., Any]:
    """What every ``evaluate`` offers CI; `parse_gates` (``steps.evaluate.gates``) takes them."""
    decorators: list[Decorator] = [
        click.option(
            "--fail-under",
            multiple=True,
            metavar="NAME=VALUE",
            help="Exit 1 when a figure is lower: mAP=0.5. May be repeated.",
        ),
        click.option(
            "--fail-over",
            multiple=True,
            metavar="NAME=VALUE",
            help="Exit 1 when an error is higher: lateral_m.mean=0.2. May be repeated.",
        ),
        click.option(
            "--baseline", type=PATH, help="An earlier report (--json): exit 1 on what got worse."
        ),
        click.option(
            "--max-drop",
            multiple=True,
            metavar="[NAME=]VALUE",
            help="How much worse than --baseline a figure may be, in its unit (default: 0.01).",
        ),
        click.option("--markdown", is_flag=True, help="Print a Markdown table of the figures."),
        as_json,
    ]
    for decorator in reversed(decorators):
        command = decorator(command)
    return command


def leak_check(command: Callable[..., Any]) -> Callable[..., Any]:
    """Was the test area seen in training? `check_leak` of ``steps.evaluate.gates.leak`` tells."""
    decorators: list[Decorator] = [
        click.option(
            "--trained-on",
            multiple=True,
            metavar="WHAT",
            help="A model, map or log: how much of the test area was seen in training? Repeatable.",
        ),
        click.option("--fail-on-leak", is_flag=True, help="Exit 1 when more than --max-leak was."),
        click.option(
            "--max-leak",
            type=FiniteRange(0, 1),
            default=0.05,
            show_default=True,
            help="Share of the test area that training may have seen.",
        ),
    ]
    for decorator in reversed(decorators):
        command = decorator(command)
    return command
