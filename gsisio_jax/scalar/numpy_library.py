"""What NumPy programs give to JAX, one operation at a time: transcendental functions, and what is not written here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import jax
import numpy as np

_OF_EVERY_ENTRY = {
    "acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "cos", "cosh", "digamma", "erf", "erf_inv",
    "erfc", "exp", "exp2", "expm1", "lgamma", "log", "log1p", "logistic", "pow", "rsqrt", "sin", "sinh", "tan", "tanh",
}  # fmt: skip
_SHORTEST, _LONGER = 16, 4


def given_to_jax(primitive: Any, params: dict[str, Any], given: Sequence[Any]) -> Callable[..., Sequence[Any]]:
    """The operation of these parameters on arguments of these shapes and types."""
    by_jax, several = _by_jax(primitive, tuple(params.items())), primitive.multiple_results

    def bound(*args: Any) -> Sequence[Any]:
        out = by_jax(*args)
        return [plain(value) for value in (out if several else [out])]

    alike = given and given[0].shape and len({kind.shape for kind in given}) == 1
    return _in_few_lengths(bound) if primitive.name in _OF_EVERY_ENTRY and alike else bound


def _in_few_lengths(function: Callable[..., Sequence[Any]]) -> Callable[..., Sequence[Any]]:
    """Arrays become vectors, filled up to one of few lengths: JAX compiles a program for every one of them."""

    def run(*args: Any) -> Sequence[Any]:
        shape, length, whole = args[0].shape, args[0].size, _SHORTEST
        while whole < length:
            whole *= _LONGER
        vectors = [np.concatenate([np.ravel(arg), np.ones(whole - length, arg.dtype)]) for arg in args]
        return [found[:length].reshape(shape) for found in function(*vectors)]

    return run


def plain(value: Any, dtype: Any = None) -> Any:
    """As an array of NumPy, which has no random keys: those stay what they are."""
    kind = getattr(value, "dtype", None)
    return np.asarray(value, dtype) if kind is None or isinstance(kind, np.dtype) else value


def _by_jax(primitive: Any, params: tuple[tuple[str, Any], ...]) -> Callable[..., Any]:
    try:
        return _jitted(primitive, params)
    except TypeError:  # parameters that have no hash
        return lambda *args: primitive.bind(*map(plain, args), **dict(params))


@lru_cache(512)
def _jitted(primitive: Any, params: tuple[tuple[str, Any], ...]) -> Callable[..., Any]:
    """One for equal operations: a third of what `bind` takes."""
    return jax.jit(lambda *args: primitive.bind(*args, **dict(params)))
