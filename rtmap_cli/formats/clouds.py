"""Point cloud files: PLY, PCD and bare float32, read as columns; PLY and LAZ written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput, UsageError
from rtmap_cli.tables import whole_file

Array = NDArray[np.float64]
Columns = dict[str, Array]

_PLY = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_HEADER = 65_536


def read_cloud(path: Path) -> Columns:
    """The columns of a .ply, .pcd or .bin file, x, y, z among them (m); BadInput when it is none.

    A .bin file holds float32 x, y, z and, where the fourth column looks like one, intensity.
    """
    try:
        if path.suffix == ".ply":
            out = _read_ply(path)
        elif path.suffix == ".pcd":
            out = _read_pcd(path)
        else:
            out = _read_bin(path)
    except FileNotFoundError:
        raise BadInput(path, "no such file") from None
    except (ValueError, IndexError, KeyError, UnicodeDecodeError) as error:
        raise BadInput(path, f"cannot be read as a point cloud ({error})") from None
    if missing := {"x", "y", "z"} - set(out):
        raise BadInput(path, f"has no column {min(missing)}")
    return out


def _read_bin(path: Path) -> Columns:
    values = np.fromfile(path, "<f4")
    if path.stat().st_size % 4 or (len(values) % 4 and len(values) % 3):
        raise BadInput(path, "is not float32 × 3 or × 4", "it may be truncated; copy it again")
    width = 3
    if len(values) % 4 == 0:
        fourth = values[3::4]
        finite = fourth[np.isfinite(fourth)]
        looks = len(finite) == 0 or (finite.min() >= 0 and finite.max() <= 255)
        width = 4 if looks or len(values) % 3 else 3
    table = values.reshape(-1, width).astype(np.float64)
    return dict(zip(("x", "y", "z", "intensity"), table.T, strict=False))


def _read_ply(path: Path) -> Columns:
    data = path.read_bytes()
    end = data.find(b"end_header", 0, _HEADER)
    if not data.startswith(b"ply") or end < 0:
        raise BadInput(path, "is not a PLY file")
    lines = data[:end].decode("ascii").splitlines()
    body = data[data.index(b"\n", end) + 1 :]
    kind, count, element = "", 0, ""
    fields: list[tuple[str, str]] = []
    for line in lines:
        word = line.split()
        if word[:1] == ["format"]:
            kind = word[1]
        elif word[:1] == ["element"]:
            if fields and element == "vertex":
                break
            element, count = word[1], int(word[2])
        elif word[:1] == ["property"] and element == "vertex":
            fields.append((word[2], _PLY[word[1]]))
    return _decoded(path, body, count, fields, kind)


def _read_pcd(path: Path) -> Columns:
    data = path.read_bytes()
    at = data.find(b"\nDATA ", 0, _HEADER)
    if at < 0:
        raise BadInput(path, "is not a PCD file")
    stop = data.index(b"\n", at + 1)
    head = {
        line.split()[0]: line.split()[1:]
        for line in data[:stop].decode("ascii").splitlines()
        if line and not line.startswith("#")
    }
    sizes = zip(head["TYPE"], head["SIZE"], strict=True)
    kinds = [{"F": "f", "I": "i", "U": "u"}[t] + size for t, size in sizes]
    repeats = [int(n) for n in head.get("COUNT", ["1"] * len(kinds))]
    fields = [
        (name if k == 0 else f"{name}{k}", kind)
        for name, kind, n in zip(head["FIELDS"], kinds, repeats, strict=True)
        for k in range(n)
    ]
    kind = head["DATA"][0]
    if kind == "binary_compressed":
        raise BadInput(path, "is a compressed PCD", "save it as binary")
    names = {"ascii": "ascii", "binary": "binary_little_endian"}
    return _decoded(path, data[stop + 1 :], int(head["POINTS"][0]), fields, names[kind])


def _decoded(
    path: Path, body: bytes, count: int, fields: list[tuple[str, str]], kind: str
) -> Columns:
    """Rows of fields, as text or packed."""
    if kind == "ascii":
        table = np.array(body.split()[: count * len(fields)], np.float64)
        table = table.reshape(count, len(fields))
        return {name: table[:, k] for k, (name, _) in enumerate(fields)}
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}[kind]

    dtype = np.dtype([(f"c{k}", order + t) for k, (_, t) in enumerate(fields)])
    if len(body) < count * dtype.itemsize:
        raise BadInput(path, "is truncated", "copy it again")
    rows = np.frombuffer(body, dtype, count)
    return {n: rows[f"c{k}"].astype(np.float64) for k, (n, _) in enumerate(fields)}


def write_ply(path: Path, parts: Any, count: int, origin: Array, crs: str) -> None:
    """Binary PLY of ``parts``, an iterable of (xyz (n, 3), intensity (n,)) with ``count`` points in
    all: x, y, z (float32, m, about ``origin``, which a comment states), intensity."""
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment crs {' '.join(crs.split())}\n"
        f"comment origin {origin[0]:.3f} {origin[1]:.3f} {origin[2]:.3f}\n"
        f"element vertex {count}\n"
        + "".join(f"property float {n}\n" for n in ("x", "y", "z", "intensity"))
        + "end_header\n"
    )
    with whole_file(path) as temporary, Path(temporary).open("wb") as stream:
        stream.write(head.encode())
        for xyz, intensity in parts:
            stream.write(np.column_stack([xyz - origin, intensity]).astype("<f4").tobytes())


def write_laz(path: Path, parts: Any, bounds: Array, crs: str) -> None:
    """LAS 1.4 (compressed when ``path`` ends in .laz) of ``parts``, an iterable of (xyz (n, 3),
    intensity (n,) in [0, 1]); millimetres about the lower corner of ``bounds`` (2, 3).

    UsageError when laspy is not installed.
    """
    try:
        import laspy
    except ImportError:
        raise UsageError("LAS files need laspy: pip install 'rtmap[label]'") from None
    from pyproj import CRS

    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(bounds[0])
    found = CRS.from_user_input(crs)
    if found.is_projected:
        header.add_crs(found)
    with whole_file(path) as temporary:
        compress = path.suffix == ".laz"
        with (
            Path(temporary).open("wb") as stream,
            laspy.open(stream, mode="w", header=header, do_compress=compress, closefd=False) as out,
        ):
            for xyz, intensity in parts:
                record = laspy.ScaleAwarePointRecord.zeros(len(xyz), header=header)
                record.x, record.y, record.z = xyz.T
                record.intensity = np.round(np.clip(intensity, 0, 1) * 65535).astype(np.uint16)
                out.write_points(record)
