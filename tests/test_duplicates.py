"""What says the same thing twice fades."""

from __future__ import annotations

import numpy as np
import pytest

from rtmap_cli.steps.infer.duplicates import FADE, fade_duplicates


def line(y: float, start: float = -20.0, end: float = 20.0) -> np.ndarray:
    return np.column_stack([np.linspace(start, end, 20), np.full(20, y)])


def test_only_the_best_of_its_class_keeps_its_score() -> None:
    points = np.stack([line(0.0), line(0.4)[::-1], line(0.3), line(3.5), line(0.2)])
    scores = np.array([0.5, 0.8, 0.3, 0.6, 0.7], np.float32)
    got = fade_duplicates(points, np.array([1, 1, 1, 1, 2]), scores)
    assert got == pytest.approx([0.5 * FADE, 0.8, 0.3 * FADE, 0.6, 0.7])
    assert scores[0] == 0.5


def test_a_piece_of_a_line_is_not_the_line() -> None:
    points = np.stack([line(0.0), line(0.0, -20.0, -10.0)])
    got = fade_duplicates(points, np.zeros(2, int), np.array([0.9, 0.8]))
    assert got == pytest.approx([0.9, 0.8])
    assert len(fade_duplicates(np.zeros((0, 20, 2)), np.zeros(0, int), np.zeros(0))) == 0
