"""How near the borders of ``rtmap label lanes`` lie to the lines of simulated towns.

    python -m benchmarks.label.lanes FOLDER [PLACE...]

``FOLDER/PLACE`` holds a town, the log of a drive through it with a VLP-16-like LiDAR and the cloud
registered from it; what is missing is made first (the commands are printed). Vertices are taken
from the registered to the true pose of the nearest frame: how well the trajectory lies in the world
is a figure of ``rtmap label cloud``, not of the borders. A vertex could be seen where a true line
crosses the perpendicular through it between ``NEAREST`` and 10 ft + the bound from the centre line.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rtmap_cli.cli import run
from rtmap_cli.formats.lanelet2.osm import write_osm
from rtmap_cli.formats.lanelet2.write import to_osm
from rtmap_cli.geometry.polylines import normals
from rtmap_cli.geometry.poses import invert
from rtmap_cli.logs.cloud import CloudFolder
from rtmap_cli.logs.native import NativeLog
from rtmap_cli.maps.crs import to_lonlat
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import read_map
from rtmap_cli.output import table
from rtmap_cli.steps.evaluate.scenarios.junctions import RoadMap
from rtmap_cli.steps.label.lanes.borders import CALTRANS, KINDS, Widths
from rtmap_cli.steps.label.lanes.lanes import LabelledLanes, LaneOptions, label_lanes
from rtmap_cli.steps.label.lanes.snap import NEAREST

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

PLACES = {
    "campus": (6, 700, "mixed", 3100),
    "streets": (4, 700, "mixed", 3100),
    "narrow": (2, 350, "campus", 1500),
    "small": (1, 300, "mixed", 2000),
    "city": (3, 420, "city", 1500),
}
"""Seed, size (m) and style of a town, metres driven. The drive of ``campus`` has every scenario
type: roundabout, loop, intersections, multi-lane. Snapping was set on ``streets`` and ``narrow``,
and that double lines have a middle was seen on ``campus``; ``small`` and ``city`` were held out."""


@dataclass(frozen=True)
class Vertices:
    """Vertices of borders: metres to the nearest true line, KINDS codes, whether a line was in
    reach, whether they lie at a junction, all (n,)."""

    off: Array
    kind: NDArray[np.int8]
    reach: Bools
    junction: Bools


def made_place(folder: Path, name: str) -> Path:
    """The folder of a place, with its town, log and cloud."""
    seed, size, style, length = PLACES[name]
    place = folder / name
    place.mkdir(parents=True, exist_ok=True)
    town, log, cloud = place / "town", place / "log", place / "cloud"
    for made, words in (
        (town, ("simulate", "town", "--seed", seed, "--size", size, "--style", style)),
        (log, ("simulate", "lidar", "--map", town, "--log", "town:", "--route", "tour",
               "--length", length, "--seed", 1, "-q")),
        (cloud, ("label", "cloud", log, "-q")),
    ):  # fmt: skip
        text = [str(w) for w in (*words, "-o", made)]
        print("rtmap " + " ".join(text), flush=True)
        if not made.exists() and (code := run(text)):
            raise SystemExit(code)
    return place


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


def measured(
    made: LabelledLanes, town: VectorMap, log: NativeLog, cloud: CloudFolder, bound: float
) -> Vertices:
    """The borders against the dividers and boundaries of the town."""
    xy, inner, outer, kind = [], [], [], []
    for e, b in zip(made.graph.edges, made.borders, strict=True):
        normal = normals(e.xy)
        for sign, line, kinds in zip((1.0, -1.0), b.lines, b.kinds, strict=True):
            at = cKDTree(e.xy).query(line)[1]
            xy.append(line)
            kind.append(kinds)
            inner.append(e.xy[at] + sign * NEAREST * normal[at])
            outer.append(e.xy[at] + sign * (CALTRANS + bound) * normal[at])
    found, near, far = (to_truth(np.concatenate(p), log, cloud) for p in (xy, inner, outer))
    lines = np.array(
        [shapely.LineString(e.xy) for e in town if e.class_name in ("divider", "boundary")]
    )
    tree = shapely.STRtree(lines)
    at = tree.query_nearest(shapely.points(found), all_matches=False)[1]
    reach = np.zeros(len(found), bool)
    rays = shapely.linestrings(np.stack([near, far], axis=1))
    reach[tree.query(rays, predicate="intersects")[0]] = True
    junction = RoadMap(town, near).at_junction()
    off = shapely.distance(shapely.points(found), lines[at])
    return Vertices(off, np.concatenate(kind), reach, junction)


def routed(made: LabelledLanes, crs: str) -> str:
    """What the lanelet2 wheel says: lanelets loaded, errors, how many it can route over, and
    whether every lanelet that the graph leads to is reached from the first one."""
    import lanelet2

    vector_map = made.lanelets.vector_map
    osm, _ = to_osm(vector_map, made.lanelets.info)
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
    leads = sum(len(graph.following(x)) for x in lanes)
    wanted = sum(len(made.graph.successors(k)) for k in range(len(made.graph.edges)))
    forks = sum(len(graph.following(x)) > 1 for x in lanes)
    passable = sum(rules.canPass(x) for x in lanes)
    ways = sum(
        graph.getRoute(x, y) is not None for x in lanes for y in graph.reachableSet(x, 200.0, 0)
    )
    near = sum(len(graph.reachableSet(x, 200.0, 0)) for x in lanes)
    return (
        f"lanelet2: {len(lanes)} of {len(made.graph.edges)} lanelets loaded, {len(errors)} errors, "
        f"{passable} passable, {leads} of {wanted} successors, {forks} before a fork, "
        f"{ways} of {near} routes up to 200 m"
    )


def percents(part: Bools, of: Bools) -> str:
    """How many of some vertices, in percent."""
    return f"{100 * (part & of).sum() / max(int(of.sum()), 1):.1f} %"


def spread(off: Array) -> list[str]:
    """Percentiles, and how many lie within 0.15 m."""
    if not len(off):
        return ["", "", "", "", ""]
    q = [f"{v:.3f}" for v in np.percentile(off, [50, 75, 90, 95])]
    return [*q, f"{100 * (off <= 0.15).mean():.1f} %"]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("places", nargs="*", metavar="PLACE", help=", ".join(PLACES))
    parser.add_argument("--bound", type=float, default=LaneOptions(Widths()).bound)
    given = parser.parse_args()
    rows: list[Sequence[object]] = []
    shares: list[Sequence[object]] = []
    told = []
    for name in given.places or PLACES:
        place = made_place(given.folder, name)
        town, log = read_map(place / "town"), NativeLog(place / "log")
        cloud = CloudFolder(place / "cloud")
        begin = time.process_time()
        options = LaneOptions(Widths(), (place / "cloud",), given.bound)
        made = label_lanes([place / "cloud"], options)
        seconds = time.process_time() - begin
        plain = label_lanes([place / "cloud"], LaneOptions(Widths()))
        v = measured(plain, town, log, cloud, given.bound)
        rows.append([name, "10 ft", len(v.off), *spread(v.off)])
        v = measured(made, town, log, cloud, given.bound)
        for k, kind in enumerate(KINDS):
            rows.append([name, kind, int((v.kind == k).sum()), *spread(v.off[v.kind == k])])
        seen, good = v.kind > 0, v.off <= 0.15
        rows.append([name, "all seen", int(seen.sum()), *spread(v.off[seen])])
        figures = made.figures
        shares.append([
            name, f"{figures['driven_m']:.0f}", figures["forks"], figures["merges"], len(v.off),
            percents(v.reach, v.off >= 0), percents(seen, v.reach), percents(seen & good, v.reach),
            percents(v.junction, ~v.reach), percents(~v.reach, seen),
        ])  # fmt: skip
        told.append(f"{name}: {seconds:.1f} CPU s; {routed(made, cloud.crs)}")
    head = ["place", "driven m", "forks", "merges", "vertices", "line in reach", "of these seen",
            "and within 0.15 m", "of the others at junctions", "seen without a line"]  # fmt: skip
    print("\n".join(table(head, shares)))
    head = ["place", "from", "vertices", "p50 m", "p75 m", "p90 m", "p95 m", "within 0.15 m"]
    print("\n".join(table(head, rows)))
    print("\n".join(told))


if __name__ == "__main__":
    main()
