"""The sizes of a network, read from a TOML file. ``architecture`` says which kind it is."""

from __future__ import annotations

import tomllib
import types
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.semantic import CLASSES, EVIDENCE
from rtmap_cli.maps.element import RING_CLASSES

CONFIGS = Path(__file__).parent / "configs"

WINDOW_MARGIN_M = (6.0, 8.0)
"""How much a kept picture is wider than the range (x, y), so that it can be turned and shifted."""


@dataclass(frozen=True)
class ModelConfig:
    """What every network has: the classes, the range, the queries, the images, the targets."""

    name: str
    architecture: str
    classes: tuple[str, ...]
    range_m: tuple[float, float, float, float]
    vertex_count: int
    new_queries: int
    prior_slots: int
    image_size: tuple[int, int]
    horizon: float
    cell_m: float
    supersample: int

    @property
    def half_range(self) -> tuple[float, float]:
        """Half extent of the range in x and y, metres (the range is centred on the vehicle)."""
        return self.range_m[2], self.range_m[3]

    @property
    def picture_size(self) -> tuple[int, int]:
        """Rows (y) and columns (x) of the bird's-eye picture; targets are half as large."""
        half_x, half_y = self.half_range
        return round(2 * half_y / self.cell_m), round(2 * half_x / self.cell_m)

    @property
    def ring_ids(self) -> tuple[int, ...]:
        """Indices of the classes whose elements are closed rings."""
        return tuple(k for k, name in enumerate(self.classes) if name in RING_CLASSES)

    @property
    def needs_images(self) -> bool:
        """Whether training needs the cameras' images (else bird's-eye pictures are enough)."""
        return False

    @property
    def channels(self) -> int:
        """Planes of the picture that training frames hold."""
        return 4

    @property
    def margin_m(self) -> tuple[float, float]:
        """How much the kept picture is wider than the range on each side, x and y."""
        return WINDOW_MARGIN_M

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as stored in checkpoints."""
        return asdict(self)

    def check(self) -> str | None:
        """What is wrong with the values, if anything."""
        x0, y0, x1, y1 = self.range_m
        if x0 != -x1 or y0 != -y1 or x1 <= 0 or y1 <= 0:
            return "range_m must be centred on the vehicle: [-x, -y, x, y]"
        for name in ("vertex_count", "new_queries", "prior_slots", "supersample"):
            if getattr(self, name) < 1:
                return f"{name} must be at least 1"
        if self.vertex_count < 4 or not self.classes or min(self.image_size) < 1:
            return "it needs a class, 4 vertices per element and an image size"
        return None


@dataclass(frozen=True)
class TinyConfig(ModelConfig):
    """The picture network; see ``configs/rtmap-tiny.toml``."""

    widths: tuple[int, int, int, int]
    fine_width: int
    coarse_width: int
    side_width: int
    field_width: int
    query_width: int
    point_width: int
    heads: int
    layers: int
    image_width: int = 0  # channels of the image features; 0 = the picture is all that is read
    image_heights_m: tuple[float, ...] = ()  # where a 1 m cell looks into the images; () = nowhere
    tilt_sigma: float = 0.0  # slopes that teach the head for pitch and roll; 0 = no such head

    @property
    def needs_images(self) -> bool:
        """The image branch reads images, and the picture is warped as it says."""
        return self.image_width > 0

    def check(self) -> str | None:
        """What is wrong with the values, if anything."""
        if any(size % 8 for size in self.picture_size):
            return "the picture must have multiples of 8 cells: change cell_m"
        if self.image_width < 0 or self.tilt_sigma < 0:
            return "image_width and tilt_sigma must not be negative"
        if (self.image_width > 0) != bool(self.image_heights_m or self.tilt_sigma):
            return "image_width goes with image_heights_m, tilt_sigma or both"
        if self.needs_images and any(size % 8 for size in self.image_size):
            return "image_size must be multiples of 8"
        return super().check()


@dataclass(frozen=True, kw_only=True)
class SemanticConfig(TinyConfig):
    """The vectoriser of semantic rasters; see ``configs/semantic-tiny.toml``.

    ``planes`` are those of a raster in their order, ``raster_cell_m`` its cell and
    ``raster_half_m`` half its extent in x and y. There is no camera: what describes one is idle.
    """

    image_size: tuple[int, int] = (1, 1)
    horizon: float = 0.0
    supersample: int = 1
    planes: tuple[str, ...] = (*CLASSES, EVIDENCE)
    raster_cell_m: float = 0.2
    raster_half_m: tuple[float, float] = (36.0, 18.0)

    @property
    def channels(self) -> int:
        """One per plane of the raster."""
        return len(self.planes)

    @property
    def margin_m(self) -> tuple[float, float]:
        """What the raster shows beyond the range."""
        (x, y), (half_x, half_y) = self.raster_half_m, self.half_range
        return x - half_x, y - half_y

    @property
    def raster_size(self) -> tuple[int, int]:
        """Rows (y) and columns (x) of a raster."""
        x, y = (2 * half / self.raster_cell_m for half in self.raster_half_m)
        return round(y), round(x)

    def check(self) -> str | None:
        """What is wrong with the values, if anything."""
        if self.image_width:
            return "a semantic network reads no images: image_width must be 0"
        if self.raster_cell_m <= 0 or len(set(self.planes)) != len(self.planes):
            return "raster_cell_m must be above 0 and planes must differ"
        if min(self.margin_m) < 0 or any(abs(m / self.cell_m % 1) > 1e-6 for m in self.margin_m):
            return "raster_half_m must exceed the range by whole cells (cell_m)"
        return super().check()


@dataclass(frozen=True)
class PaperConfig(ModelConfig):
    """The network of the RTMap paper; see ``configs/rtmap-r50.toml``.

    The bird's-eye map has cells of 2 · ``cell_m``: the grid of the segmentation targets.
    """

    encoder: str  # "camera" or "raster"
    raster_channels: int  # of the raster encoder's input
    backbone: str  # "resnet18" or "resnet50"
    backbone_width: int  # of its stem; 64 for torchvision's weights
    backbone_norm: str  # "batch" (from scratch) or "frozen" (with weights that the user brings)
    image_stride: int  # pixels per cell of the image features that are lifted: 8, 16 or 32
    image_width: int  # channels of the image features
    heights_m: tuple[float, ...]  # where a bird's-eye cell looks into the images
    bev_blocks: int
    width: int  # channels of the bird's-eye map, of queries and of points
    heads: int
    deform_points: int
    feedforward: int
    layers: int
    dropout: float
    pose: str  # "least_squares" or "learned": which pose the graph answers with
    pre_attribution: bool
    use_nll: bool
    use_pose_loss: bool
    many_queries: int  # one-to-many queries, in training only; 0 = none
    many_repeat: int
    class_weight: float
    manhattan_weight: float
    nll_weight: float
    direction_weight: float
    pose_weight: float
    translation_weight: float
    bev_segmentation_weight: float
    image_segmentation_weight: float
    many_weight: float

    @property
    def needs_images(self) -> bool:
        """The camera encoder reads images; a raster comes as the batch's picture."""
        return self.encoder == "camera"

    @property
    def stages(self) -> int:
        """How many stages of the ResNet reach the image features."""
        return {8: 3, 16: 2, 32: 1}[self.image_stride]

    @property
    def bev_size(self) -> tuple[int, int]:
        """Rows (y) and columns (x) of the bird's-eye map."""
        rows, columns = self.picture_size
        return rows // 2, columns // 2

    def check(self) -> str | None:
        """What is wrong with the values, if anything."""
        choices = {
            "encoder": ("camera", "raster"),
            "backbone": ("resnet18", "resnet50"),
            "backbone_norm": ("batch", "frozen"),
            "pose": ("least_squares", "learned"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                return f"{name} must be one of {', '.join(allowed)}"
        for name in (
            "raster_channels",
            "backbone_width",
            "image_width",
            "width",
            "heads",
            "layers",
        ):
            if getattr(self, name) < 1:
                return f"{name} must be at least 1"
        if self.width % self.heads or not self.heights_m or self.deform_points < 1:
            return "width must be a multiple of heads; a height and a deform point are needed"
        if any(size % 32 for size in self.image_size) or self.image_stride not in (8, 16, 32):
            return "image_size must be multiples of 32, image_stride 8, 16 or 32"
        if any(size % 4 for size in self.picture_size):
            return "the picture must have multiples of 4 cells: change cell_m"
        return super().check()


KINDS: dict[str, type[ModelConfig]] = {
    "tiny": TinyConfig,
    "semantic": SemanticConfig,
    "paper": PaperConfig,
}


def config_from_dict(values: dict[str, Any], where: str | Path = "configuration") -> ModelConfig:
    """A configuration from plain values; BadInput when a key is missing, unknown or of a wrong
    type. Without ``architecture`` it is "tiny" (checkpoints of earlier versions)."""
    values = {"architecture": "tiny"} | values
    kind = KINDS.get(str(values["architecture"]))
    if kind is None:
        raise BadInput(where, "unknown architecture", f"use one of {', '.join(KINDS)}")
    known = {f.name: f for f in fields(kind)}
    needed = {k for k, f in known.items() if f.default is MISSING}
    if odd := sorted((set(values) - set(known)) | (needed - set(values))):
        like = "rtmap-r50.toml" if kind is PaperConfig else "rtmap-tiny.toml"
        raise BadInput(where, f"missing or unknown keys: {', '.join(odd)}", f"see {like}")
    plain: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    hints = get_type_hints(kind)
    if wrong := [k for k, v in plain.items() if not _fits(v, hints[k])]:
        raise BadInput(where, f"{wrong[0]} has a value of a wrong type", f"it is {hints[wrong[0]]}")
    config = kind(**plain)
    if problem := config.check():
        raise BadInput(where, problem, "change the configuration")
    return config


def _fits(value: Any, hint: Any) -> bool:
    """Whether a plain value is of an annotated type (plain types, unions and tuples of them)."""
    if get_origin(hint) is tuple:
        if not isinstance(value, tuple):
            return False
        parts = get_args(hint)
        if parts[-1] is Ellipsis:
            return all(_fits(v, parts[0]) for v in value)
        return len(value) == len(parts) and all(map(_fits, value, parts))
    if isinstance(hint, types.UnionType):
        return any(_fits(value, h) for h in get_args(hint))
    if isinstance(value, bool) or hint is bool:
        return isinstance(value, bool) and hint is bool
    return isinstance(value, (int, float) if hint is float else hint)


def load_config(name: str | Path = "rtmap-tiny") -> ModelConfig:
    """Read a configuration by name (in ``configs/``) or by path.

    A key ``base`` names another one there: what the file does not say is as there.
    """
    values, path = _read_values(name)
    values.pop("training", None)  # how to train it, not what it is: rtmap_models.training.recipe
    if (base := values.pop("base", None)) is not None:
        values = load_config(CONFIGS / f"{base}.toml").to_dict() | values
    return config_from_dict(values, path)


def _read_values(name: str | Path) -> tuple[dict[str, Any], Path]:
    path = Path(name)
    if path.suffix != ".toml":
        path = CONFIGS / f"{name}.toml"
    if not path.is_file():
        have = ", ".join(sorted(p.stem for p in CONFIGS.glob("*.toml")))
        raise BadInput(path, "no such configuration", f"use one of {have} or a .toml file")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8")), path
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise BadInput(path, f"not TOML: {error}", "mend the file") from error
