"""Lemma 5 (Upper Bounds of the Interval Widths): width sequences and limits, as printed and as corrected.

Printed and wrong (P10): ``Jhat = J^+ + J^{++}``, which is 2 J^+ and 0 for J = -1 (corrected: |J|); the limit
``||dz|| L / (1 - L)``, below the limit ``||dz|| / (1 - L)`` of the printed sequence itself; the bound of d[k-1] from
the width of x[k] alone (f and g see x[k-1]). The bound "if (ii) or (iii)" is empty: there is no P to take the minimum
over, and ``||D_0||`` alone bounds nothing under noise (start from a point).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.interval.reading import check_type
from gsisio_jax.paper.lipschitz import spectral_norm
from gsisio_jax.paper.stability import Stability


class WidthBounds(NamedTuple):
    """Upper bounds of the widths; k = 0..steps for states, k - 1 = 0..steps - 1 for inputs. ``inf`` is "no bound".

    Attributes:
        state, input: of the 2-norms of the widths, (steps + 1,) and (steps,).
        state_limit, input_limit: their limits; printed: ``||dz|| L / (1 - L)``.
        weighted: Delta^P_0. Printed: the minimum over an empty set, inf. Corrected: largest norm ever, with the P of
            the repaired (iii): ``sqrt(max(D'P D, gamma lambda_max(P) |dz|^2 / eps) / lambda_min(P))``.
        weighted_limit: ultimate bound with that P, ``|dz| sqrt(gamma lambda_max / (eps lambda_min))``; inf if printed.
        uniform: largest norm ever. Printed: ``min(||D_0||, Delta^P_0)``. Corrected: ``max(||D_0||, ||dz|| / (1 - L))``.
        state_elementwise, input_elementwise: (steps + 1, n) and (steps, p), corrected and tighter: no norms.
        state_elementwise_limit, input_elementwise_limit: (n,) and (p,), inf unless rho(growth) < 1.

    Source: paper, Lemma 5; theory 2.10.
    """

    state: np.ndarray
    input: np.ndarray
    state_limit: float
    input_limit: float
    weighted: float
    weighted_limit: float
    uniform: float
    state_elementwise: np.ndarray
    input_elementwise: np.ndarray
    state_elementwise_limit: np.ndarray
    input_elementwise_limit: np.ndarray


@named_arguments
def width_bounds(stability: Stability, initial_width: Any, steps: int, printed: bool = False) -> WidthBounds:
    """Upper bounds of the widths of the paper's recursion with decomposition bounds.

    The corrected bounds hold for boxes in the region of `stability`, if it was made with ``printed=False`` and its
    `framer` is True. Elementwise bounds use the corrected matrices in any case.

    Args:
        stability: constants of Theorem 2; made with ``printed=True`` its T_f carries the misprint of P8.
        initial_width: width of the first box, (n,).
        steps: number of steps, at least 0.
        printed: Lemma 5's own formulas exactly as printed.

    Returns:
        WidthBounds: for L >= 1 the sequences are finite (``k ||dz||`` is added where L = 1) and the limits infinite.

    Raises:
        ValueError: the width has the wrong shape or is negative or not finite, or `steps` is negative.

    Source: paper, Lemma 5; theory 2.8 and 2.10.
    """
    check_type("width_bounds", "stability", stability, Stability, "what paper.stability returns")
    first = np.asarray(initial_width, np.float64)
    if first.shape != stability.noise_width.shape or not (np.isfinite(first).all() and (first >= 0).all()):
        raise ValueError(
            f"width_bounds: `initial_width` must be finite and nonnegative, shape {stability.noise_width.shape}, got "
            f"{initial_width!r}; it is the width (not the radius) of the box of x[0]"
        )
    if steps < 0:
        raise ValueError(f"width_bounds: `steps` must be at least 0, got {steps}")
    L, noise, norm = stability.contraction, float(np.linalg.norm(stability.noise_width)), float(np.linalg.norm(first))
    state = np.empty(steps + 1)
    state[0] = norm
    with np.errstate(over="ignore"):
        for k in range(steps):
            state[k + 1] = L * state[k] + noise
    limit = _limit(L, noise, printed)
    bound = _input_bound(stability, printed)
    weighted, weighted_limit = (np.inf, np.inf) if printed else _weighted(stability, first)
    elementwise, elementwise_limit = _elementwise(stability, first, steps)
    return WidthBounds(
        state=state,
        input=bound(state[1:], state[:-1]),
        state_limit=limit,
        input_limit=float(bound(np.array(limit), np.array(limit))),
        weighted=weighted,
        weighted_limit=weighted_limit,
        uniform=min(norm, weighted) if printed else max(norm, limit),
        state_elementwise=elementwise,
        input_elementwise=_input_elementwise(stability, elementwise[1:], elementwise[:-1]),
        state_elementwise_limit=elementwise_limit,
        input_elementwise_limit=_input_elementwise(stability, elementwise_limit, elementwise_limit),
    )


def _limit(L: float, noise: float, printed: bool) -> float:
    if L >= 1:
        return np.inf
    return noise * L / (1 - L) if printed else noise / (1 - L)


def _input_bound(stability: Stability, printed: bool) -> Any:
    """The function G of Lemma 5, of the state widths (now, before); printed: of `now` alone."""
    J1, J2 = stability.J1, stability.J2
    if printed:
        hat1, hat2 = 2 * np.maximum(J1, 0), 2 * np.maximum(J2, 0)  # J^+ + (J^+)^+
    else:
        hat1, hat2 = np.abs(J1), np.abs(J2)
    size1, size2 = spectral_norm(hat1), spectral_norm(hat2)
    noise = float(np.linalg.norm(hat1 @ stability.width_w + hat2 @ stability.width_v))
    of_maps = stability.L_fd * size1 + stability.L_gd * size2

    def bound(now: np.ndarray, before: np.ndarray) -> np.ndarray:
        return _product(size1, now) + _product(of_maps, now if printed else before) + noise

    return bound


def _product(factor: float, value: np.ndarray) -> np.ndarray:
    """``factor * value`` with ``0 * inf = 0``: an input that the states do not enter has a finite bound."""
    return np.zeros_like(value) if factor == 0 else factor * value


def _weighted(stability: Stability, first: np.ndarray) -> tuple[float, float]:
    """Largest and ultimate norm from V = D'P D: ``V[k+1] <= (1 - eps / lambda_max) V[k] + gamma |dz|^2``."""
    answer = stability.lmi
    if not answer.feasible or stability.printed:
        return np.inf, np.inf
    values = np.linalg.eigvalsh(answer.P)
    ultimate = answer.gamma * values[-1] * float(stability.noise_width @ stability.noise_width) / answer.eps
    ever = max(float(first @ answer.P @ first), ultimate)
    return float(np.sqrt(ever / values[0])), float(np.sqrt(ultimate / values[0]))


def _elementwise(stability: Stability, first: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """``D[k] = growth D[k-1] + |T_f| dw + |T_g| dv`` with the corrected matrices, and its limit.

    With S = |G||J1| this is ``(I - S)^{-1} [(I + S)(W_f D + dw) + |G||J2| (W_g D + dv)]``.
    """
    widths = np.empty((steps + 1, len(first)))
    widths[0] = first
    with np.errstate(over="ignore"):
        for k in range(steps):
            widths[k + 1] = _image(stability.growth, widths[k]) + stability.growth_noise
    return widths, stability.steady_width


def _input_elementwise(stability: Stability, now: np.ndarray, before: np.ndarray) -> np.ndarray:
    """``|J1| (D[k] + W_f D[k-1] + dw) + |J2| (W_g D[k-1] + dv)``, (p,) or a stack."""
    hat1, hat2 = np.abs(stability.J1), np.abs(stability.J2)
    of_maps = hat1 @ stability.constants.W_f + hat2 @ stability.constants.W_g
    return _image(hat1, now) + _image(of_maps, before) + hat1 @ stability.width_w + hat2 @ stability.width_v


def _image(matrix: np.ndarray, width: np.ndarray) -> np.ndarray:
    """``matrix @ width`` for a nonnegative matrix and widths (..., n) with ``0 * inf = 0``."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.where(matrix == 0, 0.0, matrix * width[..., None, :]).sum(-1)
