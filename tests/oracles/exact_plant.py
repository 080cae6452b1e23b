"""Plants whose equations hold exactly, with the tightest noise bounds that a record leaves possible.

x, y and d are floating numbers; w and v are the exact differences, so the plant equations hold as they stand; and the
bounds of the noise are the smallest floating boxes that hold these: a single number, or two neighbours. Whatever is
lost by one rounding more than allowed shows as a miss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from oracles.exact_sums import hull, product


@dataclass(frozen=True)
class Plant:
    """``x+ = A x + a + sum q x_j x_k + G d + w``, ``y = C x + c + H d + v``; all numbers are what their floats are,
    but H, which is ``H_whole / H_over``: its decimals, with the rank that they have.

    Attributes:
        A, C, G: matrices of floats.
        H_whole: matrix of whole numbers, (l, p).
        H_over: a whole number of few bits.
        a, c: constants.
        squares: (row, j, k, q) for every term q x_j x_k of the state equation.
    """

    A: np.ndarray
    C: np.ndarray
    G: np.ndarray
    H_whole: np.ndarray
    H_over: float = 1.0
    a: Sequence[float] | None = None
    c: Sequence[float] | None = None
    squares: Sequence[tuple[int, int, int, float]] = ()

    @property
    def H(self) -> np.ndarray:
        return self.H_whole / self.H_over

    def astype(self, dtype: Any) -> Plant:
        """The plant whose numbers are those of a narrower type."""
        A, C, G = (np.asarray(m, np.float64).astype(dtype).astype(np.float64) for m in (self.A, self.C, self.G))
        a, c = (None if v is None else np.asarray(v, dtype).astype(np.float64) for v in (self.a, self.c))
        squares = [(i, j, k, float(dtype(q))) for i, j, k, q in self.squares]
        return Plant(A, C, G, self.H_whole, self.H_over, a, c, squares)


@dataclass(frozen=True)
class Record:
    """Records (batch, steps, .) and the noise bounds (batch, steps, .) that hold them, lower and upper."""

    x: np.ndarray
    y: np.ndarray
    d: np.ndarray
    w: tuple[np.ndarray, np.ndarray]
    v: tuple[np.ndarray, np.ndarray]


def tight_records(
    rng: np.random.Generator, plant: Plant, batch: int, steps: int, d_size: Any, noise: Any, dtype: Any
) -> Record:
    """Runs of a plant. `d_size` and `noise` are numbers, or one for every run."""
    plant = plant.astype(dtype)
    A, C, G, H = plant.A, plant.C, plant.G, plant.H
    n, p, l = len(A), G.shape[1], len(C)
    a, c = (np.zeros(m) if v is None else np.asarray(v) for v, m in ((plant.a, n), (plant.c, l)))
    sizes, noises = (np.broadcast_to(np.asarray(v, float), (batch,))[:, None] for v in (d_size, noise))
    x, y = np.zeros((batch, steps, n), dtype), np.zeros((batch, steps, l), dtype)
    d = (sizes[:, None] * rng.standard_normal((batch, steps, p))).astype(dtype)
    x[:, 0] = rng.standard_normal((batch, n))
    for k in range(steps):
        now, given = x[:, k].astype(np.float64), d[:, k].astype(np.float64)
        y[:, k] = now @ C.T + c + given @ H.T + noises * rng.uniform(-1, 1, (batch, l))
        if k + 1 < steps:
            moved = now @ A.T + a + given @ G.T + noises * rng.uniform(-1, 1, (batch, n))
            for i, j, m, q in plant.squares:
                moved[:, i] += q * now[:, j] * now[:, m]
            x[:, k + 1] = moved
    v = _hulls([_row(y, x, d, i, plant.C, c, plant.H_whole, plant.H_over) for i in range(l)], dtype, plant.H_over)
    w = _hulls([_state_row(plant, x, d, i, a) for i in range(n)], dtype, 1.0)
    return Record(x, y, d, _padded(w, batch, n, dtype), v)


def _state_row(plant: Plant, x: Any, d: Any, i: int, a: Any) -> list[Any]:
    terms = _row(x[:, 1:], x[:, :-1], d[:, :-1], i, plant.A, a, plant.G, 1.0)
    now = x[:, :-1].astype(np.float64)
    for row, j, k, q in plant.squares:
        if row == i:
            terms += [part for term in product(now[..., j], now[..., k]) for part in product(-term, q)]
    return terms


def _row(out: Any, x: Any, d: Any, i: int, matrix: Any, constant: Any, inputs: Any, over: float) -> list[Any]:
    """Terms whose exact sum is `over` times what row i of an equation leaves for the noise."""
    factor = float(over)
    terms = product(out[..., i].astype(np.float64), factor) + product(-factor * np.ones(()), np.float64(constant[i]))
    for j in range(x.shape[-1]):
        for part in product(np.float64(matrix[i, j]), -x[..., j].astype(np.float64)):
            terms += product(part, factor) if factor != 1 else [part]
    for j in range(d.shape[-1]):
        terms += product(np.float64(inputs[i, j]), -d[..., j].astype(np.float64))
    return terms


def _hulls(rows: list[Any], dtype: Any, over: float) -> tuple[np.ndarray, np.ndarray]:
    pairs = [hull(terms, dtype, np.float64(over)) for terms in rows]
    return np.stack([pair[0] for pair in pairs], -1), np.stack([pair[1] for pair in pairs], -1)


def _padded(w: Any, batch: int, n: int, dtype: Any) -> tuple[np.ndarray, np.ndarray]:
    """One row more: the step after the last is never looked at."""
    last = np.zeros((batch, 1, n), dtype)
    return np.concatenate([w[0], last], 1), np.concatenate([w[1], last], 1)


def is_tight(plant: Plant, record: Record, run: int, k: int) -> bool:
    """Do the noise bounds of one step hold the exact differences, no box being smaller? In fractions."""
    plant = plant.astype(record.x.dtype.type)
    x, y, d = ([Fraction(float(v)) for v in side[run, k]] for side in (record.x, record.y, record.d))

    def image(matrix: Any, v: list[Fraction], i: int) -> Fraction:
        return sum((Fraction(float(m)) * t for m, t in zip(matrix[i], v, strict=True)), Fraction(0))

    good = True
    for i in range(len(plant.C)):
        rest = y[i] - image(plant.C, x, i) - image(plant.H_whole, d, i) / Fraction(plant.H_over)
        rest -= 0 if plant.c is None else Fraction(float(plant.c[i]))
        good &= _around(rest, record.v[0][run, k, i], record.v[1][run, k, i])
    for i in range(len(plant.A)):
        rest = Fraction(float(record.x[run, k + 1, i])) - image(plant.A, x, i) - image(plant.G, d, i)
        rest -= 0 if plant.a is None else Fraction(float(plant.a[i]))
        rest -= sum((Fraction(q) * x[j] * x[m] for row, j, m, q in plant.squares if row == i), Fraction(0))
        good &= _around(rest, record.w[0][run, k, i], record.w[1][run, k, i])
    return good


def _around(value: Fraction, lower: Any, upper: Any) -> bool:
    if not Fraction(float(lower)) <= value <= Fraction(float(upper)):
        return False
    return lower == upper or np.nextafter(lower, upper) == upper
