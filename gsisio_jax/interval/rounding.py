"""Outward rounding: the error model of the machine, and the few operations that every bound here is widened with.

**Model.** For +, -, *, / and the square root the result on the machine is ``exact (1 + a) + b`` with ``|a| <= 2 u``,
``|b| <= tiny``: u = eps / 2 is the unit roundoff and tiny the smallest normal number. IEEE arithmetic gives a = u and b
< tiny. The rest of the room is for what XLA makes of a program: ``x / c`` becomes ``x * (1 / c)`` (a second rounding),
``a b + c`` is contracted (one rounding less), constants are reassociated (their sum rounds once), and numbers below
tiny are flushed to zero, on their way in or out (b). Fast-math and tf32 are outside of this model; matrix products ask
for the full precision of their type (`primitives.matmul`), so no flag brings tf32 in. A subnormal constant or
measurement counts as zero.

**Widening.** ``down(x) = x - (c |x| + t)`` with ``c = ulps * eps`` and ``t = 4 tiny``: three operations and no
`nextafter`. For an x that is off by ``2 u |x| + tiny`` (one operation), ``ulps = 2`` proves ``down(x) <= exact``: the
machine's value of ``c |x| + t`` is at least ``(1 - 4 u) (c |x| + t) - tiny``, the last subtraction adds at most
``u |result| + tiny``, and ``2 u + u (1 + c) + 4 u c <= c = 4 u`` up to ``O(u^2) |x|``, which the slack of u |x| covers,
as ``t`` covers the three flushed numbers. It holds where the widening is contracted or reassociated, too.

**Sums.** n terms, each with a relative error of at most 4 u (a product, of a factor that is itself known to one
rounding), added in any order: ``(n + 3) u sum |terms|`` and ``n tiny``, up to second order. `sum_down` takes
``(n + 4) eps`` and ``(n + 4) tiny``, twice of that.

**Overflow.** ``down(inf)`` is NaN, and so is every bound that is computed from it: sums, products, minima and maxima
hand a NaN on. `unbounded` turns it into "no bound" where a box is looked at (at every node of a function, and wherever
boxes are intersected): a side that overflowed is infinite, never a wrong number.

Gradients pass as if nothing had been widened: the widening is added as a constant.

`using("nearest")` switches all of it off while a function is traced, to compare speed; nothing is then guaranteed.

Source: theory 10.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial, wraps
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gsisio_jax.interval.direct import absolute, minus, multiple_and_more, plus, where
from gsisio_jax.interval.primitives import add_up, fusion_barrier

Rounding = Literal["outward", "nearest"]
_MODE: ContextVar[str] = ContextVar("gsisio_jax_rounding", default="outward")
_NORMAL: ContextVar[bool] = ContextVar("gsisio_jax_normal", default=False)
_FLOOR = 4.0  # smallest normal numbers that every widening adds
_FEW = 10_000  # entries; more stay where they are, on the device
FLUSHED = 2.0**60
"""Smallest normal numbers that cover whatever is lost where the terms of a sum are flushed to zero; see `generous`."""


def check_rounding(call: str, rounding: str) -> None:
    """Refuse anything but "outward" and "nearest".

    Raises:
        ValueError: `rounding` is something else.
    """
    if rounding not in ("outward", "nearest"):
        raise ValueError(f'{call}: `rounding` must be "outward" or "nearest", got {rounding!r}')


@contextmanager
def using(rounding: Rounding) -> Iterator[None]:
    """Trace what follows with this rounding."""
    check_rounding("rounding.using", rounding)
    token = _MODE.set(rounding)
    try:
        yield
    finally:
        _MODE.reset(token)


def outward() -> bool:
    """Are bounds widened, in the function that is being traced?"""
    return _MODE.get() == "outward"


def by_observer(step: Callable[..., Any]) -> Callable[..., Any]:
    """Run a function of an observer with that observer's rounding."""

    @wraps(step)
    def run(observer: Any, *args: Any, **options: Any) -> Any:
        # What comes in has been through `Interval.astype`, and arithmetic makes no subnormal numbers.
        token = _NORMAL.set(True)
        try:
            with using(observer.rounding):
                return step(observer, *args, **options)
        finally:
            _NORMAL.reset(token)

    return run


def rounded_by(call: str, rounding: Rounding | None) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: the function runs with that rounding; None leaves the one that is in force, outward if none is."""
    if rounding is None:
        return lambda function: function
    check_rounding(call, rounding)

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def run(*args: Any, **options: Any) -> Any:
            with using(rounding):
                return function(*args, **options)

        return run

    return decorate


def as_nearest(function: Callable[..., Any]) -> Callable[..., Any]:
    """For functions that return values and not bounds."""

    @wraps(function)
    def run(*args: Any, **options: Any) -> Any:
        with using("nearest"):
            return function(*args, **options)

    return run


def error(size: Any, ulps: Any = 2.0, floor: float = _FLOOR) -> Any:
    """``ulps eps size + floor tiny`` for ``size >= 0``, a constant for gradients."""
    info = jnp.finfo(size.dtype)
    kind = np.dtype(size.dtype).type
    share = kind(ulps * float(info.eps)) if isinstance(ulps, float | int) else ulps * kind(info.eps)
    least = kind(floor * float(info.tiny))
    wide = multiple_and_more(size, share, least)
    return wide if isinstance(size, np.ndarray | np.generic) else jax.lax.stop_gradient(wide)


def down(x: Any, ulps: Any = 2.0, floor: float = _FLOOR) -> Any:
    """A number at or below every number that x may stand for, if x is off by ``(ulps - 1) eps |x| + tiny`` at most."""
    if not outward() or not jnp.issubdtype(x.dtype, jnp.floating):
        return x
    return minus(x, error(absolute(x), ulps, floor))


def up(x: Any, ulps: Any = 2.0, floor: float = _FLOOR) -> Any:
    """A number at or above every number that x may stand for; see `down`."""
    if not outward() or not jnp.issubdtype(x.dtype, jnp.floating):
        return x
    return plus(x, error(absolute(x), ulps, floor))


def lowered(x: Any, size: Any, ulps: Any, floor: float = _FLOOR) -> Any:
    """`down` for an x whose error goes with `size`, the sum of what entered it, instead of with ``|x|``."""
    return minus(x, error(size, ulps, floor)) if outward() else x


def raised(x: Any, size: Any, ulps: Any, floor: float = _FLOOR) -> Any:
    """`up` with `size`; see `lowered`."""
    return plus(x, error(size, ulps, floor)) if outward() else x


def generous(radius: Any) -> Any:
    """An upper bound of a radius that was itself computed to nearest, as a sum of products of nonnegative numbers.

    Relative errors of such numbers add up: with fewer than ``2^12`` operations on the way to any of them they stay
    below ``2^-10`` (float32: ``2^12 2^-23``; float64 has room to spare). A product that is flushed to zero loses tiny,
    and fewer than ``2^60`` are added; where a radius is multiplied once more, what it lost before has been added to it
    already, here. For radii that stand for rounding themselves, where a share of a
    thousandth is nothing.
    """
    kind = np.dtype(radius.dtype).type
    least = kind(FLUSHED * float(jnp.finfo(radius.dtype).tiny))
    return fusion_barrier(multiple_and_more(radius, kind(1 + 2.0**-10), least))


def sum_down(terms: Any, axis: int = -1) -> Any:
    """Lower bound of the sum of terms that are products; ``-inf`` where a term is, NaN where the sum overflows."""
    total = add_up(terms, axis)
    if not outward() or not terms.shape[axis]:
        return fusion_barrier(total)
    n = terms.shape[axis] + 4.0
    return fusion_barrier(minus(total, error(add_up(absolute(terms), axis), n, n)))


def sum_up(terms: Any, axis: int = -1) -> Any:
    """Upper bound of the sum of terms that are products; see `sum_down`."""
    total = add_up(terms, axis)
    if not outward() or not terms.shape[axis]:
        return fusion_barrier(total)
    n = terms.shape[axis] + 4.0
    return fusion_barrier(plus(total, error(add_up(absolute(terms), axis), n, n)))


def unbounded(x: Any, side: float) -> Any:
    """``side`` (-inf for lower bounds, inf for upper ones) where x is NaN or infinite on the wrong side."""
    end = np.dtype(x.dtype).type(side)
    if isinstance(x, np.ndarray | np.generic):
        return np.where(x < -end if side < 0 else x > -end, x, end)
    return where((jax.lax.lt if side < 0 else jax.lax.gt)(x, -end), x, end)


# Numbers that are known while tracing ---------------------------------------------------------------------------------
# NumPy is IEEE: one rounding, no flushing. So one step to the neighbour is enough, and none where the result is exact.
def known_sum(x: Any, y: Any) -> tuple[Any, Any]:
    """Lower and upper bound of ``x + y`` for NumPy arrays: the very same array where every sum is exact."""
    with np.errstate(all="ignore"):
        total = np.asarray(x + y)
        part = total - x
        lost = (x - (total - part)) + (y - part)
        return _neighbours(total, lost)


def known_product(x: Any, y: Any) -> tuple[Any, Any]:
    """Lower and upper bound of ``x * y`` for NumPy arrays, ``0 * inf = 0``; one array where every product is exact."""
    with np.errstate(all="ignore"):
        product = np.asarray(x * y)
        nothing = np.equal(x, 0) | np.equal(y, 0)
        product = np.where(nothing, product.dtype.type(0), product)
        if product.dtype != np.float64:
            return _neighbours(product, np.where(nothing, 0, np.float64(x) * np.float64(y) - product))
        (a, b), (c, d) = _halves(x), _halves(y)
        lost = ((a * c - product) + a * d + b * c) + b * d
        small = (np.abs(product) < 1e-290) & (np.not_equal(x, 0) & np.not_equal(y, 0))
        return _neighbours(product, np.where(nothing, 0, np.where(small, np.nan, lost)))


def _halves(x: Any) -> tuple[Any, Any]:
    """Veltkamp's split of a float64 into two numbers of 26 bits."""
    x = np.asarray(x)
    large = x * 134217729.0
    high = large - (large - x)
    return high, x - high


def _neighbours(value: Any, lost: Any) -> tuple[Any, Any]:
    """The value where nothing was lost, else (also where that is unknown) its neighbours."""
    exact = (lost == 0) | np.isinf(value)
    if exact.all() or not outward():
        return value, value
    lower = np.where(exact, value, np.nextafter(value, value.dtype.type(-np.inf)))
    upper = np.where(exact, value, np.nextafter(value, value.dtype.type(np.inf)))
    # The neighbour of a number near zero is subnormal, which compiled code takes for zero.
    tiny = np.finfo(value.dtype).tiny
    lower = np.where((lower != 0) & (np.abs(lower) < tiny), np.where(lower < 0, -tiny, 0), lower)
    return lower, np.where((upper != 0) & (np.abs(upper) < tiny), np.where(upper > 0, tiny, 0), upper)


def normal(lower: Any, upper: Any) -> tuple[Any, Any]:
    """Bounds without subnormal numbers, moved outward: compiled code would take them for zero."""
    if not outward() or _NORMAL.get():
        return lower, upper
    return _normal(lower, -1.0), _normal(upper, 1.0)


def _normal(x: Any, side: float) -> Any:
    if isinstance(x, np.ndarray | np.generic):
        x = np.asarray(x)
        tiny = float(np.finfo(x.dtype).tiny)
        outward_side = np.where(x * side > 0, x.dtype.type(side * tiny), x.dtype.type(0))
        return np.where((x != 0) & (np.abs(x) < tiny), outward_side, x)
    if not isinstance(x, Tracer) and x.size < _FEW:
        # Looked at in NumPy, as a program would be compiled for every shape; there is hardly ever anything to change.
        given = np.asarray(x)
        if not ((given != 0) & (np.abs(given) < np.finfo(given.dtype).tiny)).any():
            return x
    return _normal_bits(x, side)


@partial(jax.jit, static_argnames="side", inline=True)
def _normal_bits(x: Any, side: float) -> Any:
    """By its bits: a comparison may already see zero. One program where x is given, not one for each operation."""
    tiny = float(jnp.finfo(x.dtype).tiny)
    kind = jnp.int64 if x.dtype == jnp.float64 else jnp.int32
    fixed = jax.lax.stop_gradient(x)
    bits = jax.lax.bitcast_convert_type(fixed, kind)
    size = jnp.bitwise_and(bits, np.iinfo(kind).max)
    smallest = np.asarray(tiny, x.dtype).view(kind)
    subnormal = (size > 0) & (size < smallest)
    outside = (bits > 0) if side > 0 else (bits < 0)
    return jnp.where(subnormal, jnp.where(outside, side * tiny, 0.0), x)


def overflowed(x: Any) -> Any:
    """A lower bound of a number that overflowed to ``inf`` by itself: a quarter of the largest number."""
    return jnp.minimum(x, float(jnp.finfo(x.dtype).max) / 4)
