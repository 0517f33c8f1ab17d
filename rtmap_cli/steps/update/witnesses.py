"""The drives as witnesses of the stretches of one class: which detections speak for which.

Where an old map has lines, what they claim speaks for them and the rest for what is new: a line
beside another one is judged by its own detections. Outlines are judged by all detections.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.element import Element
from rtmap_cli.maps.evidence import Counts
from rtmap_cli.steps.update.claims import Claims
from rtmap_cli.steps.update.compare import MISSING_NEW, MISSING_OLD, Stretch
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


@dataclass(frozen=True)
class Witnesses:
    """Drives and the ``old`` elements of a class, with the ``claims`` of these if they are lines.
    """

    traversals: Sequence[Traversal]
    old: Sequence[Element]
    name: str
    claims: Claims | None
    settings: Settings

    @staticmethod
    def of(
        traversals: Sequence[Traversal],
        old: Sequence[Element],
        name: str,
        claims: Claims | None,
        settings: Settings,
    ) -> Witnesses:
        """The witnesses of a class."""
        return Witnesses(traversals, old, name, claims, settings)

    @cached_property
    def everything(self) -> list[Detected]:
        """All detections of each drive."""
        if self.claims is None:
            return [Detected.of(t, self.name) for t in self.traversals]
        return [Detected.of_samples(d, np.arange(len(d.samples))) for d in self.claims.drives]

    @cached_property
    def loose(self) -> list[Detected]:
        """What no old line claims."""
        if self.claims is None:
            return self.everything
        return [Detected.of_samples(d, d.loose) for d in self.claims.drives]

    @cached_property
    def alone(self) -> Rates:
        """Of lines that have none beside them."""
        return Rates(usual_rate(self.old, self.name, self.everything, self.settings.margin_m))

    @cached_property
    def beside(self) -> Rates:
        """Of new lines beside old ones, which leave something there now and then."""
        if self.claims is None:
            return self.alone
        false = aside_rate(self.old, self.name, self.loose, self.settings.margin_m)
        return Rates(max(self.alone.usual, 1.5 * false), false)

    @cached_property
    def kept(self) -> object:
        """The old lines as one geometry."""
        import shapely

        return shapely.union_all([shapely.LineString(e.xy) for e in self.old])

    def say(self, stretch: Stretch) -> tuple[Counts, float]:
        """What every drive saw of a stretch, and what they say together (log-odds)."""
        import shapely

        drives, rates, rivals = self.everything, self.alone, None
        if self.claims is not None:
            number = [e.element_id for e in self.old].index(stretch.element_id) if (
                stretch.element_id is not None
            ) else -1
            if stretch.reason == MISSING_OLD:
                drives = self.loose
                near = shapely.distance(shapely.LineString(stretch.points), self.kept) < BESIDE
                rates = self.beside if near else self.alone
            else:
                parts = [d.of_line(self.claims.stations, number) for d in self.claims.drives]
                if stretch.reason != MISSING_NEW:
                    # What is nearer to where it lay does not say that it moved.
                    rivals = shapely.LineString(stretch.before)
                    pairs = zip(parts, self.claims.drives, strict=True)
                    parts = [np.union1d(p, d.loose) for p, d in pairs]
                drives = [
                    Detected.of_samples(d, p)
                    for d, p in zip(self.claims.drives, parts, strict=True)
                ]
        seen = seen_of(stretch.points, self.name, drives, self.settings.margin_m, rivals)
        return counts_of(seen, rates)
