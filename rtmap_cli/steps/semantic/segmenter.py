"""Masks by a segmentation network of the user's: any ONNX file with one image input."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.model_file import first_line
from rtmap_cli.logs.log import Camera, Frame
from rtmap_cli.logs.native import decode_image
from rtmap_cli.logs.semantic import CLASSES
from rtmap_cli.steps.semantic.labels import IGNORE, Labels
from rtmap_cli.steps.semantic.masks import Mask

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet, in RGB of 0 … 1: what nearly every float network was trained with."""


class Segmenter:
    """A session that turns images into classes of the ground.

    The input is (1, 3, H, W) or (1, H, W, 3): float32 (normalised by ``mean`` and ``std`` of the
    label list's ``input``, ImageNet's by default) or uint8 (as it is). Where the graph leaves H and
    W open, ``input.size`` [H, W] of the label list or the image's own size counts. The output is
    scores (1, C, h, w) or label numbers (1, h, w) or (1, 1, h, w). Scores of labels that mean one
    class are added (as probabilities) before the likeliest class is taken. BadInput when the model
    breaks this, or has another number of labels than the list.
    """

    def __init__(self, path: Path, labels: Labels, threads: int | None = None) -> None:
        import onnxruntime as ort

        if not path.is_file():
            raise BadInput(path, "no such model file")
        options = ort.SessionOptions()
        options.log_severity_level = 4  # what is fatal is raised as well, in one line
        if threads:
            options.intra_op_num_threads = threads
        try:
            self.session = ort.InferenceSession(
                path.read_bytes(), options, providers=["CPUExecutionProvider"]
            )
        except OSError:
            raise
        except Exception as error:  # onnxruntime raises its own untyped errors
            raise BadInput(path, f"cannot be loaded as ONNX ({first_line(error)})") from None
        self.path, self.labels = path, labels
        inputs = self.session.get_inputs()
        if len(inputs) != 1 or len(inputs[0].shape) != 4 or 3 not in inputs[0].shape[1::2]:
            raise BadInput(path, "does not take one image (1, 3, H, W) or (1, H, W, 3)")
        self._name, shape, self._type = inputs[0].name, inputs[0].shape, inputs[0].type
        if self._type not in ("tensor(float)", "tensor(uint8)"):
            raise BadInput(path, f"takes {self._type}, not float32 or uint8")
        self._first = shape[1] == 3
        fixed = shape[2:] if self._first else shape[1:3]
        self._size = self._input_size(fixed)
        self._mean, self._std = (self._three(k, v) for k, v in (("mean", MEAN), ("std", STD)))
        if (self._std <= 0).any():
            raise BadInput(labels.path, "input.std is not above 0")
        self._groups = np.zeros((len(CLASSES) + 1, len(labels)), np.float32)
        group = np.where(labels.classes == IGNORE, len(CLASSES), labels.classes)
        self._groups[group, np.arange(len(labels))] = 1.0

    def read(self, frame: Frame, camera: Camera) -> Mask | None:
        """See `Masks`."""
        from PIL import Image

        if camera.name not in frame.images:
            return None
        image = decode_image(frame.images[camera.name])
        if image.shape[:2] != (camera.height, camera.width):
            raise BadInput(frame.images[camera.name], "has another size than its camera states")
        height, width = self._size or image.shape[:2]
        if (height, width) != image.shape[:2]:
            image = np.asarray(
                Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR)
            )
        values: NDArray[Any] = image
        if self._type == "tensor(float)":
            values = ((image.astype(np.float32) / 255 - self._mean) / self._std).astype(np.float32)
        if self._first:
            values = np.ascontiguousarray(values.transpose(2, 0, 1))
        try:
            answer = self.session.run(None, {self._name: values[None]})[0]
        except Exception as error:  # onnxruntime raises its own untyped errors
            raise BadInput(self.path, f"the model cannot run ({first_line(error)})") from None
        return self._classes(np.asarray(answer))

    def _classes(self, answer: NDArray[Any]) -> Mask:
        """(h, w) classes of an answer of the network."""
        number, what = len(self.labels), self.labels.path
        if answer.ndim == 4 and answer.shape[1] > 1:
            if answer.shape[1] != number:
                raise BadInput(
                    self.path, f"answers with {answer.shape[1]} labels, {what} lists {number}",
                    "give the list that the model was trained with: --labels",
                )  # fmt: skip
            scores = answer[0].reshape(number, -1).astype(np.float32)
            scores = np.exp(scores - scores.max(axis=0))
            best = np.argmax(self._groups @ scores, axis=0).astype(np.uint8)
            best[best == len(CLASSES)] = IGNORE
            return best.reshape(answer.shape[2:])
        if answer.ndim not in (3, 4):
            raise BadInput(self.path, f"answers with {answer.shape}, not scores or label numbers")
        numbers = answer.reshape(answer.shape[-2:]).astype(np.int64)
        if numbers.min() < 0 or numbers.max() >= number:
            raise BadInput(
                self.path, f"answers with label {numbers.max()}, {what} lists {number}",
                "give the list that the model was trained with: --labels",
            )  # fmt: skip
        return self.labels.classes[numbers]

    def _input_size(self, fixed: list[Any]) -> tuple[int, int] | None:
        """(H, W) of the input: the graph's, else the label list's, else None (the image's)."""
        if all(isinstance(v, int) and v > 0 for v in fixed):
            return int(fixed[0]), int(fixed[1])
        size = self.labels.settings.get("size")
        if size is None:
            return None
        if not (isinstance(size, list) and len(size) == 2 and all(type(v) is int for v in size)):
            raise BadInput(self.labels.path, "input.size is not [height, width]")
        if min(size) < 1 or max(size) > 16_384:
            raise BadInput(self.labels.path, f"input.size {size} is no size of an image")
        return size[0], size[1]

    def _three(self, key: str, default: tuple[float, ...]) -> NDArray[np.float32]:
        """mean or std: three numbers."""
        try:
            values = np.asarray(self.labels.settings.get(key, default), np.float32)
        except (TypeError, ValueError):
            values = np.zeros(0, np.float32)
        if values.shape != (3,) or not np.isfinite(values).all():
            raise BadInput(self.labels.path, f"input.{key} is not three numbers (RGB, of 0 to 1)")
        return values
