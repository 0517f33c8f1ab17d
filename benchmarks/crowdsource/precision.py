"""How near are fused vertices to the truth, and do their covariances say so?

    python -m benchmarks.crowdsource.precision            ten drives per map and preset
    python -m benchmarks.crowdsource.precision --maps 1 --drives 3

Maps are those of three Argoverse 2 logs (RTMAP_DATA, or --data); drives and observations are
simulated (presets rtmap-straight, rtmap-turning), priors are off by 0.1 m. The drives are localized
on the prior with --smooth and fused at once, into the prior and into a new map. Printed are the
mean error across the line of all vertices in range that lie near a true line, the share inside the
90 % interval of their own sigma, and PASS or FAIL; exit code 1 when one fails.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.places import Place, av2_places, command
from benchmarks.common.printing import INSIDE_90, Verdict, markdown
from benchmarks.common.worlds import drive_through
from rtmap_cli.maps.element import CLASSES
from rtmap_cli.maps.store import read_map, write_new_map
from rtmap_cli.steps.evaluate.maps.precision import PROTOCOLS
from rtmap_cli.steps.evaluate.maps.whole import honesty, region_in_range
from rtmap_cli.steps.simulate.driving.routes import KINDS
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
from rtmap_cli.steps.simulate.worlds.degrade import degrade_map

Array = NDArray[np.float64]

BAR = 0.08
"""Mean error across the line (m) after ten drives."""
SIGMAS_90 = 1.6449
ROWS = {"prior": "into the prior", "new": "into a new map"}


def errors_of(place: Place, kind: str, drives: int, seed: int, work: Path) -> dict[str, Any]:
    """Errors (m) and their shares of sigma of both maps, and of the prior as it was."""
    before = degrade_map(place.world, 0.1, seed)
    write_new_map(before, work / "prior", "off by 0.1 m")
    poses = []
    for n in range(drives):
        d = drive_through(place, kind, DriveKey(0, seed, n), work / "runs" / f"{n:02d}")
        shutil.move(d.truth.parent, work / f"{n:02d}.truth")
        command("localize", d.run, "--map", work / "prior", "--smooth")
        poses.append(d.drive.pose)
    region = region_in_range(np.concatenate(poses), PROTOCOLS["rtmap"].range_m)
    shutil.copytree(work / "prior", work / "known")
    out = {}
    for row, target in (("prior", work / "known"), ("new", work / "empty")):
        command("crowdsource", work / "runs", "--map", target)
        found = honesty(read_map(target), place.world, region, list(CLASSES))
        out[row] = (found.error, found.ratio)
    return out


def main(arguments: list[str] | None = None) -> int:
    """Measure, print the table and the verdicts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=os.environ.get("RTMAP_DATA") or None)
    parser.add_argument("--maps", type=int, default=3)
    parser.add_argument("--drives", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args(arguments)
    if options.data is None:
        sys.exit("sample data folder not found, set RTMAP_DATA")
    rows, judged, kept = [], [], {}
    for kind in KINDS:
        parts: dict[str, list[tuple[Array, Array]]] = {row: [] for row in ROWS}
        for place in av2_places(options.data)[: options.maps]:
            with tempfile.TemporaryDirectory() as folder:
                found = errors_of(place, kind, options.drives, options.seed, Path(folder))
            for row, value in found.items():
                parts[row].append(value)
        for row, title in ROWS.items():
            error, ratio = (np.concatenate(a) for a in zip(*parts[row], strict=True))
            mean, inside = float(error.mean()), float((ratio <= SIGMAS_90).mean())
            kept[f"{kind}, {title}"] = {"mean_m": mean, "inside_90": inside, "n": len(error)}
            p90 = float(np.percentile(error, 90))
            rows.append(
                [
                    f"{kind}, {title}",
                    str(len(error)),
                    f"{mean:.3f} / {p90:.3f}",
                    f"{100 * inside:.1f}",
                ]
            )
            judged.append(Verdict(f"{kind}, {title}: mean error (m)", mean, -np.inf, BAR))
            judged.append(Verdict(f"{kind}, {title}: in the 90 % interval", inside, *INSIDE_90))
    header = ["presets, simulated", "vertices", "error across, mean / 90 % (m)", "in 90 % (%)"]
    print("\n".join([*markdown(header, rows), *(v.line for v in judged)]))
    if options.json:
        options.json.write_text(json.dumps(kept, indent=1), encoding="utf-8")
    return int(any(not v.holds for v in judged))


if __name__ == "__main__":
    sys.exit(main())
