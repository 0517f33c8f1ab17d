"""One self-describing ONNX model behind one call (docs/model-contract.md)."""

from __future__ import annotations

import hashlib
from typing import Any

from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.model_file import find_model, first_line
from rtmap_cli.steps.infer.contract import (
    ModelInfo,
    check_answer,
    check_graph,
    inputs_of,
    outputs_of,
    read_metadata,
)

__all__ = ["MapModel", "ModelInfo", "find_model"]

NOT_USED = {"TensorrtExecutionProvider", "AzureExecutionProvider"}
"""The first builds an engine for minutes at every new number of prior elements; the second calls
remote services, of which the graph has none."""


class MapModel:
    """An ONNX session that holds a model to its contract: when it is opened its metadata against
    its graph, and every answer against both. ``threads`` work on one call (default: all cores);
    several calls may run at the same time."""

    def __init__(self, name_or_path: str, threads: int | None = None) -> None:
        import onnxruntime as ort

        self.path = find_model(name_or_path)
        content = self.path.read_bytes()
        options = ort.SessionOptions()
        if threads:
            options.intra_op_num_threads = threads
        # Threads that wait long do not burn the cores that decode the next images.
        options.add_session_config_entry("session.intra_op.allow_spinning", "1")
        options.add_session_config_entry("session.intra_op.spin_duration_us", "50")
        options.log_severity_level = 4  # what is fatal is raised as well, in one line
        providers = [p for p in ort.get_available_providers() if p not in NOT_USED]
        # On a CPU a place of its own for every intermediate value is 5 % faster.
        options.enable_mem_reuse = len(providers) > 1
        try:
            self.session = ort.InferenceSession(content, options, providers=providers)
        except Exception as error:  # onnxruntime raises its own untyped errors
            raise BadInput(self.path, f"cannot be loaded as ONNX ({first_line(error)})") from None
        self.on_cpu = self.session.get_providers() == ["CPUExecutionProvider"]
        metadata = self.session.get_modelmeta().custom_metadata_map
        self.info = read_metadata(self.path, metadata, hashlib.sha256(content).hexdigest())
        check_graph(
            self.path,
            self.info,
            {i.name: (i.type, i.shape) for i in self.session.get_inputs()},
            {o.name: (o.type, o.shape) for o in self.session.get_outputs()},
        )
        self._inputs, self._outputs = tuple(inputs_of(self.info)), tuple(outputs_of(self.info))

    def __call__(self, *values: NDArray[Any]) -> dict[str, Any]:
        """Run a batch: images (B, N, H, W, 3) and ego_to_image (B, N, 3, 4), or raster
        (B, K, rows, columns); then prior_points (B, P, V, 2), prior_class and prior_mask (B, P),
        in the order of `inputs_of`.

        Returns the outputs of the contract by name: scores (B, Q, C), points and sigma
        (B, Q, V, 2) in metres, prior_score (B, P), pose_delta (B, 3), pose_covariance (B, 3, 3).
        BadInput when the model cannot run or its answer breaks the contract.
        """
        feed = dict(zip(self._inputs, values, strict=True))
        try:
            answers = self.session.run(list(self._outputs), feed)
        except Exception as error:  # onnxruntime raises its own untyped errors
            raise BadInput(self.path, f"the model cannot run ({first_line(error)})") from None
        out = dict(zip(self._outputs, answers, strict=True))
        check_answer(self.path, self.info, out, *values[-1].shape)
        return out
