"""The paper's tables as Markdown, our rows beside the paper's, and what they must show."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.places import BASELINE, mean_of
from benchmarks.common.printing import COLUMN, markdown

Array = NDArray[np.float64]
Found = Sequence[tuple[Any, dict[str, Any]]]
Results = dict[str, list[tuple[Any, dict[str, Any]]]]

SHORT = {"ped_crossing": "crossing", "divider": "divider", "boundary": "boundary", "mAP": "mAP"}
TABLE_1 = {  # crossing, divider, boundary, as the paper prints them
    ("straight", "one frame"): BASELINE["straight"],
    ("straight", "cycle 2 w/o U"): (28.6, 60.5, 31.7),
    ("straight", "cycle 2"): (32.7, 68.6, 35.5),
    ("straight", "cycle 3 w/o U"): (35.7, 74.4, 42.0),
    ("straight", "cycle 3"): (40.9, 84.3, 47.6),
    ("turning", "one frame"): BASELINE["turning"],
    ("turning", "cycle 2 w/o U"): (30.2, 65.5, 30.1),
    ("turning", "cycle 2"): (33.1, 71.0, 32.3),
    ("turning", "cycle 3 w/o U"): (35.9, 71.2, 32.6),
    ("turning", "cycle 3"): (42.3, 85.2, 38.8),
}
GAIN = {"straight": 20.5, "turning": 29.4}
"""The paper's gain in mAP at cycle 3 over the single traversal."""
TABLE_2 = {"TbV": (40.0, 68.2, 54.1), "RTMap": (48.9, 66.0, 57.4)}
TABLE_3 = {
    "Q_prior, a frame alone": (0.163, 0.318, 0.686, 1.616, 0.332, 0.766),
    "Q_map, a frame alone": (0.125, 0.256, 0.633, 1.530, 0.317, 0.713),
}
TABLE_4 = {
    "T^E": (0.142, 0.306, 0.589, 1.447, 0.521, 1.091),
    "T^R": (0.121, 0.257, 0.586, 1.429, 0.368, 0.799),
}
ABLATIONS = {  # by variant and way: without L_pose is its row "+ L_pts", without L_nll "+ L_pose"
    ("full", "only Q_map"): "Tab. 4: .121 / .257, .586 / 1.429, .368 / .799",
    ("full", "learned head"): "Tab. 4, T^E: .142 / .306, .589 / 1.447, .521 / 1.091",
    ("full", "all of Q_prior"): "Tab. 3: .163 / .318, .686 / 1.616, .332 / .766",
    ("without L_pose", "only Q_map"): "Tab. 4: .118 / .242, .609 / 1.507, .376 / .841",
    ("without L_nll", "only Q_map"): "Tab. 4: .122 / .261, .590 / 1.436, .371 / .800",
}
"""The paper's rows beside ours; Tab. 3's "only Q_map" is .125 / .256, .633 / 1.530, .317 / .713."""
POSES = ("lateral m", "longitudinal m", "yaw °")


@dataclass(frozen=True)
class Claim:
    """A statement that the tables must bear out: by how much, ± its standard error over worlds."""

    text: str
    gain: float
    error: float | None = None
    count: int | None = None

    @property
    def holds(self) -> bool:
        """True when the gain is above zero."""
        return self.gain > 0

    @property
    def line(self) -> str:
        """PASS or FAIL, the claim, the figure."""
        spread = "" if self.error is None else f" ± {self.error:.3g}"
        count = "" if self.count is None else f" ({self.count} worlds)"
        verdict = "PASS" if self.holds else "FAIL"
        return f"{verdict}  {self.text}: {self.gain:+.3g}{spread}{count}"


def paired(rows: Sequence[Any], better: Callable[[Any], float | None], text: str) -> Claim:
    """The mean over worlds of a difference within each world, and its standard error."""
    values = [v for v in (better(r) for r in rows) if v is not None]
    mean = float(np.mean(values)) if values else 0.0
    error = float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
    return Claim(text, mean, error, len(values))


def of_kind(found: Found, kind: str) -> list[dict[str, Any]]:
    """The worlds of one scenario."""
    return [result for unit, result in found if unit.kind == kind]


def kinds_of(found: Found) -> list[str]:
    """The scenarios that were measured."""
    return sorted({unit.kind for unit, _ in found})


# ---- Table 1


def table_1(found: Found) -> list[str]:
    """mAP by class over the cycles."""
    rows = []
    for kind in kinds_of(found):
        worlds = of_kind(found, kind)
        for name in dict.fromkeys(n for w in worlds for n in w["ap"]):
            some = [w["ap"] for w in worlds if name in w["ap"]]
            ap = mean_of([w[name] for w in some])
            title = name
            if len(some) < len(worlds):
                before = mean_of([w["cycle 3"]["mAP"] for w in some])
                title = f"{name} (in {len(some)}; {before:.1f} at cycle 3)"
            paper = TABLE_1.get((kind, name))
            theirs = ["", ""]
            if paper:
                theirs = [" / ".join(f"{v:.1f}" for v in paper), f"{np.mean(paper):.1f}"]
            ours = " / ".join(f"{ap[c]:.1f}" for c in ("ped_crossing", "divider", "boundary"))
            rows.append([f"{kind} ({len(worlds)})", title, ours, f"{ap['mAP']:.1f}", *theirs])
    header = ["scenario (worlds)", "", "crossing / divider / boundary", "mAP", "paper", "mAP"]
    return markdown(header, rows)


def claims_1(found: Found) -> list[Claim]:
    """More drives are better, class by class; U is better than none; the gain is the paper's."""
    out = []
    for kind in kinds_of(found):
        worlds = of_kind(found, kind)
        names = list(dict.fromkeys(n for w in worlds for n in w["ap"]))
        steps = [("one frame", "cycle 2"), ("cycle 2", "cycle 3")]
        for low, high in [s for s in steps if s[1] in names]:
            for c, short in SHORT.items():
                out.append(_between(worlds, low, high, c, f"{kind}: {high} over {low}, {short}"))
        for name in [n for n in names if f"{n} w/o U" in names and n != "cycle 1"]:
            text = f"{kind}: U over none at {name}, mAP"
            out.append(_between(worlds, f"{name} w/o U", name, "mAP", text))
        if "cycle 3" in names:
            gain = _between(worlds, "one frame", "cycle 3", "mAP", "")
            text = f"{kind}: gain of {gain.gain:.1f} mAP at cycle 3 over the paper's {GAIN[kind]}"
            out.append(Claim(text, gain.gain - GAIN[kind], gain.error, gain.count))
    return out


def _between(worlds: list[dict[str, Any]], low: str, high: str, column: str, text: str) -> Claim:
    def gain(world: dict[str, Any]) -> float | None:
        ap = world["ap"]
        return ap[high][column] - ap[low][column] if low in ap and high in ap else None

    return paired(worlds, gain, text)


# ---- Table 2


def _sums(found: Found, way: str) -> dict[str, int]:
    rows = [result[way] for _, result in found]
    return {k: sum(r[k] for r in rows) for k in rows[0]}


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def accuracies(sums: dict[str, int]) -> tuple[float | None, float | None, float | None]:
    """TbV's accuracy of changed frames, of the others, and their mean."""
    changed = _share(sums["changed_right"], sums["changed"])
    rest = _share(sums["unchanged_right"], sums["unchanged"])
    both = None if changed is None or rest is None else (changed + rest) / 2
    return changed, rest, both


def table_2(results: Results) -> list[str]:
    """Changes by TbV's protocol, and element by element."""
    rows = [[f"paper: {name}", *(f"{v:.1f}" for v in row), "", "", ""] for name, row in
            TABLE_2.items()]  # fmt: skip
    titles = {"crossings": "crossings", "changes": "all classes"}
    for what, title in titles.items():
        found = results.get(what)
        if not found:
            continue
        for way in ("a frame alone", "one drive", "three drives"):
            sums = _sums(found, way)
            cells = [_percent(v) for v in accuracies(sums)]
            rest = ["", "", ""]
            if "found" in sums:
                rest = [
                    _percent(_share(sums["found"], sums["found"] + sums["false"])),
                    _percent(_share(sums["found"], sums["found"] + sums["missed"])),
                    f"{1000 * sums['false'] / sums['metres']:.2f}" if sums["metres"] else "",
                ]
            rows.append([f"{title}, {way}", *cells, *rest])
    changes = {w: sum(r["changes"] for _, r in results.get(w, ())) for w in titles}
    told = ", ".join(f"{n} changes ({titles[w]})" for w, n in changes.items() if n)
    header = ["", "Acc_c", "Acc_r", "mAcc", "precision", "recall", "false / km"]
    return [f"{told} in {len(results.get('crossings', ()))} worlds.", "", *markdown(header, rows)]


def _percent(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.1f}"


def claims_2(found: Found) -> list[Claim]:
    """A drive tells more than the paper's row, three drives more than one."""
    one, three = (accuracies(_sums(found, w))[2] or 0.0 for w in ("one drive", "three drives"))
    paper = TABLE_2["RTMap"][2]
    text = "crossings: mAcc (%) of"
    return [
        Claim(f"{text} one drive over the paper's {paper}", 100 * one - paper, None, len(found)),
        Claim(f"{text} three drives over one", 100 * (three - one), None, len(found)),
    ]


# ---- Tables 3 and 4


def pooled(found: Found, way: str) -> Array:
    """(n, 3) errors of all worlds together."""
    parts = [np.asarray(r[way], np.float64).reshape(-1, 3) for _, r in found if way in r]
    return np.concatenate(parts) if parts else np.zeros((0, 3))


def cells_of(errors: Array) -> list[str]:
    """Mean / 90th percentile of lateral, longitudinal, yaw."""
    return [f"{errors[:, k].mean():.3f} / {np.percentile(errors[:, k], 90):.3f}" for k in COLUMN]


def paper_cells(row: Sequence[float] | None) -> str:
    """The paper's row in one cell."""
    if row is None:
        return ""
    return ", ".join(f"{row[k]:.3f} / {row[k + 1]:.3f}" for k in (0, 2, 4))


def pose_table(found: Found, paper: Mapping[str, tuple[float, ...]]) -> list[str]:
    """Mean / 90th percentile errors by way of finding the pose."""
    ways = [k for k, v in found[0][1].items() if isinstance(v, list)]
    rows = [
        [way, *cells_of(pooled(found, way)), paper_cells(paper.get(way))]
        for way in ways
        if len(pooled(found, way))
    ]
    frames = len(pooled(found, ways[0]))
    header = [f"mean / 90 %, {frames} frames, {len(found)} worlds", *POSES]
    return markdown([*header, "paper (the same three)"], rows)


def _worse(
    found: Found, worse: str, better: str, title: str, axes: Sequence[str] = POSES
) -> list[Claim]:
    out = []
    for k, name in zip(COLUMN, POSES, strict=True):
        if name not in axes:
            continue

        def less(world: dict[str, Any], k: int = k) -> float | None:
            a, b = (np.asarray(world[w], np.float64).reshape(-1, 3) for w in (worse, better))
            return float(a[:, k].mean() - b[:, k].mean()) if len(a) and len(b) else None

        rows = [r for _, r in found if worse in r and better in r]
        out.append(paired(rows, less, f"{title}: {better} under {worse}, mean {name}"))
    return out


def claims_3(found: Found) -> list[Claim]:
    """Outdated elements left out are better."""
    out = []
    for how in ("a frame alone", "whole drive"):
        out += _worse(found, f"Q_prior, {how}", f"Q_map, {how}", "outdated prior")
        blind = f"Q_map without covariance, {how}"
        if any(blind in result for _, result in found):
            # Not so for the yaw of a whole drive, which odometry tells first: see the row.
            axes = POSES if how == "a frame alone" else POSES[:2]
            out += _worse(found, blind, f"Q_map, {how}", "ablation", axes)
    return out


def table_4(found: Found | None, ablations: dict[str, Any] | None) -> list[str]:
    """T^E against T^R, and the ablations where somebody trained them."""
    out = []
    done = [(u, r) for u, r in found or () if "not_run" not in r]
    if done:
        out += pose_table(done, TABLE_4)
    else:
        why = found[0][1]["not_run"] if found else "not asked for"
        out += [f"T^E against T^R: not run ({why}).", ""]
    if ablations is None:
        return [
            *out,
            "Loss ablations: not run; they need torch and more than an hour of one core:",
            "`python -m benchmarks.paper.ablations --data DIR --json FILE`, then",
            "`python -m benchmarks.paper.tables --tables 4 --ablations FILE`.",
            "",
        ]
    return [*out, *ablation_tables(ablations)]


def ablation_tables(ablations: dict[str, Any]) -> list[str]:
    """What ``paper/ablations.py`` measured: figures, poses beside the paper's, differences."""
    made, variants = ablations["made"], ablations["variants"]
    names = list(next(iter(variants.values()))["figures"])
    figures = [
        [name, *(f"{row['figures'][k]:.3f}" for k in names), f"{row['cpu_minutes']:.1f}"]
        for name, row in variants.items()
    ]
    poses: list[list[str]] = []
    for name, row in variants.items():
        for way, (mean, high) in row["poses"].items():
            if way == "start" and poses:
                continue  # the same frames and priors for all
            cells = [f"{mean[k]:.3f} / {high[k]:.3f}" for k in COLUMN]
            title = way if way == "start" else f"{name}, {way}"
            poses.append([title, *cells, ABLATIONS.get((name, way), "")])
    told = (
        "{config}: {steps} steps of {batch} out of {frames} frames, from an encoder of {encoder "
        "steps} steps ({encoder CPU minutes} CPU minutes); {test frames} frames of {test towns} "
        "other towns."
    )
    lines = [told.format_map(made), ""]
    lines += markdown(["trained on simulated frames", *names, "CPU minutes"], figures)
    lines += markdown(["mean / 90 %", *POSES, "paper (the same three)"], poses)
    gaps = [
        [f"{name}, {what}", *cells]
        for name, row in variants.items()
        for what, cells in _gaps(row.get("against full", {}), names)
    ]
    header = ["minus full [95 % over towns]", "value or lateral m", "longitudinal m", "yaw °"]
    return [*lines, *(markdown(header, gaps) if gaps else [])]


def _gaps(against: dict[str, list[float]], names: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """Rows of the differences to the full variant; a star where the interval excludes zero."""
    told = {
        key: f"{gap:+.3f} [{low:+.3f}, {high:+.3f}]" + ("*" if low > 0 or high < 0 else "")
        for key, (gap, low, high) in against.items()
    }
    for name in names:
        if name in told and against[name] != [0.0, 0.0, 0.0]:
            yield name, [told[name], "", ""]
    for way in dict.fromkeys(key[:-2] for key in told if key not in names):
        if way != "start":
            yield way, [told[f"{way} {axis}"] for axis in COLUMN]


DIFFERS = {
    1: "Simulated observations over {maps}, calibrated to the paper's single-frame AP; "
    "the paper has logs of TbV and its MapTRv2. Maps start from nothing; drives are localized "
    "(`--smooth`) on a prior with an error of 0.1 m. Without U: every detection has the same "
    "sigma (`crowdsource --without-sigma`). 72 × 36 m, 0.5 / 1.0 / 1.5 m, at every other frame "
    "that the first three drives pass. The paper shows no cycle 5 or 10.",
    2: "Simulated changes (`simulate changes`) and answers to prior queries; TbV's are real. "
    'A frame is changed when a change is nearer than 20 m, all frames. "A frame alone" is what '
    "the simulated network answers; one drive and three are `detect-changes` afterwards. The "
    "changes lie beside the drives, 1 m or farther from what is alike.",
    3: "Simulated answers to prior queries on a map outdated by up to 8 changes a drive, with an "
    "error of 0.1 m. Q_prior: the same answers with nothing told outdated. An answer about what is "
    "gone stays where the noisy start put it. The paper's poses are single-frame.",
    4: "Rendered images of unseen towns and the shipped rtmap-tiny, starts of 0.9 m and 0.9°; the "
    "paper: nuScenes, a ResNet-50 of its own. T^E of rtmap-tiny is least squares inside the "
    "network, not a regression: T^R of one frame knows no more, that of the whole drive does. "
    "Ablations: a small network on warped pictures of unseen towns, an hour of training.",
}


def shown(results: Results, options: Any, ablations: dict[str, Any] | None) -> list[str]:
    """All tables that were asked for."""
    maps = "real Argoverse 2 maps" if options.data else "simulated towns"
    out = []
    for number in options.tables:
        title, found = f"## Tab. {number}", results
        lines: list[str] = []
        if number == 1 and "mapping" in found:
            lines = table_1(found["mapping"])
        if number == 2 and "crossings" in found:
            lines = table_2(found)
        if number == 3 and "poses" in found:
            lines = pose_table(found["poses"], TABLE_3)
        if number == 4:
            lines = table_4(found.get("network"), ablations)
        out += [title, "", *lines, "Differs: " + DIFFERS[number].format(maps=maps), ""]
    return out


def claims_of(results: Results) -> list[Claim]:
    """What the tables must show, as far as they were measured."""
    out = []
    if "mapping" in results:
        out += claims_1(results["mapping"])
    if "crossings" in results:
        out += claims_2(results["crossings"])
    if "poses" in results:
        out += claims_3(results["poses"])
    network = [(u, r) for u, r in results.get("network", ()) if "not_run" not in r]
    if network:
        out += _worse(network, "T^E", "T^R, whole drive", "network")
    return out
