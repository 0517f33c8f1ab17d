"""How a drive looks: light, weather, colours of the ground, and the camera's own flaws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Style:
    """Colours are RGB in 0…255 before exposure; fixed for a drive.

    ``visibility`` is the distance (m) at which haze takes 63 %; ``grain`` scales the texture of
    the ground; ``sun`` is the azimuth of the light in the map frame (rad); ``blur`` (px at a width
    of 224) and ``noise`` (grey levels) belong to the cameras; ``pitch`` and ``roll`` (rad) and
    ``heave`` (m) are the standard deviations of the body's motion, ``exposure`` of the gain.
    """

    asphalt: Colour
    verge: Colour
    sidewalk: Colour
    curb: Colour
    white: Colour
    yellow: Colour
    grain: float
    haze: Colour
    sky: Colour
    visibility: float
    gain: Colour
    gamma: float
    sun: float
    contrast: float
    blur: float
    noise: float
    exposure: float = 0.05
    pitch: float = 0.0052
    roll: float = 0.0052
    heave: float = 0.02
    seed: int = 0


def make_style(rng: np.random.Generator) -> Style:
    """A random drive: sunny to grey, green or paved verges, fresh or grey paint."""

    def grey(low: float, high: float, tint: float = 0.02) -> NDArray[np.float64]:
        return rng.uniform(low, high) * (1 + rng.normal(0, tint, 3))

    def colour(values: NDArray[np.float64]) -> Colour:
        r, g, b = np.clip(values, 0, 255).tolist()
        return (r, g, b)

    asphalt = grey(50, 125)
    wet = rng.random() < 0.12
    if wet:
        asphalt *= 0.7
    level = float(asphalt.mean())
    green = np.array([rng.uniform(50, 120), rng.uniform(75, 130), rng.uniform(30, 80)])
    verge = green if rng.random() < 0.55 else grey(75, 165, 0.05)
    white = grey(max(165.0, level + 50), 245)
    yellow = np.array([rng.uniform(185, 238), rng.uniform(140, 185), rng.uniform(35, 95)])
    yellow *= rng.uniform(0.85, 1.05)
    haze = grey(150, 230)
    sky = np.array([rng.uniform(100, 215), rng.uniform(130, 225), rng.uniform(170, 255)])
    if rng.random() < 0.4:
        sky = haze * rng.uniform(0.9, 1.08)
    return Style(
        asphalt=colour(asphalt),
        verge=colour(verge),
        sidewalk=colour(grey(115, 200, 0.03)),
        curb=colour(grey(125, 215, 0.02)),
        white=colour(white),
        yellow=colour(yellow),
        grain=float(rng.uniform(0.2, 0.6) if wet else rng.uniform(0.4, 1.5)),
        haze=colour(haze),
        sky=colour(sky),
        visibility=float(rng.choice([120.0, 250.0, 500.0]) * rng.uniform(0.7, 1.3)),
        gain=colour(_exposure(rng) * _white_balance(rng)),
        gamma=float(rng.uniform(0.75, 1.35)),
        sun=float(rng.uniform(0, 2 * np.pi)),
        contrast=float(rng.uniform(0.05, 0.35)),
        blur=float(rng.uniform(0.3, 1.0)) if rng.random() < 0.4 else 0.0,
        noise=float(rng.uniform(1, 7) if rng.random() < 0.85 else rng.uniform(7, 13)),
        seed=int(rng.integers(2**31)),
    )


def _exposure(rng: np.random.Generator) -> float:
    """Brightness of all cameras; one drive of five is clearly too dark or too bright."""
    return float(rng.uniform(0.7, 1.25) if rng.random() < 0.8 else rng.choice([0.5, 1.45]))


def _white_balance(rng: np.random.Generator) -> NDArray[np.float64]:
    """(3,) gains of red, green and blue: a colour temperature and a small tint."""
    warm = rng.normal(0, 0.07)
    return np.exp(np.array([warm, 0.0, -warm]) + rng.normal(0, 0.03, 3))
