"""What the attributes of an element say of the ways and the relation that it came from."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.lanelet2.osm import Member, Tags
from rtmap_cli.formats.lanelet2.tags import (
    BOUNDS,
    LENGTH,
    MEMBERS,
    NODE_TAGS,
    NODES,
    RELATION,
    WAYS,
)
from rtmap_cli.geometry.polylines import length
from rtmap_cli.geometry.rings import signed_area
from rtmap_cli.maps.element import CLASSES, RING_CLASSES, Element

Array = NDArray[np.float64]

SAME_LENGTH = (1.0, 0.01)
"""Metres, and share of the length, by which fusing and editing may change that of a whole line."""


@dataclass(frozen=True)
class Bound:
    """A bound of a lanelet or area: its nodes, and its tags where it has no element."""

    nodes: list[int]
    tags: Tags | None


@dataclass(frozen=True)
class Source:
    """An element, with its ``ways`` (None: it came from none), the ``nodes`` and tags of its
    vertices, its ``relation`` (None: none) with members and bounds by way."""

    element: Element
    ways: list[list[Any]] | None
    nodes: list[int]
    length: float
    node_tags: dict[int, Tags]
    relation: int | None
    members: list[Member]
    bounds: dict[int, Bound]

    @property
    def name(self) -> str:
        """The element's id."""
        return self.element.element_id

    @property
    def rank(self) -> int:
        """Whose word counts where a node lies; see ``Nodes``."""
        if self.element.class_name in CLASSES:
            return 0
        return 1 if self.ways is not None else 2

    @property
    def points(self) -> Array:
        """(n, 3) vertices in the order of ``nodes``: of crossings counter-clockwise, whichever way
        round somebody wrote them meanwhile."""
        points = self.element.points
        turned = self.element.class_name in RING_CLASSES and signed_area(points) < 0
        return points[::-1] if turned else points

    @property
    def fits(self) -> bool:
        """True while every vertex is the node that it was, as far as one can tell: a piece of a
        line may have as many vertices as the whole, but not its length."""
        now = length(self.element.points)
        return len(self.nodes) == len(self.element.points) and (
            abs(now - self.length) <= SAME_LENGTH[0] + SAME_LENGTH[1] * self.length
        )


def source_of(element: Element) -> Source:
    """An element with what the import wrote into its attributes; BadInput where that is broken."""
    a = element.attributes
    try:
        tags = json.loads(a.get(NODE_TAGS, "{}"))
        members = json.loads(a.get(MEMBERS, "[]"))
        bounds = json.loads(a.get(BOUNDS, "{}")).items()
        return Source(
            element=element,
            ways=json.loads(a[WAYS]) if WAYS in a else None,
            nodes=[int(n) for n in a.get(NODES, "").split()],
            length=float(a.get(LENGTH, "nan")),
            node_tags={int(k): {str(n): str(v) for n, v in t.items()} for k, t in tags.items()},
            relation=int(a[RELATION]) if RELATION in a else None,
            members=[Member(str(k), int(n), str(r)) for k, n, r in members],
            bounds={int(k): Bound([*map(int, b["nodes"])], b.get("tags")) for k, b in bounds},
        )
    except (ValueError, TypeError, KeyError, AttributeError):
        raise BadInput(
            f"element {element.element_id}",
            "an attribute that begins with lanelet2: is not as the import wrote it",
            "remove these attributes of the element to have it written as a new one",
        ) from None
