"""The matrix inequality of Theorem 2 (iii), as printed and in a form that can hold. The solver is never believed.

Feasible answers are checked by eigenvalues, infeasible ones by a positive semidefinite matrix Z that refutes every
candidate: ``<Z, M> > 0`` where ``M <= 0`` was asked for. Both checks are NumPy only.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gsisio_jax.design.gains import solve

_MARGIN = 1e-7  # the inequality is posed with this margin, so that the solver's rounding does not decide it


class LmiAnswer(NamedTuple):
    """What is proved about a matrix inequality.

    Attributes:
        feasible: P, Gamma, gamma, eps satisfy it, by eigenvalues; False: `certificate` refutes it, or (no certificate)
            nothing is proved.
        status: the solver's own word, not relied on.
        P, Gamma: (n, n), None where not feasible.
        gamma, eps: gain of the noise and decrease; nan where not feasible or not part of the inequality.
        largest_eigenvalue: of the block matrix at (P, Gamma, gamma, eps), negative; nan where not feasible.
        certificate: Z (3n, 3n), positive semidefinite, or None.
        certificate_value: `refutation` of Z per unit of trace; positive proves that there is no solution.
    """

    feasible: bool
    status: str
    P: Any
    Gamma: Any
    gamma: float
    eps: float
    largest_eigenvalue: float
    certificate: Any
    certificate_value: float


def printed_block(contraction: float, P: Any, Gamma: Any) -> np.ndarray:
    """The matrix of Theorem 2 (iii) exactly as printed, (3n, 3n)."""
    eye, zero = np.eye(len(P)), np.zeros_like(P)
    return np.block([[P + Gamma - eye, zero, P], [zero, contraction**2 * eye - P, zero], [P, zero, P]])


def iss_block(contraction: float, P: Any, Gamma: Any, gamma: float, eps: float) -> np.ndarray:
    """The repaired matrix: ``- gamma I`` in the noise block, ``+ eps I`` in the width block, (3n, 3n)."""
    eye, zero = np.eye(len(P)), np.zeros_like(P)
    return np.block(
        [[P + Gamma - eye, zero, P], [zero, (contraction**2 + eps) * eye - P, zero], [P, zero, P - gamma * eye]]
    )


def refutation(certificate: np.ndarray, contraction: float, printed: bool, floor: float = 1.0) -> float:
    """Largest number r known with ``<Z, M> >= r`` for all P >= floor I, Gamma >= 0 (repaired: and gamma, eps >= 0).

    Positive proves that ``M <= 0`` has no solution with ``P >= floor I``. -inf where Z proves nothing: Z or one of its
    images is not positive semidefinite. With Z divided into blocks,

        <Z, M> = <Z11 - Z22 + Z33 + Z13 + Z31, P> + <Z11, Gamma> - tr Z11 + L^2 tr Z22  (+ eps tr Z22 - gamma tr Z33).
    """
    n = len(certificate) // 3
    block = certificate.reshape(3, n, 3, n).transpose(0, 2, 1, 3)
    of_P = block[0, 0] - block[1, 1] + block[2, 2] + block[0, 2] + block[2, 0]
    small = -1e-12 * max(1.0, float(np.abs(certificate).max()))
    definite = all(np.linalg.eigvalsh(matrix).min() >= small for matrix in (certificate, of_P, block[0, 0]))
    if not definite or (not printed and np.trace(block[2, 2]) > 0):
        return -np.inf
    constant = contraction**2 * np.trace(block[1, 1]) - np.trace(block[0, 0])
    return float(floor * np.trace(of_P) + constant)


def printed_lmi(contraction: float, n: int) -> LmiAnswer:
    """Theorem 2 (iii) as printed: posed to the solver, and refuted for every contraction and every size.

    The third diagonal block is P, so ``Z = diag(0, 0, I)`` gives ``<Z, M> = tr P > 0`` for every P > 0.

    Args:
        contraction: the constant L of Theorem 2.
        n: number of states.

    Returns:
        An answer with ``feasible`` False and a certificate with positive value.

    >>> answer = printed_lmi(0.1, 2)
    >>> answer.feasible, answer.certificate_value > 0
    (False, True)

    Source: paper, Theorem 2 (iii); theory 2.9.
    """
    import cvxpy as cp

    P, Gamma = cp.Variable((n, n), symmetric=True), cp.Variable((n, n), symmetric=True)
    eye, zero = np.eye(n), np.zeros((n, n))
    block = cp.bmat([[P + Gamma - eye, zero, P], [zero, contraction**2 * eye - P, zero], [P, zero, P]])
    # The sign of P alone is asked for: a floor of 1e-3 only keeps the solver away from P = 0.
    goal = cp.Problem(cp.Minimize(0), [P >> 1e-3 * eye, Gamma >> 0, cp.lambda_max(block) <= 0])
    solve(goal)
    Z = np.kron(np.diag([0.0, 0.0, 1.0]), eye)
    value = refutation(Z, contraction, printed=True) / n
    return LmiAnswer(False, str(goal.status), None, None, np.nan, np.nan, np.nan, Z, value)


def iss_lmi(contraction: float, n: int) -> LmiAnswer:
    """The inequality of Theorem 2 (iii) with noise accounted for: P > 0, Gamma >= 0, gamma >= 0, eps > 0 with

        [P + Gamma - I, 0, P; 0, (L^2 + eps) I - P, 0; P, 0, P - gamma I] <= 0.

    For widths ``D[k+1] = f + z`` with ``|f| <= L |D[k]|`` and V = D'P D it promises

        V[k+1] - V[k] <= -eps |D[k]|^2 + gamma |z|^2,

    because left minus right is at most the quadratic form of the block matrix at (f, D, z): ``f'(I - Gamma) f <= f'f <=
    L^2 D'D``. So ``|D|`` ends at or below ``|z| sqrt(gamma lambda_max(P) / (eps lambda_min(P)))``.

    It holds for some eps > 0 if and only if L < 1, so it proves nothing that condition (i) with strict inequality does
    not. Necessary: ``Z = diag(I, I, 0)`` gives ``<Z, M> = tr Gamma + n (L^2 + eps - 1) > 0`` for L >= 1 (in words:
    L^2 I < P <= I). Sufficient: P = L I, Gamma = 0, gamma = L / (1 - L), eps = L - L^2. That choice gives the smallest
    ultimate bound that any solution gives, ``|z| / (1 - L)``, the limit of Lemma 5: the inequality is invariant under
    rotations, so a solution can be averaged to a multiple of I.

    Args:
        contraction: the constant L of Theorem 2.
        n: number of states.

    Returns:
        The solver's point where its eigenvalues pass, else the closed form; for L >= 1 the certificate. With L within
        about 1e-4 of 1, where rounding decides the eigenvalues, neither.

    >>> iss_lmi(0.5, 2).feasible, iss_lmi(1.5, 2).feasible
    (True, False)

    Source: paper, proof of Theorem 2 (iii), repaired; theory 2.9.
    """
    import cvxpy as cp

    if contraction >= 1:
        Z = np.kron(np.diag([1.0, 1.0, 0.0]), np.eye(n))
        value = refutation(Z, contraction, printed=False) / (2 * n)
        # At L = 1 the value is 0 and any eps > 0 makes it positive.
        return LmiAnswer(False, "not posed", None, None, np.nan, np.nan, np.nan, Z, value)
    # P = L I is no solution at L = 0, where any small P does.
    size = max(contraction, 0.01)
    eps = (1 - 1e-5) * size * (1 - size)
    P, Gamma = cp.Variable((n, n), symmetric=True), cp.Variable((n, n), symmetric=True)
    gamma = cp.Variable(nonneg=True)
    eye, zero = np.eye(n), np.zeros((n, n))
    block = cp.bmat(
        [[P + Gamma - eye, zero, P], [zero, (contraction**2 + eps) * eye - P, zero], [P, zero, P - gamma * eye]]
    )
    goal = cp.Problem(
        cp.Minimize(gamma), [Gamma >> 0, block << -_MARGIN * size * (1 - contraction) * np.eye(3 * n)]
    )  # fmt: skip
    if solve(goal) and P.value is not None and Gamma.value is not None and gamma.value is not None:
        found = _checked(contraction, P.value, _nonnegative(Gamma.value), float(gamma.value), eps, str(goal.status))
        if found.feasible:
            return found
    closed = (1 + 1e-5) * size / (1 - size)
    return _checked(contraction, size * eye, zero, closed, eps, f"{goal.status}, replaced by the closed form")


def _nonnegative(matrix: np.ndarray) -> np.ndarray:
    """The nearest positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def _checked(contraction: float, P: Any, Gamma: Any, gamma: float, eps: float, status: str) -> LmiAnswer:
    P = 0.5 * (P + P.T)
    block = iss_block(contraction, P, Gamma, gamma, eps)
    largest = float(np.linalg.eigvalsh(block).max())
    # eigvalsh is accurate to a few units of rounding of the norm.
    margin = 1e-14 * len(block) * float(np.abs(block).max())
    small = -1e-14 * max(1.0, float(np.abs(Gamma).max(initial=0.0)))
    good = largest < -margin and np.linalg.eigvalsh(P).min() > margin and np.linalg.eigvalsh(Gamma).min() >= small
    if not good:
        return LmiAnswer(False, status, None, None, np.nan, np.nan, np.nan, None, np.nan)
    return LmiAnswer(True, status, P, Gamma, gamma, eps, largest, None, np.nan)
