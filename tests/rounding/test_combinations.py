"""Linear combinations are widened once for every operand (`combinations`): held against fractions, at the corners."""

from collections.abc import Callable
from fractions import Fraction
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsisio_jax import Interval, inclusion
from gsisio_jax.inclusion import combinations
from gsisio_jax.inclusion.combinations import MOST, OPERAND, Share
from gsisio_jax.scalar.program import scalar_program

N = 4
KINDS = {"float64": np.float64, "float32": np.float32}


def chain(x: Any, number: Callable[[float], Any]) -> Any:
    """More roundings on a way than one widening covers."""
    total = x[0]
    for i in range(2 * MOST):
        total = number(0.9) * total + number(0.3 + 0.1 * i) * x[i % N]
    return total


def swallowed(x: Any, number: Callable[[float], Any]) -> Any:
    """Every sum loses nearly half a unit in the last place, all to the same side."""
    total = number(1.1) * x[0]
    for _ in range(3 * MOST):
        total = total + number(0.4 * 2.0**-52) * x[0]
    return total


def tiny_and_huge(power: int) -> Callable[..., Any]:
    """Products that are flushed to zero on their way, and then multiplied by something large."""

    def function(x: Any, number: Callable[[float], Any]) -> Any:
        small = number(1.1 * 10.0**-power)
        return number(0.7 * 10.0**power) * (small * (small * x[0]) + small * x[1]) - number(0.3) * x[2]

    return function


FUNCTIONS: dict[str, Callable[..., Any]] = {
    "sum": lambda x, n: n(0.6) * x[0] - n(0.12) * x[1] + x[2] - n(1.7),
    "nested": lambda x, n: n(0.3) * (n(0.1) * x[0] - (x[1] + n(0.2) * x[2])) - n(1.1) * (x[3] - n(0.7) * x[0]),
    "cancelled": lambda x, n: n(1e8) * x[0] - n(1e8) * (x[0] + n(1e-9) * x[1]),
    "powers of two": lambda x, n: n(2.0) * (n(0.1) * x[0]) - n(4.0) * x[1],
    "quotient": lambda x, n: (x[0] / n(3.0) + x[1] / n(-7.0)) / n(1.3),
    "chain": chain,
    "swallowed": swallowed,
    "extreme": tiny_and_huge(160),
    "extreme 32": tiny_and_huge(30),
}


def boxes(kind: type, many: int = 200) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    centre = rng.normal(size=(many, N)) * 10.0 ** rng.integers(-6, 7, (many, N))
    radius = abs(centre) * 10.0 ** rng.uniform(-16, 0, (many, N)) * rng.integers(0, 2, (many, N))
    return (centre - radius).astype(kind), (centre + radius).astype(kind)


def exactly(function: Callable[..., Any], kind: type, lower: np.ndarray, upper: np.ndarray) -> tuple[Fraction, ...]:
    """Smallest and largest value, and the sum of the magnitudes of all terms."""
    number = lambda value: Fraction(float(kind(value)))  # noqa: E731
    sides = [(Fraction(float(a)), Fraction(float(b))) for a, b in zip(lower, upper, strict=True)]
    values = [function(corner, number) for corner in product(*sides)]
    units = [tuple(Fraction(int(i == j)) for i in range(N)) for j in range(N)]
    offset = function((Fraction(0),) * N, number)
    size = abs(offset) + sum(
        abs(function(unit, number) - offset) * max(map(abs, side)) for unit, side in zip(units, sides, strict=True)
    )
    return min(values), max(values), size


def bounds_of(function: Callable[..., Any], kind: type, rounding: Any = "outward") -> Callable[..., Interval]:
    natural = inclusion.natural(lambda x: function(x, lambda value: jnp.asarray(value, kind)), rounding)
    # Constants as arrays are known to the interpreter; they are the numbers that `exactly` takes.
    bounds = jax.jit(jax.vmap(lambda lower, upper: natural(Interval.unchecked(lower, upper))))
    return lambda lower, upper: jax.device_get(bounds(lower, upper))


def missed(name: str, kind: type, rounding: Any = "outward") -> int:
    lower, upper = boxes(kind)
    found = bounds_of(FUNCTIONS[name], kind, rounding)(lower, upper)
    count = 0
    for low, high, a, b in zip(found.lower, found.upper, lower, upper, strict=True):
        least, most, _ = exactly(FUNCTIONS[name], kind, a, b)
        count += Fraction(float(low)) > least or Fraction(float(high)) < most
    return count


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
@pytest.mark.parametrize("name", [name for name in FUNCTIONS if name != "extreme"])
def test_corners_are_inside(name: str, kind: type) -> None:
    assert missed(name, kind) == 0


def test_what_is_flushed_to_zero_is_covered() -> None:
    assert missed("extreme", np.float64) == 0


def test_to_nearest_some_corners_are_outside() -> None:
    assert missed("nested", np.float64, "nearest") > 10


def test_bounds_are_no_wider_than_rounding() -> None:
    lower, upper = boxes(np.float64)
    found = bounds_of(FUNCTIONS["sum"], np.float64)(lower, upper)
    for low, high, a, b in zip(found.lower, found.upper, lower, upper, strict=True):
        least, most, size = exactly(FUNCTIONS["sum"], np.float64, a, b)
        room = 32 * Fraction(2) ** -52 * size + Fraction(1, 10**280)
        assert least - Fraction(float(low)) <= room
        assert Fraction(float(high)) - most <= room


def test_matrices_with_zeros_on_infinite_boxes() -> None:
    matrix = np.array([[0.3, 0.0, -0.7], [0.0, 0.1, 0.0], [0.0, 0.0, 0.0]])
    natural = inclusion.natural(lambda x: matrix @ jnp.sin(x) + 0.1 * (matrix @ x))
    found = natural(Interval([-1.0, -np.inf, 0.0], [1.0, np.inf, np.inf]))
    assert np.isfinite(found.upper[0])
    assert found.lower[0] == -np.inf
    assert (found.lower[1], found.upper[1]) == (-np.inf, np.inf)
    assert (found.lower[2], found.upper[2]) == (0, 0)


def test_what_overflows_is_unbounded() -> None:
    natural = inclusion.natural(lambda x: 1e200 * (1e200 * x[0]) - 0.5 * (1e200 * (1e200 * x[1])))
    found = natural(Interval([1.0, 1.0], [2.0, 2.0]))
    assert (found.lower, found.upper) == (-np.inf, np.inf)


def test_shares() -> None:
    assert OPERAND.holds()
    assert combinations.times(np.array([0.5, 0.0, -0.1]), None, 2.0) == Share(1, 0.1, 3.0)
    assert combinations.times(np.array(0.0), None, 2.0) is None
    assert combinations.plus(Share(3, 0.1, 5.0), Share(1, 0.5, 1.0)) == Share(4, 0.1, 7.0)
    assert combinations.plus(Share(MOST, 1.0, 1.0), OPERAND) is None
    assert combinations.times(np.array(1e-200), None, 2.0) is None
    assert combinations.together([Share(2, 0.5, 2.0), None], 1) is None
    assert combinations.together([Share(2, 0.5, 2.0), Share(3, 0.25, 1.0)], 1) == Share(3, 0.25, 2.0)
    assert combinations.together([Share(2, 0.5, 2.0)], 3) == Share(5, 0.5, 9.0)


def test_a_combination_costs_little() -> None:
    natural = inclusion.natural(lambda x: 0.3 * x[0] + 0.2 * x[1])
    rows = inclusion.natural(lambda x: jnp.stack([0.3 * x[0] + 0.2 * x[1], 0.1 * x[0] + 0.7 * x[1]]))

    def count(bounds: Any) -> int:
        def program(lower: Any, upper: Any) -> Any:
            found = bounds(Interval.unchecked(lower, upper))
            return found.lower, found.upper

        return sum(scalar_program(jax.make_jaxpr(program)(jnp.zeros(2), jnp.zeros(2))).count().values())

    # A second row: two products, a sum and the guard (2) a side.
    assert count(rows) - count(natural) <= 2 * (3 + 2)
