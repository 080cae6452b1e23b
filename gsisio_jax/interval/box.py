"""Boxes: the one data type that every other module passes around.

A box is a pair of arrays ``lower <= upper`` of equal shape. Infinite sides are legal (a half-line, all of R^n); NaN and
crossed bounds are not. Arithmetic here follows the conventions of interval analysis: ``0 * inf = 0``, and no operation
on legal boxes returns NaN. Results are rounded outward (see `rounding`). Everything is differentiable: infinite sides
never enter a product that a gradient flows through, because ``0 * inf`` in a backward pass would be NaN.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gsisio_jax._calls import named_arguments
from gsisio_jax.interval import rounding
from gsisio_jax.interval.cast import cast_down, cast_known, cast_up, floating_type
from gsisio_jax.interval.direct import absolute, minus, plus, where
from gsisio_jax.interval.minmax import cut, larger, raised, smaller
from gsisio_jax.interval.primitives import fusion_barrier
from gsisio_jax.interval.reading import check_type, read_array


def is_concrete(value: Any) -> bool:
    """True where the numbers of an array can be looked at (no tracer)."""
    return not isinstance(value, Tracer)


class Interval(eqx.Module):
    """A box ``[lower, upper]``, elementwise; a pytree.

    Args:
        lower: lower bounds, any shape, ``-inf`` allowed.
        upper: upper bounds, same shape (scalars broadcast), ``inf`` allowed.

    Numbers of 64 bits are rounded outward to 32 at once where JAX knows only those (`jax_enable_x64` is off): JAX
    itself would round them to nearest, inward half of the time, as soon as the box enters a compiled function.

    Raises:
        ValueError: shapes do not agree, a bound is NaN, ``lower`` is ``+inf`` or ``upper`` is ``-inf``, or
            ``lower > upper`` somewhere. Values are checked on concrete arrays only.

    >>> box = Interval([-1.0, 0.0], [1.0, 4.0])
    >>> box.center.tolist(), box.width.tolist()
    ([0.0, 2.0], [2.0, 4.0])

    Source: theory 1; paper, Definition 1.
    """

    lower: Any
    upper: Any

    @named_arguments
    def __init__(self, lower: Any, upper: Any):
        lower = read_array("Interval", "lower", lower)
        upper = read_array("Interval", "upper", upper)
        if lower.shape != upper.shape:
            try:
                shape = np.broadcast_shapes(lower.shape, upper.shape)
            except ValueError as error:
                raise ValueError(
                    f"Interval: `lower` has shape {lower.shape} and `upper` has shape {upper.shape}; "
                    "give both the same shape"
                ) from error
            lower, upper = (x if x.shape == shape else _broadcast(x, shape) for x in (lower, upper))
        if is_concrete(lower) and is_concrete(upper):
            _check_values(np.asarray(lower), np.asarray(upper))
        self.lower = _representable(lower, -np.inf)
        self.upper = _representable(upper, np.inf)

    @classmethod
    def unchecked(cls, lower: Any, upper: Any) -> Interval:
        """Build without looking at the numbers: for bounds that are ordered by construction."""
        self = object.__new__(cls)
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)
        return self

    @classmethod
    def point(cls, value: Any) -> Interval:
        """The box that holds one value only."""
        return cls(value, value)

    @classmethod
    def symmetric(cls, radius: Any) -> Interval:
        """The box ``[-radius, radius]``."""
        radius = read_array("Interval.symmetric", "radius", radius)
        return cls(-radius, radius)

    @classmethod
    def entire(cls, shape: int | tuple[int, ...]) -> Interval:
        """All of R^shape: nothing is known."""
        sizes = shape if isinstance(shape, tuple) else (shape,)
        if not all(isinstance(size, int | np.integer) and size >= 0 for size in sizes):
            raise ValueError(f"Interval.entire: `shape` must be a number of components, or a tuple; got {shape!r}")
        return cls(np.full(shape, -np.inf), np.full(shape, np.inf))

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of both bounds."""
        return self.lower.shape

    @property
    def dtype(self) -> Any:
        """Floating type of both bounds together."""
        return floating_type(self.lower.dtype, self.upper.dtype)

    @property
    def center(self) -> Any:
        """Middle of the box; the finite side where one side is infinite, 0 where both are. Never NaN."""
        if _namespace(self.lower, self.upper) is np:
            return _center(np, self.lower, self.upper)
        return _compiled_center(self.lower, self.upper)

    @property
    def width(self) -> Any:
        """``upper - lower``, ``inf`` where a side is infinite."""
        return self.upper - self.lower

    @property
    def radius(self) -> Any:
        """Half the width."""
        return 0.5 * self.width

    def __getitem__(self, index: Any) -> Interval:
        return Interval.unchecked(self.lower[index], self.upper[index])

    def __len__(self) -> int:
        if not self.shape:
            raise TypeError("Interval: a box of shape () has no length; it is one number, .lower to .upper")
        return len(self.lower)

    def __iter__(self) -> Any:
        raise TypeError(
            "Interval: a box cannot be unpacked or looped over (would that be its sides, or its components?). Its "
            "sides are box.lower and box.upper, component i is box[i]"
        )

    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        raise TypeError("Interval: a box is two arrays; use np.asarray(box.lower) and np.asarray(box.upper)")

    def __contains__(self, value: Any) -> bool:
        raise TypeError("Interval: `x in box` would not say of which components; use box.contains(x), then .all()")

    def __bool__(self) -> bool:
        raise TypeError(
            "Interval: a box is neither true nor false; ask for `box is None`, box.contains(x).all() or "
            "(box.width < limit).all()"
        )

    def _no_arithmetic(self, *_: Any) -> Any:
        raise TypeError(
            "Interval: a box has no arithmetic of its own; gx.inclusion.natural(f)(box) bounds a function f on it. Its "
            "sides are the arrays box.lower and box.upper"
        )

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __matmul__ = __rmatmul__ = _no_arithmetic
    __truediv__ = __rtruediv__ = __pow__ = __rpow__ = __neg__ = __abs__ = _no_arithmetic
    __lt__ = __le__ = __gt__ = __ge__ = _no_arithmetic

    @named_arguments
    def contains(self, value: Any, margin: float = 0.0) -> Any:
        """Elementwise: is ``value`` inside, with `margin` to spare?

        Args:
            value: of the shape of the box or a scalar; with more axes in front, many values for one box, and the
                other way round. NaN is not inside.
            margin: in the unit of the box.

        Raises:
            ValueError: the shapes do not fit; the margin is NaN.
        """
        if type(value) is not np.ndarray:
            value = read_array("Interval.contains", "value", value, missing=True)
        if type(margin) is not float:
            margin = read_array("Interval.contains", "margin", margin)
        if is_concrete(margin) and np.isnan(margin).any():
            raise ValueError("Interval.contains: `margin` is NaN; give a number in the unit of the box")
        _check_fits(self.shape, value.shape)
        inside = _inside if _namespace(self.lower, self.upper, value) is np else _compiled_inside
        return inside(self.lower, self.upper, value, margin)

    def astype(self, dtype: Any) -> Interval:
        """The smallest box of that floating type that contains this one (a narrowing cast rounds outward)."""
        if not _rounds_outward(dtype):
            raise ValueError(
                "Interval.astype: bounds have a floating type (float64, float32), got "
                f"{getattr(dtype, '__name__', None) or repr(dtype)}; in another one no bound is rounded outward, so "
                "take float32"
            )
        lower = cast_down(self.lower, dtype)
        if self.lower is self.upper and self.lower.dtype == lower.dtype:  # known to be a point: that stays known
            return Interval.unchecked(*rounding.normal(lower, lower))
        upper = cast_up(self.upper, dtype)
        return Interval.unchecked(*rounding.normal(lower, upper))

    def __repr__(self) -> str:
        if is_concrete(self.lower) and is_concrete(self.upper):
            return f"Interval({np.asarray(self.lower)}, {np.asarray(self.upper)})"
        return f"Interval({self.lower}, {self.upper})"


def _rounds_outward(dtype: Any) -> bool:
    try:
        return dtype is not None and np.dtype(dtype) in (np.float64, np.float32)
    except TypeError:  # no type at all
        return False


def _check_fits(box: tuple[int, ...], value: tuple[int, ...]) -> None:
    """Shapes whose last axes agree. NumPy's rules would also pair (T, 1) with (T,), every number with every other."""
    shared = min(len(box), len(value))
    ends = list(zip(box[len(box) - shared :], value[len(value) - shared :], strict=True))
    stretched = len(box) == len(value)  # axes of size 1, written by hand
    if any(a != b and not (stretched and 1 in (a, b)) for a, b in ends[:-1]) or any(a != b for a, b in ends[-1:]):
        raise ValueError(
            f"Interval.contains: `value` of shape {value} does not fit the box of shape {box}; give one number for "
            f"each side, shape {box}" + (f", or {('...', *box)} for many".replace("'...'", "...") if box else "")
        )


def _inside(lower: Any, upper: Any, value: Any, margin: Any) -> Any:
    return (lower + margin <= value) & (value <= upper - margin)


def _center(xp: Any, lower: Any, upper: Any) -> Any:
    low, high = xp.isfinite(lower), xp.isfinite(upper)
    a, b = xp.where(low, lower, 0.0), xp.where(high, upper, 0.0)
    return xp.where(low & high, 0.5 * a + 0.5 * b, a + b)


# One program instead of one for each operation.
_compiled_inside = jax.jit(_inside, inline=True)
_compiled_center = jax.jit(partial(_center, jnp), inline=True)


def _namespace(*values: Any) -> Any:
    return np if all(isinstance(value, np.ndarray | np.generic) for value in values) else jnp


def _representable(value: Any, towards: float) -> Any:
    """A host array that JAX would round when it sees it, rounded outward before."""
    dtype = jax.dtypes.canonicalize_dtype(value.dtype)
    if isinstance(value, jax.Array) or value.dtype == dtype:
        return value
    return cast_known(value, dtype, towards)


def _broadcast(value: Any, shape: tuple[int, ...]) -> Any:
    return _namespace(value).broadcast_to(value, shape)


def _check_values(lower: np.ndarray, upper: np.ndarray) -> None:
    for name, value in (("lower", lower), ("upper", upper)):
        if np.isnan(value).any():
            where = np.argwhere(np.isnan(value))[0].tolist()
            raise ValueError(f"Interval: `{name}` is NaN at index {where}; use -inf or inf for an unknown bound")
    bad = (lower > upper) | (lower == np.inf) | (upper == -np.inf)
    if bad.any():
        where = tuple(np.argwhere(bad)[0])
        raise ValueError(
            f"Interval: bounds cross at index {[int(i) for i in where]}: lower = {lower[where]}, "
            f"upper = {upper[where]}; give lower <= upper, finite or infinite outward"
        )


def add(*boxes: Interval) -> Interval:
    """Minkowski sum of boxes; NaN where it overflows, see `nan_to_unbounded`."""
    return Interval.unchecked(_add_down([box.lower for box in boxes]), -_add_down([-box.upper for box in boxes]))


def in_a_row(*boxes: Interval) -> Interval:
    """All entries of some boxes, one box behind the other."""
    return Interval.unchecked(
        *(jnp.concatenate([getattr(b, side).ravel() for b in boxes]) for side in ("lower", "upper"))
    )


def _add_down(values: list[Any]) -> Any:
    total = sum(values[1:], values[0])
    if len(values) == 1 or not rounding.outward():
        return total
    if len(values) == 2:  # one operation: its error goes with the result
        return rounding.down(total)
    size = sum((abs(value) for value in values[1:]), abs(values[0]))
    return rounding.lowered(total, size, len(values))


def computed_once(box: Interval) -> Interval:
    """The box itself, whose bounds are computed once however often they are used; see `fusion_barrier`."""
    return Interval.unchecked(fusion_barrier(box.lower), fusion_barrier(box.upper))


def nan_to_unbounded(box: Interval) -> Interval:
    """No bound where a side is NaN because it overflowed."""
    if not rounding.outward():
        return box
    return Interval.unchecked(rounding.unbounded(box.lower, -jnp.inf), rounding.unbounded(box.upper, jnp.inf))


def widen(box: Interval, radius: Any) -> Interval:
    """The box, `radius` larger on either side; nothing where the radius is 0 by construction (None)."""
    return box if radius is None else add(box, Interval.unchecked(-radius, radius))


def magnitude(box: Interval) -> Any:
    """Largest magnitude in the box, elementwise."""
    return jnp.maximum(absolute(box.lower), absolute(box.upper))


def center_and_radius(box: Interval) -> tuple[Any, Any]:
    """Center and radius of a traced box, to nearest; an infinite side makes the radius infinite and the center 0."""
    radius = 0.5 * minus(box.upper, box.lower)
    return where(radius < jnp.inf, 0.5 * plus(box.lower, box.upper), 0), radius


def entire_like(box: Any) -> Interval:
    """All of R^n, in the shape and type of a box or an array."""
    like = box.lower if isinstance(box, Interval) else box
    return Interval.unchecked(jnp.full_like(like, -jnp.inf), jnp.full_like(like, jnp.inf))


def choose(mask: Any, a: Interval, b: Interval) -> Interval:
    """Elementwise `a` where the mask holds, else `b`."""
    return Interval.unchecked(where(mask, a.lower, b.lower), where(mask, a.upper, b.upper))


def _check_pair(call: str, a: Any, b: Any) -> None:
    for name, box in (("a", a), ("b", b)):
        check_type(call, name, box, Interval, "gx.Interval.point(x) is the box that holds one value")
    try:
        np.broadcast_shapes(a.shape, b.shape)
    except ValueError:
        raise ValueError(f"{call}: two boxes of the same shape are needed, got {a.shape} and {b.shape}") from None


@named_arguments
def hull(a: Interval, b: Interval) -> Interval:
    """The smallest box that contains both boxes, elementwise."""
    _check_pair("hull", a, b)
    return _hull(a, b)


@partial(jax.jit, inline=True)
def _hull(a: Interval, b: Interval) -> Interval:
    return Interval.unchecked(smaller(a.lower, b.lower), larger(a.upper, b.upper))


@named_arguments
def intersect(a: Interval, b: Interval) -> tuple[Interval, Any]:
    """Elementwise intersection and its signed slack.

    Args:
        a: a box.
        b: a box of the same shape.

    Returns:
        (Interval, slack): the intersection, and ``min(a.upper - b.lower, b.upper - a.lower)``, how far one box could be
        moved before they miss each other. A negative slack is the size of the gap; there the first box is returned
        unchanged, so the result is never crossed: the caller must look at the slack. A side of b that is NaN (it
        overflowed) is passed over.
    """
    _check_pair("intersect", a, b)
    return _intersect(a, b)


@partial(jax.jit, inline=True)
def _intersect(a: Interval, b: Interval) -> tuple[Interval, Any]:
    slack = smaller(a.upper - b.lower, b.upper - a.lower)
    lower, upper = raised(a.lower, b.lower), cut(a.upper, b.upper)
    empty = upper < lower
    return Interval.unchecked(jnp.where(empty, a.lower, lower), jnp.where(empty, a.upper, upper)), slack
