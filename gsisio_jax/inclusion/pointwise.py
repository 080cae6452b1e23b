"""A function seen as a list of rows, each evaluated at points of its own: what bounds by values of f at points need."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.form_arithmetic import guard
from gsisio_jax.inclusion.transforms import _typed, distance, jacobian, natural
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, is_concrete
from gsisio_jax.interval.minmax import larger, smaller
from gsisio_jax.interval.primitives import times


def room(a: Any, b: Any, behind: Any, ahead: Any) -> Any:
    """How far f can fall below its value at a point, if its box reaches back by `behind` and on by `ahead`; summands.

    With the two distances exchanged, how far it can rise. To nearest: the sum is what gets widened.
    """
    return larger(larger(times(-a, ahead), times(b, behind)), 0)


def is_box(value: Any) -> bool:
    return isinstance(value, Interval)


def check_derivative(call: str, derivative: Any) -> None:
    """Bounds of a derivative given by hand must be boxes; the numbers are checked where they can be looked at.

    Raises:
        ValueError: something else than a box (or a tree of them), NaN, or crossed bounds.
    """
    for leaf in [] if derivative is None else jax.tree.leaves(derivative, is_leaf=is_box):
        if not is_box(leaf):
            raise ValueError(
                f"inclusion.{call}: `derivative` must be an Interval of the shape of f's result and (n,), got "
                f"{type(leaf).__name__}; give gsisio_jax.Interval(lower, upper), with infinite sides where unknown"
            )
        if not (is_concrete(leaf.lower) and is_concrete(leaf.upper)):
            continue
        lower, upper = np.asarray(leaf.lower), np.asarray(leaf.upper)
        if lower.shape != upper.shape:
            raise ValueError(
                f"inclusion.{call}: both sides of `derivative` must have one shape, got {lower.shape} and {upper.shape}"
            )
        # NaN compares false, so it counts as bad.
        bad = ~((lower <= upper) & (lower < np.inf) & (upper > -np.inf))
        if bad.any():
            at = tuple(int(i) for i in np.argwhere(bad)[0])
            raise ValueError(
                f"inclusion.{call}: `derivative` must have lower <= upper and no NaN, got [{lower[at]}, {upper[at]}] "
                f"at index {list(at)}; use -inf and inf for an unknown side, or leave it out to have it computed"
            )


class Rows:
    """f on a box, its results (a tree of arrays) joined to one vector of m rows.

    Args:
        call: the name for error messages.
        f: as for `natural`.
        box: shape (n,).
        args: further arguments of f; boxes among them stand for all of their values.
    """

    def __init__(self, call: str, f: Callable[..., Any], box: Any, args: tuple[Any, ...]):
        self.call, self.f, self.args, self.box = call, f, args, _typed(call, box, args)
        self.has_boxes = any(is_box(leaf) for leaf in jax.tree.leaves(args, is_leaf=is_box))
        out = jax.eval_shape(self._value, jax.ShapeDtypeStruct(self.box.shape, self.box.dtype))
        self._shapes = [leaf.lower.shape for leaf in jax.tree.leaves(out, is_leaf=is_box)]
        self._structure = jax.tree.structure(out, is_leaf=is_box)
        self.count = sum(int(np.prod(shape)) for shape in self._shapes)

    def _value(self, point: Any) -> Any:
        """f at a point, as a tree of boxes: as wide as rounding and arguments that are boxes make them."""
        if self.has_boxes or rounding.outward():
            return natural(self.f)(Interval.unchecked(point, point), *self.args)
        dtype = self.box.dtype

        def convert(arg: Any) -> Any:
            arg = jnp.asarray(arg)
            return arg.astype(dtype) if jnp.issubdtype(arg.dtype, jnp.floating) else arg

        value = self.f(point, *jax.tree.map(convert, self.args))
        return jax.tree.map(lambda v: Interval.unchecked(*[jnp.asarray(v).astype(dtype)] * 2), value)

    def values(self, points: Any) -> Interval:
        """All rows at all points (k, n): shape (k, m)."""
        return jax.vmap(lambda point: self.flatten(self._value(point)))(points)

    def diagonal(self, points: Any) -> Interval:
        """Row i at its own point, points (..., m, n): shape (..., m)."""
        size = self.count
        table = self.values(points.reshape(int(np.prod(points.shape[:-1])), points.shape[-1]))
        # A select and a sum, not a gather; values that are not wanted may be infinite.
        own = np.eye(size, dtype=bool)
        shape = (*points.shape[:-1], size)
        return jax.tree.map(lambda v: jnp.where(own, v.reshape(shape), 0).sum(-1), table)

    def between(self, share: Any) -> Any:
        """The points at `share` (..., n) of the way through the box: 0 is its lower end, 1 its upper end, exactly.

        An end at infinity is replaced by the center, which is finite: any point of the box will do for bounds.
        """
        lower, upper = (jnp.where(jnp.isfinite(end), end, self.box.center) for end in (self.box.lower, self.box.upper))
        return jnp.clip((1 - share) * lower + share * upper, lower, upper)

    def around(self, points: Any, value: Interval, a: Any, b: Any) -> tuple[Any, Any]:
        """Bounds of every row over the box from its `value` at points: ``f(x)`` lies in ``f(c) + [a, b] (x - c)``.

        Never NaN: where f has no value at a point of its own, that point says nothing.
        """
        behind, ahead = -distance(self.box, points).lower, distance(self.box, points).upper
        fall, rise = room(a, b, behind, ahead), room(a, b, ahead, behind)
        lower, upper = value.lower - fall.sum(-1), value.upper + rise.sum(-1)
        terms = points.shape[-1] + 4.0
        lower = rounding.lowered(lower, abs(value.lower) + fall.sum(-1), terms, terms)
        upper = rounding.raised(upper, abs(value.upper) + rise.sum(-1), terms, terms)
        return jnp.where(jnp.isnan(lower), -jnp.inf, lower), jnp.where(jnp.isnan(upper), jnp.inf, upper)

    def derivative(self, given: Any = None) -> tuple[Any, Any]:
        """Bounds (a, b) of the derivative, (m, n) each: those given, or the Jacobian enclosure on the box.

        Raises:
            ValueError: those given do not have the shapes of f's results and (n,).
        """
        n = self.box.lower.shape[0]
        if given is None:
            given = jacobian(self.f)(self.box, *self.args)
        else:
            got = [leaf.lower.shape for leaf in jax.tree.leaves(given, is_leaf=is_box)]
            expected = [(*shape, n) for shape in self._shapes]
            if got != expected:
                raise ValueError(
                    f"inclusion.{self.call}: `derivative` must have the shape of f's result and (n,), "
                    f"{_list(expected)}, got {_list(got)}; give one row of bounds for every component of f"
                )
            given = jax.tree.map(lambda box: box.astype(self.box.dtype), given, is_leaf=is_box)
        joined = self.flatten(given)
        return joined.lower.reshape(self.count, n), joined.upper.reshape(self.count, n)

    def flatten(self, tree: Any) -> Interval:
        """A tree of boxes like f's result, as one box (m,)."""
        boxes = jax.tree.leaves(tree, is_leaf=is_box)
        lower, upper = zip(*map(_sides, boxes), strict=True)
        return Interval.unchecked(*(jnp.concatenate([jnp.ravel(v) for v in side]) for side in (lower, upper)))

    def unflatten(self, vector: Any) -> Any:
        """A vector (m,) in the structure of f's result."""
        ends = np.cumsum([int(np.prod(shape)) for shape in self._shapes])[:-1]
        leaves = [part.reshape(shape) for part, shape in zip(jnp.split(vector, ends), self._shapes, strict=True)]
        return jax.tree.unflatten(self._structure, leaves)

    def pack(self, lower: Any, upper: Any) -> Any:
        """Bounds (m,) as boxes in the structure of f's result, never crossed.

        Bounds of a row that is nearly constant can cross by rounding: the box between them is then the best there is.
        """
        box = guard(Interval.unchecked(smaller(lower, upper), larger(lower, upper)))
        pairs = self.unflatten(box.lower), self.unflatten(box.upper)
        return jax.tree.map(Interval.unchecked, *pairs)


def _sides(box: Interval) -> tuple[Any, Any]:
    return box.lower, box.upper


def _list(shapes: list[tuple[int, ...]]) -> str:
    return ", ".join(map(str, shapes))
