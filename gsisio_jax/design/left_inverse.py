"""The left inverse of [G; H] that serves Theorem 1 best: the smallest spectral radius of |G||J1|."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsisio_jax.design.gains import solve
from gsisio_jax.design.inverse_rows import RESIDUAL, checked, equilibration, residual, restored
from gsisio_jax.design.problem import without_rounding
from gsisio_jax.observer.certificate import spectral_radius

_SEEN = 1e-6  # input directions that H shows less strongly than this are treated as if it did not show them


def smallest_radius_inverse(G: Any, H: Any, margin: float = 1e-6) -> np.ndarray:
    """The left inverse of [G; H] for which the spectral radius of ``|G||J1|`` is smallest.

    Theorem 1 is a framer only where that radius is below 1. The smallest radius is 0 where H has full column rank
    (J1 = 0), and at least 1 everywhere else: for ``H v = 0``, ``|J1||G||v| >= |J1 G v| = |v|``. So no left inverse
    saves Theorem 1 for rank-deficient H. rho(|J1||G|) <= r if ``mu' |J1||G| <= r mu'`` for some mu > 0, which is linear
    in mu and Y = diag(mu) J: a bisection over linear programs.

    Args:
        G: (n, p), units [x]/[d].
        H: (l, p), units [y]/[d]; [G; H] of full column rank.
        margin: the radius is found to this accuracy, relative (absolute below 1).

    Returns:
        J, (p, n + l). Its radius is never above that of the pseudo-inverse. An H too close to rank-deficient to be
        inverted in floating point counts as rank-deficient.

    Raises:
        ValueError: G and H do not fit together, an entry is not finite, or [G; H] lacks column rank.

    >>> np.round(smallest_radius_inverse([[1.0]], [[2.0]]), 6).tolist()
    [[0.0, 0.5]]

    Source: paper, Theorem 1; theory 2.3.
    """
    import cvxpy as cp

    G, H = np.asarray(G, dtype=np.float64), np.asarray(H, dtype=np.float64)
    if G.ndim != 2 or H.ndim != 2 or G.shape[1] != H.shape[1]:
        raise ValueError(
            f"smallest_radius_inverse: G (n, p) and H (l, p) are needed, got shapes {G.shape} and {H.shape}; "
            "give both one column per unknown input"
        )
    stacked = checked("smallest_radius_inverse", np.vstack([G, H]))
    n, p = G.shape
    best = without_rounding(np.linalg.pinv(stacked))
    if p == 0:
        return best
    direct = np.hstack([np.zeros((p, n)), np.linalg.pinv(H)])
    direct = direct + (np.eye(p) - direct @ stacked) @ direct
    if residual(direct, np.eye(p), stacked).max() <= RESIDUAL:
        return direct
    # Units: the radius changes neither with those of x and y nor with those of d.
    rows, columns = equilibration(stacked)
    scaled = stacked / (rows[:, None] * columns)
    _, sigma, V = np.linalg.svd(scaled[n:])
    seen = V[: int((sigma > _SEEN * sigma.max(initial=0.0)).sum())]
    scaled[n:] = scaled[n:] @ seen.T @ seen  # no solver may live on directions that are almost or only rounding

    def radius(J: np.ndarray) -> float:
        return spectral_radius(np.abs(J[:, :n]) @ np.abs(G))

    lower, upper = float(len(seen) < p), radius(best)
    mu, Y, slack, r = cp.Variable(p, nonneg=True), cp.Variable((p, len(scaled))), cp.Variable(), cp.Parameter()
    spent = cp.sum(cp.abs(Y[:, :n]), axis=0) @ np.abs(scaled[:n])
    # A positive slack proves mu > 0, and a radius below r.
    constraints: list[Any] = [r * mu - spent >= slack, Y @ scaled == cp.diag(mu), cp.sum(mu) == 1]
    program = cp.Problem(cp.Maximize(slack), constraints)
    while upper - lower > margin * max(upper, 1.0):
        r.value = middle = 0.5 * (lower + upper)
        found = upper
        if solve(program) and mu.value is not None and Y.value is not None and mu.value.min() > 0:
            J = Y.value / mu.value[:, None] / (columns[:, None] * rows)
            J = np.stack([restored(J[i], np.eye(p)[i], stacked, 1e-7) for i in range(p)])
            if residual(J, np.eye(p), stacked).max() <= RESIDUAL and radius(J) < upper:
                best, found = J, radius(J)
        # The radius that counts is the one evaluated here: the solver's word only steers the bisection.
        upper, lower = found, (lower if found <= middle else middle)
    return best
