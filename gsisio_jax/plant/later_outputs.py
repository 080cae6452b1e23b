"""Combinations of y[k..k+L] that are free of every unknown input, as functions of x[k]: found in fractions.

    y[k+i] = g(x[k+i]) + ...,   x[k+i] = f(x[k+i-1]) + ...

Where g, and f but for the last step back, are affine in what they take, an entry of y[k+i] is a function of x[k], of
known inputs, unknown inputs and noise. d has no bound, so combinations must be free of it exactly.

Source: theory 5.9.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from gsisio_jax.errors import NoDesignFound
from gsisio_jax.inclusion.reader import AffineRow, affine_rows
from gsisio_jax.plant.elimination import left_null_space, whole_numbers
from gsisio_jax.plant.system import System

Weights = dict[Any, Fraction]
Pieces = tuple[float, ...]


@dataclass
class _Later:
    """A combination of y[k..k+L]: the weights of its parts, by step (from k) and index, and a constant."""

    y: Weights = field(default_factory=dict)
    g: Weights = field(default_factory=dict)
    f: Weights = field(default_factory=dict)
    u: Weights = field(default_factory=dict)
    w: Weights = field(default_factory=dict)
    d: Weights = field(default_factory=dict)
    constant: Fraction = Fraction(0)


@dataclass(frozen=True, eq=False)
class LiftedRows:
    """r further outputs: combinations of y[k..k+L] that are free of d, as numbers of one floating type.

        outputs y[k..k+L] - known u[k..k+L]
            = of_g g(x[k]) + of_f f(x[k]) + constant + outputs v[k..k+L] + process w[k..k+L]

    Attributes:
        outputs: (r, (L+1) l); known: (r, (L+1) m); process: (r, (L+1) n). Rounded to nearest.
        of_f, of_g: for every row its (index, pieces), the sum of the pieces being the exact weight.
        constant: for every row its pieces.
        entries: for every row the outputs that enter it.
        free: (f, (L+1) l) all combinations that are free of d, those of y[k] alone among them, to nearest; what `more`
            is made of. free_process: (f, (L+1) n), free_f: (f, n) and free_g: (f, l), likewise.
        blocked: why entries of y[k+1..k+L] could not be used; empty where all were.
    """

    outputs: np.ndarray
    known: np.ndarray
    process: np.ndarray
    of_f: tuple[tuple[tuple[int, Pieces], ...], ...]
    of_g: tuple[tuple[tuple[int, Pieces], ...], ...]
    constant: tuple[Pieces, ...]
    entries: tuple[tuple[int, ...], ...]
    blocked: str
    free: np.ndarray
    free_process: np.ndarray
    free_f: np.ndarray
    free_g: np.ndarray


def lifted_rows(plant: System, delay: int, dtype: Any, more: tuple[Pieces, ...] = ()) -> LiftedRows:
    """Combinations of y[k..k+L] that are free of d, beyond those of y[k] alone.

    Args:
        plant: its G, B and D are taken as they are, its H as the decimals that were written.
        delay: L.
        dtype: the constants of f and g are those of this type.
        more: further rows, as weights of all rows that are free of d.
    """
    n, l, m, p = plant.n, plant.l, plant.m, plant.p
    entries, blocked = _entries(plant, delay, affine_rows(plant.maps, n, m, dtype))
    names = list(entries)

    def combined(row: list[Fraction]) -> _Later:
        total = _Later(y={name: v for name, v in zip(names, row, strict=True) if v})
        for name, share in total.y.items():
            for kind in ("g", "f", "u", "w"):
                _add(getattr(total, kind), getattr(entries[name], kind), share)
            total.constant += share * entries[name].constant
        return _binary(total)

    inputs = [(t, q) for t in range(delay + 1) for q in range(p)]
    null = left_null_space([[entry.d.get(at, Fraction(0)) for at in inputs] for entry in entries.values()])
    every = [combined(_scaled(row)) for row in null]
    free = [[one.y.get(name, Fraction(0)) for name in names] for one in every]
    rows = _beyond(free, [i for i, _ in names])
    for shares in more:
        rows.append([sum(map(_product, shares, column), Fraction(0)) for column in zip(*free, strict=True)])
    totals, L = [one for one in map(combined, rows) if one.f or one.g], delay + 1

    def matrix(rows: list[Weights], *shape: int) -> np.ndarray:
        found = np.zeros((len(rows), *shape))
        for r, row in enumerate(rows):
            for at, value in row.items():
                found[r][at] = _pieces(value, dtype)[0]
        return found.reshape(len(rows), math.prod(shape)).astype(dtype)

    def exactly(rows: list[Weights]) -> tuple[tuple[tuple[int, Pieces], ...], ...]:
        return tuple(tuple((i, _pieces(v, dtype)) for i, v in sorted(row.items())) for row in rows)

    return LiftedRows(
        outputs=matrix([t.y for t in totals], L, l),
        known=matrix([t.u for t in totals], L, m),
        process=matrix([t.w for t in totals], L, n),
        of_f=exactly([t.f for t in totals]),
        of_g=exactly([t.g for t in totals]),
        constant=tuple(_pieces(t.constant, dtype) for t in totals),
        entries=tuple(tuple(sorted({j for _, j in t.y})) for t in totals),
        blocked=blocked,
        free=matrix([t.y for t in every], L, l),
        free_process=matrix([t.w for t in every], L, n),
        free_f=matrix([t.f for t in every], n),
        free_g=matrix([t.g for t in every], l),
    )


def _product(share: float, weight: Fraction) -> Fraction:
    return Fraction(share) * weight


def _binary(total: _Later) -> _Later:
    """A multiple of the combination, near it in size, whose weights of f, g and 1 have powers of two as denominators
    (1 / 3 is no sum of floating numbers)."""
    of_x = (*total.f.values(), *total.g.values(), total.constant)
    factor = math.lcm(*(value.denominator for value in of_x))
    factor //= factor & -factor
    share = Fraction(factor, 2 ** (factor - 1).bit_length())
    kinds = (
        {key: share * value for key, value in kind.items()} for kind in (total.y, total.g, total.f, total.u, total.w)
    )
    return _Later(*kinds, constant=share * total.constant)


def _scaled(row: list[Fraction]) -> list[Fraction]:
    """The row as whole numbers over a power of two, the largest up to 1."""
    integers = whole_numbers(row)
    scale = 2 ** (max(map(abs, integers)) - 1).bit_length()
    return [Fraction(value, scale) for value in integers]


def _entries(plant: System, delay: int, affine: list[AffineRow | None]) -> tuple[dict[tuple[int, int], _Later], str]:
    """The entries (i, j) of y[k+i], i = 0..L, as functions of x[k]; and why some are left out."""
    n, p, m = plant.n, plant.p, plant.m
    G, B, D = ([[Fraction(float(v)) for v in row] for row in np.asarray(M)] for M in (plant.G, plant.B, plant.D))
    H = [[Fraction(repr(float(v))) for v in row] for row in np.asarray(plant.H)]
    found, blocked = {}, {}
    for j in range(plant.l):
        now = _Later(g={j: Fraction(1)})
        _at(now, 0, H[j], D[j])
        found[0, j] = now
    for i in range(1, delay + 1):
        for j in range(plant.l):
            row = affine[n + j]
            if row is None:
                blocked[f"output {j + 1} is not affine in x"] = True
                continue
            entry = _Later()
            _at(entry, i, H[j], D[j])
            for t in range(i, 0, -1):  # from a row of x[k+t] to one of f(x[k+t-1])
                _add(entry.u, {(t, q): v for q, v in row.inputs.items()}, Fraction(1))
                entry.constant += row.constant
                of_f = row.states
                _add(entry.w, {(t - 1, s): v for s, v in of_f.items()}, Fraction(1))
                for s, v in of_f.items():
                    _add(entry.d, {(t - 1, q): G[s][q] for q in range(p)}, v)
                    _add(entry.u, {(t - 1, q): B[s][q] for q in range(m)}, v)
                if t == 1:
                    entry.f, found[i, j] = of_f, entry
                    break
                before = _combined(affine, of_f)
                if isinstance(before, int):
                    blocked[f"f of state {before + 1}, which output {j + 1} needs, is not affine"] = True
                    break
                row = before
    return found, "; ".join(blocked)


def _combined(affine: list[AffineRow | None], weights: Weights) -> AffineRow | int:
    """A combination of rows; the first that is missing where one is."""
    states, inputs, constant = {}, {}, Fraction(0)
    for s, weight in weights.items():
        part = affine[s]
        if part is None:
            return s
        _add(states, part.states, weight)
        _add(inputs, part.inputs, weight)
        constant += weight * part.constant
    return AffineRow(states, inputs, constant)


def _at(entry: _Later, step: int, H: list[Fraction], D: list[Fraction]) -> None:
    _add(entry.d, {(step, q): v for q, v in enumerate(H)}, Fraction(1))
    _add(entry.u, {(step, q): v for q, v in enumerate(D)}, Fraction(1))


def _add(total: Weights, more: Weights, factor: Fraction) -> None:
    """In place; zeros are left out."""
    for key, value in more.items():
        total[key] = total.get(key, Fraction(0)) + factor * value
        if not total[key]:
            del total[key]


def _beyond(rows: list[list[Fraction]], steps: list[int]) -> list[list[Fraction]]:
    """Those rows that say more than combinations of y[k] alone and of the rows before: their weights of later steps
    are linearly independent."""
    later = [c for c, i in enumerate(steps) if i > 0]
    kept: list[list[Fraction]] = []
    pivots: dict[int, list[Fraction]] = {}
    for row in rows:
        rest = [row[c] for c in later]
        for column, pivot in pivots.items():
            if rest[column]:
                factor = rest[column] / pivot[column]
                rest = [a - factor * b for a, b in zip(rest, pivot, strict=True)]
        first = next((c for c, value in enumerate(rest) if value), None)
        if first is not None:
            pivots[first] = rest
            kept.append(row)
    return kept


def _pieces(value: Fraction, dtype: Any) -> Pieces:
    """Floating numbers of that type, largest first, whose sum is the fraction exactly."""
    kind, pieces = np.dtype(dtype).type, []
    smallest = float(np.finfo(dtype).tiny)
    while value:
        piece = float(kind(float(value)))
        if not np.isfinite(piece) or abs(piece) < smallest:
            raise NoDesignFound(
                "design_observer: `delay` needs products of the constants of f, g and G that are exact as sums of "
                f"numbers of type {np.dtype(dtype)}, and {float(value):.3g} is out of range; take a smaller delay, or "
                "other units"
            )
        pieces.append(piece)
        value -= Fraction(piece)
    return tuple(pieces)
