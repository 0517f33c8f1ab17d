"""Average precision of detected map elements, as the field's own evaluators compute it.

docs/evaluate-map.md tells the steps; ``protocols`` names the evaluators, ``matching`` has what
happens in a frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.steps.evaluate.maps.matching import match
from rtmap_cli.steps.evaluate.maps.protocols import PROTOCOLS, THRESHOLDS, Detection
from rtmap_cli.steps.evaluate.maps.shape import MEASURES, Shape, measure

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ClassScore:
    """Average precision ``ap`` and true positives ``tp`` of one class by threshold (m)."""

    ap: dict[float, float]
    tp: dict[float, int]
    num_gt: int
    num_pred: int

    @property
    def mean(self) -> float:
        """Mean AP over the thresholds."""
        return float(np.mean(list(self.ap.values())))


@dataclass(frozen=True)
class MapScore:
    """The result of one evaluation; all APs lie in [0, 1]."""

    protocol: str
    classes: dict[str, ClassScore]
    frames: int

    @property
    def mAP(self) -> float:  # noqa: N802 - the field's own word
        """Plain mean over all classes; a class without true elements counts as 0."""
        return float(np.mean([c.mean for c in self.classes.values()])) if self.classes else 0.0

    @property
    def without_truth(self) -> list[str]:
        """Classes without any true element: their 0 says nothing about the predictions."""
        return [name for name, c in self.classes.items() if not c.num_gt]

    def as_json(self) -> dict[str, Any]:
        """``{"protocol", "frames", "mAP", "classes": {name: {"ap", "tp", "num_gt", "num_pred"}}}``
        and, where there are such classes, ``without_truth``."""
        classes = {
            name: {
                "ap": {str(t): v for t, v in c.ap.items()},
                "tp": {str(t): v for t, v in c.tp.items()},
                "num_gt": c.num_gt,
                "num_pred": c.num_pred,
            }
            for name, c in self.classes.items()
        }
        out = {"protocol": self.protocol, "frames": self.frames, "mAP": self.mAP}
        flag = {"without_truth": self.without_truth} if self.without_truth else {}
        return out | {"classes": classes} | flag


def evaluate_frames(
    pred: Iterable[Sequence[Detection]],
    truth: Iterable[Sequence[Detection]],
    classes: Sequence[str],
    thresholds: Sequence[float] = THRESHOLDS,
    protocol: str = "rtmap",
) -> MapScore:
    """Score predictions against truth, frame by frame in the same order.

    Each frame is a sequence of (class, vertices, score), vertices in metres of any frame that both
    share; the score of a true element is ignored, as are elements of other ``classes``. Nothing is
    cropped here. Equal scores keep the order of the input. Frames may be generators: only scores
    and hits are kept. Raises BadInput for vertices that are not finite, a score that is NaN, a
    true element of one vertex, and (streammapnet) a predicted one.
    """
    scorer = Scorer(classes, thresholds, protocol)
    for p, t in zip(pred, truth, strict=True):
        scorer.add(p, t)
    return scorer.result()


@dataclass(frozen=True)
class Judged:
    """One frame and class: scores (n,) and hits (n, thresholds) of predictions, the number of true
    elements, and the sums of ``steps.evaluate.maps.shape`` where they were asked for."""

    scores: Array
    hits: NDArray[np.bool_]
    num_gt: int
    shape: Array | None = None


@dataclass(frozen=True)
class Ranking:
    """One class over many frames: scores (n,), hits (n, thresholds), the frame (n,) of every
    prediction in input order, and the number of true elements (frames,)."""

    scores: Array
    hits: NDArray[np.bool_]
    frame: NDArray[np.int32]
    num_gt: NDArray[np.int32]

    def score(self, thresholds: Array, frames: NDArray[np.bool_] | None = None) -> ClassScore:
        """Rank the predictions of all frames, or of those that a mask (frames,) names."""
        kept = slice(None) if frames is None else frames[self.frame]
        scores, hits = self.scores[kept], self.hits[kept]
        hits = hits[np.argsort(-scores, kind="stable")]
        num_gt = int((self.num_gt if frames is None else self.num_gt[frames]).sum())
        names = [float(t) for t in thresholds]
        return ClassScore(
            ap={t: average_precision(hits[:, k], num_gt) for k, t in enumerate(names)},
            tp={t: int(hits[:, k].sum()) for k, t in enumerate(names)},
            num_gt=num_gt,
            num_pred=len(scores),
        )


class Scorer:
    """Judges frames one by one and ranks them at the end.

    Only scores, hits and counts are kept, geometry is forgotten at once. ``judge`` has no memory,
    so that frames can be judged anywhere. ``shape`` also measures smoothness and topology.
    """

    def __init__(
        self,
        classes: Sequence[str],
        thresholds: Sequence[float] = THRESHOLDS,
        protocol: str = "rtmap",
        shape: bool = False,
    ) -> None:
        self.protocol = PROTOCOLS[protocol]
        self.shape = shape
        self.thresholds = np.array(sorted(thresholds), dtype=np.float64)
        self.classes = list(classes)
        self.judged: dict[str, list[Judged]] = {name: [] for name in classes}
        self.frames = 0

    def add(
        self, pred: Sequence[Detection], truth: Sequence[Detection], name: str | None = None
    ) -> None:
        """Add one frame; ``name`` (default: its number) is used in error messages."""
        self.collect(self.judge(pred, truth, str(self.frames if name is None else name)))

    def judge(
        self, pred: Sequence[Detection], truth: Sequence[Detection], name: str
    ) -> dict[str, Judged]:
        """Match one frame, class by class."""
        where = f"frame {name}"
        sides: list[list[list[Detection]]] = [[], []]
        for class_name in self.classes:
            predicted = [p for p in pred if p[0] == class_name]
            if self.protocol.drop_single:
                predicted = [p for p in predicted if len(p[1]) > 1]
            if not all(isfinite(p[2]) for p in predicted):
                raise BadInput(where, f"a predicted {class_name} has a score that is not finite")
            sides[0].append(predicted)
            sides[1].append([t for t in truth if t[0] == class_name])
        matches = match(sides[0], sides[1], self.thresholds, self.protocol, where)
        out = {}
        for k, class_name in enumerate(self.classes):
            lines, targets = ([np.asarray(e[1]) for e in side[k]] for side in sides)
            shape = measure(lines, targets, matches[k].taken) if self.shape else None
            scores = np.array([p[2] for p in sides[0][k]], dtype=np.float64)
            out[class_name] = Judged(scores, matches[k].hits, len(targets), shape)
        return out

    def collect(self, judged: dict[str, Judged]) -> None:
        """Add one frame that was judged, here or elsewhere."""
        for name in self.classes:
            self.judged[name].append(judged[name])
        self.frames += 1

    def rankings(self) -> dict[str, Ranking]:
        """Everything collected, by class."""
        out = {}
        for name, judged in self.judged.items():
            sizes = [len(j.scores) for j in judged]
            out[name] = Ranking(
                np.concatenate([np.zeros(0), *(j.scores for j in judged)]),
                np.concatenate(
                    [np.zeros((0, len(self.thresholds)), bool), *(j.hits for j in judged)]
                ),
                np.repeat(np.arange(len(judged), dtype=np.int32), sizes),
                np.array([j.num_gt for j in judged], dtype=np.int32),
            )
        return out

    def shapes(self, frames: NDArray[np.bool_] | None = None) -> dict[str, Shape]:
        """Smoothness and topology by class, over all frames or those of a mask."""
        out = {}
        for name, judged in self.judged.items():
            sums = np.array([np.zeros(MEASURES) if j.shape is None else j.shape for j in judged])
            out[name] = Shape(
                sums.reshape(-1, MEASURES)[slice(None) if frames is None else frames].sum(axis=0)
            )
        return out

    def result(self, frames: NDArray[np.bool_] | None = None) -> MapScore:
        """Rank everything added so far, or the frames that a mask (frames,) names."""
        return MapScore(
            self.protocol.name,
            {name: r.score(self.thresholds, frames) for name, r in self.rankings().items()},
            self.frames if frames is None else int(frames.sum()),
        )


def average_precision(hits: NDArray[np.bool_], num_gt: int) -> float:
    """Area under the precision envelope, summed at every recall step.

    ``hits`` (n,) says of each prediction, by falling score, whether it is a true positive. The
    precision at a recall is the highest one at that or a larger recall. 0 without truth.
    """
    if not len(hits) or not num_gt:
        return 0.0
    tp = np.cumsum(hits)
    precision = tp / np.arange(1, len(hits) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(envelope[hits].sum() / num_gt)
