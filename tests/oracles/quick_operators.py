"""Operators of arrays that are being traced, without the detour: the very equation that `jnp` would write, at half the
time.

``x + y`` on a traced array is `jnp.add`, a function under `jax.jit` that JAX takes from its cache and writes into the
trace, where it is one equation, `add`. Where the other side is a traced array of the same type, of the same shape or a
number, or a number of Python, that equation is written at once; anything else goes the usual way. Tests trace for half
of their time, and operators are a sixth of that. tests/test_quick_operators.py compares the programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np
import pytest
from jax import lax
from jax.core import ShapedArray
from jax.interpreters.partial_eval import DynamicJaxprTracer

OPERATIONS = {
    # name: what writes the equation, kinds of types
    "add": (lax.add, "fiu"), "sub": (lax.sub, "fiu"), "mul": (lax.mul, "fiu"), "truediv": (lax.div, "f"),
    "lt": (lax.lt, "fiu"), "le": (lax.le, "fiu"), "gt": (lax.gt, "fiu"), "ge": (lax.ge, "fiu"),
    "eq": (lax.eq, "fiu"), "ne": (lax.ne, "fiu"), "and": (lax.bitwise_and, "b"), "or": (lax.bitwise_or, "b"),
}  # fmt: skip
REVERSED = {"radd": "add", "rsub": "sub", "rmul": "mul", "rtruediv": "truediv"}
_EXACT = 2**53  # integers up to there are floating numbers


@contextmanager
def quick_operators() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name in (*OPERATIONS, *REVERSED):
            operation, kinds = OPERATIONS[REVERSED.get(name, name)]
            usual = getattr(ShapedArray, f"_{name}")
            patch.setattr(ShapedArray, f"_{name}", staticmethod(_quick(operation, kinds, usual, name in REVERSED)))
        patch.setattr(ShapedArray, "_getitem", staticmethod(_entry(ShapedArray._getitem)))  # type: ignore[attr-defined]
        yield


def _quick(operation: Any, kinds: str, usual: Callable[..., Any], is_reversed: bool) -> Callable[..., Any]:
    def operator(self: Any, other: Any) -> Any:
        if type(self) is not DynamicJaxprTracer:
            return usual(self, other)
        aval = self.aval
        dtype = aval.dtype
        if dtype.kind not in kinds or aval.weak_type:
            return usual(self, other)
        if type(other) is DynamicJaxprTracer:
            given = other.aval
            fits = given.dtype == dtype and not given.weak_type and given.sharding == aval.sharding
            if not (fits and given.shape == aval.shape):
                return usual(self, other)
        elif type(other) is dtype.type:
            pass
        elif dtype.kind == "f" and (type(other) is float or (type(other) is int and abs(other) <= _EXACT)):
            with np.errstate(over="ignore"):
                other = dtype.type(other)
        else:
            return usual(self, other)
        return operation(other, self) if is_reversed else operation(self, other)

    return _as_of_jax(operator)


def _entry(usual: Callable[..., Any]) -> Callable[..., Any]:
    """``x[i]`` with a number of Python."""

    def operator(self: Any, item: Any) -> Any:
        shape = self.aval.shape
        if type(self) is not DynamicJaxprTracer or type(item) is not int or not shape:
            return usual(self, item)
        at = item + shape[0] if item < 0 else item
        if shape[0] == 1 or not 0 <= at < shape[0]:
            return usual(self, item)
        first, last = (at, *(0 for _ in shape[1:])), (at + 1, *shape[1:])
        return lax.squeeze(lax.slice(self, first, last), (0,))

    return _as_of_jax(operator)


def _as_of_jax(operator: Any) -> Callable[..., Any]:
    """Errors name the line of a user's code that led to an equation: the first one that is not JAX's."""
    operator.__code__ = operator.__code__.replace(co_filename=jax.numpy.__file__)
    return operator
