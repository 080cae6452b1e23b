"""Flags of nodes that may be no number.

Where a function has no real value in part of a box, its rule cuts that part away: bounds are of the real values. That
is sound for whatever is computed from them, as it is no number there either, but not for what looks: ``isnan``,
comparisons (false of NaN), casts to integers, places of the largest entry (`nans`). So nodes that come of an operation
with a restricted domain carry flags: traced truth values, one for a whole array, "some entry may be NaN, or infinite at
a pole". All other operations pass them on. Nodes of a function without such an operation carry none, and nothing is
computed for them.

NaN that come of overflow (``inf - inf``) are not followed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.form_arithmetic import known_if_concrete
from gsisio_jax.inclusion.node import is_node
from gsisio_jax.interval.box import is_concrete

_MOST_FLAGS = 8  # of a node; beyond, they are joined to one


def flags_of(value: Any) -> tuple[Any, ...]:
    """The flags of a node or a constant."""
    if is_node(value):
        return getattr(value, "nan_flags", ())
    if is_concrete(value) and jnp.issubdtype(jnp.result_type(value), jnp.floating):
        return (np.True_,) if np.isnan(known_if_concrete(value)).any() else ()
    return ()


def may_be_nan(values: Iterable[Any]) -> Any:
    """One truth value for all of them; None: certainly not."""
    return joined(_all_flags(values))


def _all_flags(values: Iterable[Any]) -> tuple[Any, ...]:
    return tuple({id(one): one for value in values for one in flags_of(value)}.values())


def joined(flags: Sequence[Any]) -> Any:
    found = None
    for one in flags:
        found = one if found is None else found | one
    return found


def flag(values: Iterable[Any], flags: Sequence[Any]) -> None:
    """Note on nodes of floating type that they may be NaN if one of the flags holds."""
    for value in values:
        if flags and is_node(value) and jnp.issubdtype(value.dtype, jnp.floating):
            both = {id(one): one for one in (*flags_of(value), *flags)}
            kept = tuple(both.values())
            kept = kept if len(kept) <= _MOST_FLAGS else (joined(kept),)
            object.__setattr__(value, "nan_flags", kept)


def pass_on(operands: Iterable[Any], results: Iterable[Any]) -> None:
    """Note that results are computed from operands."""
    operands = list(operands)
    flags = _all_flags(operands)
    if flags:
        flag([v for v in results if not any(v is w for w in operands)], flags)
