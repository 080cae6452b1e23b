"""Determinants and factors of small matrices whose entries depend on the box.

**Determinants** are expanded by rows over all minors of the last columns, and differentiated by their cofactors;
**factors** are eliminated entry by entry, without exchange of rows: what does not hold for all matrices of the
enclosure is not known.
"""

from __future__ import annotations

import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.node import Node, normalised
from gsisio_jax.inclusion.rules.bilinear import divide, multiply
from gsisio_jax.inclusion.rules.functions import CURVES, SQUARE
from gsisio_jax.inclusion.rules.linear import move, multiple, structural, subtract, total
from gsisio_jax.inclusion.rules.possible import formless, unknown
from gsisio_jax.inclusion.rules.tangents import Tangents
from gsisio_jax.inclusion.rules.univariate import apply
from gsisio_jax.interval.box import Interval, choose, entire_like, intersect, magnitude
from gsisio_jax.interval.direct import where

_MOST_COFACTORS = 6  # rows of a matrix whose determinant is differentiated by its cofactors


# Determinants ---------------------------------------------------------------------------------------------------------
def determinant(a: Node) -> Node:
    """Of a node (n, n)."""
    n, found = a.shape[0], normalised(_expanded(a))
    if found.jac is None or not 1 < n <= _MOST_COFACTORS:
        return found
    # d det = sum of cofactors times dA: forms keep what they have in common.
    kept = [[k for k in range(n) if k != i] for i in range(n)]
    rows, columns = np.repeat(kept, n, 0), np.tile(kept, (n, 1))  # of minor (i, j), at n i + j
    minors = move(lambda v: jnp.moveaxis(v[rows[:, :, None], columns[:, None, :]], 0, -1), formless(a))
    signs = np.array([(-1.0) ** (i + j) for i in range(n) for j in range(n)])
    tangent = move(lambda v: v.reshape(-1, n * n), Tangents(found.jac.lower.shape[0])(a))
    shape = tangent.shape
    cofactors = move(lambda v: jnp.broadcast_to(v, shape), multiple(signs, normalised(_expanded(minors))))
    terms = normalised(total(multiply(normalised(cofactors), normalised(tangent)), [1]))
    jac, _ = intersect(terms.range, found.jac)
    return Node(found.range, found.form, jac)


def _expanded(a: Node) -> Node:
    """Determinants (*rest) of a node (n, n, *rest), over the minors of its first k rows: n products of arrays."""
    n, rest_axes = a.shape[0], (1,) * (len(a.shape) - 2)
    minors = move(lambda v: v[0], a)  # of row 0 and column j
    before: list[tuple[int, ...]] = [(j,) for j in range(n)]
    for k in range(1, n):
        sets = list(itertools.combinations(range(n), k + 1))
        columns = np.array(sets)
        rest = np.array([[before.index(s[:i] + s[i + 1 :]) for i in range(k + 1)] for s in sets])
        signs = np.array([(-1.0) ** (k - i) for i in range(k + 1)]).reshape(-1, *rest_axes)
        row = move(lambda v, k=k, columns=columns: v[k][columns], a)
        below = move(lambda v, rest=rest: v[rest], minors)
        signed = multiple(np.broadcast_to(signs, below.shape), below)
        minors, before = total(multiply(row, signed), [1]), sets
    return move(lambda v: v[0], minors)


# Factors --------------------------------------------------------------------------------------------------------------
def _entries(a: Node) -> list[list[Any]]:
    if len(a.shape) != 2:
        raise NotImplementedError("of several matrices at once; take them one by one")
    n, m = a.shape
    return [[move(lambda v, i=i, j=j: v[i, j], a) for j in range(m)] for i in range(n)]


def _matrix(rows: list[list[Any]]) -> Node:
    flat = [v for row in rows for v in row]
    shape = (len(rows), len(rows[0]))
    return structural(lambda *v: jnp.stack(v).reshape(shape), flat)[0]


def cholesky(a: Node) -> Node:
    """The lower factor L of ``a = L L'``; only the lower triangle of a is looked at."""
    n, entries = a.shape[0], _entries(normalised(a))
    zero = np.zeros((), a.dtype)
    factor: list[list[Any]] = [[zero] * n for _ in range(n)]
    for j in range(n):
        rest = entries[j][j]
        for k in range(j):
            rest = subtract(rest, apply(SQUARE, factor[j][k]))
        factor[j][j] = apply(CURVES["sqrt"], normalised(rest))
        for i in range(j + 1, n):
            rest = entries[i][j]
            for k in range(j):
                rest = subtract(rest, multiply(factor[i][k], factor[j][k]))
            factor[i][j] = normalised(divide(normalised(rest), factor[j][j]))
    return _matrix(factor)


def lu(a: Node) -> list[Node]:
    """Factors, pivots and permutation, as long as no row needs to be exchanged; else nothing is known of them."""
    n, rows = a.shape[0], _entries(normalised(a))
    certain = jnp.ones((), bool)
    for k in range(n):
        pivot = normalised(rows[k][k]).range
        least = where((pivot.lower <= 0) & (pivot.upper >= 0), 0, jnp.minimum(abs(pivot.lower), abs(pivot.upper)))
        certain &= least > 0
        for i in range(k + 1, n):
            certain &= magnitude(normalised(rows[i][k]).range) < least
            rows[i][k] = normalised(divide(rows[i][k], rows[k][k]))
            for j in range(k + 1, n):
                rows[i][j] = normalised(subtract(rows[i][j], multiply(rows[i][k], rows[k][j])))
    factors = _matrix(rows)
    nothing = unknown(a.shape, a.dtype, [a])
    found = structural(lambda p, q: where(certain, p, q), [factors, nothing], [certain])[0]
    places = np.arange(n, dtype=float)
    order = Interval.unchecked(where(certain, places, 0), where(certain, places, n - 1.0))
    jac = None
    if a.jac is not None:
        flat = jnp.zeros((a.jac.lower.shape[0], n))
        jac = choose(certain, Interval.unchecked(flat, flat), entire_like(flat))
    return [found, Node(order, None, jac), Node(order, None, jac)]
