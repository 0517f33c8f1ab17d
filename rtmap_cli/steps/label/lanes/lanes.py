"""``rtmap label lanes``: drives become a map of lanelets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtmap_cli.errors import NoAnswer
from rtmap_cli.formats.lanelet2.read import Lanelet2Map
from rtmap_cli.geometry.polylines import length
from rtmap_cli.steps.label.lanes.borders import KINDS, Borders, Widths, borders_of, sides_of
from rtmap_cli.steps.label.lanes.cuts import cut_in_lanelets
from rtmap_cli.steps.label.lanes.graph import LaneGraph, lane_graph
from rtmap_cli.steps.label.lanes.snap import evidence_of, snapped
from rtmap_cli.steps.label.lanes.traces import read_traces
from rtmap_cli.steps.label.lanes.write import to_lanelet2


@dataclass(frozen=True)
class LaneOptions:
    """``widths`` to each side; ``snap`` folders whose paint and curbs draw borders to them, by at
    most ``bound`` metres; ``limit`` km/h; lanelets are cut at ``longest`` metres."""

    widths: Widths
    snap: tuple[Path, ...] = ()
    bound: float = 1.9
    limit: float | None = None
    longest: float = 100.0


@dataclass
class LabelledLanes:
    """The graph with its borders, the map of its lanelets, figures, and what was taken out of the
    drives."""

    graph: LaneGraph
    borders: list[Borders]
    lanelets: Lanelet2Map
    figures: dict[str, Any]
    notes: Counter[str]


def label_lanes(sources: Sequence[Path], options: LaneOptions) -> LabelledLanes:
    """Lanes of what was driven in ``sources`` (clouds, logs, runs), with their borders.

    BadInput for sources that cannot be read or lie in several CRSs; NoAnswer without a lane.
    """
    traces, crs, notes = read_traces(sources)
    graph = lane_graph(traces)
    if not graph.edges:
        raise NoAnswer(f"{sources[0]}: no lane was driven")
    sides = sides_of(graph, options.widths)
    for folder in options.snap:
        sides = snapped(graph, sides, evidence_of(folder, crs), options.bound)
    graph, sides = cut_in_lanelets(graph, sides, options.longest)
    borders = borders_of(graph, sides)
    lanelets = to_lanelet2(graph, borders, crs, options.limit, bool(options.snap))
    leaves, enters = graph.ends()
    kinds = np.concatenate([k for b in borders for k in b.kinds])
    figures = {
        "traces": len(traces),
        "driven_m": round(sum(length(t.xy) for t in traces), 1),
        "lanelets": len(graph.edges),
        "lanes_m": round(sum(length(e.xy) for e in graph.edges), 1),
        "forks": sum(len(v) > 1 for v in leaves.values()),
        "merges": sum(len(v) > 1 for v in enters.values()),
        "ends": sum(not leaves[e.end] for e in graph.edges),
        "vertices": {name: int((kinds == k).sum()) for k, name in enumerate(KINDS)},
    }
    return LabelledLanes(graph, borders, lanelets, figures, +notes)
