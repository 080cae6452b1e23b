"""Studies, rollouts of a search and tables of sensitivities without XLA: the same programs, run in NumPy.

Part of `uncompiled`. What has longer records than `MOST` is compiled."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest

from gsisio_jax.observer.fixed import Fixed
from gsisio_jax.scalar.numpy_program import numpy_function
from gsisio_jax.study import kernel
from gsisio_jax.tuning import rollout, sensitivity
from gsisio_jax.tuning.compiled import quickly

MOST = 1000
"""Longer records are compiled: a step takes NumPy a millisecond, or ten where it is one of arrays."""
FEW = 32
"""So many records or cases at most are run one by one: single numbers take a twentieth of what short arrays take."""


def in_numpy(function: Callable[..., Any]) -> Callable[..., Any]:
    """In place of `jax.jit` for large programs that run a few times; traced once for equal shapes."""
    programs: dict[Any, Callable[..., Any]] = {}
    one_at_a_time = threading.Lock()

    def run(*args: Any) -> Any:
        leaves, structure = jax.tree.flatten(args)
        key = structure, tuple((np.shape(leaf), _dtype(leaf)) for leaf in leaves)
        with one_at_a_time:
            if key not in programs:
                programs[key] = numpy_function(function, *args)
        return programs[key](*args)

    return run


_COMPILED = (
    (kernel, "compiled", kernel.compiled),
    (rollout, "_program", rollout._program),
    (sensitivity, "quickly", quickly),
)


def compiled(patch: pytest.MonkeyPatch) -> None:
    """From here on as users have them."""
    for module, name, function in _COMPILED:
        patch.setattr(module, name, function)


def replaced(patch: pytest.MonkeyPatch) -> None:
    """From here on; programs are kept as long as the functions that stand in."""
    by_xla, study = kernel.compiled, cache(_study)

    def run(fixed: Any, varying: Any, shared: Any, rows: Any, reductions: Any, hold: bool, most: int) -> Any:
        case = eqx.combine(jax.tree.map(lambda a: a[0], varying), shared)
        if rows.steps(case) > MOST or any(_is_shared(a) for a in jax.tree.leaves(varying)):
            return by_xla(fixed)(varying, shared, rows, reductions, hold, most)
        one, all_ = study(fixed, rows, reductions, hold, most)
        return _each(one, varying, shared) if _size(varying) <= FEW else all_(varying, shared)

    programs = {True: _gradients(), False: _values()}
    patch.setattr(kernel, "compiled", lambda fixed: partial(run, fixed))
    patch.setattr(rollout, "_program", lambda gradients, small: programs[gradients])
    patch.setattr(sensitivity, "quickly", in_numpy)


def _study(fixed: Any, rows: Any, reductions: Any, hold: bool, most: int) -> tuple[Callable[..., Any], ...]:
    """The study of one case, and of many."""

    def one(varying: Any, shared: Any) -> Any:
        return kernel._case(fixed.value, eqx.combine(varying, shared), rows, reductions, hold, most)

    def many(varying: Any, shared: Any) -> Any:
        return kernel._run(fixed, None, varying, shared, rows, reductions, hold, most)

    return in_numpy(one), in_numpy(many)


def _values() -> Callable[..., Any]:
    @cache
    def of(static: Fixed) -> tuple[Callable[..., Any], ...]:
        return in_numpy(partial(rollout.score_record, static.value)), in_numpy(partial(rollout._values, static, None))

    def run(static: Fixed, traced: None, noise: Any, records: Any, room: Any) -> Any:
        one, many = of(static)
        noise = jax.tree.map(np.asarray, noise)
        flat = np.concatenate([leaf.reshape(len(leaf), -1) for leaf in jax.tree.leaves(noise)], axis=1)
        _, first, back = np.unique(flat, axis=0, return_index=True, return_inverse=True)  # the last one is repeated
        if len(first) * _size(records) > FEW:
            return many(noise, records, room)
        found = [_each(lambda record, i=i: one(_row(noise, i), record, room), records) for i in first]
        return jax.tree.map(lambda *leaves: np.stack(leaves)[back.reshape(-1)], *found)

    return run


def _gradients() -> Callable[..., Any]:
    one = cache(lambda static: in_numpy(partial(rollout._gradient, static.value)))
    return lambda static, traced, noise, records, room, mix: _each(
        lambda record: one(static)(noise, record, room, mix), records
    )


def _each(function: Callable[..., Any], rows: Any, *shared: Any) -> Any:
    """As `jax.vmap` over `rows`, one by one."""
    rows = jax.tree.map(lambda a: a if isinstance(a, jax.Array) else np.asarray(a), rows)
    found = [function(_row(rows, i), *shared) for i in range(_size(rows))]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found)


def _row(rows: Any, i: int) -> Any:
    return jax.tree.map(lambda a: a[i], rows)


def _size(rows: Any) -> int:
    return len(jax.tree.leaves(rows)[0])


def _dtype(leaf: Any) -> Any:
    return getattr(leaf, "dtype", None) or np.asarray(leaf).dtype


def _is_shared(array: Any) -> bool:
    """By several devices."""
    return isinstance(array, jax.Array) and len(array.devices()) > 1
