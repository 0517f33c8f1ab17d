"""rtmap picture: the cameras of one frame with lines that lie on the road."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options

if TYPE_CHECKING:
    from rtmap_cli.logs.log import Frame, Log
    from rtmap_cli.maps.element import VectorMap
    from rtmap_cli.steps.infer.model import ModelInfo
    from rtmap_cli.steps.picture import GroundLine, View


@click.command("picture")
@click.argument("log_path", metavar="LOG", type=str)
@options.output("The picture to write (.png or .jpg).")
@click.option("--frame", "number", type=int, help="Number of the frame (default: the first).")
@click.option("--grid", is_flag=True, help="Draw range, 5 m and 1 m lines and the axes.")
@click.option("--map", "map_path", type=options.PATH, help="Draw this map around the frame.")
@options.map_version
@click.option("--run", "run_path", type=options.PATH, help="Draw what this run saw in the frame.")
@click.option(
    "--score-threshold",
    type=options.FiniteRange(0, 1),
    default=0.3,
    show_default=True,
    help="Leave out what the run saw below this score.",
)
@click.option("--as-seen", metavar="MODEL", help="The images as this model gets them.")
@click.option(
    "--width", type=click.IntRange(64), default=800, show_default=True, help="Of one image, pixels."
)
@options.overwrite
@options.as_json
def command(
    log_path: str,
    output: Path,
    number: int | None,
    grid: bool,
    map_path: Path | None,
    map_version: int | None,
    run_path: Path | None,
    score_threshold: float,
    as_seen: str | None,
    width: int,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Show the cameras of one frame of LOG, with a grid, a map or detections drawn on the road.

    A grid that follows the lane lines shows that calibration, lens and poses are read as meant.
    All lines lie on the plane that infer takes for the road: how it slopes tell the heights of the
    map, else those of the log's path.

    \b
    Example:
      rtmap picture logs/monday --frame 3 --grid -o grid.png
    """
    from rtmap_cli.errors import BadInput, UsageError
    from rtmap_cli.logs.open import notes_of, open_log
    from rtmap_cli.maps.crop import DEFAULT_RANGE
    from rtmap_cli.maps.store import read_map
    from rtmap_cli.output import emit, log
    from rtmap_cli.steps.infer import MapModel
    from rtmap_cli.steps.infer.levelling import RoadUnder
    from rtmap_cli.steps.picture import draw_views, grid_lines
    from rtmap_cli.tables import refuse_existing, refuse_inside, whole_file

    if output.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise BadInput(output, "is not the name of a picture", "end it in .png or .jpg")
    refuse_existing(output, overwrite)
    source = open_log(log_path)
    refuse_inside(output, source.path if source.path.is_dir() else None, map_path, run_path)
    for note in notes_of(source):
        log(f"{source.log_id}: {note}")
    frame = _frame(source, number)
    model = MapModel(as_seen).info if as_seen else None
    if model is not None and model.raster is not None:
        raise UsageError(f"--as-seen: {model.name} reads rasters, see overview.png beside them")
    vector_map = read_map(map_path, map_version) if map_path is not None else None
    road = RoadUnder([f.map_SE3_ego for f in source.frames()], vector_map)
    views = _views(source, frame, road.plane(frame.map_SE3_ego), model, width)
    lines = grid_lines(model.range_m if model else DEFAULT_RANGE) if grid else []
    if vector_map is not None:
        lines += _of_map(source, frame, vector_map, str(map_path))
    if run_path is not None:
        lines += _of_run(source, frame, run_path, score_threshold)
    picture = draw_views(views, lines, f"{source.log_id}, frame {frame.index}")
    with whole_file(output) as temporary:
        picture.save(temporary, "PNG" if output.suffix.lower() == ".png" else "JPEG")
    result = {"picture": str(output), "frame": frame.index, "cameras": [v.name for v in views]}
    emit(result, as_json, [f"{output}: frame {frame.index}, {len(views)} cameras"])


def _frame(log: Log, number: int | None) -> Frame:
    from rtmap_cli.errors import BadInput

    found = [f for f in log.frames() if number in (None, f.index)]
    if not found:
        raise BadInput(log.path, f"has no frame {number}")
    return found[0]


def _views(log: Log, frame: Frame, plane: Any, model: ModelInfo | None, width: int) -> list[View]:
    """The images of a frame, as they are stored or as a model gets them; ``plane`` (3,): z of the
    road above the place under the vehicle is a x + b y + c."""
    from rtmap_cli.errors import BadInput

    cameras = [c for c in log.rig or () if c.name in frame.images]
    if not cameras:
        raise BadInput(log.path, f"frame {frame.index} has no images with calibration")
    shown = [
        _seen(log, frame, plane, c, model) if model else _stored(log, frame, plane, c)
        for c in cameras
    ]
    return [_scaled(view, width) for view in shown]


def _stored(log: Log, frame: Frame, plane: Any, camera: Any) -> View:
    """The image as it lies on disk, lens and all."""
    import numpy as np
    from PIL import Image

    from rtmap_cli.geometry.poses import invert, transform
    from rtmap_cli.logs.native import decode_image
    from rtmap_cli.steps.picture import View

    motion = frame.ego_SE3_exposure.get(camera.name, np.eye(4))
    camera_SE3_ego = invert(motion @ camera.ego_SE3_camera)
    pixels = decode_image(frame.images[camera.name])
    ratio = np.array(pixels.shape[1::-1]) / [camera.width, camera.height]

    def project(points: Any) -> Any:
        lifted = np.array(points, np.float64)
        lifted[:, 2] += log.ground_z + points[:, :2] @ plane[:2] + plane[2]
        return (camera.project(transform(camera_SE3_ego, lifted)) + 0.5) * ratio - 0.5

    return View(camera.name, Image.fromarray(pixels), project)


def _seen(log: Log, frame: Frame, plane: Any, camera: Any, model: ModelInfo) -> View:
    """The image and the projection that a model is given."""
    import numpy as np
    from PIL import Image

    from rtmap_cli.geometry.cameras import levelled
    from rtmap_cli.steps.infer.images import FittedCamera
    from rtmap_cli.steps.picture import View

    fitted = FittedCamera(camera, model.image_size, model.horizon, log.ground_z)
    matrix = levelled(fitted.at(frame.ego_SE3_exposure.get(camera.name)), plane)

    def project(points: Any) -> Any:
        u = points @ matrix[:, :3].T + matrix[:, 3]
        ahead = u[:, 2] > 0.1
        return np.where(ahead[:, None], u[:, :2] / np.where(ahead, u[:, 2], 1.0)[:, None], np.nan)

    return View(camera.name, Image.fromarray(fitted.load(frame.images[camera.name])), project)


def _scaled(view: View, width: int) -> View:
    """A view at another width in pixels."""
    from PIL import Image

    from rtmap_cli.steps.picture import View

    scale = width / view.image.size[0]
    size = (width, max(1, round(view.image.size[1] * scale)))
    image = view.image.resize(size, Image.Resampling.BILINEAR)
    return View(view.name, image, lambda p: (view.project(p) + 0.5) * scale - 0.5)


def _of_map(log: Log, frame: Frame, vector_map: VectorMap, where: str) -> list[GroundLine]:
    """The map around the frame's initial pose, on the plane of the road."""
    from rtmap_cli.maps.crop import MapIndex
    from rtmap_cli.maps.crs import check_same_crs
    from rtmap_cli.steps.picture import element_lines

    check_same_crs(vector_map.crs, log.crs, where)
    local = MapIndex(vector_map).crop(frame.map_SE3_ego)
    return element_lines([e.class_name for e in local], [e.points[:, :2] for e in local])


def _of_run(log: Log, frame: Frame, path: Path, threshold: float) -> list[GroundLine]:
    """What a run says of the frame, on the plane of the road: confirmed and new elements where it
    saw them, outdated ones where the map has them."""
    import numpy as np

    from rtmap_cli.errors import BadInput
    from rtmap_cli.geometry.poses import invert, se3_from_xyyaw, transform, xyyaw_of
    from rtmap_cli.logs.run import MATCHED, NEW, OUTDATED
    from rtmap_cli.logs.run_files import read_run
    from rtmap_cli.steps.picture import element_lines

    run = read_run(path)
    if run.log_id != log.log_id:
        raise BadInput(path, f"is the run of {run.log_id}, not of {log.log_id}")
    o = run.observations
    if frame.index not in run.frames.frame:
        raise BadInput(path, f"has no frame {frame.index}")
    here = o.frame == frame.index
    gone = o.select(here & (o.state == OUTDATED) & np.isfinite(o.prior_points).all(axis=(1, 2)))
    ego_SE3_map = invert(se3_from_xyyaw(*xyyaw_of(frame.map_SE3_ego)))
    places = [transform(ego_SE3_map, np.asarray(p)) for p in gone.prior_points]
    lines = element_lines(list(gone.class_name), places, "outdated")
    for state, name in ((MATCHED, "confirmed"), (NEW, "new")):
        seen = o.select(here & (o.state == state) & (o.score >= threshold))
        lines += element_lines(list(seen.class_name), list(seen.points), name)
    return lines
