"""Gains of the paper's Theorem 1, exactly as printed, for any left inverse of [G; H]. NumPy only.

What is printed without a definition is supplied here: ``A_y = [K2 - L2; K2 - L2]``, and "K_{1:n}" means the first n
columns. The existence condition is another matter: see `FramerGains.rho` and theory 2.1-2.3.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.interval.reading import check_type
from gsisio_jax.observer.certificate import spectral_radius
from gsisio_jax.plant.system import System


class FramerGains(NamedTuple):
    """Matrices of Theorem 1. With q_k = [q_up; q_low] stacked, (eq:xup) reads

    x_k = M_f f_k + M_g g_k + M_v v + M_w w + M_y y[k-1] + M_u u[k-1].

    Attributes:
        J: left inverse of [G; H], (p, n + l); J1 its first n columns, J2 the other l.
        K, L: (n, n + l), ``K - L = G J`` and ``K + L = |G||J|``; split like J into K1, K2 and L1, L2.
        A_x, A_f, A_g, A_y, A_u, A_v, A_w: the implicit equation (eq:framerx), 2n rows.
        M_f, M_g, M_y, M_u, M_v, M_w: ``pinv(A_x) A_s``.
        N11, N12, N21, N22: of (eq:dup): J^+, -J^-, -J^-, J^+.
        rho: spectral radius of ``|G||J1|``; the recursion is a framer for all data only if it is below 1 (P3).
        guaranteed: it is, by a margin, and a nonnegative inverse of ``I - |G||J1|`` confirms it.

    Source: paper, Theorem 1 and Lemma 3; theory 2.
    """

    J: Any
    J1: Any
    J2: Any
    K: Any
    L: Any
    K1: Any
    K2: Any
    L1: Any
    L2: Any
    A_x: Any
    A_f: Any
    A_g: Any
    A_y: Any
    A_u: Any
    A_v: Any
    A_w: Any
    M_f: Any
    M_g: Any
    M_y: Any
    M_u: Any
    M_v: Any
    M_w: Any
    N11: Any
    N12: Any
    N21: Any
    N22: Any
    rho: float
    guaranteed: bool


@named_arguments
def framer_gains(system: System, left_inverse: Any = None) -> FramerGains:
    """The gains of Theorem 1.

    Args:
        system: the plant; p = 0 gives the plain observer ``x_k = f + B u + w``.
        left_inverse: J with ``J [G; H] = I``, (p, n + l); None takes the pseudo-inverse, as the paper does.

    Raises:
        ValueError: `left_inverse` has the wrong shape or is no left inverse.

    Source: paper, Theorem 1 (with A_y supplied, theory 2.7).
    """
    check_type("framer_gains", "system", system, System)
    G, H, B, D = (np.asarray(matrix, dtype=np.float64) for matrix in (system.G, system.H, system.B, system.D))
    n = system.n
    stacked = np.vstack([G, H])
    J = np.linalg.pinv(stacked) if left_inverse is None else np.asarray(left_inverse, dtype=np.float64)
    if J.shape != stacked.T.shape:
        raise ValueError(f"framer_gains: `left_inverse` must have shape {stacked.T.shape}, got {J.shape}")
    error = np.abs(J @ stacked - np.eye(system.p)).max(initial=0.0)
    if error > 1e-9 * max(1.0, np.abs(J).max(initial=0.0) * np.abs(stacked).max(initial=0.0)):
        raise ValueError(
            f"framer_gains: `left_inverse` must satisfy J [G; H] = I, the largest error is {error:.3g}; "
            "numpy.linalg.pinv of [G; H] does"
        )
    G_up, G_down, J_up, J_down = np.maximum(G, 0), np.maximum(-G, 0), np.maximum(J, 0), np.maximum(-J, 0)
    K, L = G_down @ J_down + G_up @ J_up, G_down @ J_up + G_up @ J_down
    (K1, K2), (L1, L2) = (np.split(matrix, [n], axis=1) for matrix in (K, L))
    eye = np.eye(n)
    A_x = np.block([[eye - K1, L1], [L1, eye - K1]])
    A_f = np.block([[eye + L1, -K1], [-K1, eye + L1]])
    A_g = np.block([[L2, -K2], [-K2, L2]])
    A_y = np.vstack([K2 - L2, K2 - L2])
    F = (eye + L1 - K1) @ B + (L2 - K2) @ D
    A_u = np.vstack([F, F])
    # A_x is exactly singular for a rank-deficient H: do not invert what rounding left of its zero.
    solve = np.linalg.pinv(A_x, rcond=1e-10)
    M_f, M_g, M_y, M_u = (solve @ matrix for matrix in (A_f, A_g, A_y, A_u))
    rho = spectral_radius(np.abs(G) @ np.abs(J[:, :n]))
    return FramerGains(
        J, J[:, :n], J[:, n:], K, L, K1, K2, L1, L2,
        A_x, A_f, A_g, A_y, A_u, A_g, A_f,
        M_f, M_g, M_y, M_u, M_g, M_f,
        J_up, -J_down, -J_down, J_up,
        rho, _is_framer(G, H, J[:, :n], rho),
    )  # fmt: skip


def _is_framer(G: np.ndarray, H: np.ndarray, J1: np.ndarray, rho: float) -> bool:
    """rho < 1, by a margin; for a rank-deficient H it is at least 1, whatever rounding says (P3)."""
    if np.linalg.matrix_rank(H) < G.shape[1] or not rho < 1 - 1e-9:
        return False
    inverse = np.linalg.inv(np.eye(len(G)) - np.abs(G) @ np.abs(J1))
    return bool(inverse.min() >= -1e-12 * np.abs(inverse).max())
