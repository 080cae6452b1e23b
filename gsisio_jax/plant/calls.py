"""How the user's maps are called, and what they may return. Nothing is guessed: what is unclear is refused."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from gsisio_jax.traced import check_trace
from gsisio_jax.tracing import explanation

_POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
_NONE = inspect.Parameter.empty


def takes_u(function: Callable[..., Any], name: str, m: int | None) -> tuple[bool, str]:
    """Is the map called as ``function(x, u)``, or as ``function(x)``? Decided by its signature and by m alone.

    A second parameter without a default is the known input. One with a default is, where there are known inputs
    (m > 0), if it is called ``u``; under any other name it is a parameter of the model and keeps its value.

    Args:
        function: f or g.
        name: "f" or "g".
        m: number of known inputs; None where it is not known yet.

    Returns:
        The answer, and a hint for known inputs that reach nothing: an optional argument that could be meant for them.

    Raises:
        ValueError: it is no function, or cannot be called with x or (x, u).
    """
    if not callable(function):
        raise ValueError(f"System: `{name}` must be a function of x or of (x, u), got {type(function).__name__}")
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # builtins without a signature
        return False, ""
    _check_keywords(function, name, parameters)
    places = [p for p in parameters if p.kind in _POSITIONAL]
    required = [p for p in places if p.default is _NONE]
    many = any(p.kind is inspect.Parameter.VAR_POSITIONAL for p in parameters)
    if len(required) > 2 or not (places or many):
        raise ValueError(
            f"System: `{name}` must take x or (x, u); it takes {len(required)} required arguments "
            f"({', '.join(p.name for p in required)}); bind parameters with functools.partial"
        )
    if len(required) == 2:
        return True, ""
    second = places[1].name if len(places) > 1 else None
    if second is None or second == "u":
        return bool(m) and (second == "u" or many), ""
    return False, f" The optional argument `{second}` is not passed: call it `u` if it is meant."


def _check_keywords(function: Callable[..., Any], name: str, parameters: list[inspect.Parameter]) -> None:
    """Keyword-only arguments are never passed: they must have been bound, or not be the known input."""
    bound = function.keywords if isinstance(function, functools.partial) else {}
    for p in parameters:
        if p.kind is not inspect.Parameter.KEYWORD_ONLY or p.name in bound:
            continue
        if p.default is _NONE or p.name == "u":
            raise ValueError(
                f"System: `{name}` has the keyword-only argument `{p.name}`, which would not be passed. Make the known "
                "input the second positional argument, and bind parameters with functools.partial"
            )


def as_vector(out: Any, size: int, dtype: Any) -> Any:
    """What a map returned, as an array of shape (size,) of the type of x: lists of numbers are stacked, and a single
    number serves where one is asked for. What has another shape is handed back, for the caller to say so."""
    value: Any = out
    if isinstance(out, list | tuple) and len(out) == size and all(jnp.ndim(v) == 0 for v in out):
        value = jnp.stack([jnp.asarray(v) for v in out]) if size else jnp.zeros(0, dtype)
    elif isinstance(out, int | float | complex):
        value = jnp.asarray(out)
    if getattr(value, "shape", None) == () and size == 1:
        value = jnp.reshape(value, (1,))
    kind = getattr(value, "dtype", None)
    real = kind is None or jnp.issubdtype(kind, jnp.inexact)
    return value if real else jax.lax.convert_element_type(value, dtype)


def check_map(name: str, function: Callable[..., Any], size: int, n: int, m: int) -> None:
    """Call a map once with abstract values, and refuse what it returns where that is not (size,) real numbers.

    Raises:
        ValueError: it fails, or returns something else.
    """
    dtype = jnp.result_type(float)
    x, u = jax.ShapeDtypeStruct((n,), dtype), jax.ShapeDtypeStruct((m,), dtype)
    found: list[Any] = []

    def once(x: Any, u: Any) -> None:
        found.append(function(x, u))

    try:
        first, second = (jax.make_jaxpr(lambda x, u: once(x, u))(x, u) for _ in range(2))
    except Exception as error:
        raise ValueError(
            f"System: calling {name} with x of shape ({n},) and u of shape ({m},) failed: {explanation(error)}"
        ) from error
    out = found[0]
    if getattr(out, "shape", None) != (size,):
        got = "nothing (None)" if out is None else getattr(out, "shape", None) or type(out).__name__
        raise ValueError(
            f"System: {name} must return an array of shape ({size},) to fit the rows of "
            f"{'G' if name == 'f' else 'H'}, it returns {() if getattr(out, 'shape', None) == () else got}"
        )
    if not jnp.issubdtype(out.dtype, jnp.floating):
        raise ValueError(
            f"System: {name} must return real numbers, it returns {out.dtype}; write complex states as their real and "
            "imaginary parts"
        )
    check_trace(name, first, second)


class Unhashable:
    """A callable that has no hash, or is a pytree of arrays (an Equinox module), as a static part of a `System`: equal
    to itself alone. Its numbers are watched as those of every map (`captured`)."""

    def __init__(self, function: Callable[..., Any]):
        self.__wrapped__ = function

    def __call__(self, *args: Any) -> Any:
        return self.__wrapped__(*args)

    def __hash__(self) -> int:
        return id(self.__wrapped__)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Unhashable) and self.__wrapped__ is other.__wrapped__

    def __repr__(self) -> str:
        return repr(self.__wrapped__)


def as_static(function: Callable[..., Any]) -> Callable[..., Any]:
    """The map itself, or in `Unhashable` where it cannot be compared."""
    try:
        hash(function)
    except TypeError:
        return Unhashable(function)
    arrays = any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(function))
    return Unhashable(function) if arrays else function


class hashable:
    """A method of an Equinox module that ``jax.jit`` takes. Equinox would make it a pytree, and the hash of that is one
    of the module's arrays, which have none; this is a plain function with the module bound to it."""

    def __init__(self, function: Callable[..., Any]):
        self.function = function
        self.__doc__ = function.__doc__

    def __get__(self, instance: Any, owner: Any = None) -> Any:
        return self.function if instance is None else functools.partial(self.function, instance)
