"""Block-tridiagonal normal equations: assembly, solution, covariance of the diagonal blocks.

Unknowns are sorted into consecutive chunks; a factor may touch one chunk or two neighbours. Cost
and memory grow linearly with the number of chunks.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class BlockSystem:
    """H x = -g with H positive definite; chunk b owns unknowns ``offset[b]`` to ``offset[b+1]``."""

    def __init__(self, sizes: list[int]) -> None:
        self.offset = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        self.diagonal = [np.zeros((n, n)) for n in sizes]
        self.lower = [np.zeros((b, a)) for a, b in pairwise(sizes)]
        self.gradient = np.zeros(int(self.offset[-1]))
        self.factors: list[tuple[Array, bool]] = []
        self.gains: list[Array] = []

    def chunk_of(self, index: Index) -> Index:
        """Chunk of each unknown."""
        return np.asarray(np.searchsorted(self.offset, index, side="right") - 1, np.int64)

    def add(self, index: Index, information: Array, gradient: Array) -> None:
        """Add a factor: ``information`` (n, n) and ``gradient`` (n,) on sorted unknowns (n,)."""
        self.gradient[index] += gradient
        first = int(self.chunk_of(index[:1])[0])
        split = int(np.searchsorted(index, self.offset[first + 1]))
        a = index[:split] - self.offset[first]
        self.diagonal[first][np.ix_(a, a)] += information[:split, :split]
        if split < len(index):
            b = index[split:] - self.offset[first + 1]
            self.diagonal[first + 1][np.ix_(b, b)] += information[split:, split:]
            self.lower[first][np.ix_(b, a)] += information[split:, :split]

    def add_chain(self, first: Index, own: Array, below: Array, gradient: Array) -> None:
        """Add n factors in a row, each of k unknowns from ``first`` (n,) on: ``own`` (n, k, k),
        ``below`` (n, k, k) with the one before (the first is not used), ``gradient`` (n, k)."""
        index = first[:, None] + np.arange(own.shape[1])
        self.gradient[index] += gradient
        chunk = self.chunk_of(first)
        for b in np.unique(chunk):
            n = np.flatnonzero(chunk == b)
            at = index[n] - self.offset[b]
            self.diagonal[b][at[:, :, None], at[:, None, :]] += own[n]
            rows, columns = at[1:, :, None], at[:-1, None, :]
            self.diagonal[b][rows, columns] += below[n[1:]]
            self.diagonal[b][at[:-1, :, None], at[1:, None, :]] += np.swapaxes(below[n[1:]], -1, -2)
            if b and n[0] > 0:
                last = index[n[0] - 1] - self.offset[b - 1]
                self.lower[b - 1][np.ix_(at[0], last)] += below[n[0]]

    def add_prior(self, index: Index, information: Array, pull: Array) -> None:
        """Independent priors: ``information`` (n,), and ``pull`` (n,) distances from their mean."""
        self.gradient[index] += information * pull
        chunk = self.chunk_of(index)
        for b in np.unique(chunk):
            own = index[chunk == b] - self.offset[b]
            self.diagonal[b][own, own] += information[chunk == b]

    def factor(self) -> None:
        """Eliminate chunk after chunk (block Cholesky)."""
        self.factors, self.gains = [], []
        for b, d in enumerate(self.diagonal):
            if b:
                d = d - self.lower[b - 1] @ self.gains[b - 1].T
            f = cho_factor(d, lower=True, check_finite=False)
            self.factors.append(f)
            if b < len(self.lower):
                self.gains.append(cho_solve(f, self.lower[b].T, check_finite=False).T)

    def solve(self) -> Array:
        """The step -H⁻¹ g (after ``factor``)."""
        o = self.offset
        parts = [-self.gradient[o[b] : o[b + 1]] for b in range(len(self.diagonal))]
        for b in range(1, len(parts)):
            parts[b] = parts[b] - self.gains[b - 1] @ parts[b - 1]
        for b in range(len(parts) - 1, -1, -1):
            parts[b] = cho_solve(self.factors[b], parts[b], check_finite=False)
            if b < len(self.gains):
                parts[b] = parts[b] - self.gains[b].T @ parts[b + 1]
        return np.concatenate(parts)

    def marginals(self) -> list[Array]:
        """The diagonal blocks of H⁻¹, one per chunk (after ``factor``)."""
        out: list[Array] = []
        for b in range(len(self.factors) - 1, -1, -1):
            n = len(self.diagonal[b])
            block = cho_solve(self.factors[b], np.eye(n), check_finite=False)
            if out:
                gain = self.gains[b]
                block = block + gain.T @ out[-1] @ gain
            out.append(block)
        return out[::-1]
