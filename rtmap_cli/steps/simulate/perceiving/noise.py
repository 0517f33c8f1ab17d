"""Seeded randomness: generators by key, smooth fields over the map, first-order sequences.

Every draw comes from a counter-based generator whose key names what is drawn (world, drive, frame,
element). The same key gives the same numbers, whoever asks first and on however many workers.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

Key = tuple[str | int, ...]


def generator(*key: str | int) -> np.random.Generator:
    """A Philox generator that belongs to ``key`` (words and whole numbers) alone."""
    digest = hashlib.blake2b(repr(key).encode(), digest_size=16).digest()
    return np.random.Generator(np.random.Philox(key=int.from_bytes(digest, "little")))


class SmoothField:
    """Gaussian random fields over the plane: a function of its key and the place alone.

    ``components`` independent fields of zero mean, unit variance and correlation
    exp(-d² / 2 L²) with L = ``length`` metres, as sums of random Fourier features
    (Rahimi & Recht 2007): sqrt(2 / K) Σ cos(w_k · x + φ_k), w_k ~ N(0, L⁻²).
    """

    def __init__(self, key: Key, length: float, components: int = 1, features: int = 96) -> None:
        rng = generator("field", *key)
        self.waves = rng.normal(size=(components, features, 2)) / length
        self.phases = rng.uniform(0, 2 * np.pi, (components, features))

    def __call__(self, xy: Array) -> Array:
        """(n, 2) metres in the map frame → (n, components)."""
        angles = np.einsum("cfk,nk->ncf", self.waves, xy) + self.phases
        return np.cos(angles).sum(axis=-1) * np.sqrt(2.0 / self.phases.shape[1])


@lru_cache(maxsize=256)
def smooth_field(key: Key, length: float, components: int = 1) -> SmoothField:
    """The field that belongs to a key (kept, as frames ask for the same ones again)."""
    return SmoothField(key, length, components)


class FirstOrder:
    """First-order (AR(1)) unit sequences, one per name, that stay put while nobody asks.

    The innovation of a name at a frame is drawn by key; a name that was not seen for k frames has
    kept ``memory`` ** k of its last value.
    """

    def __init__(self, key: Key, memory: float, size: int) -> None:
        self.key, self.memory, self.size = key, memory, size
        self.last: dict[str, tuple[int, Array]] = {}

    def at(self, name: str, frame: int) -> Array:
        """(size,) values of ``name`` at ``frame``; frames must not go back."""
        fresh = generator(*self.key, name, frame).normal(size=self.size)
        if name in self.last:
            before, value = self.last[name]
            kept = self.memory ** (frame - before)
            fresh = kept * value + np.sqrt(1.0 - kept**2) * fresh
        self.last[name] = (frame, fresh)
        return fresh


def first_order_walk(rng: np.random.Generator, travelled: Array, length: float, size: int) -> Array:
    """(n, size) stationary unit first-order noise at distances ``travelled`` (n,) metres.

    Correlation exp(-d / length).
    """
    steps = rng.normal(size=(len(travelled), size))
    kept = np.exp(-np.diff(travelled, prepend=travelled[:1]) / length)
    for i in range(1, len(steps)):
        steps[i] = kept[i] * steps[i - 1] + np.sqrt(1.0 - kept[i] ** 2) * steps[i]
    return steps
