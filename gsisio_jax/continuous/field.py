"""The vector field of a continuous plant, as a function of everything that is constant over a step beside the state."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.continuous import maps
from gsisio_jax.continuous.merging import merged
from gsisio_jax.inclusion.rules.makers import library_function
from gsisio_jax.traced import equations


class Field:
    """``x' = f(x, u) + drift + G d`` with u and d constant over a step; ``z = (x, u, d)``."""

    def __init__(self, f: Callable[..., Any], takes_u: bool, n: int, m: int, G: np.ndarray, drift: np.ndarray | None):
        self.f, self.takes_u, self.G, self.drift = f, takes_u, G, drift
        self.n, self.m, self.p = n, m, G.shape[1]

    def alone(self, x: Any, u: Any) -> Any:
        """f as it is."""
        return maps.rate(self.f, None, x, *((u,) if self.takes_u else ()))

    def known(self, x: Any, u: Any) -> Any:
        """``f(x, u) + drift``."""
        return maps.rate(self.f, self.drift, x, *((u,) if self.takes_u else ()))

    def rate(self, x: Any, u: Any, d: Any) -> Any:
        """``x'``."""
        found = self.known(x, u)
        return found + jnp.asarray(self.G) @ d if self.p else found

    def of_z(self, z: Any) -> Any:
        """`rate` at ``z = (x, u, d)``."""
        return self.rate(*self.split(z))

    def split(self, z: Any) -> tuple[Any, Any, Any]:
        """x, u and d of z."""
        return z[: self.n], z[self.n : self.n + self.m], z[self.n + self.m :]

    def derivatives(self, order: int) -> Callable[..., Any]:
        """``(x, u, d) -> (order, n)``: ``x', x'', ...`` of the solution."""

        def stacked(x: Any, u: Any, d: Any) -> Any:
            return jnp.stack(list(maps.derivatives(lambda x: self.rate(x, u, d), order, x)))

        return merged(stacked, *self._example)

    def method_derivatives(self, step: Callable[..., Any], order: int) -> Callable[..., Any]:
        """``(s, x, u) -> (order, n)``: derivatives by s, from the first on, of a step of length s of a method."""

        def stacked(s: Any, x: Any, u: Any) -> Any:
            last, found = lambda s: step(lambda x: self.known(x, u), s, x), []
            for _ in range(order):
                last = _by_number(last)
                found.append(last(s))
            return jnp.stack(found)

        return merged(stacked, np.zeros(()), *self._example[:2])

    @property
    def _example(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return np.zeros(self.n), np.zeros(self.m), np.zeros(self.p)

    @cached_property
    def own_derivative(self) -> str:
        """What of f JAX would differentiate by a rule that need not be its derivative; empty where there is nothing."""
        closed = jax.make_jaxpr(self.known)(*self._example[:2])
        for equation in equations(closed.jaxpr):
            name = equation.primitive.name
            if name == "stop_gradient":
                return "jax.lax.stop_gradient"
            if name.startswith("custom_"):
                body = equation.params.get("call_jaxpr", equation.params.get("fun_jaxpr"))
                if not library_function(getattr(body, "jaxpr", body)):
                    source = getattr(getattr(body, "jaxpr", body).debug_info, "func_src_info", None) or ""
                    return f"the derivative rule of `{source.partition(' at ')[0]}` (jax.{name.removesuffix('_call')})"
        return ""


def _by_number(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda s: jax.jvp(function, (s,), (jnp.ones_like(s),))[1]
