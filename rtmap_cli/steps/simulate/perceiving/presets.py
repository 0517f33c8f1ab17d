"""Presets of the perception model: every number of it, named and with its unit.

The noise model is described in docs/simulate.md. A preset file (TOML) names a preset to start from
and what differs::

    base = "rtmap-straight"
    prior_gain = 0.5
    [noise]
    divider = 1.4
"""

from __future__ import annotations

import tomllib
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from rtmap_cli.errors import BadInput

ByClass = dict[str, float]


def _by_class(ped_crossing: float, divider: float, boundary: float) -> ByClass:
    return {"ped_crossing": ped_crossing, "divider": divider, "boundary": boundary}


@dataclass(frozen=True)
class PriorPreset:
    """How the prior queries behave (used with --prior only); logits are mean and sd."""

    # Position errors across a line shrink to this factor when a prior query guides the vertex.
    gain: float = 0.6
    # Share of the initial pose's error along a line that the network sees and takes out.
    along_gain: float = 0.5
    # A prior vertex is still in the world when a line of its class lies within this distance.
    same_place_m: float = 1.0
    # Existence logits: seen, real but missed, vanished, and hidden (nobody can tell).
    seen: tuple[float, float] = (2.5, 1.0)
    missed: tuple[float, float] = (0.3, 1.3)
    vanished: tuple[float, float] = (-2.5, 1.2)
    hidden: tuple[float, float] = (0.8, 1.0)
    # Slots for prior elements; the farthest are dropped.
    slots: int = 100


@dataclass(frozen=True)
class Preset:
    """The perception model. Lengths in metres, angles in degrees, probabilities in [0, 1].

    ``noise`` scales the position errors and cut ends of a class; 0 switches them off.
    """

    noise: ByClass = field(default_factory=lambda: _by_class(2.737, 1.167, 0.784))
    vertex_scale: float = 0.10  # Laplace scale of each vertex
    offset_sd: float = 0.28  # sd of what the vertices of an element share
    # Shares of the offset's variance: fixed to the place, to the drive and place, to the element.
    shares: tuple[float, float, float] = (0.20, 0.45, 0.35)
    field_length: float = 20.0
    element_memory: float = 0.85  # correlation of the element's part from frame to frame
    drive_shift: tuple[float, float] = (0.10, 0.06)  # sd of a whole drive, along and across
    spread: tuple[float, float] = (0.35, 0.3)  # log of the scale: per unit of hardness, per element
    end_cut: float = 1.2
    detected: ByClass = field(default_factory=lambda: _by_class(0.93, 0.95, 0.95))
    range_loss: float = 0.25
    hardness_loss: float = 0.75
    false_per_frame: ByClass = field(default_factory=lambda: _by_class(0.18, 0.45, 0.40))
    ghosts_per_drive: float = 1.5
    wrong_class: float = 0.03
    score: tuple[float, float, float] = (1.2, 1.2, 0.9)  # logit: level, per log offset, sd
    false_score: tuple[float, float] = (-0.7, 1.0)
    ghost_score: tuple[float, float] = (-0.3, 1.0)
    # sd of the log of what the network says about its own scale; 0: it states the true one.
    sigma_spread: float = 0.0
    vehicles_per_drive: float = 7.0
    # Initial pose: bias of the drive, drift (50 m) and white part, per axis; yaw bias and white.
    gnss: tuple[float, float, float] = (0.8, 0.3, 0.2)
    gnss_yaw_deg: tuple[float, float] = (0.8, 0.5)
    gnss_drift_length: float = 50.0
    odometry: tuple[float, float] = (0.01, 0.05)  # share of each step; degrees per metre
    prior: PriorPreset = field(default_factory=PriorPreset)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for run.json."""
        return asdict(self)


PRESETS: dict[str, Preset] = {
    "rtmap-straight": Preset(),
    "rtmap-turning": Preset(noise=_by_class(3.115, 1.496, 2.005)),
    "mild": Preset(
        noise=_by_class(0.6, 0.5, 0.5),
        false_per_frame=_by_class(0.02, 0.05, 0.05),
        ghosts_per_drive=0.3,
        wrong_class=0.0,
        hardness_loss=0.3,
    ),
    "perfect": Preset(
        noise=_by_class(0.0, 0.0, 0.0),
        drive_shift=(0.0, 0.0),
        detected=_by_class(1.0, 1.0, 1.0),
        range_loss=0.0,
        hardness_loss=0.0,
        false_per_frame=_by_class(0.0, 0.0, 0.0),
        ghosts_per_drive=0.0,
        wrong_class=0.0,
        vehicles_per_drive=0.0,
        prior=PriorPreset(
            gain=0.0,
            along_gain=1.0,
            seen=(6.0, 0.0),
            missed=(6.0, 0.0),
            vanished=(-6.0, 0.0),
            hidden=(6.0, 0.0),
        ),
    ),
}
"""``rtmap-*`` are calibrated by benchmarks/paper/presets.py to the MapTRv2 rows of Table 1."""


def find_preset(name: str | Path) -> Preset:
    """A preset by its name, or read from a TOML file (``base`` and what differs)."""
    if str(name) in PRESETS:
        return PRESETS[str(name)]
    path = Path(name)
    if path.suffix != ".toml":
        known = ", ".join(PRESETS)
        raise BadInput(name, "no such preset", f"known are {known}, or name a .toml file")
    if not path.is_file():
        raise BadInput(path, "no such file")
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise BadInput(path, f"cannot be read as TOML ({error})") from None
    base = str(values.pop("base", "rtmap-straight"))
    if base not in PRESETS:
        raise BadInput(path, f"base {base!r} is no preset", f"known are {', '.join(PRESETS)}")
    return _changed(PRESETS[base], values, path, "")


def _changed(preset: Any, values: dict[str, Any], path: Path, prefix: str) -> Any:
    """``preset`` with the values of a TOML table, every one of the type that it replaces."""
    known = {f.name: getattr(preset, f.name) for f in fields(preset)}
    changes: dict[str, Any] = {}
    for name, value in values.items():
        label = f"{prefix}{name}"
        if name not in known:
            raise BadInput(path, f"{label} is no parameter", f"known are {', '.join(known)}")
        changes[name] = _converted(known[name], value, path, label)
    return replace(preset, **changes)


def _converted(old: Any, value: Any, path: Path, label: str) -> Any:
    if isinstance(old, PriorPreset) and isinstance(value, dict):
        return _changed(old, value, path, f"{label}.")
    if isinstance(old, dict) and isinstance(value, dict):
        return old | {k: _number(v, path, f"{label}.{k}") for k, v in value.items()}
    if isinstance(old, tuple):
        if not isinstance(value, list) or len(value) != len(old):
            raise BadInput(path, f"{label} must be a list of {len(old)} numbers")
        return tuple(_number(v, path, label) for v in value)
    if isinstance(old, int) and isinstance(value, int):
        return value
    return _number(value, path, label)


def _number(value: Any, path: Path, label: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadInput(path, f"{label} must be a number, not {value!r}")
    return float(value)
