"""Independent truth for fitted noise bounds on a linear plant: the whole box recursion as ONE linear program.

For ``x+ = A x + G d + w``, ``y = x + v`` (all states measured, H = 0) and gains taken as given, every upper bound of
the recursion is at most a sum, with nonnegative weights, of upper bounds, negated lower bounds and noise bounds. So the
upper and lower bounds of all steps become unknowns, every intersection an inequality per member, and "no conflict"
reads lower <= upper. Where such unknowns exist the recursion itself, whose upper bounds are the largest that the
inequalities allow, has no conflict either; so the cheapest noise bounds are the optimum of this program.

Nothing here shares code with the package: expressions are dictionaries of coefficients, solved by SciPy's HiGHS.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array

Expression = dict[int, float]  # coefficient by unknown; -1 is the constant
Box = list[tuple[Expression, Expression]]  # lower, upper


def combine(*terms: tuple[float, Expression]) -> Expression:
    total: Expression = {}
    for weight, expression in terms:
        for key, value in expression.items():
            total[key] = total.get(key, 0.0) + weight * value
    return total


def image(matrix: Any, box: Box) -> Box:
    found = []
    for row in np.asarray(matrix):
        lower = combine(*((a, part[0 if a > 0 else 1]) for a, part in zip(row, box, strict=True) if a))
        upper = combine(*((a, part[1 if a > 0 else 0]) for a, part in zip(row, box, strict=True) if a))
        found.append((lower, upper))
    return found


def add(*boxes: Box) -> Box:
    return [
        (combine(*((1.0, p[0]) for p in parts)), combine(*((1.0, p[1]) for p in parts)))
        for parts in zip(*boxes, strict=True)
    ]


def minus(box: Box) -> Box:
    return [(combine((-1.0, upper)), combine((-1.0, lower))) for lower, upper in box]


def constant(lower: Any, upper: Any) -> Box:
    return [({-1: float(a)}, {-1: float(b)}) for a, b in zip(lower, upper, strict=True)]


@dataclass
class Program:
    """Inequalities ``expression <= 0`` over unknowns that are numbered as they come."""

    count: int = 0
    rows: list[Expression] = field(default_factory=list)

    def unknown(self) -> int:
        self.count += 1
        return self.count - 1

    def meet(self, *boxes: Box) -> Box:
        """An intersection that must not be empty."""
        met: Box = []
        for parts in zip(*boxes, strict=True):
            low, high = {self.unknown(): 1.0}, {self.unknown(): 1.0}
            for lower, upper in parts:
                self.rows += [combine((1.0, lower), (-1.0, low)), combine((1.0, high), (-1.0, upper))]
            self.rows.append(combine((1.0, low), (-1.0, high)))
            met.append((low, high))
        return met

    def contains_zero(self, box: Box) -> None:
        for lower, upper in box:
            self.rows += [lower, combine((-1.0, upper))]

    def minimise(self, price: Any) -> tuple[float, np.ndarray]:
        """The optimum, and the first unknowns (one per price), which are nonnegative."""
        at, value, limit = ([], []), [], []
        for i, row in enumerate(self.rows):
            limit.append(-row.get(-1, 0.0))
            for key, coefficient in row.items():
                if key >= 0:
                    at[0].append(i)
                    at[1].append(key)
                    value.append(coefficient)
        matrix = csr_array((value, at), shape=(len(self.rows), self.count))
        cost = np.zeros(self.count)
        cost[: len(price)] = price
        bounds = [(0, None)] * len(price) + [(None, None)] * (self.count - len(price))
        found = linprog(cost, matrix, limit, bounds=bounds, method="highs")
        assert found.status == 0, found.message
        return found.fun, found.x[: len(price)]


def smallest_noise(
    observer: Any, A: np.ndarray, initial: Any, records: np.ndarray, price: Any
) -> tuple[float, np.ndarray]:
    """Cheapest factors on the symmetric noise bounds of the observer, one per component of w and v.

    Args:
        observer: supplies the gains, left inverses and circuits; nothing of it is run.
        A: (n, n).
        initial: box of x[0] with `lower` and `upper`.
        records: (R, T, n).
        price: (2 n,) of the factors.

    Returns:
        Cost, and factors (2 n,).
    """
    n = len(A)
    G = np.asarray(observer.system.G)
    program = Program()
    factor = [program.unknown() for _ in range(2 * n)]
    radius = np.concatenate([observer.noise.w.upper, observer.noise.v.upper])
    noise = [({key: -r}, {key: r}) for key, r in zip(factor, radius, strict=True)]
    w, v = noise[:n], noise[n:]
    slope = np.vstack([A, np.eye(n)])
    gains, inverses, exact = observer.gains, observer.inverses, observer.exact
    for y in records:
        seen = add(constant(y[0], y[0]), minus(v))
        box = program.meet(constant(initial.lower, initial.upper), seen)
        for k in range(1, len(y)):
            before, seen_before = box, seen
            seen = add(constant(y[k], y[k]), minus(v))
            shift = w + minus(seen_before)

            def explicit(bank: Any, i: int, before=before, shift=shift, seen=seen) -> Box:
                residual = np.asarray(bank.residual[i])
                return add(
                    image(residual @ slope, before), image(residual, shift), image(np.asarray(bank.output[i]), seen)
                )

            def left(box: Box, explicit=explicit) -> list[Box]:
                count = len(inverses.residual)
                return [add(image(np.asarray(inverses.state[i]), box), explicit(inverses, i)) for i in range(count)]

            box = program.meet(seen, *(explicit(gains, i) for i in range(len(gains.residual))))
            moved = add(image(A, before), w)
            box = program.meet(box, add(moved, image(G, program.meet(*left(box)))))
            explained = add(box + constant(np.zeros(n), np.zeros(n)), minus(add(image(slope, before), shift)))
            program.meet(*left(box), *(image(np.asarray(rows), explained) for rows in exact.rows))
            program.contains_zero(image(np.asarray(exact.circuits), explained))
    return program.minimise(price)
