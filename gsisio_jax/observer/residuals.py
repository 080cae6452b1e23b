"""What the stored gains do not cancel exactly, in rational arithmetic; and bounds of inverses that are proved.

A gain and a left inverse are numbers of a floating type, and taken as they stand. Insert the plant,

    f + B u + w = x[k] - G d,     g + D u + v - y = -H d,     z - T2 v = C x[k] + psi(x[k]),

into `LinearBounds`: what is left of x[k] and of d[k-1] beyond what is asked for is a matrix times either, of the size
of rounding. Both are unknown, and d has no bound. But both are finite, and what is left is small, so they bound each
other (`contractors.CancellationResidual`). Fractions make these matrices exact, and then they are rounded up.

T2 annihilates the H of the declared rank. Where T2 times the H that was written is not exactly 0, the H of the promise
is another one, within `H_slack` of it; that is accounted for as well.

Source: theory 3 and 10.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np

from gsisio_jax.observer.bank import CancellationResidual, LinearBounds
from gsisio_jax.observer.certificate import spectral_radius

_INFLATIONS = (2e-15, 2e-14, 2e-13, 2e-12, 2e-10)
_exact = np.vectorize(Fraction, otypes=[object])


def exact(matrix: Any) -> Any:
    """A matrix of fractions."""
    matrix = np.asarray(matrix, np.float64)
    return _exact(matrix) if matrix.size else np.zeros(matrix.shape, object)


def product(a: Any, b: Any) -> Any:
    """``a.dot(b)`` of two matrices of fractions, over whole numbers: all come from floating numbers, so the largest
    denominator, a power of two, is a common one. Fractions would look for a common divisor at every sum."""
    if not a.size or not b.size:
        return a.dot(b)
    (over, a), (under, b) = _whole(a), _whole(b)
    whole = a.dot(b)
    return np.array([Fraction(value, over * under) for value in whole.ravel()], object).reshape(whole.shape)


def _whole(matrix: Any) -> tuple[int, Any]:
    largest = max(value.denominator for value in matrix.flat)
    whole = [value.numerator * (largest // value.denominator) for value in matrix.flat]
    return largest, np.array(whole, object).reshape(matrix.shape)


def rounded_up(matrix: Any) -> np.ndarray:
    """Magnitudes of a matrix of fractions as float64, at or above."""
    up = np.array([_up(abs(value)) for value in np.ravel(matrix)], np.float64)
    return up.reshape(np.shape(matrix))


def _up(value: Any) -> float:
    found = float(value)
    return found if Fraction(found) >= value else float(np.nextafter(found, np.inf))


def cancellation_residual(
    bank: LinearBounds, plant: Any, C: Any, bounded: Any, known: Any, states: bool, H_slack: Any
) -> CancellationResidual:
    """What a bank leaves of x[k] and of d[k-1].

    Args:
        bank: gains or left inverses, as stored, in the floating type in which they run.
        plant: the system.
        C: slopes of T2 g, (q, n), in that type.
        bounded: rows of the identity for states with bounds, (s, n).
        known: rows of the identity for inputs with bounds, (b, p).
        states: the bank bounds x[k]; otherwise d[k-1].
        H_slack: (l, p), how far the H of the promise may be from the one that is written.
    """
    n, p = plant.n, plant.p
    G, H, C, S, D = (exact(m) for m in (plant.G, plant.H, C, bounded, known))
    slack = exact(H_slack)
    eye_x, eye_d = exact(np.eye(n)), exact(np.eye(p))
    of_x, of_d = [], []
    for k in range(len(bank.residual)):
        A, B = exact(bank.residual[k][:, :n]), exact(bank.residual[k][:, n:])
        Z, Sb, Kd = exact(bank.remainder[k]), exact(bank.bounds[k]), exact(bank.known[k])
        found = A + product(Z, C) + product(Sb, S)
        if bank.state is not None:
            found = found + exact(bank.state[k])
        of_x.append(rounded_up(eye_x - found if states else -found))
        through = product(A, G) + product(B, H) - product(Kd, D)
        of_d.append(rounded_up(abs(through if states else eye_d + through) + product(abs(B), slack)))
    rows = n if states else p
    count = len(bank.residual)
    return CancellationResidual(np.array(of_x).reshape(count, rows, n), np.array(of_d).reshape(count, rows, p))


def row_cancellation_residual(
    rows: Any, known: Any, plant: Any, identity: bool, bounded: Any, H_slack: Any
) -> np.ndarray:
    """The same for rows that act on ``[x[k]; 0] - known terms``, that is on ``[G; H] d``: (..., p)."""
    stacked = np.vstack([plant.G, plant.H])
    S, D = exact(stacked), exact(bounded)
    slack = exact(np.vstack([np.zeros_like(plant.G), H_slack]))
    rows, known = np.asarray(rows, np.float64), np.asarray(known, np.float64)
    count = int(np.prod(rows.shape[:-1]))
    flat, flat_known = rows.reshape(count, rows.shape[-1]), known.reshape(count, known.shape[-1])
    p = S.shape[1]
    target = exact(np.tile(np.eye(p), (len(flat) // p if p else 0, 1)) if identity else np.zeros((len(flat), p)))
    left = target - product(exact(flat), S) - product(exact(flat_known), D)
    return rounded_up(abs(left) + product(abs(exact(flat)), slack)).reshape(*rows.shape[:-1], p)


def window_residual(window: Any, plant: Any, C: Any, bounded: Any, H_slack: Any) -> tuple[np.ndarray, np.ndarray]:
    """What the rows of a window leave of x[k], (R, n), and of the inputs of its steps, (N, R, p). Of the states in
    between nothing is left: what multiplies them is taken from the multipliers as they are stored."""
    n = plant.n
    G, H, C, D, slack = (exact(m) for m in (plant.G, plant.H, C, bounded, H_slack))
    target = exact(np.eye(n)[list(window.targets)])
    x = target - exact(window.multipliers[0][:, :n]) - product(exact(window.remainder), C)
    d = []
    for weights, known in zip(window.multipliers, window.known, strict=True):
        of_f, of_g = exact(weights[:, :n]), exact(weights[:, n:])
        through = product(of_f, G) + product(of_g, H) - product(exact(known), D)
        d.append(rounded_up(abs(through) + product(abs(of_g), slack)))
    return rounded_up(x), np.array(d).reshape(len(window.known), len(x), plant.p)


def input_row_residual(rows: Any, plant: Any, H_slack: Any) -> tuple[np.ndarray, np.ndarray]:
    """What `InputRows` leave of the inputs of their steps, (N, R, p), and of d[k], (R, p); of states nothing, as in
    `window_residual`."""
    n, N, (G, H, slack) = plant.n, rows.length, (exact(m) for m in (plant.G, plant.H, H_slack))
    output, ahead, moves = exact(rows.output), exact(rows.ahead), [exact(part) for part in rows.moves]
    now = rounded_up(abs(product(output, H) - ahead) + product(abs(output), slack))
    found = []
    for lag in range(N):
        of_f, of_g = exact(rows.multipliers[lag][:, :n]), exact(rows.multipliers[lag][:, n:])
        left = product(of_f, G) + product(of_g, H) - exact(rows.boxes[lag]) - moves[lag]
        left = left + (moves[lag - 1] if lag else ahead)
        if lag < rows.over:
            left = left - exact(np.eye(plant.p)[list(rows.targets)])
        found.append(rounded_up(abs(left) + product(abs(of_g), slack)))
    return np.array(found).reshape(N, len(rows.targets), plant.p), now.reshape(len(rows.targets), plant.p)


def upper_inverse(M: np.ndarray) -> np.ndarray | None:
    """V >= 0 with ``V (I - M) >= I`` entry by entry, proved in fractions; None where ``I - M`` is no M-matrix.

    Then ``z <= M z + b`` with z >= 0 gives ``z <= V b``: multiply ``(I - M) z <= b`` by V. Where rows do not see each
    other, directly or through others, V is exactly 0, so an infinite b_j stays with those that it concerns.
    """
    n = len(M)
    if not n:
        return np.zeros((0, 0))
    if not np.isfinite(M).all() or spectral_radius(M) >= 1 - 1e-9:
        return None
    linked = np.linalg.matrix_power((np.eye(n) + (M > 0) > 0).astype(float), n) > 0
    guess = np.where(linked, np.maximum(np.linalg.inv(np.eye(n) - M), 0.0), 0.0)
    weight = np.where(linked, guess @ (np.eye(n) + M) + guess, 0.0)
    wanted, left = exact(np.eye(n)), exact(np.eye(n)) - exact(M)
    for share in _INFLATIONS:
        larger = M + share * weight
        if spectral_radius(larger) >= 1:
            return None
        V = np.where(linked, np.maximum(np.linalg.inv(np.eye(n) - larger), 0.0), 0.0)
        if (product(exact(V), left) >= wanted).all():
            return V
    return None


def nearest_feedthrough(T2: Any, H: Any) -> np.ndarray:
    """How far, entry by entry, an H that T2 annihilates exactly is from the one that is written: 0 if that one is."""
    H = np.asarray(H, np.float64)
    if not T2.shape[0] or not product(exact(T2), exact(H)).any():
        return np.zeros_like(H)
    # The decimals of the user differ from their floating numbers by half an ulp; T2 is exact for the decimals.
    return np.spacing(np.abs(H)) * (H != 0)
