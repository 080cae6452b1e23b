"""The paper's Corollary 1: bounds of a function by any choice of methods, intersected.

All methods are sound, so their intersection is; which of them are worth their time depends on the function. The default
of the observer, affine and natural bounds met at every node, is usually the tightest for its cost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp

from gsisio_jax._calls import named_arguments
from gsisio_jax.inclusion.known_boxes import by_numpy
from gsisio_jax.inclusion.mixed_monotone import decomposition, remainder
from gsisio_jax.inclusion.planes import Abstraction
from gsisio_jax.inclusion.transforms import AffineForm, affine, distance, jacobian, mean_value, natural
from gsisio_jax.interval.box import Interval, choose, magnitude
from gsisio_jax.interval.minmax import larger, smaller
from gsisio_jax.interval.rounding import Rounding, lowered, raised, rounded_by, unbounded, up

METHODS = ("affine", "natural", "decomposition", "remainder", "mean_value", "abstraction")
"""Names of the ways to bound a function that `bound` and `design_observer(bounds=...)` take, any number of them: those
of the functions `affine`, `natural`, `decomposition`, `remainder` and `mean_value`, and the planes of `Abstraction`."""

DEFAULT = ("affine", "natural")


def check_methods(call: str, methods: Sequence[str]) -> tuple[str, ...]:
    """The methods in their standard order, each once.

    Raises:
        ValueError: none is given, or one is unknown.
    """
    given = (methods,) if isinstance(methods, str) else tuple(methods)
    unknown = [name for name in given if name not in METHODS]
    if unknown or not given:
        raise ValueError(
            f"{call}: `bounds` must name some of {', '.join(METHODS)}; got {unknown[0] if unknown else 'none'!r}"
        )
    return tuple(name for name in METHODS if name in given)


@named_arguments
def bound(
    f: Callable[..., Any],
    methods: Sequence[str] = DEFAULT,
    abstraction: Abstraction | None = None,
    derivative: Interval | None = None,
    rounding: Rounding | None = None,
) -> Callable[..., AffineForm]:
    """Bounds of f by several methods, intersected: a function of a box (n,) and of f's further arguments.

    Args:
        f: takes an array (n,), then further arguments; returns an array of shape (r,).
        methods: any of `METHODS`. "affine" and "natural" together meet at every operation of f, which is tighter than
            the intersection of the two at the end.
        abstraction: planes of ``lambda z: f(z[:n], z[n:])`` (of f itself where f takes x alone), for "abstraction".
        derivative: box (r, n) that contains the derivative everywhere, for "decomposition" and "remainder"; None
            encloses it on the box at hand, which is tighter.
        rounding: as in `natural`.

    Returns:
        Callable: it returns an `AffineForm`. Its range is the intersection of all ranges; its slope is that of the
        affine form, else of the mean-value form, else zero.

    Raises:
        ValueError: a method is unknown, or "abstraction" is asked for and none is given.

    Source: paper, Corollary 1; theory 9.
    """
    chosen = check_methods("inclusion.bound", methods)
    if "abstraction" in chosen and abstraction is None:
        raise ValueError('inclusion.bound: the method "abstraction" needs an `Abstraction`; give `abstraction`')

    ranges_of = {
        "natural": natural(f),
        "decomposition": decomposition(f, derivative),
        "remainder": remainder(f, derivative),
        "mean_value": mean_value(f),
    }

    @rounded_by("inclusion.bound", rounding)
    @by_numpy
    def bounds(box: Interval, *args: Any) -> AffineForm:
        form, ranges = None, []
        if "affine" in chosen:
            form = affine(f)(box, *args)
            ranges.append(form.range if "natural" in chosen else form.over(box))
        ranges += [ranges_of[m](box, *args) for m in chosen if m in ranges_of and not (m == "natural" and form)]
        if form is None and "mean_value" in chosen:
            form = _mean_value_form(f, box, *args)
        if abstraction is not None and "abstraction" in chosen:
            takes_x_alone = abstraction.region.shape[-1] == box.shape[0]
            ranges.append(abstraction.over(box if takes_x_alone else _with_arguments(box, args)))
        met = ranges[0]
        for other in ranges[1:]:
            met = _meet(met, other)
        if form is None:
            slope = jnp.zeros((*met.lower.shape, *box.lower.shape), met.lower.dtype)
            return AffineForm(slope, met, met)
        return AffineForm(form.slope, form.offset, met)

    return bounds


def _meet(a: Interval, b: Interval) -> Interval:
    """Intersection of two bounds of the same values; where rounding makes them miss each other, the first."""
    lower, upper = larger(a.lower, b.lower), smaller(a.upper, b.upper)
    return choose(lower <= upper, Interval.unchecked(lower, upper), a)


def _mean_value_form(f: Callable[..., Any], box: Interval, *args: Any) -> AffineForm:
    """``f(c) + J (x - c)`` as an affine form: the middle of J is the slope, its radius the offset."""
    enclosure, center = jacobian(f)(box, *args), box.center
    finite = jnp.isfinite(enclosure.lower) & jnp.isfinite(enclosure.upper)
    slope = jnp.where(finite, enclosure.center, 0)
    radius = jnp.where(finite, up(larger(enclosure.upper - slope, slope - enclosure.lower)), jnp.inf)
    radius = jnp.where(enclosure.lower == enclosure.upper, 0, radius)
    around = magnitude(distance(box, center))
    spread = jnp.where(around == 0, 0, jnp.where(radius == 0, 0, radius * around))
    at_center = natural(f)(Interval.unchecked(center, center), *args)
    moved = slope * center
    size = abs(moved).sum(-1) + spread.sum(-1)
    lower = at_center.lower - moved.sum(-1) - spread.sum(-1)
    upper = at_center.upper - moved.sum(-1) + spread.sum(-1)
    terms = 2.0 * slope.shape[-1] + 4.0
    offset = Interval.unchecked(
        unbounded(lowered(lower, abs(at_center.lower) + size, terms, terms), -jnp.inf),
        unbounded(raised(upper, abs(at_center.upper) + size, terms, terms), jnp.inf),
    )
    return AffineForm(slope, offset, offset)


def _with_arguments(box: Interval, args: Sequence[Any]) -> Interval:
    """The box of (x, u): known arguments are points."""
    values = [jnp.asarray(arg, box.dtype) for arg in args]
    return Interval.unchecked(jnp.concatenate([box.lower, *values]), jnp.concatenate([box.upper, *values]))
