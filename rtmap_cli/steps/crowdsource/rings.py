"""Closed elements of the next version: outlines averaged point by point over all drives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.rings import align, close, open_ring, open_rings, simplified
from rtmap_cli.logs.traversal import Traversal, pose_variance
from rtmap_cli.maps.consensus import Sightings, consensus
from rtmap_cli.maps.refit import FusionModel, columns, planar
from rtmap_cli.steps.crowdsource.cut_rings import cut_offsets
from rtmap_cli.steps.crowdsource.lines import LONGEST_MOVE, Fused

Array = NDArray[np.float64]
Int = NDArray[np.int64]

SIMPLIFY = 0.25
"""A vertex of a new outline that lies so near (m) to the line of its neighbours is left out."""
SMOOTH = 1.5
"""Single vertices are noisy: offsets of an outline are smoothed along it over so much (m)."""
NEAR, REACH, FARTHEST = 3.5, 2.2, 8.0
"""A detection whose centre is farther (m) from the element's is not averaged, unless that is
within so many of its sigmas and this distance (m)."""
ROUNDS, STAYS = 3, 0.2
"""Times that a new element is averaged, unless it moves by less (m)."""
WHOLE = 0.25
"""Log of how much longer or shorter the outline of a detection at the border may be."""


def fuse_ring(
    points: Array,
    covariance: Array | None,
    new: bool,
    class_name: str,
    traversals: Sequence[Traversal],
    model: FusionModel,
) -> Fused:
    """One closed element from the detections around it and, unless ``new``, its prior.

    The vertices of a prior outline keep their number and order: each moves by the offset that
    the outline has at its place, by Eq. 5 with its own covariance.
    """
    reference = outline = open_ring(points)
    # Which detections are the element's, and what of them, is told anew where a new one has moved.
    for _ in range(ROUNDS if new else 1):
        reference = outline
        drives = [_sightings(t, class_name, reference, new) for t in traversals]
        moves, variances = consensus([d for d in drives if len(d)], 1, model)
        if not np.isfinite(variances[0]):
            return Fused(points, covariance, False)
        outline = reference + _smooth(moves[0].reshape(-1, 2), reference)
        if np.hypot(*(outline - reference).mean(axis=0)) < STAYS:
            break
    variance = np.full(len(reference), variances[0] + model.common)
    if new:
        ring = simplified(outline, SIMPLIFY)
        near = np.argmin(np.hypot(*np.moveaxis(ring[:, None] - outline, -1, 0)), axis=1)
        spread = np.eye(2) * variance[near, None, None]
        heights = np.full(len(ring), np.nan)
        return Fused(np.column_stack([ring, heights]), columns(spread, None), True)
    return _moved(points, covariance, reference, outline, variance)


def _smooth(offset: Array, reference: Array) -> Array:
    """Offsets (n, 2) smoothed along the outline, over ``SMOOTH`` metres."""
    from scipy.ndimage import gaussian_filter1d

    step = float(_outline(reference[None])[0]) / len(reference)
    out: Array = gaussian_filter1d(offset, SMOOTH / max(step, 1e-3), axis=0, mode="wrap")
    return out


def _sightings(traversal: Traversal, class_name: str, reference: Array, new: bool) -> Sightings:
    """Detections of one element as offsets of its outline, point by point; the whole outline is
    one station. Of a ``new`` one those that the range cuts tell what was in view; an answer about
    the map is cut where the frame was thought to stand when the network was asked."""
    near, reach = _near(traversal, class_name, reference)
    rings = open_rings(traversal.points[near])
    share = np.maximum(_outline(rings), 1e-3) / _outline(reference[None])
    whole = np.hypot(*(rings.mean(axis=1) - reference.mean(axis=0)).T) <= reach
    whole &= ~traversal.cut[near] | (np.abs(np.log(share)) <= WHOLE)
    offset = np.zeros((len(near), *reference.shape))
    offset[whole] = align(rings[whole], reference) - reference
    cover = whole.astype(np.float64)
    cut = np.flatnonzero(traversal.cut[near] & ~whole & new)
    windows = traversal.windows(traversal.frame[near[cut]])
    some, offset_cut, in_view = cut_offsets(rings[cut], windows, reference, reach[cut])
    offset[cut[some]], cover[cut[some]] = offset_cut, in_view
    kept = np.flatnonzero(cover > 0)
    index, offset = near[kept], offset[kept]
    frame = traversal.frame[index]
    cov = traversal.covariance[index]
    variance = (cov[..., 0, 0] + cov[..., 1, 1]).mean(axis=1) / 2
    centre = np.tile(reference.mean(axis=0), (len(index), 1))
    axes = [pose_variance(traversal, frame, centre, np.tile(a, (len(index), 1))) for a in np.eye(2)]
    return Sightings(
        np.zeros(len(index), np.int64),
        traversal.way[frame],
        offset.reshape(len(index), 2 * len(reference)),
        np.sqrt(np.maximum(variance, 0.01)),
        cover[kept],
        traversal.score[index],
        (axes[0] + axes[1]) / 2,
    )


def _near(traversal: Traversal, class_name: str, reference: Array) -> tuple[Int, Array]:
    """Detections of the class that may be the element, and how far (m) the middle of each may lie
    from the element's."""
    mine = np.flatnonzero(traversal.class_name == class_name)
    centre = reference.mean(axis=0)
    cov = traversal.covariance[mine]
    sigma = np.sqrt((cov[..., 0, 0] + cov[..., 1, 1]).mean(axis=1) / 2)
    reach = np.clip(REACH * sigma, NEAR, FARTHEST)
    # Nearly all are elsewhere: their outlines need not be drawn to see that.
    points = traversal.points[mine]
    size = np.ptp(points, axis=1).max(axis=1, initial=0.0)
    own = np.where(traversal.cut[mine], np.ptp(reference, axis=0).max(), 0.0)
    near = np.hypot(*(points.mean(axis=1) - centre).T) <= reach + np.maximum(size, own)
    return mine[near], reach[near]


def _outline(rings: Array) -> Array:
    """(n,) length of the outlines of rings (n, k, 2), metres."""
    step = rings - np.roll(rings, 1, axis=1)
    return np.asarray(np.hypot(step[..., 0], step[..., 1]).sum(axis=1))


def _moved(
    points: Array, covariance: Array | None, reference: Array, outline: Array, variance: Array
) -> Fused:
    """Prior vertices moved by the information-weighted offset of the outline at their places."""
    n = len(points) - 1
    distance = np.hypot(*np.moveaxis(points[:n, None, :2] - reference, -1, 0))
    weight = np.exp(-0.5 * (distance / 1.0) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    offset = weight @ (outline - reference)
    spread = weight @ variance
    before = planar(covariance, len(points))[:n]
    after = np.linalg.inv(np.linalg.inv(before) + np.eye(2) / spread[:, None, None])
    move = np.einsum("nij,nj->ni", after, offset / spread[:, None])
    size = np.hypot(move[:, 0], move[:, 1])
    move *= np.minimum(1.0, LONGEST_MOVE / np.maximum(size, 1e-9))[:, None]
    xy = points[:n, :2] + move
    fused = np.column_stack([close(xy), points[:, 2]])
    cov = np.concatenate([after, after[:1]])
    return Fused(fused, columns(cov, covariance), True)
