"""Numbers and arrays that a map reads from around it: a change of them behind the back of a `System` is an error.

A design and the compiled programs hold the numbers that were there when the system was made. Code that changes an
array in place, or gives a name another value, would leave gains of the old model beside bounds of the new one, and
boxes that miss the truth without a word.
"""

from __future__ import annotations

import dis
import functools
import hashlib
import inspect
from collections.abc import Callable, Iterator
from types import CodeType, FunctionType, MethodType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

Captured = tuple[tuple[str, str], ...]
_DEEPEST = 4  # functions that call functions, containers in containers


def captured(function: Callable[..., Any]) -> Captured:
    """Name and fingerprint of every number and array that the function reads from its closure, its module, its
    defaults, its object or its partial arguments; functions of the same module that it calls are looked into."""
    found: dict[str, str] = {}
    seen: set[int] = set()
    for name, value in _surroundings(function, seen, _DEEPEST):
        found.setdefault(name, _fingerprint(value))
    return tuple(sorted(found.items()))


def changed(function: Callable[..., Any], before: Captured) -> list[str]:
    """Names whose values are no longer what they were."""
    now = dict(captured(function))
    return [name for name, value in before if now.get(name, value) != value]


def _surroundings(value: Any, seen: set[int], depth: int) -> Iterator[tuple[str, Any]]:
    if depth < 0 or id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, functools.partial):
        yield from _surroundings(value.func, seen, depth - 1)
        named = {**{f"argument {i + 1}": v for i, v in enumerate(value.args)}, **value.keywords}
        yield from _members(named, seen, depth)
    elif isinstance(value, MethodType):
        yield from _surroundings(value.__func__, seen, depth - 1)
        yield from _members(_attributes(value.__self__), seen, depth)
    elif isinstance(value, FunctionType):
        yield from _members(_read_by(value), seen, depth)
    elif callable(value) and hasattr(value, "__wrapped__"):
        yield from _surroundings(inspect.unwrap(value), seen, depth - 1)
    elif callable(value) and not isinstance(value, type):
        yield from _members(_attributes(value), seen, depth)


def _read_by(function: FunctionType) -> dict[str, Any]:
    """What a function finds by name outside of itself, without the names that it gives values to (a counter)."""
    code, names = function.__code__, {}
    read, stored = _names(code)
    for name in read & set(function.__globals__):
        names[name] = function.__globals__[name]
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        try:
            names[name] = cell.cell_contents
        except ValueError:  # not filled yet
            continue
    positional = code.co_varnames[: code.co_argcount]
    defaults = function.__defaults__ or ()
    names.update(zip(positional[len(positional) - len(defaults) :], defaults, strict=True))
    names.update(function.__kwdefaults__ or {})
    return {name: value for name, value in names.items() if name not in stored}


@functools.lru_cache(maxsize=256)  # the code of a function does not change, and every call of `estimate` asks
def _names(code: CodeType) -> tuple[frozenset[str], frozenset[str]]:
    read, stored = set(), set()
    for step in dis.get_instructions(code):
        if step.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            read.add(step.argval)
        elif step.opname in ("STORE_GLOBAL", "STORE_DEREF"):
            stored.add(step.argval)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            inner = _names(constant)
            read |= inner[0]
            stored |= inner[1]
    return frozenset(read), frozenset(stored)


def _attributes(value: Any) -> dict[str, Any]:
    return getattr(value, "__dict__", {})


def _members(names: dict[Any, Any], seen: set[int], depth: int) -> Iterator[tuple[str, Any]]:
    for name, value in names.items():
        if isinstance(value, np.ndarray | np.generic | float | int | complex | jax.Array):
            if not isinstance(value, Tracer) and getattr(value, "dtype", None) != np.dtype(object):
                yield str(name), value
        elif depth <= 0:
            continue
        elif isinstance(value, tuple | list):
            yield from _members({f"{name}[{i}]": v for i, v in enumerate(value)}, seen, depth - 1)
        elif isinstance(value, dict):
            yield from _members({f"{name}[{key!r}]": v for key, v in value.items()}, seen, depth - 1)
        elif not inspect.ismodule(value) and not _foreign(value):
            yield from _surroundings(value, seen, depth - 1)


def _foreign(value: Any) -> bool:
    """From a library: its insides are its own affair."""
    module = getattr(value, "__module__", None) or type(value).__module__
    return module.split(".")[0] in ("jax", "jaxlib", "numpy", "scipy", "equinox", "builtins", "gsisio_jax")


def _fingerprint(value: Any) -> str:
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        value = jax.random.key_data(value)
    array = np.asarray(value)
    digest = hashlib.blake2b(np.ascontiguousarray(array).tobytes(), digest_size=12).hexdigest()
    return f"{array.dtype}{array.shape}{digest}"
