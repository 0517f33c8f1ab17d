"""Element: one vectorised map object; VectorMap: elements that share a CRS."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import is_ring

Array = NDArray[np.float64]

CLASSES = ("ped_crossing", "divider", "boundary")
"""The classes of the default models, in the order of their indices."""

RING_CLASSES = frozenset({"ped_crossing"})
"""Classes whose elements are closed rings (polygons in files)."""

OUTLINE_CLASSES = frozenset({"boundary"})
"""Classes whose lines are outlines of areas: they never fork."""


@dataclass(frozen=True)
class Element:
    """One map object in the map frame (a projected metric CRS; x east, y north, z up; metres).

    ``points`` (n, 3) float64; z is NaN where unknown, never 0 for unknown. A ring repeats its
    first vertex. ``covariance`` (n, 4): xx, xy, yy, zz per vertex in m², NaN where unknown, or
    None when nothing is known. ``existence`` is the log-odds that the element exists (0 = even).
    """

    element_id: str
    class_name: str
    points: Array
    covariance: Array | None = None
    existence: float = 0.0
    seen: int = 0
    in_view: int = 0
    traversals: int = 0
    first_seen_ns: int | None = None
    last_seen_ns: int | None = None
    attributes: dict[str, str] = field(default_factory=dict)
    runs: tuple[str, ...] = ()
    model_sha256: str | None = None

    def __post_init__(self) -> None:
        points = np.asarray(self.points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) < 2:
            raise ValueError(
                f"element {self.element_id}: points must be (n ≥ 2, 2 or 3), not {points.shape}"
            )
        if points.shape[1] == 2:
            points = np.column_stack([points, np.full(len(points), np.nan)])
        if not np.isfinite(points[:, :2]).all():
            raise ValueError(f"element {self.element_id}: x or y is not finite")
        object.__setattr__(self, "points", points)
        if self.covariance is not None and np.shape(self.covariance) != (len(points), 4):
            raise ValueError(
                f"element {self.element_id}: covariance must be ({len(points)}, 4), "
                f"not {np.shape(self.covariance)}"
            )

    @property
    def xy(self) -> Array:
        """(n, 2) planar vertices in the map frame."""
        return self.points[:, :2]

    @property
    def ring(self) -> bool:
        """True for a closed element."""
        return is_ring(self.points)

    def with_points(self, points: Array, covariance: Array | None = None) -> Element:
        """The same element with other geometry."""
        return replace(self, points=points, covariance=covariance)


@dataclass(frozen=True)
class VectorMap:
    """Elements in memory with the CRS of their map frame.

    ``crs`` is anything that ``pyproj.CRS.from_user_input`` reads, normally ``EPSG:326xx``.
    ``version`` is the version of the map folder that was read, or None.
    """

    elements: tuple[Element, ...]
    crs: str
    version: int | None = None

    def __init__(self, elements: Iterable[Element], crs: str, version: int | None = None) -> None:
        object.__setattr__(self, "elements", tuple(elements))
        object.__setattr__(self, "crs", crs)
        object.__setattr__(self, "version", version)

    def __iter__(self) -> Iterator[Element]:
        return iter(self.elements)

    def __len__(self) -> int:
        return len(self.elements)

    def of_class(self, class_name: str) -> list[Element]:
        """The elements of one class, in order."""
        return [e for e in self.elements if e.class_name == class_name]

    def by_id(self) -> dict[str, Element]:
        """Elements by their ids."""
        return {e.element_id: e for e in self.elements}

    def bounds(self) -> tuple[float, float, float, float]:
        """(x_min, y_min, x_max, y_max) in the map frame; NaN for an empty map."""
        if not self.elements:
            return (np.nan,) * 4
        xy = np.concatenate([e.xy for e in self.elements])
        return (*xy.min(axis=0).tolist(), *xy.max(axis=0).tolist())
