"""Linear programs with absolute values, handed to Clarabel as they stand.

Designs solve many small ones, and a modelling language takes ten times longer to read a program than Clarabel to solve
it (and to import than all of a small design). Here an expression is a matrix whose entries are linear in the unknowns.
"""

from __future__ import annotations

from typing import Any

import clarabel
import numpy as np
from scipy import sparse

_TOLERANCE = 1e-11
_SOLVED = ("Solved", "AlmostSolved")  # what comes of it is checked, not believed


class Expression:
    """A matrix (or vector) of numbers that are linear in the unknowns of a program.

    Attributes:
        rows: sparse (entries, unknowns so far), entries in C order.
        offset: array of the shape of the expression.
    """

    __array_ufunc__ = None  # NumPy leaves arithmetic to this class

    def __init__(self, rows: Any, offset: np.ndarray):
        self.rows, self.offset = rows, offset

    @property
    def shape(self) -> tuple[int, ...]:
        return self.offset.shape

    def __getitem__(self, key: Any) -> Expression:
        picked = np.arange(self.offset.size).reshape(self.shape)[key]
        return Expression(self.rows[picked.ravel()], self.offset[key])

    def __matmul__(self, matrix: np.ndarray) -> Expression:
        lead, offset = self.shape[:-1], self.offset @ matrix
        if not self.offset.size or not offset.size:
            return Expression(sparse.csr_array((offset.size, self.rows.shape[1])), offset)
        right = sparse.csr_array(np.reshape(matrix, (self.shape[-1], -1)).T)
        return Expression(_along_diagonal(right, int(np.prod(lead))) @ self.rows, offset)

    def __add__(self, other: Any) -> Expression:
        if not isinstance(other, Expression):
            return Expression(self.rows, self.offset + other)
        width = max(self.rows.shape[1], other.rows.shape[1])
        return Expression(_wide(self.rows, width) + _wide(other.rows, width), self.offset + other.offset)

    def __neg__(self) -> Expression:
        return Expression(-self.rows, -self.offset)

    def __sub__(self, other: Any) -> Expression:
        return self + (-other)

    def __radd__(self, other: np.ndarray) -> Expression:
        return self + other

    def __rsub__(self, other: np.ndarray) -> Expression:
        return -self + other

    def sum(self, axis: int | None = None) -> Expression:
        """Sum of all entries, or along an axis."""
        order = np.arange(self.offset.size).reshape(self.shape)
        groups = order.reshape(1, -1) if axis is None else np.moveaxis(order, axis, -1)
        groups = groups.reshape(-1, groups.shape[-1])
        add = _ones(groups.ravel(), groups.shape[1] * np.arange(len(groups) + 1), self.offset.size)
        return Expression(add @ self.rows, np.asarray(self.offset.sum(axis)))


class LinearProgram:
    """Collects unknowns and constraints; absolute values may stand where they are to be small."""

    def __init__(self) -> None:
        self._count = 0
        self._zero: list[Expression] = []
        self._nonnegative: list[Expression] = []

    def variable(self, *shape: int) -> Expression:
        """New unknowns."""
        size, start = int(np.prod(shape)), self._count
        self._count += size
        return Expression(_ones(start + np.arange(size), np.arange(size + 1), self._count), np.zeros(shape))

    def absolute(self, value: Any) -> Any:
        """Numbers at or above the absolute values of an expression."""
        if not isinstance(value, Expression):
            return np.abs(value)
        size = self.variable(*value.shape)
        self.nonnegative(size - value)
        self.nonnegative(size + value)
        return size

    def zero(self, value: Expression) -> None:
        if value.offset.size:
            self._zero.append(value)

    def nonnegative(self, value: Expression) -> None:
        if value.offset.size:
            self._nonnegative.append(value)

    def minimise(self, goal: Expression, *wanted: Expression) -> list[np.ndarray] | None:
        """Values of the wanted expressions at the minimum; None where Clarabel claims none."""
        constraints = [*self._zero, *self._nonnegative]
        A = sparse.csc_array(-sparse.vstack([_wide(c.rows, self._count) for c in constraints]))
        A.eliminate_zeros()
        b = np.concatenate([c.offset.ravel() for c in constraints])
        q = _wide(goal.rows, self._count).toarray().ravel()
        sizes = (sum(c.offset.size for c in part) for part in (self._zero, self._nonnegative))
        kinds: Any = clarabel
        cones = [kinds.ZeroConeT(next(sizes)), kinds.NonnegativeConeT(next(sizes))]
        found = kinds.DefaultSolver(
            sparse.csc_matrix((self._count, self._count)), q, sparse.csc_matrix(A), b, cones, _settings()
        ).solve()
        if str(found.status) not in _SOLVED:
            return None
        x = np.asarray(found.x)
        return [(_wide(w.rows, self._count) @ x).reshape(w.shape) + w.offset for w in wanted]


def diagonal(values: Expression) -> Expression:
    """The diagonal matrix of a vector."""
    n = values.shape[0]
    place = _ones(np.arange(n), (np.arange(n * n + 1) + n) // (n + 1), n)
    return Expression(place @ values.rows, np.diag(values.offset))


def _ones(columns: np.ndarray, ends: np.ndarray, width: int) -> Any:
    """Rows with ones at these columns, row r at those from ends[r] to ends[r+1]: SciPy's forms by coordinates sort."""
    return sparse.csr_array((np.ones(len(columns)), columns, ends), (len(ends) - 1, width))


def _along_diagonal(block: Any, count: int) -> Any:
    """`count` copies of a sparse matrix along the diagonal of a larger one."""
    (height, width), copies = block.shape, np.arange(count)[:, None]
    columns = (block.indices + width * copies).ravel()
    ends = np.append((block.indptr[:-1] + block.nnz * copies).ravel(), block.nnz * count)
    return sparse.csr_array((np.tile(block.data, count), columns, ends), (height * count, width * count))


def _wide(rows: Any, width: int) -> Any:
    """The same rows for more unknowns."""
    return sparse.csr_array((rows.data, rows.indices, rows.indptr), (rows.shape[0], width))


def _settings() -> Any:
    settings = clarabel.DefaultSettings()  # type: ignore[attr-defined]
    settings.verbose = False
    for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas", "tol_infeas_abs", "tol_infeas_rel"):
        setattr(settings, name, _TOLERANCE)
    return settings
