"""Places and sensors that simulated semantic rasters come from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs.log import Rig
from rtmap_cli.logs.semantic import CLASSES
from rtmap_cli.steps.semantic.evidence import CONFUSION
from rtmap_cli.steps.semantic.labels import IGNORE
from rtmap_cli.steps.simulate.images.rig import campus_rig, default_rig
from rtmap_cli.steps.simulate.sensing import ground_labels as labels
from rtmap_cli.steps.simulate.sensing.lidar import LIDARS, Lidar

Array = NDArray[np.float64]

LABEL_CLASSES = {
    labels.ROAD: "road",
    labels.CROSSWALK: "crosswalk",
    labels.MARKING: "marking",
    labels.CURB: "curb",
    labels.SIDEWALK: "sidewalk",
    labels.TERRAIN: "terrain",
}
"""What the labels of the ground are called in rasters."""


@dataclass(frozen=True)
class Domain:
    """A kind of town and the vehicle in it.

    ``style`` of its streets (`TownStyle`), its widths ``sizes`` (m); ``rig`` of cameras with images
    of ``width`` pixels, ``lidar`` a key of `LIDARS`; a frame every ``spacing`` metres over
    ``length`` metres; a share ``errors`` of the masks is wrong; ``hills`` or a plain. ``taken_for``
    are classes that its segmenter does not know, and what it says in their place; ``measured``
    whether somebody measured what it confuses there.
    """

    style: str
    sizes: tuple[float, float]
    rig: Callable[..., Rig]
    width: int
    lidar: str
    spacing: float
    length: float
    errors: float
    hills: bool
    taken_for: Mapping[str, str] = field(default_factory=dict)
    measured: bool = True

    def cameras(self) -> Rig:
        """The rig with images of the domain's width."""
        return self.rig(self.width, round(self.width * 0.66))

    def rays(self) -> Lidar:
        """The LiDAR without the rings that look up: what they hit is never ground."""
        lidar = LIDARS[self.lidar]
        return replace(lidar, elevations=tuple(e for e in lidar.elevations if e < 1.5))

    def class_table(self) -> NDArray[np.uint8]:
        """Class (`rtmap_cli.logs.semantic.CLASSES`) of every simulated label."""
        out = np.full(len(labels.LABELS), IGNORE, np.uint8)
        for label, name in LABEL_CLASSES.items():
            out[label] = CLASSES.index(self.taken_for.get(name, name))
        return out

    def confusion(self) -> Array:
        """(K, K) what a ground of class k (row) is thought to be taken for by this segmenter.

        Measured: the confusion of a good one (`CONFUSION`) with its own words for classes, and a
        share ``errors`` of what is thin taken for road; raster cells then say honestly what cannot
        be told apart. Else `CONFUSION`, as `rtmap semantic-map` without ``--confusion``: cells
        believe what the segmenter says.
        """
        if not self.measured:
            return CONFUSION
        rename = np.zeros_like(CONFUSION)
        for k, name in enumerate(CLASSES):
            rename[k, CLASSES.index(self.taken_for.get(name, name))] = 1.0
        out: Array = CONFUSION @ rename
        for name in ("crosswalk", "marking", "curb"):
            k = CLASSES.index(name)
            out[k] *= 1 - self.errors
            out[k, CLASSES.index("road")] += self.errors
        return out

    def town_size(self, rng: np.random.Generator) -> float:
        """The width of one town, metres."""
        return float(rng.uniform(*self.sizes))


DOMAINS = {
    "city": Domain("city", (220.0, 340.0), default_rig, 384, "hdl32", 3.0, 120.0, 0.02, False),
    "campus": Domain(
        "campus", (220.0, 340.0), campus_rig, 384, "vlp16", 4.0, 140.0, 0.15, True,
        {"curb": "sidewalk", "terrain": "sidewalk", "crosswalk": "marking"}, measured=False,
    ),
}  # fmt: skip
"""``city``: wide streets in a plain, seven cameras all round, 32 rings, good masks. ``campus``:
narrow streets on hills, a cart with two front cameras and a VLP-16 that keeps two frames a second,
and a segmenter that tells road, paint and what is beside the road (sidewalk, it says), no more;
what it confuses nobody has measured. Both are invented."""
