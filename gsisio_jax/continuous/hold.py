"""The zero-order hold: the exact step of an affine plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gsisio_jax import inclusion
from gsisio_jax.continuous import sides
from gsisio_jax.continuous.exponential import exponential, integral_upper
from gsisio_jax.continuous.field import Field
from gsisio_jax.continuous.sides import Sides

_AFFINE = 1e-9  # relative width of the enclosure of a slope that hardly depends on the point
_NUMBERS = 64 * float(np.finfo(np.float64).eps)  # and of one that is a number, to the rounding of its expression


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


@dataclass(frozen=True)
class Affine:
    """``f + drift = A x + B u + c + rest``, wherever the plant may be within a step.

    Attributes:
        A, B, c: (n, n), (n, m) and (n,).
        rest: (n,), bound of the magnitude of what is left.
    """

    A: np.ndarray
    B: np.ndarray
    c: np.ndarray
    rest: np.ndarray


def affine(field: Field, region: Sides, u: Sides, reach: Callable[[], Sides] | None) -> Affine:
    """That of a field which is affine, and where it need not be so everywhere.

    Args:
        field: of the plant.
        region: of states at the start of a step.
        u: of known inputs.
        reach: the box of states that a step from the region may meet, for a field that is affine in places; None where
            no bound is asked for.

    Raises:
        ValueError: the field is not affine where it has to be; the entry of the Jacobian that varies is named.
    """
    n, m = field.n, field.m

    def known(z: np.ndarray) -> np.ndarray:
        return field.known(z[:n], z[n:])

    def slopes(x: Sides) -> Sides:
        return sides.sides(inclusion.jacobian(known)(sides.box(sides.joined(x, u))))

    def split(J: np.ndarray, c: np.ndarray, rest: np.ndarray) -> Affine:
        return Affine(J[:, :n], J[:, n:], c, rest)

    found = slopes(region)
    _refuse_bent(_bent(found, _AFFINE), found, n, "")
    middle, everywhere = 0.5 * found[0] + 0.5 * found[1], (np.full(n, -np.inf), np.full(n, np.inf))
    none = np.zeros(n + m), np.zeros(n + m)
    if not _bent(slopes(everywhere), _NUMBERS).any():
        c = np.asarray(inclusion.natural(known)(sides.box(none)).center)
        return split(middle, c, np.zeros(n))
    # Affine in places: at 0, or beyond the region, f may be another one.
    around = sides.joined(region if reach is None else reach(), u)
    if reach is not None:
        found = slopes((around[0][:n], around[1][:n]))
        _refuse_bent(_bent(found, _AFFINE), found, n, " where the plant may be within a step")
        middle = 0.5 * found[0] + 0.5 * found[1]
    low, high = sides.joined(region, u)
    start = 0.5 * low + 0.5 * high
    value = sides.sides(inclusion.natural(known)(sides.box((start, start))))
    center = 0.5 * value[0] + 0.5 * value[1]
    far = np.maximum(around[1] - start, start - around[0])
    rest = np.maximum(found[1] - middle, middle - found[0]) @ far + np.maximum(value[1] - center, center - value[0])
    rounded = 4 * (n + m + 2) * np.finfo(np.float64).eps * (abs(middle) @ (abs(start) + far) + abs(center))
    return split(middle, center - middle @ start, (rest + rounded) * (1 + 1e-9) + 1e-300)


def _bent(slopes: Sides, share: float) -> np.ndarray:
    """Which of them vary by more than a share of themselves."""
    with np.errstate(invalid="ignore"):
        return ~(slopes[1] - slopes[0] <= share * np.maximum(sides.magnitude(slopes), 1e-12))


def _refuse_bent(bent: np.ndarray, slopes: Sides, n: int, where: str) -> None:
    if not bent.any():
        return
    i, j = np.argwhere(bent)[0]
    name = f"x[{j}]" if j < n else f"u[{j - n}]"
    raise ValueError(
        f'discretize: method="zoh" needs an f that is affine{where}; df[{i}]/d{name} lies between '
        f'{slopes[0][i, j]:.6g} and {slopes[1][i, j]:.6g}. Use method="taylor" or "rk4"'
        + (", a smaller region, or a shorter dt" if where else "")
    )


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
