"""The section "Illustrative Example": every number it prints beside the one that follows from its own formulas.

The figures of that section show unknown inputs that are not printed; `record` uses chosen ones and says so.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gsisio_jax.design.feedthrough import factorise
from gsisio_jax.design.framer import framer_gains
from gsisio_jax.examples import paper
from gsisio_jax.interval.box import Interval
from gsisio_jax.paper.lipschitz import PRINTED, LipschitzConstants, lipschitz_constants, spectral_norm
from gsisio_jax.paper.stability import Stability, split_matrices, stability
from gsisio_jax.paper.widths import WidthBounds, width_bounds
from gsisio_jax.plant.system import Noise

INPUTS = "d = (2 sin 0.2k, 1.5 cos 0.13k)"
"""The unknown input of `record`: the one in the paper's figures is not printed."""

FINDINGS = {
    "P1": "The existence condition (printed with K2, L2, which are n x l; the example uses K1, L1) holds only if H has "
    "full column rank: for H v = 0, v != 0, I - K1 + L1 = I - G J1 maps G v to 0. This excludes the case of the title.",
    "P2": "For rank-deficient H no finite correct box of x[k] follows from y[0..k-1]: add a v to d[k-1], H v = 0, and "
    "x[k] moves by a G v while those measurements stay. y[k] is needed.",
    "P3": "Finite is not correct: a framer needs rho(|G||J1|) < 1. For rank-deficient H rho >= 1 for every left "
    "inverse; above 1 every box computed from an uncrossed one is crossed.",
    "P4": "On this example rho(|G||J1|) = 1.927, and the boxes cross at the first step.",
    "P5": "The printed K and L do not belong to the printed G and H: (K - L)[G; H] = G fails for them.",
    "P6": "For full-rank H the closed form x[k] = f + B u + w + G pinv(H) (y[k-1] - g - D u - v) needs no implicit "
    "equation (J1 = 0, rho = 0).",
    "P7": "A_y is never defined; it is [K2 - L2; K2 - L2]. K_{1:n} means columns 1..n.",
    "P8": "T_f must be (I - K1 - L1)^{-1} (I + K1 + L1); printed with I - K1 + L1.",
    "P9": "Theorem 2 (ii) holds only for T_f = T_g = 0, (iii) never; (i) needs strict inequality.",
    "P10": "Lemma 5: Jhat = |J|, the limit is ||dz|| / (1 - L) (printed: L / (1 - L)), and the input bound needs the "
    "widths of both steps.",
    "P11": "Lemma 2 takes one z for all rows of the decomposition function, but each row has its own: L + 2 ||C|| is "
    "no bound. Elementwise gains are.",
    "P12": "Some constants do not follow from the printed f and g.",
    "P13": "Lemma 3 is tight for square [G; H] only.",
}
"""What is wrong or missing in the paper, in words; P1 to P13 as in docs/theory.md, section 2."""


class Row(NamedTuple):
    """One printed number.

    Attributes:
        name: what it is, for example "K_12".
        group: the matrix row it stands in, for example "K row 1"; the name itself for a single number.
        printed: as printed.
        computed: from the printed f, g, G, H by the printed formulas.
        digits: decimals that are printed.
        agrees: equal to half a unit of the last of them.
        reason: where it does not agree, why not.
        finding: key of `FINDINGS`, or empty.
    """

    name: str
    group: str
    printed: str
    computed: float
    digits: int
    agrees: bool
    reason: str
    finding: str


class Record(NamedTuple):
    """A simulated run: states x (T + 1, 2), unknown inputs d (T, 2), measurements y (T, 2)."""

    x: np.ndarray
    d: np.ndarray
    y: np.ndarray


def noise() -> Noise:
    """The printed bounds of w and v."""
    return Noise(Interval.symmetric(np.full(2, paper.NOISE)), Interval.symmetric(np.full(2, paper.NOISE)))


def initial() -> Interval:
    """The printed box of x[0]."""
    return Interval(paper.INITIAL_LOWER, paper.INITIAL_UPPER)


def record(steps: int = 60, seed: int = 1) -> Record:
    """Simulate the example with the unknown input `INPUTS`; x[0] and the noise are uniform in their boxes."""
    random, k = np.random.default_rng(seed), np.arange(steps)
    d = np.stack([2 * np.sin(0.2 * k), 1.5 * np.cos(0.13 * k)], axis=1)
    x, y = np.empty((steps + 1, 2)), np.empty((steps, 2))
    x[0] = random.uniform(paper.INITIAL_LOWER, paper.INITIAL_UPPER)
    w, v = random.uniform(-paper.NOISE, paper.NOISE, (2, steps, 2))
    for i in range(steps):
        y[i] = paper.output_map(x[i], np) + paper.H @ d[i] + v[i]
        x[i + 1] = paper.state_map(x[i], np) + paper.G @ d[i] + w[i]
    return Record(x, d, y)


def printed_claim(steps: int) -> WidthBounds:
    """Lemma 5 with the numbers of the example as printed (K, L, L_fd, L_gd, and .643), which do not fit together."""
    T_f, T_g = split_matrices(PRINTED.K, PRINTED.L, printed=True)
    pair = (PRINTED.df, PRINTED.dg)
    known = stability(
        paper.system(), noise(), Interval.entire(2), True, constants=lipschitz_constants(
            paper.system(), Interval.entire(2), derivative=pair)
    )  # fmt: skip
    claimed = known._replace(
        T_f=T_f, T_g=T_g, L_fd=PRINTED.L_fd, L_gd=PRINTED.L_gd, contraction=PRINTED.contraction,
        noise_width=T_f @ known.width_w + T_g @ known.width_v,
    )  # fmt: skip
    return width_bounds(claimed, initial().width, steps, printed=True)


def numbers() -> list[Row]:
    """Every number that the section prints about its system, beside the computed one.

    Returns:
        One `Row` per number, in the order of print (epsilon is 0).

    Source: paper, section "Illustrative Example"; theory 2.1, 2.5, 2.8, 2.11 and 2.12.
    """
    system, everywhere = paper.system(), Interval.entire(2)
    constants = lipschitz_constants(system, everywhere)
    gains, known = framer_gains(system), stability(system, noise(), everywhere, printed=True, constants=constants)
    right = stability(system, noise(), everywhere, constants=constants)
    rows = [_row("rk(H)", 1, factorise(paper.H).rank, 0, "", "")]
    for q, printed, found in (("f", PRINTED.df, constants.df), ("g", PRINTED.dg, constants.dg)):
        reason = "still a bound, but not the smallest value of the derivative"
        rows += _matrix(f"a^{q}", printed.lower, found.lower, 2, reason, "P12")
        rows += _matrix(f"b^{q}", printed.upper, found.upper, 2, reason, "P12")
    reason = "no Lipschitz constant: the norm of the Jacobian is larger at every state; computed is its supremum"
    rows.append(_row("L_f", PRINTED.L_f, constants.L_f, 2, reason, "P12"))
    reason = "no Lipschitz constant: the norm of the Jacobian is larger at most states; computed is its supremum"
    rows.append(_row("L_g", PRINTED.L_g, constants.L_g, 2, reason, "P12"))
    reason = "Theorem 1 gives the computed one, and no left inverse gives the printed ones"
    rows += _matrix("K", PRINTED.K, gains.K, 4, reason, "P5")
    rows += _matrix("L", PRINTED.L, gains.L, 4, reason, "P5")
    eye = np.eye(system.n)
    rows.append(_row("rk(I-K1-L1)", 2, _rank(eye - gains.K1 - gains.L1), 0, "", ""))
    reason = "I - G J1 is singular for every rank-deficient H; only the printed K, L, which are wrong, give 2"
    rows.append(_row("rk(I-K1+L1)", 2, _rank(eye - gains.K1 + gains.L1), 0, reason, "P1"))
    reason = "C is min(|a|, b) where the derivative has both signs, else 0: never negative"
    rows += _matrix("C_f", PRINTED.C_f, constants.C_f, 3, reason, "P12")
    rows += _matrix("C_g", PRINTED.C_g, constants.C_g, 3, reason, "P12")
    return rows + _constants(constants, known, right)


def _constants(constants: LipschitzConstants, known: Stability, right: Stability) -> list[Row]:
    """L_fd, L_gd and the contraction constant, with what the printed numbers themselves would give."""
    own_f, own_g = (
        L + 2 * spectral_norm(C) for L, C in ((PRINTED.L_f, PRINTED.C_f), (PRINTED.L_g, PRINTED.C_g))
    )  # fmt: skip
    reason = (
        f"the printed L_f, C_f, both wrong, give {own_f:.4f}; and the formula is no bound, corrected Lemma 2 gives "
        f"{constants.L_fd_corrected:.3f}"
    )
    rows = [_row("L_fd", PRINTED.L_fd, constants.L_fd, 3, reason, "P11")]
    reason = (
        f"the printed L_g, C_g give {own_g:.3f}; {PRINTED.L_gd:g} = {PRINTED.L_g:g} + 2 ({PRINTED.C_g.max():g}) has "
        f"the largest entry of C_g in the place of its norm; corrected Lemma 2 gives {constants.L_gd_corrected:.3f}"
    )
    rows.append(_row("L_gd", PRINTED.L_gd, constants.L_gd, 2, reason, "P11"))
    T_f, T_g = split_matrices(PRINTED.K, PRINTED.L, printed=True)
    own = PRINTED.L_fd * spectral_norm(T_f) + PRINTED.L_gd * spectral_norm(T_g)
    reason = (
        f"the printed K, L, L_fd, L_gd give {own:.3f}; with T_f and Lemma 2 corrected {right.contraction:.3f}: "
        "condition (i) of Theorem 2 fails each time"
    )
    return [*rows, _row("calligraphic L", PRINTED.contraction, known.contraction, 3, reason, "P8")]


def _rank(matrix: np.ndarray) -> int:
    return int(np.linalg.matrix_rank(matrix, tol=1e-9))


def _row(name: str, printed: float, computed: float, digits: int, reason: str, finding: str, group: str = "") -> Row:
    # Half a unit of the last printed digit, and a little for binary fractions.
    agrees = bool(abs(computed - printed) <= (0.5 * 10.0**-digits if digits else 0) + 1e-12)
    return Row(
        name,
        group or name,
        f"{printed:g}",
        float(computed) + 0.0,
        digits,
        agrees,
        *(("", "") if agrees else (reason, finding)),
    )


def _matrix(name: str, printed: np.ndarray, found: np.ndarray, digits: int, reason: str, finding: str) -> list[Row]:
    """One row per entry; a matrix that is wider than two columns is shown row by row."""
    wide = printed.shape[1] > 2
    return [
        _row(f"{name}_{i + 1}{j + 1}", float(printed[i, j]), float(found[i, j]), digits, reason, finding,
             f"{name}, row {i + 1}" if wide else name)
        for i, j in np.ndindex(*printed.shape)
    ]  # fmt: skip
