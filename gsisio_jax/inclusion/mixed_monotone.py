"""Bounds of f on a box from bounds [a, b] of its derivative: mixed-monotone decomposition functions (paper, Def. 3).

Everything here is one family. Give every row i and coordinate j a share t in [0, 1], and let

    f_d,i(x, y) = f_i(z_i) + C_i (x - y),   z_i = (1 - t_i) x + t_i y,   C = max(-(1 - t) a, t b, 0).

By the chain rule ``df_d/dx = (1 - t) f' + C >= (1 - t) a + C >= 0`` and ``df_d/dy = t f' - C <= t b - C <= 0``, and
``f_d(x, x) = f(x)``: a decomposition function. The signs are not strict and need not be: closed bounds [a, b] do, where
the paper asks for open ones, since ``f_d(lo, hi) <= f_d(x, x) <= f_d(hi, lo)`` needs weak monotonicity only. Nor is
differentiability needed: bounds of the difference quotients give the same signs, and those are what
`inclusion.jacobian` encloses, kinks included. The diagonal i = j is no exception, because time is discrete.

- t in {0, 1}, the smaller C: the four cases of Yang, Mickelin and Ozay, the paper's choice (`decomposition`).
- all of {0, 1}^n, the best for every row: the remainder form (`remainder`), f = (f - h x) + h x with h_j in {a_j, b_j}.
- t = -a / (b - a), where (1 - t) (-a) = t b: never looser than any other t, so than the two above (`tight`); see there.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.inclusion.known_boxes import by_numpy
from gsisio_jax.inclusion.pointwise import Rows, check_derivative, room
from gsisio_jax.inclusion.transforms import AffineForm, affine
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.minmax import larger, largest, smaller, smallest
from gsisio_jax.interval.primitives import times
from gsisio_jax.interval.reading import check_type
from gsisio_jax.interval.rounding import Rounding, as_nearest, rounded_by

MAX_CORNER_DIMENSION = 10
"""`remainder` evaluates f at 2^n corners: n may not be larger than this."""


@named_arguments
def decomposition_gain(derivative: Interval) -> Any:
    """The matrix C of ``f_d(x, y) = f(z) + C (x - y)``, from bounds (a, b) of the derivative, entry by entry.

    0 where the sign is known (cases 1 and 4), |a| where ``a <= 0 <= b`` and ``|a| <= |b|`` (case 2), b else (case 3).

    Args:
        derivative: box (*out, n) that contains the derivative everywhere.

    Returns:
        Array (*out, n), nonnegative.

    Source: paper, (eq:decompconstruct); theory 9.
    """
    check_type("decomposition_gain", "derivative", derivative, Interval, "inclusion.jacobian(f)(box) is one")
    return _gain(derivative.lower, derivative.upper)


@partial(jax.jit, inline=True)  # one program instead of one for each operation
def _gain(a: Any, b: Any) -> Any:
    return where((a >= 0) | (b <= 0), 0, where(-a <= b, -a, b))


@named_arguments
def width_gain(derivative: Interval) -> Any:
    """How much wider than the box the bounds of the decomposition function are, entry by entry.

    ``f_d(x, y) - f_d(y, x) <= width_gain @ (x - y)``: b (case 1), b + 2|a| (case 2), |a| + 2b (case 3), |a| (case 4).
    The constant ``L_f + 2 ||C||`` of the paper's Lemma 2 is no such bound: its proof evaluates all rows at one z. For
    ``f = (x1 + x2, x1 - x2)`` it is sqrt(2), yet the bounds are twice as wide as the unit box in both rows.

    Args:
        derivative: box (*out, n) that contains the derivative everywhere.

    Returns:
        Array (*out, n), nonnegative.

    Source: theory 2.11 (the paper's Lemma 2 has one constant for all rows).
    """
    check_type("width_gain", "derivative", derivative, Interval, "inclusion.jacobian(f)(box) is one")
    return _width_gain(derivative.lower, derivative.upper)


@partial(jax.jit, inline=True)
def _width_gain(a: Any, b: Any) -> Any:
    return jnp.maximum(jnp.abs(a), jnp.abs(b)) + 2 * _gain(a, b)


@named_arguments
def decomposition_function(
    f: Callable[..., Any], derivative: Any, form: Literal["cases", "optimal"] = "cases"
) -> Callable[..., Any]:
    """A decomposition function of f: increasing in x, decreasing in y, ``f_d(x, x) = f(x)``.

    Args:
        f: takes an array (n,), then any number of further arguments; returns an array (*out) (or a tree of arrays).
        derivative: box (*out, n) that contains all difference quotients of f on the set where f_d is used; one side
            of an entry may be infinite (with both, f_d is finite only where x = y there).
        form: "cases" for the four cases of the paper, with a z for every row; "optimal" for that of `tight`.

    Returns:
        ``f_d(x, y, *args)`` for finite points x and y, (n,), in any order; shape (*out).

    Raises:
        ValueError: `derivative` has the wrong shape, is NaN or crossed; `form` is unknown.

    >>> f_d = decomposition_function(lambda x: x[0] ** 2, Interval([-2.0], [4.0]))
    >>> float(f_d(np.array([-1.0]), np.array([2.0]))), float(f_d(np.array([2.0]), np.array([-1.0])))
    (-5.0, 10.0)

    Source: paper, Def. 3 and (eq:decompconstruct); theory 9.
    """
    check_derivative("decomposition_function", derivative)
    if form not in ("cases", "optimal"):
        raise ValueError(f'inclusion.decomposition_function: `form` must be "cases" or "optimal", got {form!r}')
    share = _cases if form == "cases" else _optimal

    @as_nearest
    def f_d(x: Any, y: Any, *args: Any) -> Any:
        if np.ndim(x) != 1 or np.shape(x) != np.shape(y):
            raise ValueError(
                "inclusion.decomposition_function: x and y must be points of shape (n,), got shapes "
                f"{np.shape(x)} and {np.shape(y)}; for more points use jax.vmap"
            )
        dtype = jnp.result_type(x, y)
        dtype = dtype if jnp.issubdtype(dtype, jnp.floating) else float
        # Not a box, since x and y come in any order, but handled like one.
        ends = Interval.unchecked(jnp.asarray(x, dtype), jnp.asarray(y, dtype))
        rows = Rows("decomposition_function", f, ends, args)
        if rows.has_boxes:
            raise ValueError(
                "inclusion.decomposition_function: further arguments of f_d must be arrays, got an Interval; "
                "make it part of x, or use inclusion.decomposition, which takes boxes"
            )
        a, b = rows.derivative(derivative)
        t, x, y = share(a, b), rows.box.lower, rows.box.upper
        total = rows.diagonal((1 - t) * x + t * y).lower + times(room(a, b, t, 1 - t), x - y).sum(-1)
        return rows.unflatten(total)

    return f_d


@named_arguments
def decomposition(
    f: Callable[..., Any], derivative: Any = None, rounding: Rounding | None = None
) -> Callable[..., Any]:
    """Bounds ``[f_d(lower, upper), f_d(upper, lower)]`` of f by the decomposition function of the paper.

    f is evaluated at two corners of the box for every row; where the sign of every derivative of a row is known the
    bounds of that row are exact. Exact also on a box of width 0. f is never evaluated at infinity, where floating point
    has conventions of its own (``atan2(inf, inf)``): a row that would need it is unbounded on that side. Bounds on a
    part of the box can be wider, because the case may change with the enclosure of the derivative.

    Args:
        f: takes an array of shape (n,), then any number of further arguments; returns an array of any shape.
        derivative: box (*out, n) that contains all difference quotients of f on every box it will be used on, sides
            infinite where unknown; nothing can detect a wrong one. None: `inclusion.jacobian` on the box at hand.
        rounding: as in `natural`.

    Returns:
        A function of a box (n,) and of the further arguments, arrays or boxes, that returns an `Interval` of the shape
        of f's result, never NaN and never crossed. Its gradient is NaN where a corner lies outside the domain of f.

    Raises:
        UnknownPrimitiveError: f uses an operation without known bounds (with `derivative`: only for boxes in `args`).
        ValueError: the first argument is no box of shape (n,); `derivative` has the wrong shape, is NaN or crossed.

    >>> decomposition(lambda x: x[0] ** 2 - x[1], rounding="nearest")(Interval([-1.0, 0.0], [2.0, 1.0]))
    Interval(-6.0, 10.0)

    Source: paper, Prop. 2 and (eq:decompconstruct); theory 9.
    """
    check_derivative("decomposition", derivative)

    @rounded_by("inclusion.decomposition", rounding)
    @by_numpy
    def bounds(box: Interval, *args: Any) -> Any:
        rows = Rows("decomposition", f, box, args)
        a, b = rows.derivative(derivative)
        return rows.pack(*_centered(rows, a, b, _cases(a, b)))

    return bounds


@named_arguments
def remainder(f: Callable[..., Any], derivative: Any = None, rounding: Rounding | None = None) -> Callable[..., Any]:
    """Bounds of f by the remainder form, the best of all 2^n choices for every row.

    With h_j in {a_j, b_j}, f - h x is monotone in every coordinate and h x is linear: both have exact ranges. A choice
    of h is a choice of the corner where f is evaluated, so 2^n evaluations serve all rows, lower and upper bounds. The
    four cases are one of the choices: never looser than `decomposition`. Nor tighter than `tight`, for any n.
    Where a sign is known, h_j = 0 stands for the bound on the right side of 0 (it gives the same), so it costs nothing.

    Args, returns and errors are those of `decomposition`; n > 10 is a ValueError too.

    >>> box = Interval([-1.0, 0.0], [3.0, 1.0])
    >>> [form(lambda x: jnp.abs(x[0]) - x[1], rounding="nearest")(box) for form in (decomposition, remainder)]
    [Interval(-4.0, 7.0), Interval(-2.0, 5.0)]

    Source: Khajenejad and Yong, tight remainder-form decomposition functions; theory 9.
    """
    check_derivative("remainder", derivative)

    @rounded_by("inclusion.remainder", rounding)
    @by_numpy
    def bounds(box: Interval, *args: Any) -> Any:
        rows = Rows("remainder", f, box, args)
        n = rows.box.lower.shape[0]
        if n > MAX_CORNER_DIMENSION:
            raise ValueError(
                f"inclusion.remainder: 2^n corners are evaluated, so n may be at most {MAX_CORNER_DIMENSION}, got n = "
                f"{n}; use inclusion.tight, which is never looser and evaluates two points for every row"
            )
        a, b = rows.derivative(derivative)
        corners = np.array(list(itertools.product([0, 1], repeat=n)), rows.box.dtype).reshape(2**n, n)
        points = rows.between(corners)
        # All corners for all rows: (2^n, 1, n) against (m, n).
        lower, upper = rows.around(points[:, None], rows.values(points), a, b)
        return rows.pack(largest(lower, 0), smallest(upper, 0))

    return bounds


@named_arguments
def tight(f: Callable[..., Any], derivative: Any = None, rounding: Rounding | None = None) -> Callable[..., Any]:
    """The tightest bounds of f that this package has: exact where the signs of the derivative are known.

    A row with a derivative of known sign (or zero) in every coordinate is monotone, and two corners give its range. Any
    other row gets the intersection of its natural and affine range with the optimally centered form

        f_i(c) - sum_j g_j width_j,   g_j = |a_j| b_j / (|a_j| + b_j),   c_j = lower_j + |a_j| / (|a_j| + b_j) width_j

    (mirrored for the upper bound; the corner where the sign of j is known). It is never looser than `decomposition`,
    `remainder` or `mean_value` from the same derivative bounds: another center e has ``f(e) <= f(c) + max J (e - c)``;
    inserted in the bound that e gives, e cancels. Its gain g is between half and all of that of `decomposition`.
    The centered form shrinks with the box if the derivative bounds do; the affine range need not.

    Args, returns and errors are those of `decomposition`; f's operations need known bounds in any case.

    >>> pair = lambda x: jnp.stack([x[0] ** 2 - x[1], x[0] ** 3 + x[0]])
    >>> tight(pair, rounding="nearest")(Interval([-1.0, 0.0], [2.0, 1.0]))
    Interval([-1. -2.], [ 4. 10.])

    Source: theory 9; the center is that of Baumann, Optimal centered forms, BIT 28 (1988).
    """
    check_derivative("tight", derivative)

    @rounded_by("inclusion.tight", rounding)
    @by_numpy
    def bounds(box: Interval, *args: Any) -> Any:
        rows = Rows("tight", f, box, args)
        a, b = rows.derivative(derivative)
        lower, upper = _centered(rows, a, b, _optimal(a, b))
        # The range of the affine domain is met with the natural one at every operation.
        known = rows.flatten(
            jax.tree.map(lambda v: v.range, affine(f)(rows.box, *args), is_leaf=lambda v: isinstance(v, AffineForm))
        )
        return rows.pack(larger(lower, known.lower), smaller(upper, known.upper))

    return bounds


def _cases(a: Any, b: Any) -> Any:
    """The share t of y in z for the four cases: 0, so z = x, in the first two, where ``|a| <= b`` or ``a >= 0``."""
    return where(-a <= b, 0, 1).astype(a.dtype)


def _optimal(a: Any, b: Any) -> Any:
    """The share ``-a / (b - a)``, cut off at 0 and 1, without overflow; it keeps an infinite a or b out of the sum."""
    small, large = jnp.minimum(-a, b), jnp.maximum(-a, b)
    mixed = (small > 0) & jnp.isfinite(large)
    ratio = where(mixed, small, 0) / where(mixed, large, 1)
    part = ratio / (1 + ratio)
    return where(-a <= b, part, 1 - part)


def _centered(rows: Rows, a: Any, b: Any, t: Any) -> tuple[Any, Any]:
    """Lower bounds from the points at share t of the way through the box, upper ones from those at 1 - t."""
    points = rows.between(jnp.stack([t, 1 - t]))
    lower, upper = rows.around(points, rows.diagonal(points), a, b)
    return lower[0], upper[1]
