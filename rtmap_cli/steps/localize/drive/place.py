"""The field of place errors along a drive as unknowns of the whole-log problem."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.steps.localize.drive.blocks import BlockSystem
from rtmap_cli.steps.localize.drive.motion import STATE
from rtmap_cli.steps.localize.model import ErrorModel
from rtmap_cli.steps.localize.seeing.field import GridField
from rtmap_cli.steps.localize.seeing.frames import Detections
from rtmap_cli.steps.localize.seeing.lines import MapLines
from rtmap_cli.steps.localize.seeing.residuals import Linear, gram_sum, place_amplitude

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Grid cells per axis that fit into a key: at 18 m a cell, far more than the Earth.
_HALF = 1 << 24


@dataclass(frozen=True)
class _Group:
    """Elements of one class in one frame: the bumps they see, ascending, and (n V, m) values."""

    frame: int
    elements: slice
    bumps: Index
    basis: Array


class PlaceField:
    """The bumps of the field that a drive sees, two weights (x, y) each, with prior N(0, 1).

    Frames come in chunks of travel longer than the view, and a bump seen again two chunks later
    is a new one, so that unknowns only couple neighbouring chunks (a place that a drive comes back
    to is thus taken as independent). Weights survive when a later round meets other bumps.

    ``index`` (bumps,), ``frame_index`` (T,): first unknown of each; ``sizes`` of the chunks.
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
        self.groups, names, born = self._group(lines, chunk, GridField(model.place_length_m))
        self.keys = dict(zip(zip(names.tolist(), born.tolist(), strict=True), count()))
        self.weights = np.zeros((len(names), 2))
        if before is not None:
            old = np.array([before.keys.get(key, -1) for key in self.keys], np.int64)
            self.weights[old >= 0] = before.weights[old[old >= 0]]
        chunks = int(chunk[-1]) + 1
        bumps, frames = np.bincount(born, minlength=chunks), np.bincount(chunk, minlength=chunks)
        sizes = 2 * bumps + STATE * frames
        first = np.cumsum(sizes) - sizes
        self.sizes: list[int] = sizes.tolist()
        self.index: Index = first[born] + 2 * _number(born, bumps)
        self.frame_index: Index = (first + 2 * bumps)[chunk] + STATE * _number(chunk, frames)

    def _group(
        self, lines: MapLines, chunk: Index, field: GridField
    ) -> tuple[list[_Group], Index, Index]:
        """What every group sees; names (bumps,) of cell and class, and the chunk they are born in.

        Cells of a group are first numbered in the box of all, and those that no vertex sees are
        left out then.
        """
        groups, per = self.seen.groups(), self.seen.points.shape[1]
        sizes = np.array([e.stop - e.start for _, _, e in groups], np.int64)
        frame = np.array([t for t, _, _ in groups], np.int64)
        group = np.repeat(np.arange(len(groups)), sizes * per)
        rows = np.flatnonzero(self.linear.found)
        if not len(rows):
            return [], np.empty(0, np.int64), np.empty(0, np.int64)
        cell, value = field.axes(lines.xy[self.linear.sample.ravel()[rows]])
        group_of = group[rows]
        low, high = np.zeros((len(groups), 2), np.int64), np.full((len(groups), 2), -1)
        first = np.flatnonzero(np.diff(group_of, prepend=-1))
        low[group_of[first]] = np.minimum.reduceat(cell, first)
        high[group_of[first]] = np.maximum.reduceat(cell, first) + field.SIDE - 1
        box = high - low + 1
        area = box.prod(1)
        start, across = np.cumsum(area) - area, box[:, 1]
        x, y = (cell - low[group_of]).T
        corner = start[group_of] + x * across[group_of] + y
        side = np.arange(field.SIDE)
        slot = (side * across[group_of, None])[..., None] + side + corner[:, None, None]
        used = np.zeros(int(area.sum()), bool)
        used[slot] = True
        slots = np.flatnonzero(used)
        owner = np.repeat(np.arange(len(groups)), area)[slots]
        x, y = np.array(np.divmod(slots - start[owner], across[owner])) + low[owner].T + _HALF
        code = np.array([c for _, c, _ in groups], np.int64)[owner]
        bump, names, born = _births((code * 2 * _HALF + x) * 2 * _HALF + y, chunk[frame[owner]])
        order = np.lexsort((bump, owner))
        many = np.bincount(owner, minlength=len(groups))
        ends = np.cumsum(many)
        column = np.empty(len(used), np.int64)
        column[slots[order]] = _number(owner, many)
        place = np.cumsum(sizes * per * many) - sizes * per * many
        basis = np.zeros(int((sizes * per * many).sum()))
        row = rows - ((np.cumsum(sizes) - sizes) * per)[group_of]
        slot = column[slot] + (place[group_of] + row * many[group_of])[:, None, None]
        basis[slot] = value[:, :, None, 0] * value[:, None, :, 1]
        bump = bump[order]
        out = []
        for k in np.flatnonzero(many):
            t, _, elements = groups[k]
            shape = (sizes[k] * per, many[k])
            values = basis[place[k] : place[k] + shape[0] * shape[1]].reshape(shape)
            out.append(_Group(t, elements, bump[ends[k] - many[k] : ends[k]], values))
        return out, names, born

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
            e, size = g.elements, 2 * len(g.bumps)
            r, amplitude = self.linear.r[e], self.amplitude[e]
            basis = g.basis.reshape(*r.shape, -1)
            columns = np.empty((*r.shape, size + 4))
            np.multiply(basis, amplitude[..., :1], out=columns[..., 0:size:2])
            np.multiply(basis, amplitude[..., 1:], out=columns[..., 1:size:2])
            columns[..., size:-1] = self.linear.jacobian[e]
            columns[..., -1] = r + columns[..., :size] @ self.weights[g.bumps].ravel()
            matrix = gram_sum(columns, weight[e], shared[e])
            # Bumps come in the order of their unknowns, and before those of the frame.
            index = np.empty(size + 3, np.int64)
            index[0:size:2] = self.index[g.bumps]
            index[1:size:2] = index[0:size:2] + 1
            index[size:] = self.frame_index[g.frame] + np.arange(3)
            system.add(index, matrix[:-1, :-1], matrix[:-1, -1])
            information[g.frame] += matrix[-4:-1, -4:-1]
            chi2[g.frame] += matrix[-1, -1]
        own = (self.index[:, None] + (0, 1)).ravel()
        system.add_prior(own, np.ones(len(own)), self.weights.ravel())
        return information, chi2

    def update(self, step: Array) -> None:
        """Apply the solver's step."""
        self.weights = self.weights + step[self.index[:, None] + np.arange(2)]


def _number(kind: Index, counts: Index) -> Index:
    """(n,) the how-manyth of its kind each is; ``kind`` (n,) ascends, ``counts`` of each."""
    return np.arange(len(kind)) - (np.cumsum(counts) - counts)[kind]


def _births(name: Index, chunk: Index) -> tuple[Index, Index, Index]:
    """Which bump (n,) is meant where a ``name`` (n,) is seen in a ``chunk`` (n,); names (bumps,)
    and chunks (bumps,) of the bumps, sorted by chunk.

    A bump serves the chunk in which it is born and the next one.
    """
    order = np.lexsort((chunk, name))
    n, c = name[order], chunk[order]
    other = np.diff(n, prepend=-1) != 0
    new = other | (np.diff(c, prepend=-1) != 0)
    pair = np.cumsum(new) - 1
    n, c, other = n[new], c[new], other[new]
    broken = other | (np.diff(c, prepend=-1) != 1)
    at = np.arange(len(n))
    old = (at - np.maximum.accumulate(np.where(broken, at, 0))) % 2 == 1
    sort = np.lexsort((n[~old], c[~old]))
    bump = np.empty(len(n), np.int64)
    bump[at[~old][sort]] = np.arange(len(sort))
    bump[old] = bump[at[old] - 1]
    out = np.empty(len(name), np.int64)
    out[order] = bump[pair]
    return out, n[~old][sort], c[~old][sort]
