"""How a network is trained: every rate, from the [training] table of its configuration file."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from rtmap_cli.errors import BadInput, UsageError
from rtmap_models.config import CONFIGS
from rtmap_models.data.dataset import Augmentation
from rtmap_models.data.samples import PriorNoise

TABLE = "training"


@dataclass(frozen=True)
class Recipe:
    """AdamW with linear warm-up and a cosine that ends at zero, and averaged weights.

    ``batch`` samples per process and step; ``rate`` the highest learning rate, reached after
    ``warmup`` steps; ``decay`` the weight decay; gradients are cut at norm ``clip``; the averaged
    weights keep a share ``average`` per step. ``precision`` is "fp32", or "bf16" where convolutions
    may run in bfloat16 (projection, sampling and losses stay in float32).
    """

    batch: int = 8
    rate: float = 1.2e-3
    warmup: int = 150
    decay: float = 0.02
    clip: float = 10.0
    average: float = 0.998
    precision: str = "bf16"
    noise: PriorNoise = field(default_factory=PriorNoise)
    augmentation: Augmentation = field(default_factory=Augmentation)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as stored in checkpoints."""
        return asdict(self)

    def problem(self) -> str | None:
        """What cannot be meant, if anything."""
        if self.batch < 1 or self.warmup < 1:
            return "batch and warmup must be at least 1"
        if self.rate <= 0 or self.clip <= 0:
            return "rate and clip must be above 0"
        if self.precision not in ("fp32", "bf16"):
            return "precision must be fp32 or bf16"
        shares = (self.noise.drop, self.noise.fake, self.augmentation.still)
        if not all(0 <= s <= 1 for s in (*shares, self.augmentation.hidden)) or self.average >= 1:
            return "drop, fake, still and hidden are shares of 1, average is below 1"
        spreads = (self.noise.sigma_m, self.noise.sigma_deg, self.noise.margin_m)
        if min(*spreads, *self.augmentation.shift_m, self.augmentation.turn_deg, self.decay) < 0:
            return "standard deviations, margins and decay must not be negative"
        return None


def load_recipe(name: str | Path, settings: Sequence[str] = ()) -> Recipe:
    """The [training] table of a configuration (by name or path, as ``load_config``), changed by
    ``settings`` "KEY=VALUE" with a TOML value, e.g. "noise.sigma_m=2". What is not given keeps its
    default. BadInput for an unknown key or a wrong type in the file, UsageError in ``settings``."""
    path = Path(name) if Path(name).suffix == ".toml" else CONFIGS / f"{name}.toml"
    table: Any = {}
    if path.is_file():  # load_config says what is wrong with the rest of the file
        table = tomllib.loads(path.read_text(encoding="utf-8")).get(TABLE, {})
    try:
        recipe = _changed(Recipe(), table)
    except ValueError as error:
        raise BadInput(path, f"[{TABLE}] {error}", "see docs/train.md") from None
    try:
        for text in settings:
            recipe = _changed(recipe, _setting(text))
    except ValueError as error:
        raise UsageError(f"--set: {error}") from None
    return recipe


def _setting(text: str) -> dict[str, Any]:
    key, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"{text!r} is not KEY=VALUE")
    try:
        return tomllib.loads(f"{key} = {value}")
    except tomllib.TOMLDecodeError:
        return tomllib.loads(f"{key} = {value!r}") if value.isalnum() else _no_value(text)


def _no_value(text: str) -> dict[str, Any]:
    raise ValueError(f"{text!r} has no TOML value")


def _changed(recipe: Recipe, values: Any) -> Recipe:
    out: Recipe = _replaced(recipe, values, "")
    if problem := out.problem():
        raise ValueError(problem)
    return out


def _replaced(old: Any, values: Any, prefix: str) -> Any:
    """A dataclass with some fields replaced by plain values of the same type."""
    if not isinstance(values, Mapping):
        raise ValueError(f"{prefix or TABLE} is not a table")
    known = {f.name for f in fields(old)}
    new = {}
    for key, value in values.items():
        if key not in known:
            raise ValueError(f"{prefix}{key} is unknown; there are {', '.join(sorted(known))}")
        before = getattr(old, key)
        if is_dataclass(before):
            new[key] = _replaced(before, value, f"{prefix}{key}.")
        else:
            new[key] = _fitted(before, value, prefix + key)
    return replace(old, **new)


def _fitted(before: Any, value: Any, name: str) -> Any:
    if isinstance(before, tuple):
        if not isinstance(value, list | tuple) or len(value) != len(before):
            raise ValueError(f"{name} must be a list of {len(before)}")
        return tuple(_fitted(b, v, name) for b, v in zip(before, value, strict=True))
    wanted = (int, float) if isinstance(before, float) else type(before)
    if not isinstance(value, wanted) or isinstance(value, bool) != isinstance(before, bool):
        raise ValueError(f"{name} must be like {before!r}")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{name} must be finite")
    return float(value) if isinstance(before, float) else value
