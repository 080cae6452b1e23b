"""`scan` and `call`: as `jax.lax.scan` and a plain call, but traced over single numbers where that pays."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer

from gsisio_jax._collector import rare_collection
from gsisio_jax._room import with_room
from gsisio_jax.interval import devices
from gsisio_jax.scalar.options import loops_are_functions
from gsisio_jax.scalar.primitive import run
from gsisio_jax.scalar.program import ScalarProgram, scalar_program
from gsisio_jax.scalar.unroll import numbers_in

MOST_NUMBERS = 100_000
"""Numbers that a body may compute, arrays unrolled. Beyond, compiling takes longer than running wins back.

Measured over single numbers and over arrays (two cores shared with other work, linear plants, batch of 2,000): at
74,000 a first call of 17 and 10 s, .62 and 6.8 microseconds a step and box; at 88,000 23 and 10 s, .76 and 8.7; at
136,000 39 and 9 s, 2.1 and 11.5."""

MOST_OF_LONG_RUNS = 250_000
"""The same where so many steps are computed that the seconds of compiling do not count."""

LONG_RUN = 10**7
"""Steps of all cases together from which `MOST_OF_LONG_RUNS` holds.

Measured with 168,000 numbers (eight states, three inputs, a window of five; CPU time of a sweep): over arrays 15
microseconds a step, over numbers 3.6 and 33 s more to compile, in 2.0 GB for .9. That is won back after 3 million."""

_SHAPES = 32  # of kept numbers; NumPy allows 64 axes


def most_numbers(steps: float) -> int:
    """Numbers that a body may compute, for so many steps of all cases together.

    >>> most_numbers(1e3), most_numbers(1e8)
    (100000, 250000)
    """
    return MOST_OF_LONG_RUNS if steps >= LONG_RUN else MOST_NUMBERS


def scan(
    body: Callable[..., Any],
    carry: Any,
    xs: Any,
    length: int | None = None,
    wrap: Callable[..., Any] = lambda step: step,
    most: int | None = None,
) -> tuple[Any, Any]:
    """``jax.lax.scan``. Packed and unpacked once, at the edge: between steps every number is a 0-d value, which
    `jax.vmap` makes a vector over the batch. `wrap` is applied to the step (`jax.checkpoint`, say) where it stays one
    over arrays; over numbers reverse mode keeps nothing but the arguments of a step anyway. `most`: numbers that the
    body may compute (None: `MOST_NUMBERS`)."""
    rows = jax.tree.leaves(xs)
    turns: int = rows[0].shape[0] if length is None else length
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), xs)
    carry = jax.tree.map(jnp.asarray, carry)
    traced = _trace(body, carry, one, most=most)
    if traced is None:
        return devices.scan(in_tasks(wrap(body)), carry, xs, length=turns)
    program, consts, structure = traced
    flat_carry = jax.tree.leaves(carry)
    count = sum(math.prod(leaf.shape) for leaf in flat_carry)

    def step(numbers: Any, row: Any) -> tuple[Any, Any]:
        out = run(program, [*consts, *numbers, *row])
        return tuple(out[:count]), tuple(_apart(out[count:]))

    numbers = tuple(entry for leaf in flat_carry for entry in _entries(leaf, 0))
    columns = tuple(entry for leaf in rows for entry in _entries(leaf, 1))
    everything = devices.agreeing([*consts, *numbers, *columns])
    consts, numbers, columns = _split(everything, len(consts), count)
    last, kept = jax.lax.scan(step, numbers, columns, length=devices.given(turns))
    leaves = program.results
    packed = _packed([*last], leaves[: len(flat_carry)], ()) + _packed(
        [entry.reshape(turns) for entry in kept], leaves[len(flat_carry) :], (turns,)
    )
    return jax.tree.unflatten(structure, packed)


def _split(values: Sequence[Any], first: int, second: int) -> tuple[Any, Any, Any]:
    return values[:first], tuple(values[first : first + second]), tuple(values[first + second :])


def _apart(entries: Sequence[Any]) -> list[Any]:
    """Numbers to be kept, each in a shape of its own: (), (1,), (1, 1) and so on.

    XLA keeps them by writing into arrays over all turns. Arrays of one shape that are written at one place it fuses
    into one operation with several results, which, where a loop is one function, copies them whole at every turn.
    """
    return [jnp.reshape(entry, (1,) * (i % _SHAPES)) for i, entry in enumerate(entries)]


def in_tasks(step: Callable[..., Any]) -> Callable[..., Any]:
    """A step of a scan that XLA does not make one function, whatever XLA_FLAGS allow.

    XLA writes an expression into such a function once for every use of it. Over numbers, uses are few (`repeated`);
    over arrays they multiply from sum to sum: a step of four states with 28 gains took more than 20 GB to compile. A
    loop that sorts stays a sequence of tasks.
    """
    if not loops_are_functions():
        return step

    def turn(carry: Any, row: Any) -> tuple[Any, Any]:
        carry, out = step(carry, row)
        leaves, structure = jax.tree.flatten(carry)
        i = next((i for i, leaf in enumerate(leaves) if jnp.issubdtype(leaf.dtype, jnp.floating) and leaf.size), None)
        if i is None:
            return carry, out
        number = jax.lax.stop_gradient(leaves[i].ravel()[0])
        low, high = jax.lax.sort(jnp.stack([number, number + 1]))
        leaves[i] = jnp.where(low > high, jnp.nan, leaves[i])  # never, which XLA does not know
        return jax.tree.unflatten(structure, leaves), out

    return turn


def call(function: Callable[..., Any], *args: Any) -> Any:
    """``function(*args)``, computed over single numbers."""
    args = jax.tree.map(jnp.asarray, args)
    traced = _trace(function, *args)
    if traced is None:
        return function(*args)
    program, consts, structure = traced
    numbers = [entry for leaf in jax.tree.leaves(args) for entry in _entries(leaf, 0)]
    return jax.tree.unflatten(structure, _packed(run(program, [*consts, *numbers]), program.results, ()))


@with_room
@rare_collection()
def _trace(
    function: Callable[..., Any], *args: Any, most: int | None = None
) -> tuple[ScalarProgram, list[Any], Any] | None:
    """The program, entries of what the function closes over, and the structure of its results; None if too large."""
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*args)
    if numbers_in(closed.jaxpr) > (MOST_NUMBERS if most is None else most):
        return None
    moving = [isinstance(const, Tracer) for const in closed.consts]
    program = scalar_program(closed, moving)
    consts = [c for c, moves in zip(closed.consts, moving, strict=True) if moves]
    return program, [entry for const in consts for entry in _entries(const, 0)], jax.tree.structure(shape)


def _entries(leaf: Any, lead: int) -> list[Any]:
    """The entries of an array behind its first `lead` axes, each an array over those."""
    if leaf.ndim == lead:
        return [leaf]
    flat = leaf.reshape(*leaf.shape[:lead], -1)
    return [jax.lax.index_in_dim(flat, i, lead, keepdims=False) for i in range(flat.shape[lead])]


def _packed(entries: list[Any], leaves: Sequence[jax.ShapeDtypeStruct], lead: tuple[int, ...]) -> list[Any]:
    """Entries, each an array of shape `lead`, as arrays of their shapes behind that."""
    out, start = [], 0
    for leaf in leaves:
        part = entries[start : start + leaf.size]
        start += leaf.size
        if leaf.shape == ():
            out.append(part[0])
        elif part:
            out.append(devices.stack(part, len(lead)).reshape(*lead, *leaf.shape))
        else:
            out.append(jnp.zeros((*lead, *leaf.shape), leaf.dtype))
    return out
