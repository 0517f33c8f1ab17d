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
    """How errors are composed; metres, radians, shares of the stated variance."""

    # Parts of the stated variance (see above); what they leave is fixed to the place.
    vertex_share: float = 0.2
    element_share: float = 0.3
    # Factor on every stated sigma.
    scale: float = 1.0
    # Correlation length l of the field over the map, exp(-d²/2l²).
    place_length_m: float = 20.0
    # Travel over which an element's own offset persists from frame to frame.
    element_length_m: float = 15.0
    # The map's own error: per axis where the map states none, its correlation length along a line,
    # and the travel over which one error of it counts once: for detections, and for answers to
    # prior queries, which take along the error of what they were asked about while it is in range.
    map_sigma_m: float = 0.1
    map_length_m: float = 12.0
    map_persist_m: float = 15.0
    asked_persist_m: float = 50.0
    # Constant error of the rig's calibration along and across the vehicle (a pitch of the cameras
    # moves what they see along it), and its turn: no drive can show them.
    rig_sigma_m: tuple[float, float] = (0.08, 0.03)
    rig_sigma_rad: float = 0.0005
    # Offset of an element that is not what the map says it is.
    outlier_sigma_m: float = 2.0
    # Growth of the GNSS bias (m per √m driven); travel over which a yaw bias persists.
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
    """How the solvers search; metres."""

    # Lateral shifts of the start that compete in every frame: first all of them with every second
    # vertex, then the best finalists with all. Per round: the gate of association, and how far the
    # pose may still be off, which must not make an outlier of a well-measured element.
    starts_m: tuple[float, ...] = (0.0, -0.8, 0.8, -1.6, 1.6, -2.4, 2.4)
    start_gates_m: tuple[tuple[float, ...], tuple[float, ...]] = ((4.0, 3.0), (2.0, 1.5))
    start_doubts_m: tuple[tuple[float, ...], tuple[float, ...]] = ((1.0, 0.5), (0.25, 0.1))
    finalists: int = 3
    # The same for the rounds with the field, and for those over the whole log.
    gates_m: tuple[float, ...] = (1.5, 1.5, 1.5)
    doubts_m: tuple[float, ...] = (0.1, 0.05, 0.0)
    smooth_gates_m: tuple[float, ...] = (3.0, 2.0, 1.5, 1.0, 1.0, 1.0)
    smooth_doubts_m: tuple[float, ...] = (0.3, 0.2, 0.1, 0.05, 0.0, 0.0)
    # Distance in association that two perpendicular lines have at the same place.
    heading_weight_m: float = 2.0
    # Vertex residuals beyond this many sigmas count linearly: in single frames, over the whole log.
    huber: float = 0.5
    smooth_huber: float = 1.0
    # Detections with a lower score are left out; the others' prior log-odds to be on the map are
    # the logit of the score and this. It doubts more than networks err, because stated sigmas
    # scatter: an element that was 2 sigmas off at the stated one had a larger sigma.
    min_score: float = 0.05
    score_logit: float = -1.0
    # What of a difference in evidence between starts is believed: elements are not independent.
    evidence_share: float = 0.5
    # A direction (yaw at a lever of 10 m) that the map leaves less certain than this is degenerate;
    # fewer vertices than this are no match.
    degenerate_m: float = 1.0
    min_residuals: int = 5
    # Travel per block of the whole-log solver: longer than the view.
    chunk_m: float = 100.0
    # Sigma of odometry that states none: share of a step, radians per metre.
    odometry_share: float = 0.01
    odometry_rad_per_m: float = 0.0009
