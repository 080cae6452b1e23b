"""``f(x, u) = f(x, 0) + M u``: M in fractions, and None where f is not of that form."""

from __future__ import annotations

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsisio_jax.inclusion.input_parts import input_parts

THIRD, TENTH = Fraction(1 / 3), Fraction(0.1)
B = np.array([[0.1, 0.0], [1 / 3, -2.0]])

OF_THAT_FORM = {
    "a matrix": (lambda x, u: jnp.sin(x) + B @ u, [{0: TENTH}, {0: THIRD, 1: Fraction(-2)}]),
    "products of constants": (lambda x, u: x + 0.1 * (x[0] * x[1] + u / 3), [{0: TENTH / 3}, {1: TENTH / 3}]),
    "signs": (lambda x, u: -(x - u) - 2 * u, [{0: Fraction(-1)}, {1: Fraction(-1)}]),
    "what cancels": (lambda x, u: x * ((u[0] + u[1]) - u[0] - u[1]) + u[0], [{0: Fraction(1)}] * 2),
    "a sum": (lambda x, u: jnp.exp(x) * 2 + jnp.sum(3 * u), [{0: Fraction(3), 1: Fraction(3)}] * 2),
    "a loop and a choice in x": (
        lambda x, u: jnp.where(x > 0, jax.lax.fori_loop(0, 3, lambda _, z: z * x, x), -x) + u[::-1],
        [{1: Fraction(1)}, {0: Fraction(1)}],
    ),
    "not at all": (lambda x, u: x + 0 * u, [{}, {}]),
    "a constant": (lambda x, u: jnp.array([1.0, 2.0]), [{}, {}]),
}
OTHERS = {
    "a product": lambda x, u: x * u,
    "a square": lambda x, u: x + u * u,
    "a bend": lambda x, u: x + jnp.maximum(u, 0),
    "a choice": lambda x, u: jnp.where(u > 0, x, -x),
    "a quotient": lambda x, u: x + 1 / u,
    "a sine": lambda x, u: x + jnp.sin(u),
    "whole numbers": lambda x, u: x + u.astype(int),
    "a narrower type": lambda x, u: x + u.astype(np.float32),
    "a loop": lambda x, u: jax.lax.while_loop(lambda z: z[0] < 1, lambda z: 2 * z, x + u),
    "infinity": lambda x, u: x + np.inf * u,
    "in one entry": lambda x, u: jnp.stack([x[0] + u[0], x[1] * u[1]]),
}


@pytest.mark.parametrize("name", OF_THAT_FORM)
def test_the_part_is_exact(name):
    function, expected = OF_THAT_FORM[name]
    assert input_parts(function, 2, 2, np.float64) == expected


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_not_affine_in_u_is_left_alone(name):
    assert input_parts(OTHERS[name], 2, 2, np.float64) is None


def test_a_wider_type_of_constants_is_exact():
    """Data of 32 bits meet constants of 64, and are widened without a loss."""
    assert input_parts(lambda x, u: x + B @ u, 2, 2, np.float32) == [{0: TENTH}, {0: THIRD, 1: Fraction(-2)}]


def test_traced_numbers_are_not_read():
    found = []

    def gain(b):
        found.append(input_parts(lambda x, u: x + b * u, 2, 2, np.float64))
        return b

    jax.make_jaxpr(gain)(1.0)
    assert found == [None]
