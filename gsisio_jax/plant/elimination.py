"""Left null spaces in rational arithmetic: d has no bound, so what annihilates it must do so exactly."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

Row = list[Fraction]


def left_null_space(rows: Sequence[Row]) -> list[Row]:
    """Reduce [H | I] over the rationals; the rows whose H part vanished are a basis of the left null space of H."""
    l = len(rows)
    p = len(rows[0]) if l else 0
    work = [list(row) + [Fraction(int(i == j)) for j in range(l)] for i, row in enumerate(rows)]
    pivot = 0
    for column in range(p):
        # Prefer a sparse pivot row: it keeps T2 sparse, and with it the gains usable when entries are missing.
        candidates = [i for i in range(pivot, l) if work[i][column] != 0]
        if not candidates:
            continue
        best = min(candidates, key=lambda i: (sum(value != 0 for value in work[i]), -abs(work[i][column])))
        work[pivot], work[best] = work[best], work[pivot]
        for i in range(l):
            if i != pivot and work[i][column] != 0:
                factor = work[i][column] / work[pivot][column]
                work[i] = [a - factor * b for a, b in zip(work[i], work[pivot], strict=True)]
        pivot += 1
    return [row[p:] for row in work[pivot:]]


def whole_numbers(row: Row) -> list[int]:
    """The row scaled to whole numbers without a common divisor."""
    whole = math.lcm(*(value.denominator for value in row))
    integers = [int(value * whole) for value in row]
    shared = math.gcd(*integers)
    return [value // shared for value in integers]
