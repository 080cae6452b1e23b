"""The discrete maps that `discretize` returns: functions of a module, so that they compare and pickle as the f in them.

Each takes x, or x and u, after its parameters, which `functools.partial` binds. `System` then reads the signature, and
watches the numbers that the user's f reads.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from math import factorial
from typing import Any

import jax
import jax.numpy as jnp

from gsisio_jax.plant.calls import as_vector

Rate = Callable[[Any], Any]


def of_x(step: Callable[..., Any], f: Callable[..., Any], drift: Any, h: float, x: Any) -> Any:
    """One step of ``x' = f(x) + drift``."""
    return step(lambda x: rate(f, drift, x), h, x)


def of_x_and_u(step: Callable[..., Any], f: Callable[..., Any], drift: Any, h: float, x: Any, u: Any) -> Any:
    """One step of ``x' = f(x, u) + drift`` with u constant."""
    return step(lambda x: rate(f, drift, x, u), h, x)


def rate(f: Callable[..., Any], drift: Any, x: Any, *u: Any) -> Any:
    """``f + drift``; `drift` is None where there is none."""
    found = as_vector(f(x, *u), x.shape[0], x.dtype)
    return found if drift is None else found + jnp.asarray(drift, x.dtype)


def euler(F: Rate, h: Any, x: Any) -> Any:
    """``x + h F(x)``."""
    return x + h * F(x)


def rk4(F: Rate, h: Any, x: Any) -> Any:
    """The classical method of Runge and Kutta, order 4."""
    k1 = F(x)
    k2 = F(x + (0.5 * h) * k1)
    k3 = F(x + (0.5 * h) * k2)
    k4 = F(x + h * k3)
    return x + (h / 6) * (k1 + 2 * k2 + 2 * k3 + k4)


def taylor(order: int, F: Rate, h: Any, x: Any) -> Any:
    """``sum of h^k / k! F_k(x)`` to the order, with the derivatives F_k of the solution."""
    terms = list(derivatives(F, order, x))
    for k, term in enumerate(terms, start=1):
        x = x + coefficient(h, k) * term
    return x


def derivatives(F: Rate, order: int, x: Any) -> Any:
    """``x', x'', ...`` of the solution of ``x' = F(x)`` through x, as many as the order: ``F_1 = F, F_{k+1} = F_k'
    F``.
    """
    last = F
    for _ in range(order):
        yield last(x)
        last = _along(last, F)


def _along(function: Rate, F: Rate) -> Rate:
    return lambda x: jax.jvp(function, (x,), (F(x),))[1]


def coefficient(h: Any, k: int) -> float:
    """``h^k / k!``, rounded once."""
    return float(Fraction(h) ** k / factorial(k))


def linear(A: Any, x: Any) -> Any:
    """``A x``."""
    return jnp.asarray(A, x.dtype) @ x


def affine_of_x(A: Any, c: Any, x: Any) -> Any:
    """``A x + c``."""
    return linear(A, x) + jnp.asarray(c, x.dtype)


def affine_of_x_and_u(A: Any, B: Any, c: Any, x: Any, u: Any) -> Any:
    """``A x + B u + c``."""
    return linear(A, x) + linear(B, jnp.asarray(u, x.dtype)) + jnp.asarray(c, x.dtype)
