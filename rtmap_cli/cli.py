"""The click group. Commands are named here and imported only when they run."""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

import click

from rtmap_cli import __version__
from rtmap_cli.errors import RtmapError

COMMANDS: dict[str, Any] = {
    "infer": ("infer", "Read a log with the network: observations of every frame."),
    "localize": ("localize", "Find where each frame stands on the prior map."),
    "detect-changes": ("detect_changes", "Tell what is gone and what is new."),
    "update": ("update", "Flag the cells of a map that predictions contradict."),
    "crowdsource": ("crowdsource", "Fuse runs into the next version of the map."),
    "evaluate": (
        "Compare with ground truth.",
        {
            "map": ("evaluate_map", "Average precision of a run, a map or a results file."),
            "poses": ("evaluate_poses", "Lateral, longitudinal and yaw errors."),
            "changes": ("evaluate_changes", "Found, missed and false changes."),
            "uncertainty": ("evaluate_uncertainty", "Whether sigmas and probabilities are honest."),
        },
    ),
    "import": (
        "Bring in maps and detections of other formats.",
        {
            "av2": ("import_av2", "The vector map of an Argoverse 2 log becomes a map."),
            "nuscenes": ("import_nuscenes", "A vector map of nuScenes becomes a map."),
            "geojson": ("import_geojson", "A GeoJSON file becomes a map."),
            "lanelet2": ("import_lanelet2", "A Lanelet2 map becomes a map."),
            "detections": ("import_detections", "Detections of any model become a run."),
        },
    ),
    "export": (
        "Write maps in other formats.",
        {
            "geojson": ("export_geojson", "A map as GeoJSON in WGS84."),
            "lanelet2": ("export_lanelet2", "A map as a Lanelet2 file."),
        },
    ),
    "simulate": (
        "Make towns, drives, images, observations and changes.",
        {
            "town": ("simulate_town", "A procedural town becomes a map."),
            "changes": ("simulate_changes", "Change a map, with a truth file."),
            "degrade": ("simulate_degrade", "A map less exact than the world: an old survey."),
            "lidar": ("simulate_lidar", "Drive with a spinning LiDAR: a native log of sweeps."),
            "images": ("simulate_images", "Render the cameras of a drive: a native log."),
            "observations": ("simulate_observations", "Observe a map without a network: a run."),
        },
    ),
    "map": (
        "Look after the versions of a map.",
        {
            "ls": ("map_ls", "List the elements of a map."),
            "log": ("map_log", "List the versions of a map."),
            "diff": ("map_diff", "What changed between two versions."),
            "review": ("map_review", "Decide on the changes of a file."),
            "merge": ("map_merge", "Add what another map of the area knows."),
            "apply": ("map_apply", "Make the accepted changes of a file."),
            "revert": ("map_revert", "Undo one version."),
            "restore": ("map_restore", "Make an old version the newest one."),
            "validate": ("map_validate", "Check a map folder."),
            "gc": ("map_gc", "Remove files that no kept version needs."),
        },
    ),
    "label": (
        "Make a first map and training labels from a drive with LiDAR.",
        {
            "cloud": ("label_cloud", "Register the sweeps of a log: trajectory and point cloud."),
            "lift": ("label_lift", "Give the vertices of a map the height of the ground."),
            "lanes": ("label_lanes", "Lanes of drives, with borders: a map of lanelets."),
            "merge": ("label_merge", "Bring edits made by hand into newly generated labels."),
            "frames": ("label_frames", "Cut a labelled drive into logs to train and to test on."),
        },
    ),
    "semantic-map": ("semantic_map", "Masks and LiDAR of a log become a raster of the ground."),
    "check-log": ("check_log", "Name what is wrong with a log."),
    "picture": ("picture", "The cameras of a frame with lines drawn on the road."),
    "train": ("train", "Train the network (extra: train)."),
    "export-model": ("export_model", "Export trained weights to one ONNX file (extra: train)."),
    "demo": ("demo", "A town, an outdated map, three drives, three cycles."),
}


class LazyGroup(click.Group):
    """A group whose commands are imported when they are called; its help imports nothing."""

    def __init__(self, table: dict[str, Any], **settings: Any) -> None:
        super().__init__(**settings)
        self.table = table

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The names, in the order of the table."""
        return list(self.table)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import one command, or build a group from its part of the table."""
        entry = self.table.get(cmd_name)
        if entry is None:
            return None
        if isinstance(entry[1], dict):
            return LazyGroup(entry[1], name=cmd_name, help=entry[0])
        module = importlib.import_module(f"rtmap_cli.commands.{entry[0]}")
        command: click.Command = module.command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands with the one-liners of the table."""
        rows = [
            (name, entry[0] if isinstance(entry[1], dict) else entry[1])
            for name, entry in self.table.items()
        ]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


@click.pass_context
def _root(ctx: click.Context, **_: Any) -> None:
    """Nothing to do before a verb."""


group = LazyGroup(
    COMMANDS,
    name="rtmap",
    callback=_root,
    help=(
        "Keep HD maps true.\n\nrtmap reads fleet logs with an ONNX network, finds where each frame "
        "stands on the prior map, tells what is confirmed, gone or new, and fuses many drives into "
        "the next version of the map.\n\nExit codes: 0 done, 1 findings past a threshold you set, "
        "2 usage, 3 bad or missing input, 4 no answer possible."
    ),
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
group = click.version_option(__version__, prog_name="rtmap")(group)


def main(arguments: list[str] | None = None) -> None:
    """Entry point: errors become one line on stderr and the documented exit code."""
    sys.exit(run(arguments))


def run(arguments: list[str] | None = None) -> int:
    """Run one command line and return its exit code (used by main, demo and tests)."""
    try:
        result = group.main(arguments, prog_name="rtmap", standalone_mode=False)
        return result if isinstance(result, int) else 0
    except click.exceptions.Exit as stop:
        return int(stop.exit_code)
    except click.ClickException as error:
        error.show()
        return 2
    except click.Abort:
        click.echo("rtmap: interrupted", err=True)
        return 130
    except RtmapError as error:
        click.echo(f"rtmap: {error}", err=True)
        return error.exit_code
    except BrokenPipeError:
        # The reader of a pipe (head, jq) went away: that is its right.
        sys.stderr.close()
        return 0
    except OSError as error:
        where = error.filename2 or error.filename or "file system"
        click.echo(f"rtmap: {where}: {error.strerror or error}", err=True)
        return 3
    except Exception as error:
        if os.environ.get("RTMAP_DEBUG"):
            raise
        what = f"{type(error).__name__}: {error}".splitlines()[0]
        hint = "check the input; if it is right this is a bug, RTMAP_DEBUG=1 shows where"
        click.echo(f"rtmap: cannot go on ({what}); {hint}", err=True)
        return 3


if __name__ == "__main__":
    main()
