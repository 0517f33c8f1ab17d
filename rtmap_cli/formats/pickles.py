"""Pickles that hold plain containers and numpy arrays, and nothing else.

A pickle is a program: loading one runs what its author wrote. Here every name that it asks for is
looked up in a short table; whatever is not in it ends the reading before anything has run.
"""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput

MAX_BYTES = 1 << 31
"""Files above 2 GiB are refused: info files of whole data sets have a few hundred MB."""

_CODES = frozenset(f"{kind}{size}" for kind in "iu" for size in (1, 2, 4, 8)) | {
    "b1", "f2", "f4", "f8", "?", "l", "q",
}  # fmt: skip


def read_plain_pickle(path: Path) -> Any:
    """The content of a pickle of dicts, lists, tuples, sets, text, numbers and numpy arrays.

    BadInput when the file is missing, broken, or asks for anything else; nothing of it is run.
    """
    if not path.exists():
        raise BadInput(path, "no such file")
    if path.stat().st_size > MAX_BYTES:
        raise BadInput(path, "is larger than 2 GiB", "split it")
    try:
        with path.open("rb") as file:
            return _plain(_Plain(file).load())
    except _Refused as error:
        raise BadInput(
            path,
            f"holds {error}, which is not loaded: only plain containers and numpy arrays are",
            "do not open it with pickle either unless you trust who made it",
        ) from None
    except RecursionError:
        raise BadInput(path, "is nested too deeply") from None
    except Exception as error:  # Any error can come out of a broken or hostile pickle.
        first = (str(error) or type(error).__name__).splitlines()[0]
        raise BadInput(path, f"cannot be read as a pickle ({first})", "copy it again") from None


class _Refused(Exception):
    """The name that a pickle asked for."""


class _Number:
    """Stands in for numpy.dtype while a pickle is read: a number type and its byte order."""

    def __init__(self, code: Any, *_: Any) -> None:
        if code not in _CODES:
            raise _Refused(f"numpy type {code!r}")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        if state[1] not in ("<", ">", "|", "="):
            raise _Refused("a numpy type of an odd byte order")
        self.dtype = self.dtype.newbyteorder(state[1])


class _Array:
    """Stands in for an array, which a pickle makes empty and fills in a second step."""

    def __init__(self, kind: Any, *_: Any) -> None:
        if kind != _NDARRAY:
            raise _Refused(f"an array of class {kind!r}")
        self.values = np.zeros(0)

    def __setstate__(self, state: Any) -> None:
        _, shape, kind, fortran, data = state
        self.values = _filled(data, kind, shape, "F" if fortran else "C")


def _filled(data: Any, kind: Any, shape: Any, order: Any = "C") -> NDArray[Any]:
    """An array of the bytes ``data``; numpy refuses sizes that do not fit."""
    if not isinstance(kind, _Number) or not isinstance(data, bytes | bytearray):
        raise _Refused("an array of something else than numbers")
    return np.frombuffer(data, kind.dtype).reshape(shape, order=order).copy()


def _scalar(kind: Any, data: Any) -> Any:
    """One number of numpy, as Python's."""
    return _filled(data, kind, ()).item()


def _encode(text: Any, encoding: Any) -> bytes:
    """How protocols below 3 write bytes."""
    if not isinstance(text, str) or encoding != "latin1":
        raise _Refused("text in an odd encoding")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """Protocols below 3 write empty bytes as a call."""
    return b""


_NDARRAY = "numpy.ndarray"
_KNOWN: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _NDARRAY,
    ("numpy", "dtype"): _Number,
    ("_codecs", "encode"): _encode,
    ("__builtin__", "bytes"): _no_bytes,
    ("builtins", "set"): set,
    ("__builtin__", "set"): set,
}
for _core in ("core", "_core"):
    _KNOWN[f"numpy.{_core}.multiarray", "_reconstruct"] = _Array
    _KNOWN[f"numpy.{_core}.multiarray", "scalar"] = _scalar
    _KNOWN[f"numpy.{_core}.numeric", "_frombuffer"] = _filled


class _Plain(pickle.Unpickler):
    """Knows the names of the table above and no others."""

    def find_class(self, module: str, name: str) -> Any:
        """The stand-in of a known name; _Refused for any other."""
        if (module, name) not in _KNOWN:
            raise _Refused(f"{module}.{name}")
        return _KNOWN[module, name]


def _plain(value: Any) -> Any:
    """The value with arrays in the place of what stood in for them."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_plain(item) for item in value)
    return value.values if isinstance(value, _Array) else value
