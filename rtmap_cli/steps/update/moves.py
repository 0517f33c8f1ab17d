"""How probable it is that a line moved, however often the drives found it there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rtmap_cli.steps.update.compare import MOVED, Stretch

ALONE, ODDS = 1.0, 12.0
"""Drives agree on their errors, too: a line that lies aside by so many limits has as probably moved
as not, and by one limit more the log-odds are so much higher."""
SURE, TOGETHER, WITH_OTHERS = 1.5, 16.0, 0.8
"""Lanes move together: on the same road (m) as a line that lies aside by so many limits, to the
same side, so many are enough. Drives that follow what moved see the rest on the other side."""


def move_odds(stretch: Stretch, stretches: Sequence[Stretch]) -> float:
    """Log-odds that a line of a class moved, by how far aside it lies and by what moved beside it
    (``stretches``, of the same class or not); no bound for what is lost or new."""
    if stretch.reason != MOVED:
        return float("inf")
    together = any(_moved_along(s, stretch) for s in stretches)
    return ODDS * (stretch.aside - (WITH_OTHERS if together else ALONE))


def _moved_along(sure: Stretch, stretch: Stretch) -> bool:
    """Whether a line surely moved, near another one and to the same side as that."""
    import shapely

    if sure.reason != MOVED or sure.aside < SURE or sure.element_id == stretch.element_id:
        return False
    lines = [shapely.LineString(s.before) for s in (sure, stretch)]
    shift = [np.mean(s.points - s.before, axis=0) for s in (sure, stretch)]
    return float(shift[0] @ shift[1]) > 0 and bool(shapely.distance(*lines) <= TOGETHER)
