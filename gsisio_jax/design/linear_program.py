"""Linear programs with absolute values, handed to Clarabel as they stand.

Designs solve many small ones, and a modelling language takes ten times longer to read a program than Clarabel to solve
it (and to import than all of a small design). Here an expression is a matrix whose entries are linear in the unknowns.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import clarabel
import numpy as np
from scipy import sparse

_TOLERANCE = 1e-11
_SOLVED = ("Solved", "AlmostSolved")  # what comes of it is checked, not believed


class Entries(NamedTuple):
    """A matrix of coefficients: `value` at (`row`, `column`); what stands at one place counts together.

    SciPy's matrices check and sort themselves at every operation, which takes longer than the operation.
    """

    row: np.ndarray
    column: np.ndarray
    value: np.ndarray

    def sorted(self) -> Entries:
        """By their rows."""
        order = np.argsort(self.row, kind="stable")
        return Entries(self.row[order], self.column[order], self.value[order])


class Expression:
    """A matrix (or vector) of numbers that are linear in the unknowns of a program.

    Attributes:
        entries: their rows are the numbers in C order, their columns the unknowns.
        offset: array of the shape of the expression.
    """

    __array_ufunc__ = None  # NumPy leaves arithmetic to this class

    def __init__(self, entries: Entries, offset: np.ndarray):
        self.entries, self.offset = entries, offset

    @property
    def shape(self) -> tuple[int, ...]:
        return self.offset.shape

    def __getitem__(self, key: Any) -> Expression:
        picked = np.arange(self.offset.size).reshape(self.shape)[key].ravel()
        given = self.entries.sorted()
        counts = np.bincount(given.row, minlength=self.offset.size)
        index = _runs((np.cumsum(counts) - counts)[picked], counts[picked])
        rows = np.repeat(np.arange(picked.size), counts[picked])
        return Expression(Entries(rows, given.column[index], given.value[index]), self.offset[key])

    def __matmul__(self, matrix: np.ndarray) -> Expression:
        offset = self.offset @ matrix
        right = np.reshape(matrix, (self.shape[-1], math.prod(np.shape(matrix)[1:])))
        lead, last = np.divmod(self.entries.row, self.shape[-1] or 1)
        begin, to = np.nonzero(right)
        counts = np.bincount(begin, minlength=len(right))
        each = counts[last]
        index = _runs((np.cumsum(counts) - counts)[last], each)
        return Expression(
            Entries(
                np.repeat(lead * right.shape[1], each) + to[index],
                np.repeat(self.entries.column, each),
                np.repeat(self.entries.value, each) * right[begin, to][index],
            ),
            offset,
        )

    def __add__(self, other: Any) -> Expression:
        if not isinstance(other, Expression):
            return Expression(self.entries, self.offset + other)
        return Expression(Entries(*map(np.append, self.entries, other.entries)), self.offset + other.offset)

    def __neg__(self) -> Expression:
        return Expression(self.entries._replace(value=-self.entries.value), -self.offset)

    def __sub__(self, other: Any) -> Expression:
        return self + (-other)

    def __radd__(self, other: np.ndarray) -> Expression:
        return self + other

    def __rsub__(self, other: np.ndarray) -> Expression:
        return -self + other

    def sum(self, axis: int | None = None) -> Expression:
        """Sum of all entries, or along an axis."""
        offset = np.asarray(self.offset.sum(axis))
        place = np.arange(offset.size).reshape(offset.shape)
        place = np.broadcast_to(place if axis is None else np.expand_dims(place, axis), self.shape).ravel()
        return Expression(self.entries._replace(row=place[self.entries.row]), offset)

    def at(self, x: np.ndarray) -> np.ndarray:
        """The numbers for these values of the unknowns."""
        of, column, value = self.entries
        return np.bincount(of, value * x[column], self.offset.size).reshape(self.shape) + self.offset


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
        place = np.arange(size)
        return Expression(Entries(place, start + place, np.ones(size)), np.zeros(shape))

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
        ends = np.cumsum([c.offset.size for c in constraints])
        rows = np.concatenate([c.entries.row + end - c.offset.size for c, end in zip(constraints, ends, strict=True)])
        columns, values = (np.concatenate([c.entries[part] for c in constraints]) for part in (1, 2))
        A = sparse.csc_array((-values, (rows, columns)), (ends[-1], self._count))
        A.eliminate_zeros()
        b = np.concatenate([c.offset.ravel() for c in constraints])
        q = np.bincount(goal.entries.column, goal.entries.value, self._count)
        sizes = (sum(c.offset.size for c in part) for part in (self._zero, self._nonnegative))
        kinds: Any = clarabel
        cones = [kinds.ZeroConeT(next(sizes)), kinds.NonnegativeConeT(next(sizes))]
        found = kinds.DefaultSolver(
            sparse.csc_matrix((self._count, self._count)), q, sparse.csc_matrix(A), b, cones, _settings()
        ).solve()
        if str(found.status) not in _SOLVED:
            return None
        x = np.asarray(found.x)
        return [w.at(x) for w in wanted]


def diagonal(values: Expression) -> Expression:
    """The diagonal matrix of a vector."""
    rows = values.entries.row * (values.shape[0] + 1)
    return Expression(values.entries._replace(row=rows), np.diag(values.offset))


def _runs(first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Indices first[i], first[i] + 1, ..., so many of each, one run behind the other."""
    return np.repeat(first - (np.cumsum(count) - count), count) + np.arange(count.sum())


def _settings() -> Any:
    settings = clarabel.DefaultSettings()  # type: ignore[attr-defined]
    settings.verbose = False
    for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas", "tol_infeas_abs", "tol_infeas_rel"):
        setattr(settings, name, _TOLERANCE)
    return settings
