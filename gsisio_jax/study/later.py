"""Observers with a delay in a study: the box of step k comes at row k + L, so what it is held against waits until then.

Source: theory 5.9.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.observer.checks import AnyObserver
from gsisio_jax.observer.delayed import DelayedObserver
from gsisio_jax.study.axes import bare
from gsisio_jax.study.row_source import Row, Rows


def delay_of(observer: AnyObserver) -> int:
    """L, 0 for an observer without a delay."""
    return observer.delay if isinstance(observer, DelayedObserver) else 0


def check_longer(call: str, observer: AnyObserver, steps: int, length: Any) -> None:
    """Raises ValueError where a record has no step with all its measurements."""
    delay, shortest = delay_of(observer), steps if length is None else min(steps, int(np.min(bare(length))))
    if shortest <= delay:
        later = f"{delay} step{'s' if delay > 1 else ''} later"
        raise ValueError(
            f"{call}: a box needs measurements up to {later}, so records must have at least {delay + 1} rows; got "
            f"{shortest}"
        )


def waiting(row: Row, delay: int) -> Any:
    """The truth of the last L rows, oldest first: before the record there is none, and zeros stand in for it."""
    return jax.tree.map(lambda a: jnp.zeros((delay, *a.shape), a.dtype).at[-1].set(a), (row.x, row.d))


def exchange(kept: Any, row: Row) -> tuple[tuple[Any, Any], Any]:
    """The truth of L rows ago, and what waits now."""
    joined = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), kept, (row.x, row.d))
    return jax.tree.map(lambda a: a[0], joined), jax.tree.map(lambda a: a[1:], joined)


def longer(source: Rows, case: Any, delay: int) -> Any:
    """What rows 1..T-1+L have at hand: the last L are missing, so their numbers do not count."""

    def filled(a: Any) -> Any:
        return jnp.pad(a, [(0, delay), *[(0, 0)] * (a.ndim - 1)], mode="edge" if len(a) else "constant")

    return jax.tree.map(filled, source.given(case))


def following(source: Rows, observer: AnyObserver, case: Any, carried: Any, k: Any, given: Any) -> tuple[Row, Any]:
    """Row k; behind the end of the record its measurements are missing, and the source stands still."""
    row, after = source.following(observer, case, carried, k, given)
    inside = k < source.steps(case)
    after = jax.tree.map(lambda a, b: jnp.where(inside, a, b), after, carried)
    return row._replace(y=jnp.where(inside, row.y, jnp.nan)), after
