"""The bookkeeping of the field along a drive: who sees which bump, and where its unknowns are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from localize_scenes import drive, observed, run_of, town

from rtmap_cli.steps.localize.drive.motion import STATE
from rtmap_cli.steps.localize.drive.place import PlaceField, _births
from rtmap_cli.steps.localize.model import ErrorModel, Settings
from rtmap_cli.steps.localize.seeing.field import GridField
from rtmap_cli.steps.localize.seeing.frames import read_detections
from rtmap_cli.steps.localize.seeing.lines import MapLines
from rtmap_cli.steps.localize.seeing.residuals import linearize

MODEL, SETTINGS = ErrorModel(), Settings()


def _scene():
    truth = drive(12)
    run = run_of(truth, observed(town(), truth, 0.1), (0.1, -0.2, 0.005))
    origin = np.round(run.frames.initial[:, :2, 3].mean(axis=0))
    lines = MapLines(town(), list(run.info["classes"]), origin, SETTINGS.heading_weight_m)
    seen = read_detections(run, lines, SETTINGS, False)
    return lines, seen, linearize(lines, seen, seen.pose, 1.0)


def test_every_vertex_sees_the_bumps_of_its_cells() -> None:
    lines, seen, linear = _scene()
    chunk = np.arange(len(seen)) // 3
    field = PlaceField(lines, seen, linear, chunk, MODEL, None)
    per, grid = seen.points.shape[1], GridField(MODEL.place_length_m)
    names = {k: key for key, k in field.keys.items()}
    values = 0
    for g in field.groups:
        assert (np.diff(g.bumps) > 0).all()
        assert g.basis.any(0).all()
        for row, basis in enumerate(g.basis):
            e, v = g.elements.start + row // per, row % per
            if linear.sample[e, v] < 0:
                assert not basis.any()
                continue
            _, wanted = grid.basis(lines.xy[linear.sample[e, v]][None])
            got = basis[basis > 0]
            assert np.allclose(np.sort(got), np.sort(wanted[0]))
            values += len(got)
        assert {int(chunk[g.frame]) - names[int(b)][1] for b in g.bumps} <= {0, 1}
    assert values == 16 * linear.found.sum()


def test_unknowns_lie_side_by_side() -> None:
    lines, seen, linear = _scene()
    chunk = np.arange(len(seen)) // 5
    field = PlaceField(lines, seen, linear, chunk, MODEL, None)
    bumps = (field.index[:, None] + np.arange(2)).ravel()
    frames = (field.frame_index[:, None] + np.arange(STATE)).ravel()
    every = np.sort(np.concatenate([bumps, frames]))
    assert (every == np.arange(sum(field.sizes))).all()
    ends = np.cumsum(field.sizes)
    assert (np.searchsorted(ends, field.frame_index, side="right") == chunk).all()
    born = [b for _, b in field.keys]
    assert (np.searchsorted(ends, field.index, side="right") == born).all()


def test_weights_survive_a_round() -> None:
    lines, seen, linear = _scene()
    chunk = np.arange(len(seen)) // 5
    field = PlaceField(lines, seen, linear, chunk, MODEL, None)
    field.weights[:] = np.random.default_rng(0).normal(size=field.weights.shape)
    fewer = replace(linear, sample=np.where(seen.frame[:, None] == 3, -1, linear.sample))
    again = PlaceField(lines, seen, fewer, chunk, MODEL, field)
    assert len(again.keys) > 10
    for key, k in again.keys.items():
        kept = field.weights[field.keys[key]] if key in field.keys else np.zeros(2)
        assert (again.weights[k] == kept).all()


def test_a_drive_that_sees_nothing_has_no_field() -> None:
    lines, seen, linear = _scene()
    blind = replace(linear, sample=np.full_like(linear.sample, -1))
    field = PlaceField(lines, seen, blind, np.zeros(len(seen), np.int64), MODEL, None)
    assert not field.groups
    assert field.sizes == [STATE * len(seen)]
    assert not field.predict().any()


def test_a_bump_serves_two_chunks() -> None:
    name = np.array([7, 7, 7, 7, 3, 7, 3, 7])
    chunk = np.array([0, 0, 1, 2, 2, 5, 4, 6])
    bump, names, born = _births(name, chunk)
    assert (names[bump] == name).all()
    assert (born == np.sort(born)).all()
    # 7 is born in 0 (serves 1), in 2, and after the gap in 5 (serves 6); 3 in 2 and in 4.
    assert born[bump].tolist() == [0, 0, 0, 2, 2, 5, 4, 5]
    assert len(names) == 5
