"""What JAX says where a user's function cannot be traced, on one line and with the remedy."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import jax

_REMEDIES = (
    (
        jax.errors.TracerArrayConversionError,
        "Use jax.numpy in the place of numpy (jnp.sin, not np.sin): JAX has to follow what is computed",
    ),
    (
        jax.errors.TracerBoolConversionError,
        "Python's `if`, `while`, `and`, min() and max() cannot depend on x; use jnp.where, jnp.logical_and, "
        "jnp.minimum, jax.lax.cond",
    ),
    (
        (jax.errors.TracerIntegerConversionError, jax.errors.NonConcreteBooleanIndexError),
        "An index, a size or a number of turns cannot depend on x; use jnp.where, jnp.interp or jnp.take",
    ),
    (
        jax.errors.ConcretizationTypeError,
        "float(x), int(x), x.item() and the functions of `math` cannot be followed by JAX; use jnp (jnp.sin, not "
        "math.sin), and jnp.where in the place of `if`",
    ),
)
_BY_WORDS = (
    ("immutable", "Write x.at[0].set(value), or stack the entries: jnp.stack([...])"),
    ("out of bounds", "x has one entry per row of G, u one per known input"),
    ("shape", "x has one entry per row of G, u one per known input"),
    ("to unpack", "x has one entry per row of G, u one per known input"),
    ("converted to a scalar index", "An index, a size or a number of turns cannot depend on x; use jnp.where"),
    (
        "unsupported format string",
        "What depends on x cannot be written as text here; jax.debug.print can",
    ),
    ("can be converted to Python scalars", "Use jnp (jnp.sin, not math.sin)"),
)


def explanation(error: Exception) -> str:
    """The first line of an error, and what to do about it where that is known."""
    text = str(error).strip().split("\n")[0].split(": https://")[0].rstrip(".") or type(error).__name__
    known = next((remedy for kinds, remedy in _REMEDIES if isinstance(error, kinds)), None)
    known = known or next((remedy for words, remedy in _BY_WORDS if words in str(error)), None)
    return f"{text}." + (f" {known}" if known else "")


@contextlib.contextmanager
def explained(what: str) -> Iterator[None]:
    """Turn what JAX raises of a traced number into a `ValueError`; everything else passes."""
    try:
        yield
    except tuple(kind for kinds, _ in _REMEDIES for kind in (kinds if isinstance(kinds, tuple) else (kinds,))) as error:
        raise ValueError(f"{what} failed: {explanation(error)}") from error
