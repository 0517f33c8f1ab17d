"""One self-describing ONNX model behind one call (docs/model-contract.md)."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.maps.crop import Range

INPUTS = ("images", "ego_to_image", "prior_points", "prior_class", "prior_mask")
OUTPUTS = ("scores", "points", "sigma", "prior_score", "pose_delta", "pose_covariance")


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


def find_model(name_or_path: str) -> Path:
    """A file, or a model of the zoo by its name."""
    path = Path(name_or_path)
    if path.suffix == ".onnx":
        if not path.exists():
            raise BadInput(path, "no such model file")
        return path
    from importlib.util import find_spec

    spec = find_spec("rtmap_models")
    zoo = Path(spec.origin).parent / "zoo" if spec and spec.origin else Path("zoo")
    known = sorted(p.stem for p in zoo.glob("*.onnx"))
    if name_or_path not in known:
        names = ", ".join(known) or "none"
        raise BadInput(name_or_path, "no such model", f"in the zoo: {names}; or give a .onnx file")
    return zoo / f"{name_or_path}.onnx"


def _describe(path: Path, metadata: dict[str, str], sha256: str) -> ModelInfo:
    def need(key: str) -> str:
        if key not in metadata:
            raise BadInput(
                path,
                f"the model's metadata lacks {key}",
                "export it with rtmap export-model (docs/model-contract.md)",
            )
        return metadata[key]

    try:
        box = json.loads(need("rtmap.range_m"))
        if need("rtmap.units") != "metres" or need("rtmap.axis_order") != "x forward, y left":
            raise BadInput(path, "units or axis order are not metres, x forward, y left")
        height, width = json.loads(need("rtmap.image_size"))
        return ModelInfo(
            name=need("rtmap.model_name"),
            sha256=sha256,
            classes=[str(c) for c in json.loads(need("rtmap.classes"))],
            range_m=(box["x"][0], box["y"][0], box["x"][1], box["y"][1]),
            vertex_count=int(need("rtmap.vertex_count")),
            prior_slots=int(need("rtmap.prior_slots")),
            image_size=(int(height), int(width)),
            horizon=float(need("rtmap.horizon")),
        )
    except (ValueError, TypeError, KeyError, IndexError) as error:
        raise BadInput(path, f"the model's metadata does not fit ({error})") from None


class MapModel:
    """An ONNX session that checks its contract when it is opened."""

    def __init__(self, name_or_path: str, threads: int | None = None) -> None:
        import onnxruntime as ort

        path = find_model(name_or_path)
        content = path.read_bytes()
        options = ort.SessionOptions()
        if threads:
            options.intra_op_num_threads = threads
        options.log_severity_level = 3
        try:
            self.session = ort.InferenceSession(
                content, options, providers=ort.get_available_providers()
            )
        except Exception as error:  # onnxruntime raises its own untyped errors
            first = str(error).splitlines()[0]
            raise BadInput(path, f"cannot be loaded as ONNX ({first})") from None
        metadata = self.session.get_modelmeta().custom_metadata_map
        self.info = _describe(path, metadata, hashlib.sha256(content).hexdigest())
        for kind, names, have in (
            ("input", INPUTS, {i.name for i in self.session.get_inputs()}),
            ("output", OUTPUTS, {o.name for o in self.session.get_outputs()}),
        ):
            missing = [n for n in names if n not in have]
            if missing:
                raise BadInput(path, f"the model has no {kind} {missing[0]}")

    def __call__(
        self,
        images: NDArray[np.uint8],
        ego_to_image: NDArray[np.float32],
        prior_points: NDArray[np.float32],
        prior_class: NDArray[np.int64],
        prior_mask: NDArray[np.float32],
    ) -> dict[str, Any]:
        """Run a batch: images (B, N, H, W, 3), ego_to_image (B, N, 3, 4), prior_points
        (B, P, V, 2), prior_class and prior_mask (B, P). Returns the outputs of the contract by
        name: scores (B, Q, C), points and sigma (B, Q, V, 2) in metres, prior_score (B, P),
        pose_delta (B, 3), pose_covariance (B, 3, 3)."""
        values = (images, ego_to_image, prior_points, prior_class, prior_mask)
        out = self.session.run(list(OUTPUTS), dict(zip(INPUTS, values, strict=True)))
        return dict(zip(OUTPUTS, out, strict=True))
