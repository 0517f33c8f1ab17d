"""Map elements per frame as JSON: this project's frames, and result files of other networks.

Read, told apart by their content:

* frames: ``{"classes", "range_m", "frames": {"<log>_<timestamp ns>": [{"class", "points",
  "score"}]}}``; truth has no scores;
* MapTR and MapTRv2 results ``{"results": [{"sample_token", "vectors": [{"pts", "cls_name",
  "confidence_level"}]}]}`` and their truth ``{"GTs": […]}``; detections of the fleet benchmark are
  of this kind too;
* StreamMapNet submissions ``{"results": {token: {"vectors", "scores", "labels"}}}``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.maps.element import CLASSES
from rtmap_cli.tables import read_json

Array = NDArray[np.float64]
Found = tuple[str, Array, float]

SUFFIXES = (".json", ".json.gz")


@dataclass(frozen=True)
class MapFrames:
    """Elements (class, points (n, 2) in ego metres, score) by frame key, in file order.

    ``classes`` and ``range_m`` (x_min, y_min, x_max, y_max) are None where the file is silent.
    """

    frames: dict[str, list[Found]]
    classes: list[str] | None = None
    range_m: tuple[float, float, float, float] | None = None


def read_map_frames(path: str | Path, scored: bool) -> MapFrames:
    """Read frames or results; ``scored`` asks for a score in [0, 1] on every element.

    BadInput names the first frame and element that is wrong.
    """
    path = Path(path)
    data = read_json(path)
    if not isinstance(data, dict):
        raise BadInput(path, "is not a JSON object", "see docs/evaluate.md for the formats")
    if isinstance(data.get("frames"), dict):
        return _frames(path, data, scored)
    if isinstance(data.get("GTs"), list):
        return _vectors(path, data, data["GTs"], scored)
    results = data.get("results")
    if isinstance(results, list):
        return _vectors(path, data, results, scored)
    if isinstance(results, dict):
        return _submission(path, results, scored)
    raise BadInput(
        path, "holds neither frames, results nor GTs", "see docs/evaluate.md for the formats"
    )


def _frames(path: Path, data: dict[str, Any], scored: bool) -> MapFrames:
    frames = {}
    for key, elements in data["frames"].items():
        if not isinstance(elements, list):
            raise BadInput(path, f"frame {key} is not a list of elements")
        frames[key] = [
            _element(path, f"frame {key}, element {k}", e, ("class", "points", "score"), scored)
            for k, e in enumerate(elements)
        ]
    classes = data.get("classes")
    if classes is not None and not isinstance(classes, list):
        raise BadInput(path, "classes is not a list")
    return MapFrames(frames, classes and [str(c) for c in classes], _range(path, data))


def _vectors(path: Path, data: dict[str, Any], rows: list[Any], scored: bool) -> MapFrames:
    meta = data.get("meta") if isinstance(data.get("meta"), dict) else {}
    assert meta is not None
    keys = ("cls_name", "pts", "confidence_level")
    frames: dict[str, list[Found]] = {}
    for k, row in enumerate(rows):
        key = _key(path, row, k, meta)
        if key in frames:
            raise BadInput(path, f"frame {key} comes twice")
        vectors = row.get("vectors")
        if not isinstance(vectors, list):
            raise BadInput(path, f"frame {key}: vectors is missing or not a list")
        frames[key] = [
            _element(path, f"frame {key}, vector {n}", v, keys, scored)
            for n, v in enumerate(vectors)
        ]
    names = meta.get("class_names")
    classes = [str(c) for c in names] if isinstance(names, list) else None
    return MapFrames(frames, classes, _range(path, meta))


def _key(path: Path, row: Any, number: int, meta: dict[str, Any]) -> str:
    if not isinstance(row, dict):
        raise BadInput(path, f"result {number} is not an object")
    if "sample_token" in row:
        return str(row["sample_token"])
    if "timestamp_ns" in row and "log_id" in meta:
        return f"{meta['log_id']}_{row['timestamp_ns']}"
    raise BadInput(path, f"result {number} has neither sample_token nor timestamp_ns")


def _submission(path: Path, results: dict[str, Any], scored: bool) -> MapFrames:
    """StreamMapNet: labels are indices of ped_crossing, divider, boundary."""
    frames: dict[str, list[Found]] = {}
    for key, row in results.items():
        lists = [row.get(n) if isinstance(row, dict) else None for n in ("vectors", "labels")]
        scores = row.get("scores") if isinstance(row, dict) else None
        if scores is None and not scored:
            scores = [1.0] * len(lists[0] or [])
        if not all(isinstance(v, list) for v in (*lists, scores)):
            raise BadInput(path, f"frame {key} lacks vectors, labels or scores")
        vectors, labels = lists
        if not len(vectors) == len(labels) == len(scores):  # type: ignore[arg-type]
            raise BadInput(path, f"frame {key}: vectors, labels and scores differ in number")
        frames[key] = []
        for n, (points, label, score) in enumerate(zip(vectors, labels, scores, strict=True)):  # type: ignore[arg-type]
            if label not in range(len(CLASSES)):
                raise BadInput(path, f"frame {key}, vector {n}: unknown label {label}")
            element = {"class": CLASSES[label], "points": points, "score": score}
            where = f"frame {key}, vector {n}"
            frames[key].append(_element(path, where, element, ("class", "points", "score"), scored))
    return MapFrames(frames, list(CLASSES))


def _element(
    path: Path, where: str, element: Any, keys: tuple[str, str, str], scored: bool
) -> Found:
    name_key, points_key, score_key = keys
    if not isinstance(element, dict):
        raise BadInput(path, f"{where} is not an object")
    for key in (name_key, points_key):
        if key not in element:
            raise BadInput(path, f"{where}: {key} is missing")
    try:
        points = np.array(element[points_key], dtype=np.float64)
    except (TypeError, ValueError):
        raise BadInput(path, f"{where}: {points_key} is not a list of [x, y]") from None
    if points.ndim != 2 or points.shape[1] < 2:
        raise BadInput(path, f"{where}: {points_key} is not a list of [x, y]")
    if not np.isfinite(points[:, :2]).all():
        raise BadInput(path, f"{where}: {points_key} is not finite")
    if not scored and len(points) < 2:
        raise BadInput(path, f"{where}: {points_key} has fewer than 2 vertices")
    score = element.get(score_key, None if scored else 1.0)
    if isinstance(score, bool) or not isinstance(score, int | float):
        raise BadInput(path, f"{where}: {score_key} is missing or not a number")
    if not 0 <= score <= 1:
        raise BadInput(path, f"{where}: {score_key} {score} is outside [0, 1]")
    return str(element[name_key]), points[:, :2], float(score)


def _range(path: Path, meta: dict[str, Any]) -> tuple[float, float, float, float] | None:
    value = meta.get("range_m")
    if value is None:
        return None
    try:
        (x0, x1), (y0, y1) = value["x"], value["y"]
        return float(x0), float(y0), float(x1), float(y1)
    except (KeyError, TypeError, ValueError):
        raise BadInput(path, 'range_m is not {"x": [low, high], "y": [low, high]}') from None
