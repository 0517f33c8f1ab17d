"""The field of place errors along a drive as unknowns of the whole-log problem."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.steps.localize.blocks import BlockSystem
from rtmap_cli.steps.localize.field import GridField
from rtmap_cli.steps.localize.frames import Detections
from rtmap_cli.steps.localize.lines import MapLines
from rtmap_cli.steps.localize.model import ErrorModel
from rtmap_cli.steps.localize.motion import STATE
from rtmap_cli.steps.localize.residuals import Linear, gram_sum, place_amplitude

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Grid cells per axis that fit into a key: at 18 m a cell, far more than the Earth.
_HALF = 1 << 24


@dataclass(frozen=True)
class _Group:
    """Elements of one class in one frame: the bumps they see and (n V, m) values of these."""

    frame: int
    elements: slice
    bumps: Index
    basis: Array


class PlaceField:
    """The bumps of the field that a drive sees, two weights (x, y) each, with prior N(0, 1).

    Frames come in chunks of travel longer than the view, and a bump seen again two chunks later
    is a new one, so that unknowns only couple neighbouring chunks (a place that a drive comes back
    to is thus taken as independent). Weights survive when a later round meets other bumps.
    """

    def __init__(
        self,
        lines: MapLines,
        seen: Detections,
        linear: Linear,
        chunk: Index,
        model: ErrorModel,
        before: PlaceField | None,
    ) -> None:
        self.seen, self.linear = seen, linear
        self.amplitude = place_amplitude(seen, linear, model)
        self.keys: dict[tuple[int, int], int] = {}
        self.groups = self._group(lines, chunk, GridField(model.place_length_m))
        born = np.array([b for _, b in self.keys], np.int64)
        self.weights = np.zeros((len(self.keys), 2))
        for key, k in self.keys.items():
            if before is not None and key in before.keys:
                self.weights[k] = before.weights[before.keys[key]]
        self.sizes: list[int] = []
        self.index = np.empty(len(born), np.int64)
        self.frame_index = np.empty(len(chunk), np.int64)
        first = 0
        for b in range(int(chunk[-1]) + 1):
            bumps, frames = np.flatnonzero(born == b), np.flatnonzero(chunk == b)
            self.index[bumps] = first + 2 * np.arange(len(bumps))
            self.frame_index[frames] = first + 2 * len(bumps) + STATE * np.arange(len(frames))
            self.sizes.append(2 * len(bumps) + STATE * len(frames))
            first += self.sizes[-1]

    def _group(self, lines: MapLines, chunk: Index, field: GridField) -> list[_Group]:
        count = self.seen.points.shape[1]
        found = self.linear.found.ravel()
        at = lines.xy[self.linear.sample.ravel()]
        cells, values = field.basis(at)
        code = np.repeat(self.seen.code, count)[:, None]
        key = (code * 2 * _HALF + cells[..., 0] + _HALF) * 2 * _HALF + cells[..., 1] + _HALF
        out = []
        for t, _, elements in self.seen.groups():
            rows = slice(elements.start * count, elements.stop * count)
            here = np.flatnonzero(found[rows])
            if not len(here):
                continue
            names, inverse = np.unique(key[rows][here], return_inverse=True)
            basis = np.zeros((rows.stop - rows.start, len(names)))
            basis[here[:, None], inverse.reshape(len(here), -1)] = values[rows][here]
            bumps = np.array([self._bump(k, int(chunk[t])) for k in names.tolist()], np.int64)
            out.append(_Group(t, elements, bumps, basis))
        return out

    def _bump(self, key: int, chunk: int) -> int:
        got = self.keys.get((key, chunk))
        if got is None:
            got = self.keys.get((key, chunk - 1))
        if got is None:
            got = self.keys[(key, chunk)] = len(self.keys)
        return got

    def predict(self) -> Array:
        """(E, V) what the field explains of the residuals, with the sign of a residual to add."""
        out = np.zeros(self.linear.r.shape)
        for g in self.groups:
            value = (g.basis @ self.weights[g.bumps]).reshape(*out[g.elements].shape, 2)
            out[g.elements] = (self.amplitude[g.elements] * value).sum(-1)
        return out

    def add(self, system: BlockSystem, weight: Array, shared: Array) -> tuple[Array, Array]:
        """Add the map residuals and the prior of the field; the field is added to a residual.

        Returns the information (T, 3, 3) and χ² (T,) of the residuals with the field as it is.
        """
        frames = len(self.seen)
        information, chi2 = np.zeros((frames, 3, 3)), np.zeros(frames)
        for g in self.groups:
            e = g.elements
            r, j = self.linear.r[e], self.linear.jacobian[e]
            field = self.amplitude[e][:, :, None] * g.basis.reshape(*r.shape, -1, 1)
            field = field.reshape(*r.shape, -1)
            w = self.weights[g.bumps].ravel()
            rest = (r + field @ w)[..., None]
            matrix = gram_sum(np.concatenate([field, j, rest], -1), weight[e], shared[e])
            bumps = (self.index[g.bumps][:, None] + (0, 1)).ravel()
            index = np.concatenate([bumps, self.frame_index[g.frame] + np.arange(3)])
            order = np.argsort(index)
            system.add(index[order], matrix[:-1, :-1][np.ix_(order, order)], matrix[order, -1])
            information[g.frame] += matrix[-4:-1, -4:-1]
            chi2[g.frame] += matrix[-1, -1]
        own = (self.index[:, None] + (0, 1)).ravel()
        system.add_prior(own, np.ones(len(own)), self.weights.ravel())
        return information, chi2

    def update(self, step: Array) -> None:
        """Apply the solver's step."""
        self.weights = self.weights + step[self.index[:, None] + np.arange(2)]
