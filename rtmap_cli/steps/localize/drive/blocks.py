"""Block-tridiagonal normal equations: assembly, solution, covariance of the diagonal blocks.

Unknowns are sorted into consecutive chunks; a factor may touch one chunk or two neighbours. Cost
and memory grow linearly with the number of chunks.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class BlockSystem:
    """H x = -g with H positive definite; chunk b owns unknowns ``offset[b]`` to ``offset[b+1]``."""

    def __init__(self, sizes: list[int]) -> None:
        self.offset = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        self.diagonal = [np.zeros((n, n)) for n in sizes]
        self.lower = [np.zeros((b, a)) for a, b in pairwise(sizes)]
        self.gradient = np.zeros(int(self.offset[-1]))
        # H = L Lᵀ: the diagonal blocks of L, and those below them.
        self.roots: list[Array] = []
        self.ties: list[Array] = []

    def chunk_of(self, index: Index) -> Index:
        """Chunk of each unknown."""
        return np.asarray(np.searchsorted(self.offset, index, side="right") - 1, np.int64)

    def add(self, index: Index, information: Array, gradient: Array) -> None:
        """Add a factor: ``information`` (n, n) and ``gradient`` (n,) on sorted unknowns (n,)."""
        self.gradient[index] += gradient
        first = int(self.chunk_of(index[:1])[0])
        split = int(np.searchsorted(index, self.offset[first + 1]))
        a = index[:split] - self.offset[first]
        self.diagonal[first][a[:, None], a] += information[:split, :split]
        if split < len(index):
            b = index[split:] - self.offset[first + 1]
            self.diagonal[first + 1][b[:, None], b] += information[split:, split:]
            self.lower[first][b[:, None], a] += information[split:, :split]

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
        self.roots, self.ties = [], []
        for b, d in enumerate(self.diagonal):
            if b:
                d = d - self.ties[-1] @ self.ties[-1].T
            self.roots.append(cholesky(d, lower=True, check_finite=False))
            if b < len(self.lower):
                self.ties.append(_forward(self.roots[-1], self.lower[b].T).T)

    def solve(self) -> Array:
        """The step -H⁻¹ g (after ``factor``)."""
        o = self.offset
        parts = [-self.gradient[o[b] : o[b + 1]] for b in range(len(self.diagonal))]
        for b, root in enumerate(self.roots):
            if b:
                parts[b] = parts[b] - self.ties[b - 1] @ parts[b - 1]
            parts[b] = _forward(root, parts[b])
        for b in range(len(parts) - 1, -1, -1):
            if b < len(self.ties):
                parts[b] = parts[b] - self.ties[b].T @ parts[b + 1]
            parts[b] = _backward(self.roots[b], parts[b])
        return np.concatenate(parts)

    def marginals(self) -> list[Array]:
        """The diagonal blocks of H⁻¹, one per chunk (after ``factor``)."""
        out: list[Array] = []
        for b in range(len(self.roots) - 1, -1, -1):
            inverse = _forward(self.roots[b], np.eye(len(self.roots[b])))
            block = inverse.T @ inverse
            if out:
                gain = self.ties[b] @ inverse
                block = block + gain.T @ out[-1] @ gain
            out.append(block)
        return out[::-1]


def _forward(root: Array, b: Array) -> Array:
    """L⁻¹ b with L lower."""
    return np.asarray(solve_triangular(root, b, lower=True, check_finite=False), np.float64)


def _backward(root: Array, b: Array) -> Array:
    """L⁻ᵀ b with L lower."""
    out = solve_triangular(root, b, lower=True, trans="T", check_finite=False)
    return np.asarray(out, np.float64)
