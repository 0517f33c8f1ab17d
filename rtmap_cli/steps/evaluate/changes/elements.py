"""Found, missed and false changes: element by element, and frame by frame as TbV counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.maps.element import RING_CLASSES

Array = NDArray[np.float64]

MIN_IOU = 0.3
"""A crossing is found when the polygons overlap by this intersection over union."""
REACH = 1.0
"""A line is found within this distance, metres …"""
MIN_SHARE = 0.5
"""… along this share of the true stretch and of the prediction."""
FRAME_RANGE = 20.0
"""TbV: a frame is changed when a change is nearer than this to the vehicle, metres."""


@dataclass(frozen=True)
class Change:
    """One change of the map: ``points`` (n, 2) in a metric frame that prediction and truth share.

    ``kind`` is seen from the map: insert (missing in it), delete (no longer real), modify.
    """

    kind: str
    class_name: str
    points: Array
    probability: float = 1.0
    change_id: str = ""
    element_id: str = ""


@dataclass(frozen=True)
class ChangeScore:
    """Element-level result: ``found`` pairs (prediction, truth), the rest missed or false."""

    found: list[tuple[Change, Change]]
    missed: list[Change]
    false: list[Change]
    outside: list[Change] = field(default_factory=list)

    @property
    def precision(self) -> float | None:
        """Found / predicted; None without predictions."""
        n = len(self.found) + len(self.false)
        return len(self.found) / n if n else None

    @property
    def recall(self) -> float | None:
        """Found / true; None without true changes."""
        n = len(self.found) + len(self.missed)
        return len(self.found) / n if n else None

    def as_json(self, km: float | None = None) -> dict[str, Any]:
        """Counts, precision, recall, F1 and, with the distance driven, false changes per km."""
        p, r = self.precision, self.recall
        f1 = 2 * p * r / (p + r) if p and r else 0.0
        out: dict[str, Any] = {
            "found": len(self.found),
            "missed": len(self.missed),
            "false": len(self.false),
            "outside_area": len(self.outside),
            "precision": p,
            "recall": r,
            "f1": f1 if p is not None or r is not None else None,
        }
        if km:
            out |= {"km": km, "false_per_km": len(self.false) / km}
        return out

    def precision_recall(self) -> dict[str, Any]:
        """Precision and recall over the threshold on the probability, and the area under them.

        ``curve``: one point per probability that occurs, from the highest down, counting all
        changes that are at least so probable. Matching goes by falling probability, so that a
        threshold leaves out the tail and changes nothing before it. ``ap``: area under the
        precision envelope, summed at every step of recall; equal probabilities are one step. None
        without true changes.
        """
        n = len(self.found) + len(self.missed)
        if not n:
            return {"ap": None, "curve": []}
        judged = [(p.probability, True) for p, _ in self.found]
        judged += [(c.probability, False) for c in self.false]
        probability = np.array([p for p, _ in judged])
        hit = np.array([h for _, h in judged], dtype=bool)
        curve = []
        for threshold in np.unique(probability)[::-1].tolist():
            kept = probability >= threshold
            tp = int(hit[kept].sum())
            point = {"threshold": threshold, "found": tp, "false": int(kept.sum()) - tp}
            curve.append(point | {"precision": tp / int(kept.sum()), "recall": tp / n})
        recall = np.array([0.0] + [c["recall"] for c in curve])
        precision = np.array([c["precision"] for c in curve])
        envelope = np.maximum.accumulate(precision[::-1])[::-1]
        return {"ap": float((np.diff(recall) * envelope).sum()), "curve": curve}


def same_place(predicted: Array, true: Array, class_name: str) -> float:
    """How well two geometries agree, 0 when they do not count as the same.

    Crossings: intersection over union, at least ``MIN_IOU``. Lines: the smaller of the share of
    the true stretch within ``REACH`` of the prediction and of the prediction within ``REACH`` of
    the true one, at least ``MIN_SHARE``.
    """
    import shapely

    if class_name in RING_CLASSES:
        a, b = _polygon(predicted), _polygon(true)
        union = a.union(b).area
        score = float(a.intersection(b).area / union) if union else 0.0
        return score if score >= MIN_IOU else 0.0
    p, t = shapely.LineString(predicted), shapely.LineString(true)
    if not p.length or not t.length:
        return 0.0
    covered = t.intersection(p.buffer(REACH)).length / t.length
    right = p.intersection(t.buffer(REACH)).length / p.length
    score = float(min(covered, right))
    return score if score >= MIN_SHARE else 0.0


def _polygon(points: Array) -> Any:
    import shapely

    if len(points) < 4:
        return shapely.Polygon()
    polygon = shapely.Polygon(points)
    return polygon if polygon.is_valid else polygon.buffer(0)


def score_changes(
    predicted: Sequence[Change], true: Sequence[Change], area: Any | None = None
) -> ChangeScore:
    """Match predicted to true changes: same kind, same class, same place; each true one once.

    Predictions go by falling probability, each takes the free true change that it fits best; a
    second prediction of a change already found is false. Where the truth says of an element that
    moved that it was deleted, and inserted at its new place, a predicted ``modify`` of it that lies
    there finds both. What lies mostly outside ``area`` (a
    shapely geometry; None: everywhere) is neither right nor wrong.
    """
    inside = [c for c in predicted if area is None or _mostly_inside(c.points, area)]
    kept = {id(c) for c in inside}
    outside = [c for c in predicted if id(c) not in kept]
    free = list(true)
    found: list[tuple[Change, Change]] = []
    false: list[Change] = []
    for change in sorted(inside, key=lambda c: -c.probability):
        fits = [
            same_place(change.points, t.points, t.class_name)
            if (t.kind, t.class_name) == (change.kind, change.class_name)
            else 0.0
            for t in free
        ]
        best = int(np.argmax(fits)) if fits else -1
        moved = _moved(change, free)
        if best >= 0 and fits[best] > 0:
            found.append((change, free.pop(best)))
        elif moved:
            found += [(change, t) for t in moved]
            free = [t for t in free if not any(t is m for m in moved)]
        else:
            false.append(change)
    return ChangeScore(found, free, false, outside)


def _moved(change: Change, true: Sequence[Change]) -> tuple[Change, ...]:
    """The true deletion of the element that a prediction modifies, and the true insertion at the
    place that it modifies it to; nothing where there is none of either."""
    if change.kind != "modify" or not change.element_id:
        return ()
    same = [t for t in true if t.class_name == change.class_name]
    gone = [t for t in same if t.kind == "delete" and t.element_id == change.element_id]
    there = [t for t in same if t.kind == "insert"]
    fits = [same_place(change.points, t.points, t.class_name) for t in there]
    if not gone or max(fits, default=0.0) <= 0:
        return ()
    return gone[0], there[int(np.argmax(fits))]


def _mostly_inside(points: Array, area: Any) -> bool:
    import shapely

    line = shapely.LineString(points)
    if not line.length:
        return bool(area.intersects(line))
    return bool(area.intersection(line).length >= 0.5 * line.length)


def distances_to_events(ego_xy: Array, events: Sequence[Array]) -> Array:
    """(n, m) planar distances from positions (n, 2) to the outlines or lines of the events."""
    import shapely

    places = shapely.points(np.asarray(ego_xy, dtype=np.float64).reshape(-1, 2))
    out = np.full((len(places), len(events)), np.inf)
    for k, points in enumerate(events):
        out[:, k] = shapely.distance(places, shapely.LineString(points))
    return out


def changed_frames(
    ego_xy: Array, events: Sequence[Array], within: float = FRAME_RANGE
) -> NDArray[np.bool_]:
    """(n,) True where an event is strictly nearer than ``within`` metres."""
    if not len(events):
        return np.zeros(len(ego_xy), dtype=bool)
    return np.asarray(distances_to_events(ego_xy, events).min(axis=1) < within, dtype=bool)


def frame_accuracy(truth: NDArray[np.bool_], answer: NDArray[np.bool_]) -> dict[str, Any]:
    """TbV's accuracies over all frames: of changed ones, of unchanged ones, and their mean.

    None where there is no frame of a kind; the mean then does not exist either.
    """
    changed = float(answer[truth].mean()) if truth.any() else None
    unchanged = float((~answer[~truth]).mean()) if (~truth).any() else None
    both = changed is not None and unchanged is not None
    return {
        "frames": len(truth),
        "changed_frames": int(truth.sum()),
        "acc_changed": changed,
        "acc_unchanged": unchanged,
        "macc": (changed + unchanged) / 2 if both else None,  # type: ignore[operator]
    }
