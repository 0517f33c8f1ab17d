"""The error model and the settings of localization: every number that can be tuned, in one place.

The residual across the line of vertex p of element k, seen in frame t at the place q of the map, is

    n · (R p + t - q) = n · s_k (√place f_c(q) + √element e_kt) + √vertex n · s v + map error

with s the stated sigma, f_c a smooth unit field over the map per class (the systematic error of a
detector at a place, the same in every frame of a drive), e_kt an offset which the vertices of one
element share, and v the vertex' own error; vertex + element + place = 1. Taking vertices as
independent gives a covariance that is wrong by an order of magnitude.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ErrorModel:
    """How errors are composed; metres, radians, shares of the stated variance.

    ``vertex_share``, ``element_share``: see above, the rest is fixed to the place; ``scale``:
    factor on every stated sigma; ``place_length_m``: correlation length l of the field
    (exp(-d²/2l²)); ``element_length_m``: travel over which an element's own offset persists;
    ``map_sigma_m``: per axis, where the map states no covariance; ``map_length_m``: correlation length of the map's
    error along a line; ``map_persist_m``: travel over which one error of the map stays in range;
    ``rig_sigma_m``, ``rig_sigma_rad``: constant error of the rig's calibration, which no drive can
    show; ``outlier_sigma_m``: offset of an element that is not what the map says it is;
    ``gnss_walk_m``: growth of the GNSS bias (m per √m driven); ``gnss_yaw_length_m``: travel
    over which a yaw bias persists.
    """

    vertex_share: float = 0.2
    element_share: float = 0.3
    scale: float = 1.0
    place_length_m: float = 20.0
    element_length_m: float = 15.0
    map_sigma_m: float = 0.1
    map_length_m: float = 12.0
    map_persist_m: float = 50.0
    rig_sigma_m: float = 0.05
    rig_sigma_rad: float = 0.0005
    outlier_sigma_m: float = 2.0
    gnss_walk_m: float = 0.06
    gnss_yaw_length_m: float = 2000.0

    @property
    def place_share(self) -> float:
        """What is neither the vertex' nor the element's own."""
        return max(0.0, 1.0 - self.vertex_share - self.element_share)

    @property
    def offset_share(self) -> float:
        """What the vertices of an element share in one frame."""
        return self.element_share + self.place_share


@dataclass(frozen=True)
class Settings:
    """How the solvers search; metres.

    ``starts_m``: lateral shifts of the start that are tried per frame; ``start_gates_m``: gates of
    association, widest first, while all of them compete with every second vertex, then while the
    best ``finalists`` do with all; ``gates_m``: gates of the rounds with the field;
    ``smooth_gates_m``: the same for the whole log; ``heading_weight_m``: distance that two
    perpendicular lines are apart in association; ``huber``: vertex residuals beyond this many
    sigmas count linearly; ``score_logit``: added to the logit of a score: prior log-odds that a
    detection is on the map; ``min_score``: detections below are left out; ``min_residuals``: fewer
    vertices than this are no match; ``evidence_share``: what of the difference in evidence between
    starts is believed (elements are not independent); ``degenerate_m``: a direction (yaw at a lever of
    10 m) that the map leaves less certain than this is degenerate; ``chunk_m``: travel per block of
    the solver, longer than the view; ``odometry_share``, ``odometry_rad_per_m``: sigma of odometry
    that states none.
    """

    starts_m: tuple[float, ...] = (0.0, -0.8, 0.8, -1.6, 1.6, -2.4, 2.4)
    start_gates_m: tuple[tuple[float, ...], tuple[float, ...]] = ((4.0, 3.0), (2.0, 1.5))
    finalists: int = 3
    gates_m: tuple[float, ...] = (1.0, 1.0, 1.0)
    smooth_gates_m: tuple[float, ...] = (3.0, 2.0, 1.5, 1.0, 1.0, 1.0)
    heading_weight_m: float = 2.0
    huber: float = 1.0
    min_score: float = 0.05
    score_logit: float = 1.5
    evidence_share: float = 0.5
    degenerate_m: float = 1.0
    min_residuals: int = 5
    chunk_m: float = 100.0
    odometry_share: float = 0.01
    odometry_rad_per_m: float = 0.0009
