"""A network cut down to almost nothing, and painted frames to train it on."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from rtmap_models.config import CONFIGS, load_config
from rtmap_models.data.dataset import window_half, window_size, write_shard
from rtmap_models.data.samples import Scene

TINY = {
    "cell_m = 0.25": "cell_m = 0.75",
    "supersample = 2": "supersample = 1",
    "[24, 48, 96, 128]": "[8, 8, 16, 16]",
    "fine_width = 24": "fine_width = 8",
    "coarse_width = 64": "coarse_width = 16",
    "query_width = 128": "query_width = 32",
    "point_width = 48": "point_width = 16",
    "layers = 3": "layers = 1",
    "new_queries = 50": "new_queries = 12",
    "[192, 384]": "[32, 48]",
    'name = "rtmap-tiny"': 'name = "rtmap-test"',
}


def tiny_config(folder: Path, extra: str = "") -> Path:
    """The default configuration with every size cut down; ``extra`` is added to the file."""
    text = (CONFIGS / "rtmap-tiny.toml").read_text()
    for old, new in TINY.items():
        assert old in text
        text = text.replace(old, new)
    path = folder / "test.toml"
    path.write_text(text + extra)
    return path


def painted_frames(folder: Path, config_file: Path, count: int = 12, seed: int = 0) -> Path:
    """Frames of a straight road of two lanes, some with a crossing."""
    config, rng = load_config(config_file), np.random.default_rng(seed)
    (rows, columns), half = window_size(config), np.array(window_half(config))
    pictures = np.full((count, rows, columns, 4), 60, np.uint8)
    scenes = []
    for picture in pictures:
        y = rng.uniform(-4, 4)
        lines = [
            (2, np.array([[-60, y - 6], [60, y - 6]])),
            (2, np.array([[-60, y + 6], [60, y + 6]])),
        ]
        lines.append((1, np.array([[-60, y], [60, y]])))
        if rng.random() < 0.5:
            x = rng.uniform(-20, 20)
            ring = [[x, y - 6], [x + 4, y - 6], [x + 4, y + 6], [x, y + 6], [x, y - 6]]
            lines.append((0, np.array(ring)))
        canvas = np.ascontiguousarray(picture)
        for _, p in lines:
            pixel = np.round((p + half) / config.cell_m - 0.5).astype(np.int32)
            cv2.polylines(canvas, [pixel], False, (220, 220, 220, 200))
        picture[...] = canvas
        offsets = np.cumsum([0] + [len(p) for _, p in lines])
        classes = np.array([c for c, _ in lines])
        scenes.append(Scene(np.concatenate([p for _, p in lines]), offsets, classes))
    write_shard(folder, "painted", pictures, scenes, {})
    return folder
