"""Samples and batches: frames moved and recoloured, with a wrong prior and their targets."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rtmap_models.config import ModelConfig, SemanticConfig
from rtmap_models.data.samples import (
    Array,
    Pieces,
    Prior,
    PriorNoise,
    Scene,
    clip,
    equivalent_orders,
    field_target,
    heat_target,
    make_prior,
    rotation,
    segmentation_target,
)
from rtmap_models.data.shards import (
    SCENE_MARGIN_M,
    Frame,
    Frames,
    crop_window,
    window_half,
    window_size,
    write_shard,
)

__all__ = [
    "SCENE_MARGIN_M",
    "Augmentation",
    "Batch",
    "Frame",
    "Frames",
    "Sample",
    "augment",
    "collate",
    "crop_window",
    "make_sample",
    "window_half",
    "window_size",
    "write_shard",
]


@dataclass(frozen=True)
class Augmentation:
    """How training frames are varied: the ego frame turned (standard deviation ``turn_deg``),
    shifted (``shift_m`` along x and y) and mirrored, in a share ``still`` of the samples mirrored
    only; colours multiplied by 1 ± ``contrast`` and moved by up to ``brightness``, each channel by
    up to ``tint`` more. A share ``hidden`` of the samples hides its prior from the new queries."""

    turn_deg: float = 4.0
    shift_m: tuple[float, float] = (1.0, 0.8)
    still: float = 0.3
    mirror: bool = True
    contrast: float = 0.25
    brightness: float = 20.0
    tint: float = 6.0
    hidden: float = 0.6


@dataclass
class Sample:
    """One frame ready for a batch. ``picture`` uint8 (H, W, K); ``scene`` the elements also
    outside the range; see `Batch` for the rest."""

    picture: NDArray[np.uint8]
    scene: Scene
    truth: Pieces
    prior: Prior | None
    visible: bool
    gain: Array
    offset: Array
    images: NDArray[np.uint8] | None = None
    ego_to_image: NDArray[np.float32] | None = None
    plane: Array | None = None


@dataclass
class Batch:
    """B samples; G truth elements of all samples one after the other; P prior slots."""

    picture: Tensor  # (B, K, H, W) float 0 … 255
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
    field: Tensor  # (B, C, 2, H/2, W/2) metres to the nearest element, NaN where far
    heat: Tensor  # (B, C, h, w)
    cells: Tensor  # (M, 5) sample, class, row, column, truth
    images: Tensor | None = None  # (B, N, H, W, 3) uint8; an absent camera is zero
    ego_to_image: Tensor | None = None  # (B, N, 3, 4) float32; an absent camera is zero
    plane: Tensor | None = None  # (B, 3) the road z = a x + b y + c there, NaN where unknown

    def to(self, device: torch.device | str) -> Batch:
        """The batch with every tensor on a device (numpy fields stay)."""
        moved = {
            f.name: value.to(device, non_blocking=True)
            for f in fields(self)
            if isinstance(value := getattr(self, f.name), Tensor)
        }
        return replace(self, **moved)

    def pin_memory(self) -> Batch:
        """The batch in page-locked memory, from which a copy to a GPU need not wait."""
        pinned = {
            f.name: value.pin_memory()
            for f in fields(self)
            if isinstance(value := getattr(self, f.name), Tensor)
        }
        return replace(self, **pinned)


def augment(
    frame: Frame, config: ModelConfig, rng: np.random.Generator, how: Augmentation
) -> Frame:
    """Mirror, turn and shift everything in a frame alike; the picture is cut to the range.

    With p' = M p + s the ego coordinates of the moved frame, a projection P becomes
    P · [M⁻¹, -M⁻¹ s]; where M mirrors, the images are mirrored too, so that cameras stay cameras.
    """
    flip = np.diag(rng.choice([1.0, -1.0], 2)) if how.mirror else np.eye(2)
    angle = rng.normal(0, math.radians(how.turn_deg))
    shift = rng.normal(0, 1, 2) * how.shift_m
    if rng.random() < how.still:
        angle, shift = 0.0, np.zeros(2)
    matrix = rotation(angle) @ flip
    inverse: Array = np.linalg.inv(matrix).astype(np.float64)
    moved = Frame(
        _moved_picture(frame.picture, inverse, shift, config), frame.scene.moved(matrix, shift)
    )
    if frame.images is None or frame.ego_to_image is None:
        return moved
    images, projections = _moved_cameras(frame.images, frame.ego_to_image, inverse, shift)
    return moved._replace(
        images=images, ego_to_image=projections, plane=_moved_plane(frame.plane, inverse, shift)
    )


def _moved_picture(
    picture: NDArray[np.uint8], inverse: Array, shift: Array, config: ModelConfig
) -> NDArray[np.uint8]:
    cell, half = config.cell_m, np.array(config.half_range)
    origin = inverse @ (0.5 * cell - half - shift)  # the first cell's centre in the old frame
    offset = (origin + window_half(config)) / cell - 0.5
    warp = np.column_stack([inverse, offset])
    rows, columns = config.picture_size
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    parts = [
        cv2.warpAffine(
            np.ascontiguousarray(picture[..., k : k + 4]), warp, (columns, rows), flags=flags
        )
        for k in range(0, picture.shape[2], 4)  # OpenCV takes four channels at a time
    ]
    return np.concatenate([p.reshape(rows, columns, -1) for p in parts], axis=2).astype(np.uint8)


def _moved_cameras(
    images: NDArray[np.uint8], projections: NDArray[np.float32], inverse: Array, shift: Array
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    back = np.eye(4)
    back[:2, :2], back[:2, 3] = inverse, -inverse @ shift
    out = projections @ back
    if np.linalg.det(inverse) < 0:
        images = np.ascontiguousarray(images[:, :, ::-1])
        out[:, 0] = (images.shape[2] - 1) * out[:, 2] - out[:, 0]
    return images, out.astype(np.float32)


def _moved_plane(plane: Array | None, inverse: Array, shift: Array) -> Array | None:
    if plane is None:
        return None
    slopes = plane[:2] @ inverse
    return np.array([*slopes, plane[2] - slopes @ shift])


def recoloured(images: NDArray[np.uint8], gain: Array, offset: Array) -> NDArray[np.uint8]:
    """(N, H, W, 3) images with gain and offset per channel about 110; black (unseen) stays."""
    values = (np.arange(256)[:, None] - 110) * gain + 110 + offset
    values[0] = 0
    table = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    flat = images.reshape(-1, images.shape[2], 3)
    return np.asarray(cv2.LUT(flat, table[None]), np.uint8).reshape(images.shape)


def make_sample(
    frame: Frame,
    config: ModelConfig,
    rng: np.random.Generator,
    noise: PriorNoise | None = None,
    prior: str = "both",
    train: bool = True,
    augmentation: Augmentation | None = None,
) -> Sample:
    """One sample. ``prior`` is "none", "seen", "hidden" or "both" (hidden in some samples): a
    hidden prior is refined beside new queries that do not know of it. Without ``train`` nothing is
    varied."""
    how = augmentation or Augmentation()
    gain, offset = np.ones(3), np.zeros(3)
    if train:
        frame = augment(frame, config, rng, how)
        gain = np.full(3, 1 + rng.uniform(-how.contrast, how.contrast))
        offset = rng.uniform(-how.brightness, how.brightness) + rng.uniform(-how.tint, how.tint, 3)
        if frame.images is not None:
            frame = frame._replace(images=recoloured(frame.images, gain, offset))
    else:
        frame = frame._replace(picture=crop_window(frame.picture, config))
    truth = clip(frame.scene, config)
    if prior == "both":
        prior = "hidden" if rng.random() < how.hidden else "seen"
    made = None
    if prior != "none":
        made = make_prior(frame.scene, truth, config, noise or PriorNoise(), rng)
    return Sample(
        frame.picture,
        frame.scene,
        truth,
        made,
        prior == "seen",
        gain,
        offset,
        frame.images,
        frame.ego_to_image,
        frame.plane,
    )


def _stacked_cameras(samples: list[Sample]) -> tuple[Tensor | None, Tensor | None]:
    """Images and projections of all samples, padded with absent cameras to the most."""
    cameras = [(s.images, s.ego_to_image) for s in samples]
    shown = [(i, p) for i, p in cameras if i is not None and p is not None]
    if len(shown) < len(samples):
        return None, None
    count = max(len(i) for i, _ in shown)
    images = np.zeros((len(shown), count, *shown[0][0].shape[1:]), np.uint8)
    projections = np.zeros((len(shown), count, 3, 4), np.float32)
    for b, (image, projection) in enumerate(shown):
        images[b, : len(image)], projections[b, : len(projection)] = image, projection
    return torch.from_numpy(images), torch.from_numpy(projections)


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
    if not isinstance(config, SemanticConfig):  # classes have no colour to vary
        picture = torch.cat([(picture[:, :3] - 110) * gain + 110 + offset, picture[:, 3:]], dim=1)
    images, ego_to_image = _stacked_cameras(samples)
    planes = [np.full(3, np.nan) if s.plane is None else s.plane for s in samples]
    tensor = torch.from_numpy
    return Batch(
        picture=picture,
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
        field=tensor(np.stack([field_target(s.truth, config) for s in samples])),
        heat=tensor(np.stack([h for h, _ in heats])),
        cells=tensor(np.concatenate(cells).astype(np.int64)),
        images=images,
        ego_to_image=ego_to_image,
        plane=tensor(np.array(planes, np.float32)),
    )
