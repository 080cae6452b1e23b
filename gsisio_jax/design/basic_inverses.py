"""All the left inverses of [G; H] that make input boxes exact, and the rows that tell whether there is an input at all.

The rows are enumerated offline; online an exact bound is the best of a few products (theory 7).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from math import comb
from typing import Any, NamedTuple

import numpy as np

from gsisio_jax.design.gains import solve
from gsisio_jax.design.inverse_rows import RESIDUAL, checked, equilibrated, equilibration, residual, restored
from gsisio_jax.design.problem import without_rounding

_SINGULAR = 1e-10  # a support whose equilibrated rows have a smaller ratio of singular values counts as dependent
ZERO = 1e-12  # equilibrated weights below this share of the largest are zeros of the minimal support
_FEW = 8  # width profiles tried where there are too many supports


class BasicInverses(NamedTuple):
    """Rows of left inverses whose best bound is the exact bound of the unknown input.

    Attributes:
        rows: (K, p, r). ``rows[:, i]`` are the distinct rows for input i, best nominal width first, the last places
            filled by repeating the first.
        complete: all basic rows are here, so the bound is exact. Otherwise it is correct, but may be wider.
        note: empty, or what is missing and why.

    Source: theory 7.
    """

    rows: np.ndarray
    complete: bool
    note: str


class Circuits(NamedTuple):
    """Rows c of minimal support with ``c [G; H] = 0``: c h must contain 0, or the data contradict the bounds.

    Attributes:
        rows: (K, r), the entry of largest modulus is 1; K may be 0.
        complete: a box of h that no circuit refutes is feasible for certain.
        note: empty, or what is missing and why.

    Source: theory 7.
    """

    rows: np.ndarray
    complete: bool
    note: str


def basic_left_inverses(stacked: Any, free: Any = None, cap: int = 4096, width: Any = None) -> BasicInverses:
    """The rows that make the box of the unknown input exact, given a box of ``h = stacked @ d``.

    By duality ``max{d_i : h_lo <= S d <= h_hi}`` is the smallest upper bound of ``row h`` over the rows with
    ``row S = e_i'`` that stand on linearly independent rows of S (the bound is infinite only where d_i is unbounded,
    if the box of h can be attained at all: see `circuits`). The paper's box ``J^+ h_hi - J^- h_lo`` with the
    pseudo-inverse J (Lemma 3) is exact for square S; for G = H = 1 and h in [0, 2] x [0, 1] it is [0, 1.5], not [0, 1].

    Args:
        stacked: S = [G; H], (r, p), full column rank, units [x; y]/[d].
        free: (p,) False for inputs with known bounds: their bounds serve as further rows, and what is left of them,
            ``(e_i - row S)`` in their columns, is to be multiplied with those bounds. A row of zeros then stands for
            the bounds themselves. None: all inputs are free.
        cap: most supports (and circuits) to enumerate for each group of inputs that share rows of S. Above it only
            the pseudo-inverse and the rows best for a few width profiles are kept.
        width: nominal width of the box of h, (r,), by which rows are ordered; None: rows of S count alike.

    Raises:
        ValueError: `stacked` is no finite matrix of full column rank, or `free` or `width` has the wrong shape.

    >>> basic_left_inverses([[1.0], [2.0]]).rows[:, 0].tolist()
    [[1.0, 0.0], [0.0, 0.5]]

    Source: theory 7; theory 2.13 (the paper's Lemma 3).
    """
    S, r = _extended("basic_left_inverses", stacked, free)
    p = S.shape[1]
    nominal, _ = equilibration(S)
    if width is not None:
        width = np.asarray(width, dtype=np.float64)
        if width.shape != (r,):
            raise ValueError(f"basic_left_inverses: `width` must have shape ({r},), got {width.shape}")
        nominal[:r] = width
    notes: list[str] = []
    found: list[np.ndarray] = [np.zeros((0, r))] * p
    for lines, columns in _groups(S):
        block, target = S[np.ix_(lines, columns)], np.eye(len(columns))
        supports = comb(len(lines), len(columns))
        if supports > cap:
            candidates = _few(block, nominal[lines])
            notes.append(f"{supports} supports for inputs {columns.tolist()}, more than cap = {cap}: only the best few")
        else:
            candidates = _basic(block)
        for i, column in enumerate(columns):
            kept, dropped = _distinct(candidates[i], target[i], block)
            if dropped:
                notes.append(f"{dropped} ill-conditioned rows for input {column} left out")
            if not len(kept):
                kept = np.linalg.pinv(block)[i : i + 1]
                notes.append(f"input {column} is close to unobservable: only its pseudo-inverse is left")
            full = np.zeros((len(kept), len(S)))
            full[:, lines] = kept[np.argsort(np.abs(kept) @ nominal[lines], kind="stable")]
            found[column] = full[:, :r]
    count = max((len(rows) for rows in found), default=1)
    padded = [np.concatenate([rows, np.repeat(rows[:1], count - len(rows), axis=0)]) for rows in found]
    rows = np.stack(padded, axis=1) if p else np.zeros((1, 0, r))
    return BasicInverses(rows, not notes, "; ".join(notes))


def circuits(stacked: Any, free: Any = None, cap: int = 4096) -> Circuits:
    """The rows that tell whether some d reaches a box of ``h = stacked @ d`` at all (Farkas).

    Arguments, units and errors are those of `basic_left_inverses`; with known input bounds, ``-(c S)`` in the columns
    of those inputs is to be multiplied with them. Above the cap only the circuits of one basis are kept: an infeasible
    box may then go unnoticed, but no feasible one is refused.

    >>> (circuits([[1.0], [2.0], [0.0]]).rows + 0.0).round(6).tolist()
    [[0.0, 0.0, 1.0], [1.0, -0.5, 0.0]]

    Source: theory 7.
    """
    S, r = _extended("circuits", stacked, free)
    zero = np.flatnonzero(~S.any(axis=1))
    found, notes = [np.eye(len(S))[zero]], []
    for lines, columns in _groups(S):
        block, p = S[np.ix_(lines, columns)], len(columns)
        supports = comb(len(lines), p + 1)
        if supports > cap:
            candidates = _fundamental(block)
            notes.append(f"{supports} possible circuits for inputs {columns.tolist()}, more than cap = {cap}")
        else:
            candidates = _dependencies(block)
        kept, dropped = _distinct(candidates, np.zeros(p), block)
        if dropped:
            notes.append(f"{dropped} ill-conditioned circuits for inputs {columns.tolist()} left out")
        full = np.zeros((len(kept), len(S)))
        full[:, lines] = kept
        found.append(full)
    rows = np.concatenate(found)[:, :r]
    largest = np.abs(rows).argmax(axis=1)[:, None] if len(rows) else np.zeros((0, 1), int)
    return Circuits(rows / np.take_along_axis(rows, largest, axis=1), not notes, "; ".join(notes))


def _basic(block: np.ndarray) -> np.ndarray:
    """``e_i' S_I^{-1}`` for all i and all supports I of p independent rows: (p, number of supports, r)."""
    r, p = block.shape
    supports = np.array(list(combinations(range(r), p)))
    A, rows, columns = equilibrated(block[supports])
    singular = np.linalg.svd(A, compute_uv=False)
    good = singular[:, -1] > _SINGULAR * singular[:, 0]
    supports, A, rows, columns = supports[good], A[good], rows[good], columns[good]
    inverse = np.linalg.inv(A) / (columns[:, :, None] * rows[:, None, :])
    out = np.zeros((p, len(supports), r))
    np.put_along_axis(out, np.broadcast_to(supports, (p, *supports.shape)), inverse.transpose(1, 0, 2), axis=2)
    return out


def _dependencies(block: np.ndarray) -> np.ndarray:
    """The null vector of every support of p + 1 rows that has one null vector only: (number of supports, r)."""
    r, p = block.shape
    supports = np.array(list(combinations(range(r), p + 1)), dtype=int).reshape(-1, p + 1)
    if not len(supports):
        return np.zeros((0, r))
    A, rows, _ = equilibrated(block[supports])
    U, singular, _ = np.linalg.svd(A)
    good = singular[:, -1] > _SINGULAR * singular[:, 0]
    out = np.zeros((int(good.sum()), r))
    np.put_along_axis(out, supports[good], (U[:, :, -1] / rows)[good], axis=1)
    return out


def _fundamental(block: np.ndarray) -> np.ndarray:
    """The circuits of one well-conditioned basis, greedily chosen: one for each row outside it."""
    r, p = block.shape
    (rest,), _, _ = equilibrated(block[None])
    basis: list[int] = []
    for _ in range(p):  # Gram-Schmidt with pivoting
        norms = np.linalg.norm(rest, axis=1)
        norms[basis] = 0
        basis.append(int(norms.argmax()))
        direction = rest[basis[-1]] / norms.max()
        rest = rest - np.outer(rest @ direction, direction)
    outside = np.setdiff1d(np.arange(r), basis)
    out = np.eye(r)[outside]
    out[:, basis] = -np.linalg.solve(block[basis].T, block[outside].T).T
    return out


def _few(block: np.ndarray, width: np.ndarray) -> np.ndarray:
    """The pseudo-inverse and the rows of smallest width for a few width profiles: (p, number of rows, r)."""
    import cvxpy as cp

    r, p = block.shape
    rows, columns = equilibration(block)
    J, profile = cp.Variable((p, r)), cp.Parameter(r, nonneg=True)
    program = cp.Problem(
        cp.Minimize(cp.sum(cp.abs(J) @ profile)), [J @ (block / (rows[:, None] * columns)) == np.eye(p)]
    )
    relative = np.maximum(width / rows, 1e-9 * max((width / rows).max(), 1e-300))
    random = np.random.default_rng(0)
    found = [without_rounding(np.linalg.pinv(block))]
    for k in range(_FEW):
        spread = relative if k == 0 else relative * 10.0 ** random.uniform(-1, 1, r)
        profile.value = spread / spread.max()
        if solve(program) and J.value is not None:
            found.append(np.where(np.abs(J.value) > 1e-7, J.value, 0.0) / (columns[:, None] * rows))
    return np.stack(found, axis=1)


def _distinct(candidates: np.ndarray, target: np.ndarray, block: np.ndarray) -> tuple[np.ndarray, int]:
    """One row per support, with its equality restored; and how many had to go because it could not be.

    On a minimal support the row is unique, so supports can be compared instead of numbers.
    """
    weight = np.abs(candidates) * equilibration(block)[0]
    support = weight > ZERO * weight.max(axis=1, keepdims=True, initial=0.0)
    _, first = np.unique(support, axis=0, return_index=True)
    rows = np.array([restored(candidates[k], target, block, ZERO) for k in sorted(first)]).reshape(-1, len(block))
    good = residual(rows, target, block) <= RESIDUAL
    return rows[good], int((~good).sum())


def _groups(S: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Rows and columns of the diagonal blocks of S: inputs that share no row do not disturb each other."""
    pattern, rest = S != 0, np.full(S.shape[1], True)
    while rest.any():
        columns = np.arange(S.shape[1]) == rest.argmax()
        while True:
            lines = pattern[:, columns].any(axis=1)
            grown = columns | pattern[lines].any(axis=0)
            if (grown == columns).all():
                break
            columns = grown
        rest &= ~columns
        yield np.flatnonzero(lines), np.flatnonzero(columns)


def _extended(call: str, stacked: Any, free: Any) -> tuple[np.ndarray, int]:
    """S with a row of the identity for every input that has bounds; and the number of rows of S itself."""
    S = checked(call, np.asarray(stacked, dtype=np.float64))
    p = S.shape[1]
    free = np.full(p, True) if free is None else np.asarray(free, dtype=bool)
    if free.shape != (p,):
        raise ValueError(f"{call}: `free` must have one entry per column of `stacked`, ({p},), got {free.shape}")
    return np.concatenate([S, np.eye(p)[~free]]), len(S)
