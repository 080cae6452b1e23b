"""What tells one f or g from another: the program that JAX traces of it, line by line, and values at some points."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np

POINTS = 16
"""At which a map is evaluated."""
_ADDRESS = re.compile(r" at 0x[0-9a-f]+")
_PLACEMENT = re.compile(r".*(shardings?|layouts?|mesh|compiler_options_kvs|donated_invars|keep_unused|inline)$")
"""Parameters that say where and how an operation runs, and not what it gives."""


def program(function: Any, n: int, m: int) -> list[str]:
    """The operations of ``function(x, u)``, one a line, with the numbers that it holds (arrays by their digest).

    Equal lines are equal functions, also in another process; names of variables and lines of source do not matter.
    """
    dtype = jnp.result_type(float)
    closed = jax.make_jaxpr(lambda x, u: function(x, u))(
        jax.ShapeDtypeStruct((n,), dtype), jax.ShapeDtypeStruct((m,), dtype)
    )
    return lines(closed)


def lines(closed: Any) -> list[str]:
    """`program` of what JAX has traced already, jaxprs inside of it and their arrays included."""
    return list(_lines(closed, {}))


def points(lower: np.ndarray, upper: np.ndarray, rows: int = POINTS) -> np.ndarray:
    """Points of a box, (rows, n), the same every time; sides that are infinite count as 10 long."""
    lower, upper = (np.asarray(side, np.float64) for side in (lower, upper))
    low = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper - 10.0, -5.0))
    high = np.where(np.isfinite(upper), upper, low + 10.0)
    return low + np.random.default_rng(0).uniform(0.0, 1.0, (rows, len(low))) * (high - low)


def values(function: Any, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """``function`` at every row of x and u, (rows, size)."""
    return np.asarray(jax.vmap(lambda x, u: function(x, u))(jnp.asarray(x), jnp.asarray(u)), np.float64)


def first_difference(ours: list[str], theirs: list[str]) -> str:
    """Where two programs part."""
    for number, (mine, other) in enumerate(zip(ours, theirs, strict=False)):
        if mine != other:
            return f"operation {number + 1} is `{_short(other)}` in the file and `{_short(mine)}` here"
    return f"it has {len(theirs)} operations in the file and {len(ours)} here"


def _short(line: str) -> str:
    return line if len(line) <= 100 else f"{line[:97]}..."


def _lines(closed: Any, names: dict[Any, str]) -> Iterator[str]:
    """Of a jaxpr, closed or open; `names` gives every variable a number in order of appearance."""
    jaxpr = getattr(closed, "jaxpr", closed)
    for var in jaxpr.invars:
        yield f"in {_named(var, names)}"
    for var, constant in zip(jaxpr.constvars, getattr(closed, "consts", ()), strict=False):
        yield f"constant {_named(var, names)} = {_number(constant)}"
    for eqn in jaxpr.eqns:
        inputs = ", ".join(_atom(atom, names) for atom in eqn.invars)
        outputs = ", ".join(_named(var, names) for var in eqn.outvars)
        inner: list[Any] = []
        params = [(key, eqn.params[key]) for key in sorted(eqn.params) if not _PLACEMENT.match(key)]
        settings = ", ".join(f"{key}={_setting(value, inner)}" for key, value in params)
        yield f"{outputs} = {eqn.primitive.name}({inputs})[{settings}]"
        for part in inner:
            yield from (f"  {line}" for line in _lines(part, {}))
    yield f"out {', '.join(_atom(atom, names) for atom in jaxpr.outvars)}"


def _named(var: Any, names: dict[Any, str]) -> str:
    aval = var.aval
    return f"{names.setdefault(var, f'v{len(names)}')}:{aval.dtype}{list(aval.shape)}"


def _atom(atom: Any, names: dict[Any, str]) -> str:
    return _number(atom.val) if isinstance(atom, jex.Literal) else _named(atom, names)


def _number(value: Any) -> str:
    array = np.asarray(value)
    if array.ndim == 0:
        return f"{array.dtype}({array[()]!s})"
    digest = hashlib.blake2b(np.ascontiguousarray(array).tobytes(), digest_size=12).hexdigest()
    return f"{array.dtype}{list(array.shape)} {digest}"


def _setting(value: Any, inner: list[Any]) -> str:
    """A parameter of an operation as text; the programs in it go to `inner`."""
    if hasattr(getattr(value, "jaxpr", value), "eqns"):
        inner.append(value)
        return "program"
    if isinstance(value, tuple | list):
        return f"({', '.join(_setting(part, inner) for part in value)})"
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return _number(value)
    if callable(value) and not isinstance(value, type):
        return "function"  # of derivatives, which the value does not depend on
    return _ADDRESS.sub("", repr(value))
