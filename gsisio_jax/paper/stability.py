"""Theorem 2: when the widths of the paper's recursion stay bounded, as printed and as corrected.

The recursion of Theorem 1 gives for the widths, exactly,

    width[k] = T_f (width of f + dw) + T_g (width of g + dv),
    T_f = (I - |G||J1|)^{-1} (I + |G||J1|),     T_g = (I - |G||J1|)^{-1} |G||J2|.

Corrected: T_f (printed with I - K1 + L1 = I - G J1 on the right, P8), the constants of Lemma 2 (P11), strict
inequality in (i), and (iii) with noise accounted for (P9), which then says the same as (i). For (ii) there is no such
repair; what it was for, a condition weaker than (i), is the elementwise one: spectral radius of ``T_f W_f + T_g W_g``
below 1. It never asks more than the corrected (i): ``rho(M) <= ||M|| <= L``. None of this makes boxes correct: that
needs ``rho(|G||J1|) < 1`` (P3); where it fails the numbers bound |upper - lower| of boxes that may cross.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.design.framer import framer_gains
from gsisio_jax.design.lmi import LmiAnswer, iss_lmi, printed_lmi
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import check_type
from gsisio_jax.observer.certificate import spectral_radius
from gsisio_jax.paper.lipschitz import LipschitzConstants, lipschitz_constants, spectral_norm
from gsisio_jax.plant.system import Noise, System

_CUTOFF = 1e-10  # singular values below this share of the largest count as 0 in the pseudo-inverse


class Stability(NamedTuple):
    """Matrices, constants and conditions of Theorem 2; `print` shows them.

    Attributes:
        printed: T_f and the constants as printed, else as corrected.
        rho: spectral radius of ``|G||J1|``.
        framer: rho < 1: the boxes are correct for all data, and the matrices below nonnegative.
        constants: Lemma 2.
        J1, J2: left inverse of [G; H], (p, n) and (p, l).
        T_f, T_g: (n, n), (n, l).
        L_fd, L_gd: constants used: ``L_q + 2 ||C_q||`` if printed, else ``||W_q||``.
        contraction: ``L = L_fd ||T_f|| + L_gd ||T_g||``.
        Q: ``L_fd^2 ||T_f||^2 + L_gd^2 ||T_g||^2 - 1``.
        width_w, width_v: of the noise, (n,) and (l,).
        noise_width: ``T_f dw + T_g dv``, (n,).
        growth, growth_noise: ``|T_f| W_f + |T_g| W_g`` (n, n) and ``|T_f| dw + |T_g| dv`` (n,), corrected in any case:
            ``width[k] <= growth width[k-1] + growth_noise``.
        largest_eigenvalue: of the 5-block matrix of (ii).
        lmi: the answer to (iii).
        condition_i, condition_ii, condition_iii: printed: L <= 1, the matrix of (ii) is <= 0, (iii) is feasible.
            Corrected: L < 1, (ii) unchanged, the repaired (iii); (i) and (iii) also ask for `framer`.

    Source: paper, Theorem 2; theory 2.8-2.11.
    """

    printed: bool
    rho: float
    framer: bool
    constants: LipschitzConstants
    J1: np.ndarray
    J2: np.ndarray
    T_f: np.ndarray
    T_g: np.ndarray
    L_fd: float
    L_gd: float
    contraction: float
    Q: float
    width_w: np.ndarray
    width_v: np.ndarray
    noise_width: np.ndarray
    growth: np.ndarray
    growth_noise: np.ndarray
    largest_eigenvalue: float
    lmi: LmiAnswer
    condition_i: bool
    condition_ii: bool
    condition_iii: bool

    @property
    def rate(self) -> float:
        """Spectral radius of `growth`: below 1 the widths of a framer are bounded, whatever (i)-(iii) say."""
        return spectral_radius(self.growth)

    @property
    def steady_width(self) -> np.ndarray:
        """``(I - growth)^{-1} growth_noise``, (n,); inf where the rate is not below 1 or the boxes are no framers."""
        if not (self.framer and self.rate < 1 - 1e-9):
            return np.full(len(self.growth), np.inf)
        return np.linalg.solve(np.eye(len(self.growth)) - self.growth, self.growth_noise)

    def __str__(self) -> str:
        def word(value: bool) -> str:
            return "holds" if value else "fails"

        kind = "as printed" if self.printed else "as corrected"
        lines = [
            f"Theorem 2, {kind}",
            f"  rho(|G||J1|) {self.rho:.6g}: {'framers' if self.framer else 'NO framers, boxes may cross'}",
            f"  L_fd {self.L_fd:.6g} · L_gd {self.L_gd:.6g} · ||T_f|| {spectral_norm(self.T_f):.6g} "
            f"· ||T_g|| {spectral_norm(self.T_g):.6g} · ||dz|| {np.linalg.norm(self.noise_width):.6g}",
            f"  (i)   L = {self.contraction:.6g}: {word(self.condition_i)}",
            f"  (ii)  largest eigenvalue {self.largest_eigenvalue:.6g}, Q {self.Q:.6g}: {word(self.condition_ii)}",
            f"  (iii) {word(self.condition_iii)} (solver: {self.lmi.status})",
            f"  elementwise rate {self.rate:.6g}, steady width {self.steady_width}",
        ]
        return "\n".join(lines)


def width_matrices(G: Any, J: Any, printed: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """T_f and T_g from G (n, p) and a left inverse J (p, n + l) of [G; H].

    Source: paper, Theorem 2; theory 2.8.
    """
    G, J = np.asarray(G, np.float64), np.asarray(J, np.float64)
    return split_matrices(0.5 * (np.abs(G) @ np.abs(J) + G @ J), 0.5 * (np.abs(G) @ np.abs(J) - G @ J), printed)


def split_matrices(K: np.ndarray, L: np.ndarray, printed: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """T_f and T_g from K and L of Theorem 1, both (n, n + l); serves the printed K and L too.

    Raises:
        ValueError: the shapes do not agree.

    >>> T_f, T_g = split_matrices(np.array([[0.5, 0.5]]), np.zeros((1, 2)))
    >>> T_f.item(), T_g.item()
    (3.0, 1.0)

    Source: paper, Theorem 2; theory 2.8.
    """
    if K.shape != L.shape or K.ndim != 2 or K.shape[1] < K.shape[0]:
        raise ValueError(f"split_matrices: K and L must both have shape (n, n + l), got {K.shape} and {L.shape}")
    n = len(K)
    eye, total = np.eye(n), K + L
    inverse = np.linalg.pinv(eye - total[:, :n], rcond=_CUTOFF)
    right = eye - K[:, :n] + L[:, :n] if printed else eye + total[:, :n]
    return inverse @ right, inverse @ total[:, n:]


def block_matrix(T_f: np.ndarray, T_g: np.ndarray, Q: float) -> np.ndarray:
    """The matrix of Theorem 2 (ii) exactly as printed, for (width, dv, dw, width of f, width of g); Q stands for Q I.

    Its diagonal blocks T_g'T_g and T_f'T_f are positive semidefinite, so it is <= 0 only if T_f = T_g = 0: never (P9).
    """
    n, l = T_g.shape
    ff, fg, gg = T_f.T @ T_f, T_f.T @ T_g, T_g.T @ T_g
    gf = fg.T

    def zero(rows: int, columns: int) -> np.ndarray:
        return np.zeros((rows, columns))

    return np.block(
        [
            [Q * np.eye(n), zero(n, l), zero(n, n), zero(n, n), zero(n, l)],
            [zero(l, n), gg, gf, gf, gg],
            [zero(n, n), fg, ff, ff, fg],
            [zero(n, n), fg, ff, zero(n, n), fg],
            [zero(l, n), gg, gf, gf, zero(l, l)],
        ]
    )


@named_arguments
def stability(
    system: System,
    noise: Noise,
    region: Interval,
    printed: bool = False,
    left_inverse: Any = None,
    u_region: Interval | None = None,
    constants: LipschitzConstants | None = None,
) -> Stability:
    """Theorem 2 for the paper's recursion with decomposition bounds.

    Args:
        system: the plant.
        noise: bounds of w (n,) and v (l,).
        region: box (n,) of states on which the constants hold; all of R^n (`Interval.entire`) makes the statements
            global where the derivatives are bounded.
        printed: T_f, constants and conditions exactly as printed.
        left_inverse: J with ``J [G; H] = I``; None takes the pseudo-inverse.
        u_region: box (m,) of known inputs; needed where f or g takes ``u``.
        constants: those of Lemma 2, if known; computed otherwise.

    Returns:
        `Stability`. Where I - |G||J1| is singular the pseudo-inverse is used, as in the paper, and `framer` is False.

    Raises:
        ValueError: a shape does not fit, or a derivative is not bounded on the region.

    Source: paper, Theorem 2; theory 2.8-2.11.
    """
    check_type("stability", "system", system, System)
    check_type("stability", "noise", noise, Noise)
    for name, box, size in (("w", noise.w, system.n), ("v", noise.v, system.l)):
        if box.shape != (size,):
            raise ValueError(f"stability: the noise bounds of `{name}` must have shape ({size},), got {box.shape}")
    gains = framer_gains(system, left_inverse)
    if constants is None:
        constants = lipschitz_constants(system, region, u_region)
    T_f, T_g = split_matrices(gains.K, gains.L, printed)
    L_fd, L_gd = (constants.L_fd, constants.L_gd) if printed else (constants.L_fd_corrected, constants.L_gd_corrected)
    size_f, size_g = spectral_norm(T_f), spectral_norm(T_g)
    contraction = L_fd * size_f + L_gd * size_g
    Q = (L_fd * size_f) ** 2 + (L_gd * size_g) ** 2 - 1
    largest = float(np.linalg.eigvalsh(block_matrix(T_f, T_g, Q)).max())
    lmi = (printed_lmi if printed else iss_lmi)(contraction, system.n)
    right_f, right_g = split_matrices(gains.K, gains.L)
    dw, dv = (np.asarray(box.width, np.float64) for box in (noise.w, noise.v))
    return Stability(
        printed=printed,
        rho=gains.rho,
        framer=gains.guaranteed,
        constants=constants,
        J1=gains.J1,
        J2=gains.J2,
        T_f=T_f,
        T_g=T_g,
        L_fd=L_fd,
        L_gd=L_gd,
        contraction=contraction,
        Q=Q,
        width_w=dw,
        width_v=dv,
        noise_width=T_f @ dw + T_g @ dv,
        growth=np.abs(right_f) @ constants.W_f + np.abs(right_g) @ constants.W_g,
        growth_noise=np.abs(right_f) @ dw + np.abs(right_g) @ dv,
        largest_eigenvalue=largest,
        lmi=lmi,
        condition_i=contraction <= 1 if printed else gains.guaranteed and contraction < 1,
        condition_ii=largest <= 0,
        condition_iii=lmi.feasible and (printed or gains.guaranteed),
    )
