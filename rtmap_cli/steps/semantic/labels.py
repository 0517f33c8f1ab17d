"""Label lists: what the numbers in a mask mean, and which class of the ground that is."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.semantic import CLASSES
from rtmap_cli.tables import read_json

IGNORE, UNKNOWN = 255, 254
"""In place of a class: what is no ground, and a number that the list does not have."""

KNOWN = {
    "marking--crosswalk": "crosswalk",
    "construction--flat--crosswalk": "crosswalk",
    "marking": "marking",
    "construction--barrier--curb": "curb",
    "construction--flat--curb-cut": "curb",
    "construction--flat--sidewalk": "sidewalk",
    "construction--flat--pedestrian-area": "sidewalk",
    "construction--flat": "road",
    "nature--terrain": "terrain",
    "nature--vegetation": "terrain",
    "nature--sand": "terrain",
    "nature--snow": "terrain",
    # The names of Cityscapes, and rtmap's own.
    "road": "road",
    "parking": "road",
    "crosswalk": "crosswalk",
    "curb": "curb",
    "sidewalk": "sidewalk",
    "terrain": "terrain",
    "vegetation": "terrain",
}
"""Names, or beginnings of names (up to ``--`` or the end), and the class they mean; the longest
that fits counts."""

OTHER = (
    "animal", "human", "nature", "object", "void", "construction", "ignore", "unlabeled",
    "building", "wall", "fence", "pole", "traffic light", "traffic sign", "sky", "person", "rider",
    "car", "truck", "bus", "train", "motorcycle", "bicycle", "vehicle",
)  # fmt: skip
"""Beginnings of names of what is no ground."""


@dataclass(frozen=True)
class Labels:
    """A label list: ``names[id]``, and in ``classes`` (n,) the number of the ground class of each
    id, `IGNORE` for what is no ground. ``settings`` is what the file says of a network's input."""

    path: Path
    names: tuple[str, ...]
    classes: NDArray[np.uint8]
    settings: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.names)

    def lookup(self, size: int) -> NDArray[np.uint8]:
        """(size,) label number → class, `UNKNOWN` beyond the list."""
        table = np.full(size, UNKNOWN, np.uint8)
        table[: min(size, len(self))] = self.classes[:size]
        return table


def read_labels(path: Path) -> Labels:
    """A label list in the style of Mapillary's: ``{"labels": [{"name": …, "class": …}, …]}``.

    The place in the list is the number in the masks. ``class`` (one of `CLASSES`, or "ignore") may
    be left out where the name is one of Mapillary Vistas, Cityscapes or rtmap. BadInput otherwise.
    """
    content = read_json(path)
    rows = content.get("labels") if isinstance(content, dict) else None
    if not isinstance(rows, list) or not rows:
        raise BadInput(path, "is not a label list (no labels in it)", "see docs/semantic-map.md")
    names, classes = [], []
    for number, row in enumerate(rows):
        name = row.get("name") if isinstance(row, dict) else None
        if not isinstance(name, str) or not name:
            raise BadInput(path, f"label {number} has no name")
        names.append(name)
        classes.append(_class_of(path, number, name, row.get("class")))
    if all(c == IGNORE for c in classes):
        raise BadInput(path, "none of its labels is a class of the ground", 'state "class" in it')
    settings = content.get("input", {})
    if not isinstance(settings, dict):
        raise BadInput(path, "input is not an object")
    return Labels(path, tuple(names), np.array(classes, np.uint8), settings)


def _class_of(path: Path, number: int, name: str, stated: Any) -> int:
    """The class of one label: as stated, else by its name."""
    todo = f'give it "class": one of {", ".join(CLASSES)} or "ignore"'
    if stated is not None:
        if stated == "ignore":
            return IGNORE
        if stated not in CLASSES:
            raise BadInput(path, f"label {number} ({name}) is of unknown class {stated!r}", todo)
        return CLASSES.index(stated)
    fitting = [k for k in KNOWN if _begins(name, k)]
    if fitting:
        return CLASSES.index(KNOWN[max(fitting, key=len)])
    if any(_begins(name, k) for k in OTHER):
        return IGNORE
    raise BadInput(path, f"nothing is known of label {number} ({name})", todo)


def _begins(name: str, start: str) -> bool:
    """Whether ``start`` is the name or its first parts (parts are parted by dashes)."""
    return name == start or name.startswith((start + "--", start + "-"))
