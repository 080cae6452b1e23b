"""A long record folded into a few numbers, with a gradient that fits the memory.

Reverse-mode differentiation keeps what every step has computed. Here a step keeps nothing but what it hands to the next
one, and a chunk of steps nothing but its start: two levels of `jax.checkpoint`, chunks of sqrt(T) steps. The memory
grows with sqrt(T), the time by two more forward runs. Short records are one chunk: that compiles faster.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from gsisio_jax import scalar
from gsisio_jax._calls import named_arguments
from gsisio_jax.interval import devices
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer import checks, scan
from gsisio_jax.observer.checks import AnyObserver
from gsisio_jax.observer.estimation import OnConflict
from gsisio_jax.observer.fixed import chosen, fixed
from gsisio_jax.plant.system import Noise

SHORT = 512  # steps up to which a record is one chunk


@named_arguments
def fold(
    observer: AnyObserver,
    initial: Interval,
    y: Any,
    update: Callable[..., Any],
    state: Any,
    u: Any = None,
    noise: Noise | None = None,
    on_conflict: OnConflict = "restart",
    length: Any = None,
    rows: Any = None,
) -> Any:
    """Run `estimate` over a record and fold its steps into `state`, without storing any box.

    Made for derivatives of long records: under `jax.grad` the memory grows with the square root of T. Works under
    `jax.jit` (use it: every call traces anew), `jax.vmap`, and forward over reverse.

    Args:
        observer: from `design_observer`.
        initial: box of x[0] before y[0], (n,).
        y: measurements (T, l), NaN where missing.
        update: takes (state, out, k) and returns the next state, of the same types; `out` is the `StepOutput` of step
            k, `k` an integer. Called for k = 0, ..., T - 1. With `rows` it takes (state, out, k, row).
        state: a pytree of arrays.
        u: known inputs (T, m).
        noise: bounds at run time; None takes those of the design.
        on_conflict: as in `estimate`.
        length: number of rows of `y` that count; `update` does not see the rows behind.
        rows: a pytree of arrays (T, ...) whose row k is handed to `update`: a logged truth, say.

    Returns:
        The last state.

    Raises:
        ValueError: as `estimate`.

    Source: theory 5.
    """
    initial, y, u, noise, observer = checks.prepare("fold", observer, initial, y, u, noise, rows=True)
    if length is not None:
        checks.check_length(length, y.shape[0])
        y = scan.cut(y, length)
    hold = checks.check_on_conflict("fold", on_conflict)
    return fold_rows(observer, initial, y, u, noise, update, state, hold=hold, length=length, rows=rows)


def fold_rows(
    observer: AnyObserver,
    initial: Interval,
    y: Any,
    u: Any,
    noise: Noise,
    update: Callable[..., Any],
    state: Any,
    *,
    hold: bool = False,
    length: Any = None,
    rows: Any = None,
) -> Any:
    """`fold` without its checks: everything in its final type and shape, rows behind `length` already missing."""
    observer = chosen(*fixed(observer))
    given = () if rows is None else (rows,)
    carry, out = scan.begin(observer, initial, y[0], u[0], scan.noise_at(noise, 0), hold)
    state = _like(state, update(state, out, jnp.int32(0), *jax.tree.map(lambda a: a[0], given)))
    steps = y.shape[0] - 1
    if not steps:
        return state
    last = jnp.int32(y.shape[0]) if length is None else length

    # A scan keeps what its body hands on; what the body computes besides is computed again in the backward run.
    def step(both: Any, row: Any) -> tuple[Any, None]:
        carry, state = both
        k, y_k, u_k, now, given = row
        carry, out = scan.advance(observer, carry, y_k, u_k, scan.noise_of_row(noise, now), hold)
        after = _like(state, update(state, out, k, *given))
        return (carry, jax.tree.map(lambda a, b: jnp.where(k < last, a, b), after, state)), None

    size = chunk_size(steps)
    chunks = -(-steps // size)
    spare = chunks * size - steps  # steps behind the end, whose results are not taken

    def fit(a: Any) -> Any:
        return jnp.concatenate([a[1:], a[-1:].repeat(spare, 0)]).reshape(chunks, size, *a.shape[1:])

    k = jnp.arange(y.shape[0] + spare, dtype=jnp.int32)[1:].reshape(chunks, size)
    rest = jax.tree.map(fit, (y, u, scan.noise_rows(noise), given))
    rows = (k, *rest)
    if chunks == 1:
        (_, state), _ = scalar.scan(step, (carry, state), jax.tree.map(lambda a: a[0], rows), wrap=_forget)
        return state

    @_forget
    def chunk(both: Any, rows: Any) -> tuple[Any, None]:
        return scalar.scan(step, both, rows, wrap=_forget)

    (_, state), _ = devices.scan(chunk, (carry, state), rows)
    return state


def chunk_size(steps: int) -> int:
    """Steps per chunk: the square root, so that as many chunk starts are kept as steps in a chunk; short records whole.

    >>> chunk_size(9_999), chunk_size(511)
    (100, 511)
    """
    return steps if steps <= SHORT else round(steps**0.5)


def _forget(body: Callable[..., Any]) -> Callable[..., Any]:
    # A scan already keeps XLA from merging the second computation with the first.
    return jax.checkpoint(body, prevent_cse=False)


def _like(before: Any, after: Any) -> Any:
    """The next state in the types of the one before: a scan must not change them."""
    return jax.tree.map(lambda a, b: jnp.asarray(b, jnp.result_type(a)), before, after)
