"""The sizes of a network, read from a TOML file."""

from __future__ import annotations

import tomllib
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from rtmap_cli.errors import BadInput
from rtmap_cli.maps.element import RING_CLASSES

CONFIGS = Path(__file__).parent / "configs"


@dataclass(frozen=True)
class ModelConfig:
    """Everything that fixes the shape of a network; see ``configs/rtmap-tiny.toml``."""

    name: str
    classes: tuple[str, ...]
    range_m: tuple[float, float, float, float]
    vertex_count: int
    new_queries: int
    prior_slots: int
    image_size: tuple[int, int]
    horizon: float
    cell_m: float
    supersample: int
    widths: tuple[int, int, int, int]
    fine_width: int
    coarse_width: int
    query_width: int
    point_width: int
    heads: int
    layers: int

    @property
    def half_range(self) -> tuple[float, float]:
        """Half extent of the range in x and y, metres (the range is centred on the vehicle)."""
        return self.range_m[2], self.range_m[3]

    @property
    def picture_size(self) -> tuple[int, int]:
        """Rows (y) and columns (x) of the bird's-eye picture."""
        half_x, half_y = self.half_range
        return round(2 * half_y / self.cell_m), round(2 * half_x / self.cell_m)

    @property
    def ring_ids(self) -> tuple[int, ...]:
        """Indices of the classes whose elements are closed rings."""
        return tuple(k for k, name in enumerate(self.classes) if name in RING_CLASSES)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as stored in checkpoints."""
        return asdict(self)


def config_from_dict(values: dict[str, Any], where: str | Path = "configuration") -> ModelConfig:
    """A configuration from plain values; BadInput when a key is missing or unknown."""
    known = {f.name for f in fields(ModelConfig)}
    if set(values) != known:
        odd = sorted(set(values) ^ known)
        raise BadInput(where, f"missing or unknown keys: {', '.join(odd)}", "see rtmap-tiny.toml")
    plain: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    config = ModelConfig(**plain)
    x0, y0, x1, y1 = config.range_m
    if x0 != -x1 or y0 != -y1 or x1 <= 0 or y1 <= 0:
        raise BadInput(where, "range_m must be centred on the vehicle", "give [-x, -y, x, y]")
    if any(size % 16 for size in config.picture_size):
        raise BadInput(where, "the picture must have multiples of 16 cells", "change cell_m")
    return config


def load_config(name: str | Path = "rtmap-tiny") -> ModelConfig:
    """Read a configuration by name (in ``configs/``) or by path."""
    path = Path(name)
    if path.suffix != ".toml":
        path = CONFIGS / f"{name}.toml"
    if not path.is_file():
        have = ", ".join(sorted(p.stem for p in CONFIGS.glob("*.toml")))
        raise BadInput(path, "no such configuration", f"use one of {have} or a .toml file")
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise BadInput(path, f"not TOML: {error}", "mend the file") from error
    return config_from_dict(values, path)
