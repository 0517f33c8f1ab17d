"""Poses, intrinsics and numbers out of other people's records, checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.poses import se3_from_quaternion

Array = NDArray[np.float64]


def need(record: Any, key: str, path: Path, what: str) -> Any:
    """``record[key]``; BadInput names what lacks it."""
    if not isinstance(record, dict) or key not in record:
        raise BadInput(path, f"{what} has no {key}")
    return record[key]


def array(value: Any, shape: tuple[int, ...], path: Path, what: str) -> Array:
    """A float64 array of a shape; BadInput unless every number is finite."""
    try:
        out = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        out = np.zeros(0)
    if out.shape != shape:
        size = " × ".join(map(str, shape))
        raise BadInput(path, f"{what} is not {size} numbers")
    if not np.isfinite(out).all():
        raise BadInput(path, f"{what} holds a value that is not a number")
    return out


def pose_of(rotation: Any, translation: Any, path: Path, what: str) -> Array:
    """(4, 4) of a quaternion w, x, y, z and a position in metres; BadInput unless it is a pose."""
    q = array(rotation, (4,), path, f"the rotation of {what}")
    t = array(translation, (3,), path, f"the translation of {what}")
    if abs(np.linalg.norm(q) - 1) > 1e-3:
        raise BadInput(path, f"the quaternion of {what} is not of length 1")
    return se3_from_quaternion(q, t)


def matrix_of(value: Any, path: Path, what: str) -> Array:
    """(4, 4) rigid transform; BadInput unless its rotation is one (to 1e-3)."""
    out = array(value, (4, 4), path, what)
    turn = out[:3, :3]
    rigid = np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) and np.linalg.det(turn) > 0
    if not rigid or not np.allclose(out[3], [0, 0, 0, 1]):
        raise BadInput(path, f"{what} is not a rigid transform")
    return out


def intrinsics_of(value: Any, path: Path, what: str) -> Array:
    """(3, 3) camera matrix in pixels; BadInput without focal lengths above zero."""
    out = array(value, (3, 3), path, f"the intrinsics of {what}")
    if out[0, 0] <= 0 or out[1, 1] <= 0 or not np.allclose(out[2], [0, 0, 1]):
        raise BadInput(path, f"the intrinsics of {what} are not a camera matrix")
    return out


def count_of(value: Any, path: Path, what: str) -> int:
    """A whole number above zero; BadInput otherwise."""
    if isinstance(value, bool) or not isinstance(value, int) or value <= 0:
        raise BadInput(path, f"{what} is {value!r}, not a whole number above zero")
    return value
