"""The zero-order hold: the exact step of an affine plant."""

from __future__ import annotations

import numpy as np

from gsisio_jax import inclusion
from gsisio_jax.continuous import sides
from gsisio_jax.continuous.exponential import exponential, integral_upper
from gsisio_jax.continuous.field import Field
from gsisio_jax.continuous.sides import Sides

_AFFINE = 1e-9  # relative width of the enclosure of a slope that does not depend on the point


def held(call: str, A: np.ndarray, columns: list[np.ndarray], h: float) -> tuple[list[np.ndarray], np.ndarray]:
    """The step of ``x' = A x + sum_i columns[i] c_i`` with constant c_i: its matrices, and a bound of their errors.

    Args:
        call: of which a refusal speaks.
        A: (n, n).
        columns: matrices (n, m_i).
        h: length of the step.

    Returns:
        ``[exp(A h), integral of exp(A s) ds columns[0], ...]``, and one (n, n + m_0 + ...) for the errors of all.

    Raises:
        ValueError: the step is too long for numbers.
    """
    n, widths = len(A), [matrix.shape[1] for matrix in columns]
    whole = np.zeros((n + sum(widths),) * 2)
    whole[:n] = np.hstack([A, *columns])
    try:
        value, lost = exponential(whole, h)
    except OverflowError as error:
        raise ValueError(f"{call}: dt = {h:g} is too long for this plant: {error}; give a shorter one") from None
    return np.split(value[:n], n + np.cumsum([0, *widths])[:-1], axis=1), lost[:n]


def affine(field: Field, everywhere: Sides) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B and c of ``f + drift = A x + B u + c`` on a box of (x, u), to rounding.

    Raises:
        ValueError: the field is not affine there; the entry of the Jacobian that varies is named.
    """
    n, m = field.n, field.m

    def known(z: np.ndarray) -> np.ndarray:
        return field.known(z[:n], z[n:])

    low, high = sides.sides(inclusion.jacobian(known)(sides.box(everywhere)))
    with np.errstate(invalid="ignore"):
        wide = ~(high - low <= _AFFINE * np.maximum(sides.magnitude((low, high)), 1e-12))
    if wide.any():
        i, j = np.argwhere(wide)[0]
        name = f"x[{j}]" if j < n else f"u[{j - n}]"
        raise ValueError(
            f'discretize: method="zoh" needs an f that is affine; df[{i}]/d{name} lies between {low[i, j]:.6g} and '
            f'{high[i, j]:.6g}. Use method="taylor" or "rk4"'
        )
    slopes, none = 0.5 * low + 0.5 * high, (np.zeros(n + m), np.zeros(n + m))
    return slopes[:, :n], slopes[:, n:], np.asarray(inclusion.natural(known)(sides.box(none)).center)


def hold_error(
    A: np.ndarray, parts: list[np.ndarray], lost: np.ndarray, around: Sides, spread: np.ndarray, h: float, eps: float
) -> Sides:
    """What rounding of the matrices and a disturbance of radius `spread` leave; `around` is the box of what they are
    multiplied with, and eps that of the type of the run, 0 for float64."""
    radius = (lost + eps * abs(np.hstack(parts))) @ sides.magnitude(around) * (1 + 1e-9) + 1e-300
    if spread.any():
        larger = np.where(np.eye(len(A), dtype=bool), A, abs(A))
        radius = np.nextafter(radius + integral_upper(larger, spread, h), np.inf)
    return sides.symmetric(radius)
