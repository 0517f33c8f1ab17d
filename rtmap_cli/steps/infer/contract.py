"""What a model must be (docs/model-contract.md), checked when it is opened and when it answers."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtmap_cli.errors import BadInput
from rtmap_cli.maps.crop import Range
from rtmap_cli.maps.element import CLASSES
from rtmap_cli.maps.footprint import METADATA_KEY, NOTHING_KNOWN, Footprint, read_footprint
from rtmap_cli.steps.infer.rasters import RasterSpec

EXPORT_IT = "export it with rtmap export-model (docs/model-contract.md)"

MEANINGS = {
    "rtmap.units": "metres",
    "rtmap.axis_order": "x forward, y left",
    "rtmap.ground": "z = 0",
    "rtmap.sigma": "standard deviation, metres",
}
"""Metadata with one allowed value: everything behind the model counts on it."""


RASTER_KEY = "rtmap.raster"
"""Metadata of a model that reads semantic rasters: their planes, cell and half extent."""

SCORE_SLACK = 1e-3
"""What rounding may carry scores beyond 0 … 1."""

UINT8, FLOAT, INT64 = "tensor(uint8)", "tensor(float)", "tensor(int64)"

Axis = int | str
Value = tuple[str, Sequence[Any]]  # element type, shape as onnxruntime gives them


@dataclass(frozen=True)
class ModelInfo:
    """What a model says about itself in its metadata."""

    name: str
    sha256: str
    classes: list[str]
    range_m: Range
    vertex_count: int
    prior_slots: int
    image_size: tuple[int, int]
    horizon: float
    footprint: Footprint = NOTHING_KNOWN
    raster: RasterSpec | None = None  # what it reads in place of images


def inputs_of(info: ModelInfo) -> dict[str, tuple[str, tuple[Axis, ...]]]:
    """Element type and shape of every input; letters are dynamic axes."""
    height, width = info.image_size
    seen: dict[str, tuple[str, tuple[Axis, ...]]] = {
        "images": (UINT8, ("B", "N", height, width, 3)),
        "ego_to_image": (FLOAT, ("B", "N", 3, 4)),
    }
    if info.raster is not None:
        seen = {"raster": (UINT8, ("B", *info.raster.shape))}
    return seen | {
        "prior_points": (FLOAT, ("B", "P", info.vertex_count, 2)),
        "prior_class": (INT64, ("B", "P")),
        "prior_mask": (FLOAT, ("B", "P")),
    }


def outputs_of(info: ModelInfo) -> dict[str, tuple[str, tuple[Axis, ...]]]:
    """Element type and shape of every output; Q = new queries + P."""
    return {
        "scores": (FLOAT, ("B", "Q", len(info.classes))),
        "points": (FLOAT, ("B", "Q", info.vertex_count, 2)),
        "sigma": (FLOAT, ("B", "Q", info.vertex_count, 2)),
        "prior_score": (FLOAT, ("B", "P")),
        "pose_delta": (FLOAT, ("B", 3)),
        "pose_covariance": (FLOAT, ("B", 3, 3)),
    }


def read_metadata(path: Path, metadata: Mapping[str, str], sha256: str) -> ModelInfo:
    """What the metadata of a model say; BadInput when a key is missing or makes no sense."""

    def need(key: str) -> str:
        if key not in metadata:
            raise BadInput(path, f"the model's metadata lacks {key}", EXPORT_IT)
        return metadata[key]

    def whole(key: str, least: int) -> int:
        value = int(need(key))
        if value < least:
            raise ValueError(f"{key} is {value}, at least {least} is needed")
        return value

    for key, meaning in MEANINGS.items():
        if need(key) != meaning:
            raise BadInput(path, f"{key} is {metadata[key]!r}, not {meaning!r}", EXPORT_IT)
    try:
        box = json.loads(need("rtmap.range_m"))
        raster = _raster(json.loads(metadata.get(RASTER_KEY, "null")))
        info = ModelInfo(
            name=need("rtmap.model_name"),
            sha256=sha256,
            classes=[str(c) for c in json.loads(need("rtmap.classes"))],
            range_m=(box["x"][0], box["y"][0], box["x"][1], box["y"][1]),
            vertex_count=whole("rtmap.vertex_count", 2),
            prior_slots=whole("rtmap.prior_slots", 1),
            image_size=_pair(json.loads(need("rtmap.image_size"))) if raster is None else (1, 1),
            horizon=float(need("rtmap.horizon")) if raster is None else 0.0,
            footprint=read_footprint(json.loads(metadata.get(METADATA_KEY, "null"))),
            raster=raster,
        )
        _sensible(info)
    except (ValueError, TypeError, KeyError, IndexError) as error:
        raise BadInput(path, f"the model's metadata make no sense ({error})", EXPORT_IT) from None
    return info


def _raster(values: Any) -> RasterSpec | None:
    if values is None:
        return None
    half_x, half_y = values["half_m"]
    spec = RasterSpec(
        tuple(str(p) for p in values["planes"]), float(values["cell_m"]), half_x, half_y
    )
    if min(spec.cell, half_x, half_y) <= 0 or len(set(spec.planes)) != len(spec.planes):
        raise ValueError(f"{RASTER_KEY} is {values}")
    return spec


def _pair(values: Any) -> tuple[int, int]:
    height, width = values
    return int(height), int(width)


def _sensible(info: ModelInfo) -> None:
    x0, y0, x1, y1 = (float(v) for v in info.range_m)
    if not all(map(math.isfinite, (x0, y0, x1, y1))) or x0 >= x1 or y0 >= y1:
        raise ValueError(f"rtmap.range_m spans {x0:g} … {x1:g} by {y0:g} … {y1:g} m")
    if info.raster is not None and (unknown := sorted(set(info.classes) - set(CLASSES))):
        raise ValueError(f"rtmap.classes has {unknown[0]}, maps have {', '.join(CLASSES)}")
    if not info.classes or len(set(info.classes)) != len(info.classes):
        raise ValueError(f"rtmap.classes are {', '.join(info.classes) or 'none'}")
    if min(info.image_size) < 1 or not 0 <= info.horizon <= 1:
        raise ValueError(f"image {info.image_size} with its horizon at {info.horizon:g}")


def check_graph(
    path: Path, info: ModelInfo, inputs: Mapping[str, Value], outputs: Mapping[str, Value]
) -> None:
    """Hold the graph's inputs and outputs (type and shape by name) against the metadata.

    A model whose metadata lie would fail late or, worse, answer nonsense. BadInput names the
    first thing that does not fit.
    """
    extra = sorted(set(inputs) - set(inputs_of(info)))
    for kind, wanted, given in (
        ("input", inputs_of(info), inputs),
        ("output", outputs_of(info), outputs),
    ):
        for name, (element, shape) in wanted.items():
            if name not in given:
                raise BadInput(path, f"the model has no {kind} {name}", EXPORT_IT)
            have_element, have = given[name]
            if have_element != element:
                what = f"{kind} {name} is {have_element}, not {element}"
                raise BadInput(path, what, EXPORT_IT)
            if not _fits(shape, have):
                what = f"{kind} {name} has the shape {_text(have)}, its metadata say {_text(shape)}"
                raise BadInput(path, what, EXPORT_IT)
    if extra:
        raise BadInput(path, f"the model wants an input {extra[0]} that nobody gives", EXPORT_IT)


def _fits(shape: Sequence[Axis], have: Sequence[Any]) -> bool:
    """Numbers must agree; dynamic axes (letters) must not be numbers; unknown axes may pass."""
    return len(have) == len(shape) and all(
        not isinstance(h, int) or (isinstance(w, int) and h == w)
        for w, h in zip(shape, have, strict=True)
    )


def _text(shape: Sequence[Any]) -> str:
    return "×".join("?" if axis is None else str(axis).replace(" ", "") for axis in shape)


def check_answer(
    path: Path, info: ModelInfo, out: Mapping[str, Any], batch: int, slots: int
) -> None:
    """Hold an answer (arrays by name) against the contract: shapes, finite numbers, scores in
    0 … 1, standard deviations not negative. BadInput names the first output that breaks it."""
    queries = out["scores"].shape[1] if out["scores"].ndim > 1 else 0
    axes: dict[Axis, int] = {"B": batch, "P": slots, "Q": max(queries, slots)}
    for name, (_, shape) in outputs_of(info).items():
        value = out[name]
        wanted = tuple(axes.get(axis, axis) for axis in shape)
        if value.shape != wanted:
            what = f"answers {name} of the shape {_text(value.shape)} instead of {_text(wanted)}"
            raise BadInput(path, what, EXPORT_IT)
        if not np.isfinite(value).all():
            raise BadInput(
                path,
                f"answers {name} that are not finite numbers",
                "check the model, and the calibration with rtmap check-log",
            )
    for name in ("scores", "prior_score"):
        low, high = float(out[name].min(initial=0.0)), float(out[name].max(initial=0.0))
        if low < -SCORE_SLACK or high > 1.0 + SCORE_SLACK:
            worst = low if low < -SCORE_SLACK else high
            raise BadInput(path, f"answers {name} of {worst:.3g}, outside 0 … 1", EXPORT_IT)
    if float(out["sigma"].min(initial=0.0)) < 0:
        raise BadInput(path, "answers sigma below 0", EXPORT_IT)
