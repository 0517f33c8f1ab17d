"""Training frames on disk (bird's-eye pictures and their elements) and batches of samples.

A cache folder holds shards; a shard is three files that appear whole: ``NAME.npy`` uint8
(n, rows, columns, 4), a picture wider than the range so that it can be turned and shifted;
``NAME.npz`` with the elements; ``NAME.json``, written last, that says what they are.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rtmap_cli.errors import BadInput
from rtmap_cli.tables import whole_file
from rtmap_models.config import ModelConfig
from rtmap_models.samples import (
    Array,
    Pieces,
    Prior,
    PriorNoise,
    Scene,
    clip,
    equivalent_orders,
    heat_target,
    make_prior,
    rotation,
    segmentation_target,
)

WINDOW_MARGIN_M = (6.0, 8.0)
"""How much the cached picture is wider than the range on each side, x and y."""

SCENE_MARGIN_M = 14.0
"""Elements are kept this far outside the range, for augmentation."""


def window_half(config: ModelConfig) -> tuple[float, float]:
    """Half extent of the cached picture, metres."""
    half_x, half_y = config.half_range
    return half_x + WINDOW_MARGIN_M[0], half_y + WINDOW_MARGIN_M[1]


def window_size(config: ModelConfig) -> tuple[int, int]:
    """Rows and columns of the cached picture."""
    half_x, half_y = window_half(config)
    return round(2 * half_y / config.cell_m), round(2 * half_x / config.cell_m)


def write_shard(
    folder: Path, name: str, pictures: NDArray[np.uint8], scenes: list[Scene], info: dict[str, Any]
) -> None:
    """Write one shard; readers see it when its JSON file is there."""
    with whole_file(folder / f"{name}.npy") as path, path.open("wb") as stream:
        np.save(stream, pictures, allow_pickle=False)
    counts = [len(s.classes) for s in scenes]
    lengths = [np.diff(s.offsets) for s in scenes]
    with whole_file(folder / f"{name}.npz") as path, path.open("wb") as stream:
        np.savez(
            stream,
            frame=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            length=np.concatenate([*lengths, np.zeros(0)]).astype(np.int64),
            classes=np.concatenate([*(s.classes for s in scenes), np.zeros(0)]).astype(np.int64),
            points=np.concatenate([*(s.points for s in scenes), np.zeros((0, 2))]).astype("f4"),
        )
    with whole_file(folder / f"{name}.json") as path:
        path.write_text(json.dumps({"frames": len(scenes)} | info, indent=1), encoding="utf-8")


class Frames:
    """Random access to the frames of a cache folder; ``refresh`` finds new shards."""

    def __init__(self, folder: str | Path, config: ModelConfig):
        self.folder, self.size = Path(folder), window_size(config)
        self.names: list[str] = []
        self.pictures: list[NDArray[np.uint8]] = []
        self.tables: list[dict[str, NDArray[Any]]] = []
        self.starts = np.zeros(1, np.int64)
        self.refresh()

    def refresh(self) -> None:
        """Open shards that have appeared since."""
        if not self.folder.is_dir():
            raise BadInput(self.folder, "no such folder", "make one with rtmap train --frames")
        fresh = sorted({p.stem for p in self.folder.glob("*.json")} - set(self.names))
        for name in fresh:
            try:
                picture = np.load(self.folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)
                with np.load(self.folder / f"{name}.npz", allow_pickle=False) as data:
                    table = {k: data[k] for k in ("frame", "length", "classes", "points")}
            except (OSError, ValueError, KeyError) as error:
                where = self.folder / f"{name}.npy"
                raise BadInput(where, f"unreadable shard: {error}", "delete it") from error
            if picture.shape[1:3] != self.size:
                raise BadInput(
                    self.folder / f"{name}.npy",
                    f"pictures of {picture.shape[1:3]}, the configuration needs {self.size}",
                    "use another --data folder",
                )
            table["start"] = np.concatenate([[0], np.cumsum(table["length"])])
            self.names.append(name)
            self.pictures.append(picture)
            self.tables.append(table)
        self.starts = np.concatenate([[0], np.cumsum([len(p) for p in self.pictures])])

    def __len__(self) -> int:
        return int(self.starts[-1])

    def __getitem__(self, index: int) -> tuple[NDArray[np.uint8], Scene]:
        """Wide picture (rows, columns, 4) and the scene of one frame."""
        shard = int(np.searchsorted(self.starts, index, side="right")) - 1
        row, table = index - self.starts[shard], self.tables[shard]
        first, last = table["frame"][row], table["frame"][row + 1]
        begin, end = table["start"][first], table["start"][last]
        offsets = (table["start"][first : last + 1] - begin).astype(np.int64)
        points = table["points"][begin:end].astype(np.float64)
        return np.asarray(self.pictures[shard][row]), Scene(
            points, offsets, table["classes"][first:last]
        )


@dataclass
class Sample:
    """One frame ready for a batch. ``picture`` uint8 (H, W, 4); see `Batch` for the rest."""

    picture: NDArray[np.uint8]
    truth: Pieces
    prior: Prior | None
    visible: bool
    gain: Array
    offset: Array


@dataclass
class Batch:
    """B samples; G truth elements of all samples one after the other; P prior slots."""

    picture: Tensor  # (B, 4, H, W) float 0 … 255
    prior_points: Tensor  # (B, P, V, 2)
    prior_class: Tensor  # (B, P) int64
    prior_mask: Tensor  # (B, P) 1 = used
    prior_visible: Tensor  # (B,) 1 = the new queries see the prior
    prior_target: Tensor  # (B, P, V, 2) the prior's vertices in the true ego frame
    prior_real: Tensor  # (B, P) 1 = the element exists
    delta: Tensor  # (B, 3)
    truth_orders: Tensor  # (G, V - 1, V, 2)
    truth_class: Tensor  # (G,)
    truth_start: NDArray[np.int64]  # (B + 1,) samples are truth[start[b]:start[b + 1]]
    truth_new: NDArray[np.bool_]  # (G,) to be found by the new queries
    truth_closed: NDArray[np.bool_]  # (G,)
    segmentation: Tensor  # (B, C, H/2, W/2)
    heat: Tensor  # (B, C, h, w)
    cells: Tensor  # (M, 5) sample, class, row, column, truth


def crop_window(picture: NDArray[np.uint8], config: ModelConfig) -> NDArray[np.uint8]:
    """The range itself, out of the wider cached picture."""
    rows, columns = config.picture_size
    top, left = (round(m / config.cell_m) for m in (WINDOW_MARGIN_M[1], WINDOW_MARGIN_M[0]))
    return picture[top : top + rows, left : left + columns]


def augment(
    picture: NDArray[np.uint8], scene: Scene, config: ModelConfig, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], Scene]:
    """Mirror, turn (σ 4°) and shift (σ 1 m, 0.8 m) picture and scene alike."""
    flip = np.diag(rng.choice([1.0, -1.0], 2))
    angle, shift = rng.normal(0, 0.07), rng.normal(0, 1, 2) * [1.0, 0.8]
    if rng.random() < 0.3:
        angle, shift = 0.0, np.zeros(2)
    matrix = rotation(angle) @ flip
    inverse = np.linalg.inv(matrix)
    cell, half = config.cell_m, np.array(config.half_range)
    origin = inverse @ (0.5 * cell - half - shift)  # the first cell's centre in the old frame
    offset = (origin + window_half(config)) / cell - 0.5
    warp = np.column_stack([inverse, offset])
    rows, columns = config.picture_size
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(picture, warp, (columns, rows), flags=flags), scene.moved(matrix, shift)


def make_sample(
    frame: tuple[NDArray[np.uint8], Scene],
    config: ModelConfig,
    rng: np.random.Generator,
    noise: PriorNoise | None = None,
    prior: str = "both",
    train: bool = True,
) -> Sample:
    """One sample. ``prior`` is "none", "seen", "hidden" or "both" (hidden in 60 % of samples):
    a hidden prior is refined beside new queries that do not know of it."""
    picture, scene = frame
    gain, offset = np.ones(3), np.zeros(3)
    if train:
        picture, scene = augment(picture, scene, config, rng)
        gain = np.full(3, rng.uniform(0.75, 1.25))
        offset = rng.uniform(-20, 20) + rng.uniform(-6, 6, 3)
    else:
        picture = crop_window(picture, config)
    truth = clip(scene, config)
    if prior == "both":
        prior = "seen" if rng.random() < 0.4 else "hidden"
    made = None
    if prior != "none":
        made = make_prior(scene, truth, config, noise or PriorNoise(), rng)
    return Sample(picture, truth, made, prior == "seen", gain, offset)


def collate(samples: list[Sample], config: ModelConfig) -> Batch:
    """Samples → one batch; prior slots are padded to the longest prior, at least one slot."""
    count, v = len(samples), config.vertex_count
    slots = max([1] + [len(s.prior.classes) for s in samples if s.prior is not None])
    points, target = np.zeros((2, count, slots, v, 2), np.float32)
    class_id = np.zeros((count, slots), np.int64)
    mask, real = np.zeros((2, count, slots), np.float32)
    delta = np.zeros((count, 3), np.float32)
    is_new: list[NDArray[np.bool_]] = []
    for b, s in enumerate(samples):
        new = np.ones(len(s.truth.classes), bool)
        if s.prior is not None:
            k = len(s.prior.classes)
            points[b, :k], target[b, :k] = s.prior.points, s.prior.target
            class_id[b, :k], mask[b, :k], real[b, :k] = s.prior.classes, 1, s.prior.real
            delta[b] = s.prior.delta
            if s.visible:
                new = ~np.isin(s.truth.source, s.prior.kept)
        is_new.append(new)
    start = np.concatenate([[0], np.cumsum([len(s.truth.classes) for s in samples])])
    orders = [
        equivalent_orders(p, c)
        for s in samples
        for p, c in zip(s.truth.points, s.truth.closed, strict=True)
    ]
    heats = [heat_target(s.truth, config) for s in samples]
    cells = [
        np.column_stack([np.full(len(c), b), c[:, :3], c[:, 3] + start[b]])
        for b, (_, c) in enumerate(heats)
    ]
    picture = torch.from_numpy(np.stack([s.picture for s in samples])).permute(0, 3, 1, 2).float()
    gain = torch.from_numpy(np.stack([s.gain for s in samples])).float()[..., None, None]
    offset = torch.from_numpy(np.stack([s.offset for s in samples])).float()[..., None, None]
    colour = (picture[:, :3] - 110) * gain + 110 + offset
    tensor = torch.from_numpy
    return Batch(
        picture=torch.cat([colour, picture[:, 3:]], dim=1),
        prior_points=tensor(points),
        prior_class=tensor(class_id),
        prior_mask=tensor(mask),
        prior_visible=torch.tensor([float(s.visible) for s in samples]),
        prior_target=tensor(target),
        prior_real=tensor(real),
        delta=tensor(delta),
        truth_orders=tensor(np.array(orders, np.float32).reshape(-1, v - 1, v, 2)),
        truth_class=tensor(np.concatenate([s.truth.classes for s in samples])),
        truth_start=start,
        truth_new=np.concatenate(is_new),
        truth_closed=np.concatenate([s.truth.closed for s in samples]),
        segmentation=tensor(np.stack([segmentation_target(s.truth, config) for s in samples])),
        heat=tensor(np.stack([h for h, _ in heats])),
        cells=tensor(np.concatenate(cells).astype(np.int64)),
    )
