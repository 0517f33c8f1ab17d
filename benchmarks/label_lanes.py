"""How near the borders of ``rtmap label lanes`` lie to the lines of a simulated town.

    rtmap simulate town --seed 4 --size 700 -o town
    rtmap simulate lidar --map town --log town: --route tour --length 3100 --seed 1 -o log
    rtmap label cloud log -o cloud
    python benchmarks/label_lanes.py town log cloud

Vertices are taken from the registered to the true pose of the nearest frame first: how well the
trajectory lies in the world is a figure of ``rtmap label cloud``, not of the borders.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rtmap_cli.formats.lanelet2.osm import write_osm
from rtmap_cli.formats.lanelet2.write import to_osm
from rtmap_cli.geometry.poses import invert
from rtmap_cli.logs.cloud import CloudFolder
from rtmap_cli.logs.native import NativeLog
from rtmap_cli.maps.crs import to_lonlat
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import read_map
from rtmap_cli.output import table
from rtmap_cli.steps.label.lanes.borders import KINDS, Widths, borders_of, sides_of
from rtmap_cli.steps.label.lanes.lanes import LaneOptions, label_lanes
from rtmap_cli.steps.label.lanes.snap import evidence_of, snapped

Array = NDArray[np.float64]


def to_truth(xy: Array, log: NativeLog, cloud: CloudFolder) -> Array:
    """(n, 2) places of the cloud in the true world, by the nearest frame."""
    truth, found = log.truth_poses(), cloud.trajectory()
    assert truth is not None
    row = {int(f): k for k, f in enumerate(truth.frame)}
    move = truth.pose[[row[int(f)] for f in found.frame]] @ invert(found.pose)
    at = cKDTree(found.pose[:, :2, 3]).query(xy)[1]
    full = np.column_stack([xy, found.pose[at, 2, 3], np.ones(len(xy))])
    out: Array = np.einsum("nij,nj->ni", move[at], full)[:, :2]
    return out


def distances(xy: Array, town: VectorMap) -> Array:
    """(n,) metres to the nearest divider or boundary."""
    lines = [shapely.LineString(e.xy) for e in town if e.class_name in ("divider", "boundary")]
    at = shapely.STRtree(lines).query_nearest(shapely.points(xy), all_matches=False)[1]
    out: Array = shapely.distance(shapely.points(xy), np.array(lines)[at])
    return out


def routed(made: object, crs: str) -> str:
    """What the lanelet2 wheel says: lanelets loaded, errors, and how many it can route over."""
    import lanelet2

    vector_map = made.vector_map  # type: ignore[attr-defined]
    osm, _ = to_osm(vector_map, made.info)  # type: ignore[attr-defined]
    middle = to_lonlat(crs, np.array([vector_map.bounds()[:2]]))[0]
    with tempfile.TemporaryDirectory() as folder:
        write_osm(osm, Path(folder) / "map.osm")
        origin = lanelet2.io.Origin(float(middle[1]), float(middle[0]))
        projector = lanelet2.projection.UtmProjector(origin)
        loaded, errors = lanelet2.io.loadRobust(str(Path(folder) / "map.osm"), projector)
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    graph = lanelet2.routing.RoutingGraph(loaded, rules)
    lanes = list(loaded.laneletLayer)
    linked = sum(bool(graph.following(x) or graph.previous(x)) for x in lanes)
    passable = sum(rules.canPass(x) for x in lanes)
    return (
        f"lanelet2: {len(lanes)} lanelets loaded, {len(errors)} errors, {passable} passable, "
        f"{linked} with a neighbour to route to"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("town", "log", "cloud"):
        parser.add_argument(name, type=Path)
    given = parser.parse_args()
    town, log, cloud = read_map(given.town), NativeLog(given.log), CloudFolder(given.cloud)
    begin = time.process_time()
    made = label_lanes([given.cloud], LaneOptions(Widths(), (given.cloud,), 1.6))
    seconds = time.process_time() - begin
    sides = sides_of(made.graph, Widths())
    seen = evidence_of(given.cloud, cloud.crs)
    rows = []
    for what, metres in (("10 ft", sides), ("snapped", snapped(made.graph, sides, seen, 1.6))):
        borders = borders_of(made.graph, metres)
        xy = np.concatenate([line for b in borders for line in b.lines])
        kinds = np.concatenate([k for b in borders for k in b.kinds])
        off = distances(to_truth(xy, log, cloud), town)
        for k, n in sorted(Counter(kinds.tolist()).items()):
            d = off[kinds == k]
            q = [f"{v:.3f}" for v in np.percentile(d, [50, 75, 90, 95])]
            rows.append([what, KINDS[k], n, *q, f"{100 * (d <= 0.15).mean():.1f} %"])
        if what == "snapped":
            d = off[kinds > 0]
            q = [f"{v:.3f}" for v in np.percentile(d, [50, 75, 90, 95])]
            rows.append([what, "all seen", len(d), *q, f"{100 * (d <= 0.15).mean():.1f} %"])
    head = [
        "borders",
        "place from",
        "vertices",
        "p50 m",
        "p75 m",
        "p90 m",
        "p95 m",
        "within 0.15 m",
    ]
    print("\n".join(table(head, rows)))
    print(f"{made.figures['driven_m']:.0f} m driven (simulated), {seconds:.1f} CPU s")
    print(routed(made.lanelets, cloud.crs))


if __name__ == "__main__":
    main()
