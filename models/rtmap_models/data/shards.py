"""Training frames on disk: what the cameras saw, and the elements around the vehicle.

A folder holds shards; a shard is a few files that appear whole:

``NAME.npy``         uint8 (n, rows, columns, K) bird's-eye pictures, wider than the range so that
                     they can be turned and shifted: K = 4 colours and quality of cameras, or the
                     planes of a semantic raster
``NAME.images.npy``  uint8 (n, N, H, W, 3) camera images (optional; networks that look at them)
``NAME.npz``         the elements of each frame; with images, their projections (n, N, 3, 4) and the
                     road's plane in them (n, 3), NaN where unknown
``NAME.json``        written last: says what the others are and where they come from: ``town`` (its
                     seed), or ``log`` with the ``footprint`` of its frames
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.maps.footprint import TOWNS, Footprint, read_footprint, union
from rtmap_cli.tables import whole_file
from rtmap_models.config import ModelConfig
from rtmap_models.data.samples import Array, Scene

SCENE_MARGIN_M = 14.0
"""Elements are kept this far outside the range, for augmentation."""


class Frame(NamedTuple):
    """One training frame.

    ``picture`` uint8 (rows, columns, K), the wide bird's-eye picture; ``scene`` the elements around
    the vehicle; ``images`` uint8 (N, H, W, 3) and ``ego_to_image`` float32 (N, 3, 4) where kept: an
    absent camera is zero in both; ``plane`` (3,) the road z = a x + b y + c in the frame that they
    project from, where known: what levelling left.
    """

    picture: NDArray[np.uint8]
    scene: Scene
    images: NDArray[np.uint8] | None = None
    ego_to_image: NDArray[np.float32] | None = None
    plane: Array | None = None


def window_half(config: ModelConfig) -> tuple[float, float]:
    """Half extent of the cached picture, metres."""
    half_x, half_y = config.half_range
    return half_x + config.margin_m[0], half_y + config.margin_m[1]


def window_size(config: ModelConfig) -> tuple[int, int]:
    """Rows and columns of the cached picture."""
    half_x, half_y = window_half(config)
    return round(2 * half_y / config.cell_m), round(2 * half_x / config.cell_m)


def crop_window(picture: NDArray[np.uint8], config: ModelConfig) -> NDArray[np.uint8]:
    """The range itself, out of the wider cached picture."""
    rows, columns = config.picture_size
    top, left = (round(m / config.cell_m) for m in config.margin_m[::-1])
    return picture[top : top + rows, left : left + columns]


def write_shard(
    folder: Path,
    name: str,
    pictures: NDArray[np.uint8],
    scenes: Sequence[Scene],
    info: dict[str, Any],
    images: NDArray[np.uint8] | None = None,
    ego_to_image: NDArray[np.float32] | None = None,
    plane: Array | None = None,
) -> None:
    """Write one shard of `Frame` parts stacked along a first axis; readers see it when its JSON
    file is there."""
    arrays = {f"{name}.npy": pictures}
    if images is not None:
        arrays[f"{name}.images.npy"] = images
    for file, array in arrays.items():
        with whole_file(folder / file) as path, path.open("wb") as stream:
            np.save(stream, array, allow_pickle=False)
    counts = [len(s.classes) for s in scenes]
    lengths = [np.diff(s.offsets) for s in scenes]
    kept = {"ego_to_image": ego_to_image, "plane": plane}
    extra: dict[str, Any] = {k: v.astype("f4") for k, v in kept.items() if v is not None}
    with whole_file(folder / f"{name}.npz") as path, path.open("wb") as stream:
        np.savez(
            stream,
            frame=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            length=np.concatenate([*lengths, np.zeros(0)]).astype(np.int64),
            classes=np.concatenate([*(s.classes for s in scenes), np.zeros(0)]).astype(np.int64),
            points=np.concatenate([*(s.points for s in scenes), np.zeros((0, 2))]).astype("f4"),
            **extra,
        )
    with whole_file(folder / f"{name}.json") as path:
        path.write_text(json.dumps({"frames": len(scenes)} | info, indent=1), encoding="utf-8")


class _Shard:
    """One opened shard; pictures and images stay on disk until they are asked for."""

    def __init__(self, folder: Path, name: str, config: ModelConfig):
        self.path, self.name = folder / f"{name}.npy", name
        images = folder / f"{name}.images.npy"
        try:
            self.pictures = np.load(self.path, mmap_mode="r", allow_pickle=False)
            with np.load(folder / f"{name}.npz", allow_pickle=False) as data:
                self.table = {k: data[k] for k in ("frame", "length", "classes", "points")}
                self.projections, self.planes = data.get("ego_to_image"), data.get("plane")
            self.images = None
            if config.needs_images and images.exists():
                self.images = np.load(images, mmap_mode="r", allow_pickle=False)
            info = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
            self.footprint = TOWNS if "town" in info else read_footprint(info.get("footprint"))
        except (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError) as error:
            raise BadInput(self.path, f"unreadable shard: {error}", "delete it") from error
        self.start = np.concatenate([[0], np.cumsum(self.table["length"])])
        self._check(config)

    def _check(self, config: ModelConfig) -> None:
        size = window_size(config)
        if self.pictures.shape[1:] != (*size, config.channels):
            needed = (*size, config.channels)
            what = f"pictures of {self.pictures.shape[1:]}, the configuration needs {needed}"
            raise BadInput(self.path, what, "use another --data folder")
        if self.table["classes"].max(initial=0) >= len(config.classes):
            raise BadInput(self.path, "classes that the configuration lacks", "use other data")
        if len(self.table["frame"]) != len(self.pictures) + 1:
            raise BadInput(self.path, "unreadable shard: its files disagree", "delete it")
        if not config.needs_images:
            return
        if self.images is None or self.projections is None:
            raise BadInput(
                self.path, f"no camera images, which {config.name} needs", "render with them anew"
            )
        if self.images.shape[2:4] != tuple(config.image_size):
            what = f"images of {self.images.shape[2:4]}, the configuration needs "
            raise BadInput(self.path, what + f"{tuple(config.image_size)}", "use other data")

    def __len__(self) -> int:
        return len(self.pictures)

    def frame(self, row: int) -> Frame:
        first, last = self.table["frame"][row], self.table["frame"][row + 1]
        begin, end = self.start[first], self.start[last]
        offsets = (self.start[first : last + 1] - begin).astype(np.int64)
        points = self.table["points"][begin:end].astype(np.float64)
        scene = Scene(points, offsets, self.table["classes"][first:last])
        picture = np.asarray(self.pictures[row])
        if self.images is None or self.projections is None:
            return Frame(picture, scene)
        plane = None if self.planes is None else self.planes[row].astype(np.float64)
        return Frame(picture, scene, np.asarray(self.images[row]), self.projections[row], plane)


class Frames:
    """Random access to the frames of one or several folders, in the order of names.

    ``refresh`` opens shards that have appeared and drops those that are gone (a reader of a shard
    that is deleted under it keeps its files until then).
    """

    def __init__(self, folders: str | Path | Sequence[str | Path], config: ModelConfig):
        several = [folders] if isinstance(folders, str | Path) else folders
        self.folders, self.config = [Path(f) for f in several], config
        self.shards: dict[tuple[int, str], _Shard] = {}
        self.starts = np.zeros(1, np.int64)
        self.refresh()

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process opens the files itself instead of getting copies of them."""
        return Frames, (self.folders, self.config)

    @property
    def folder(self) -> Path:
        """The first folder (for messages)."""
        return self.folders[0]

    def refresh(self) -> None:
        """Look at the folders again."""
        found: dict[tuple[int, str], _Shard] = {}
        for k, folder in enumerate(self.folders):
            if not folder.is_dir():
                raise BadInput(folder, "no such folder", "make one with rtmap train --frames")
            for name in sorted(p.stem for p in folder.glob("*.json")):
                opened = self.shards.get((k, name)) or self._open(folder, name)
                if opened is not None:
                    found[k, name] = opened
        self.shards = found
        self.order = list(found.values())
        self.starts = np.concatenate([[0], np.cumsum([len(s) for s in self.order])])

    def _open(self, folder: Path, name: str) -> _Shard | None:
        try:
            return _Shard(folder, name, self.config)
        except BadInput:
            if (folder / f"{name}.json").exists():
                raise
            return None  # it went away meanwhile

    def footprint(self) -> Footprint:
        """Where the frames that are there now come from."""
        return union(shard.footprint for shard in self.order)

    def __len__(self) -> int:
        return int(self.starts[-1])

    def __getitem__(self, index: int) -> Frame:
        """Frame ``index`` of all folders; IndexError past the end."""
        if not 0 <= index < len(self):
            raise IndexError(index)
        shard = int(np.searchsorted(self.starts, index, side="right")) - 1
        return self.order[shard].frame(int(index - self.starts[shard]))
