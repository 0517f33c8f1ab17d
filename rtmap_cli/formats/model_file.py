"""Model files: which one a name means, and what one says about itself without being run."""

from __future__ import annotations

from pathlib import Path

from rtmap_cli.errors import BadInput


def find_model(name_or_path: str) -> Path:
    """A file, or a model of the zoo by its name."""
    path = Path(name_or_path)
    if path.suffix == ".onnx":
        if not path.is_file():
            raise BadInput(path, "no such model file")
        return path
    zoo = zoo_models()
    if name_or_path not in zoo:
        names = ", ".join(zoo) or "none"
        raise BadInput(name_or_path, "no such model", f"in the zoo: {names}; or give a .onnx file")
    return zoo[name_or_path]


def zoo_models() -> dict[str, Path]:
    """The shipped models by name."""
    from importlib.util import find_spec

    spec = find_spec("rtmap_models")
    zoo = Path(spec.origin).parent / "zoo" if spec and spec.origin else Path("zoo")
    return {p.stem: p for p in sorted(zoo.glob("*.onnx"))}


def read_model_metadata(path: Path) -> dict[str, str]:
    """``custom_metadata_map`` of an ONNX file; BadInput when it cannot be loaded."""
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.log_severity_level = 4  # what is fatal is raised as well, in one line
    try:
        session = ort.InferenceSession(path.read_bytes(), options, ["CPUExecutionProvider"])
    except OSError:
        raise
    except Exception as error:  # onnxruntime raises its own untyped errors
        raise BadInput(path, f"cannot be loaded as ONNX ({first_line(error)})") from None
    metadata: dict[str, str] = session.get_modelmeta().custom_metadata_map
    return metadata


def first_line(error: Exception) -> str:
    """The first line of an error, without onnxruntime's prefix."""
    line = (str(error).splitlines() or [type(error).__name__])[0]
    return line.removeprefix("[ONNXRuntimeError] : ")
