"""The drives as witnesses of the stretches of one class: which detections speak for which.

Where an old map has lines, what they claim speaks for them and the rest for what is new: a line
beside another one is judged by its own detections. Outlines are judged by all detections.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.element import Element
from rtmap_cli.maps.evidence import Counts
from rtmap_cli.steps.update.claims import Claims, loose_rings
from rtmap_cli.steps.update.compare import MISSING_OLD, MOVED, Stretch
from rtmap_cli.steps.update.evidence import (
    Detected,
    Rates,
    aside_rate,
    counts_of,
    seen_of,
    usual_rate,
)
from rtmap_cli.steps.update.settings import Settings

BESIDE = 2.5
"""What is new so near (m) to a line of its class may be that line's errors."""

CLUTTER = 0.07
"""Share of the candidates for new lines that are something else, taken for a line at times: as
many as lines are worn, so that what is found rarely stays undecided."""


@dataclass(frozen=True)
class Witnesses:
    """Drives and the ``old`` elements of a class, with the ``claims`` of these if they are lines
    (None: they are outlines, or there are none)."""

    traversals: Sequence[Traversal]
    old: Sequence[Element]
    name: str
    claims: Claims | None
    settings: Settings

    @cached_property
    def everything(self) -> list[Detected]:
        """All detections of each drive."""
        if self.claims is None:
            return [Detected.of(t, self.name) for t in self.traversals]
        return [Detected.of_samples(d, np.arange(len(d.samples))) for d in self.claims.drives]

    @cached_property
    def loose(self) -> list[Detected]:
        """What no old element claims."""
        if self.claims is not None:
            return [Detected.of_samples(d, d.loose) for d in self.claims.drives]
        if not self.old:
            return self.everything
        rings = [loose_rings(t, self.name, self.old) for t in self.traversals]
        pairs = zip(self.traversals, rings, strict=True)
        return [Detected.of(t, self.name, rows) for t, rows in pairs]

    @cached_property
    def alone(self) -> Rates:
        """Of elements that have none beside them."""
        return Rates(usual_rate(self.old, self.name, self.everything, self.settings.margin_m))

    @cached_property
    def beside(self) -> Rates:
        """Of new lines beside old ones, which leave something there now and then."""
        false = aside_rate(self.old, self.name, self.loose, self.settings.margin_m)
        return Rates(max(self.alone.usual, 1.5 * false), false)

    @cached_property
    def kept(self) -> Any:
        """The old lines as one geometry."""
        import shapely

        return shapely.union_all([shapely.LineString(e.xy) for e in self.old])

    def say(self, stretch: Stretch) -> tuple[Counts, float]:
        """What every drive saw of a stretch, and what they say together (log-odds)."""
        import shapely

        drives, rates, rivals = self.everything, self.alone, None
        if stretch.reason == MISSING_OLD:
            drives = self.loose
            if self.claims is not None:
                near = shapely.distance(shapely.LineString(stretch.points), self.kept) < BESIDE
                rates = replace(self.beside if near else self.alone, clutter=CLUTTER)
        elif self.claims is not None:
            drives = self._of_line(stretch)
            if stretch.reason == MOVED:
                # What is nearer to where it lay does not say that it moved.
                rivals = shapely.LineString(stretch.before)
        margin = self.settings.margin_m
        return counts_of(seen_of(stretch.points, self.name, drives, margin, rivals), rates)

    def _of_line(self, stretch: Stretch) -> list[Detected]:
        """What the old line of a stretch claims, of a moved one also what nobody does."""
        assert self.claims is not None
        number = next(k for k, e in enumerate(self.old) if e.element_id == stretch.element_id)
        out = []
        for drive in self.claims.drives:
            mine = drive.of_line(self.claims.stations, number)
            if stretch.reason == MOVED:
                mine = np.union1d(mine, drive.loose)
            out.append(Detected.of_samples(drive, mine, stretch.reason == MOVED))
        return out
