"""Everything that shapes an update, with what each number means."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """``grid_m``: side of a cell of the accumulation grids (the paper's 0.5 m); ``cell_m``: side of
    the cells that the map is split into; ``max_ap``: cells in which old and new agree less are
    candidates; ``min_probability`` of a change that is told.

    ``blur``: Gaussian (grid cells) that a grid is seen through; ``clear_m``: a look from so far
    counts half; ``margin_m``: border of the range that does not count; ``least_looks``: drives with
    fewer (weighted) looks at a place say nothing about it.
    ``threshold``: share of a class's usual confidence from which a grid cell may be a line;
    ``ridge``: how sharply (share of the confidence, per grid cell squared) it must fall to both
    sides; ``spur_m``, ``angle_deg``, ``gap_m``: branches that are dropped at junctions, ends that
    are joined there and over gaps; ``shortest_m``: shorter lines and changes are not told, nor new
    lines shorter than ``new_m``;
    ``simplify_m``: what a simplified line may be off.
    ``lost``: share of the usual confidence below which an old line is not there;
    ``drives``: how many must agree on something new, where so many looked.
    """

    grid_m: float = 0.5
    cell_m: float = 18.0
    max_ap: float = 0.95
    min_probability: float = 0.5
    blur: float = 1.0
    clear_m: float = 15.0
    margin_m: float = 3.0
    least_looks: float = 1.0
    threshold: float = 0.15
    ridge: float = 0.06
    spur_m: float = 4.0
    angle_deg: float = 40.0
    gap_m: float = 5.0
    shortest_m: float = 4.0
    new_m: float = 6.0
    simplify_m: float = 0.1
    lost: float = 0.25
    drives: int = 2
