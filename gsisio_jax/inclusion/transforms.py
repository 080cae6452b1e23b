"""The four ways to bound a function on a box: ranges, affine forms, Jacobians, mean-value form."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsisio_jax._calls import named_arguments
from gsisio_jax.inclusion.form_arithmetic import box_sum, guard, is_known, is_point, product, slope_image, sum_slack
from gsisio_jax.inclusion.interpreter import evaluate
from gsisio_jax.inclusion.known_boxes import by_numpy, in_numpy
from gsisio_jax.inclusion.node import POINT_MODE, Form, InputBox, Node, as_node, is_node, jac_of, slack_of, slope_of
from gsisio_jax.interval.box import Interval, choose
from gsisio_jax.interval.cast import as_array
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.primitives import add_up
from gsisio_jax.interval.rounding import Rounding, down, rounded_by, sum_down, sum_up, up
from gsisio_jax.traced import refuse_change, refuse_trace
from gsisio_jax.tracing import explained


class AffineForm(eqx.Module):
    """Bounds of f on a box X of shape (n,): a linear part, an offset box, and a range.

    For every x in X, ``f(x) - slope @ x`` lies in `offset`, and ``f(x)`` in `range`.

    Attributes:
        slope: shape (*out, n), finite.
        offset: box of shape (*out).
        range: box of shape (*out), the natural bounds met with the affine ones at every node of f.

    Source: theory 9.
    """

    slope: Float[Array, "*out n"]
    offset: Interval
    range: Interval

    def over(self, box: Interval) -> Interval:
        """Bounds of f on a box inside X, from slope and offset alone; shape (*out)."""
        if not isinstance(box, Interval):
            raise ValueError(f"AffineForm.over: `box` must be an Interval of shape (n,), got {type(box).__name__}")
        return in_numpy(partial(_over, self), box.astype(jnp.result_type(self.slope)), self)


def _over(form: AffineForm, box: Interval) -> Interval:
    return guard(box_sum(slope_image(jnp.moveaxis(jnp.asarray(form.slope), -1, 0), box), form.offset))


@named_arguments
def natural(f: Callable[..., Any], rounding: Rounding | None = None) -> Callable[..., Any]:
    """Natural inclusion function of f: every operation replaced by its range.

    Args:
        f: takes an array of shape (n,), then any number of further arguments; returns an array of any shape.
        rounding: "outward" (what None means, too) for bounds that hold on the machine; "nearest" is faster, and its
            bounds hold up to rounding errors only. A constant expression in f counts as the number it evaluates to.

    Returns:
        A function of a box (n,) and of the further arguments, arrays or boxes (the result then holds for all of
        their values), that returns an `Interval` of the shape of f's result, containing every value f takes.

    Raises:
        UnknownPrimitiveError: f uses an operation without known bounds.
        ValueError: the first argument is no box of shape (n,).

    >>> natural(lambda x: jnp.sqrt(x[0]) - x[1], rounding="nearest")(Interval([0.0, 1.0], [4.0, 2.0]))
    Interval(-2.0, 1.0)

    Source: theory 9.
    """

    @rounded_by("inclusion.natural", rounding)
    def bounds(box: Interval, *args: Any) -> Any:
        box = _typed("natural", box, args)
        if not is_point(box):
            return _run(f, box, Node, args, lambda node, _: _finish_range(node))
        token = POINT_MODE.set(True)
        try:
            return _run(f, box, _variable, args, lambda node, _: _finish_range(node))
        finally:
            POINT_MODE.reset(token)

    return bounds


@named_arguments
def affine(f: Callable[..., Any], rounding: Rounding | None = None) -> Callable[..., Any]:
    """Affine bounds of f: a function of a box (n,) and of f's further arguments that returns an `AffineForm`.

    Arguments and errors are those of `natural`. Exact, with an offset of width 0, where f is affine; infinite boxes
    are legal, and the offset stays finite where a finite one exists for the chosen slope.

    >>> form = affine(lambda x: 2 * x[0] + jnp.sin(x[1]), rounding="nearest")(Interval.entire(2))
    >>> form.slope.tolist(), form.offset
    ([2.0, 0.0], Interval(-1.0, 1.0))

    Source: theory 9.
    """

    @rounded_by("inclusion.affine", rounding)
    def bounds(box: Interval, *args: Any) -> Any:
        box = _typed("affine", box, args)
        return _run(f, box, _variable, args, _finish_affine)

    return bounds


@named_arguments
def jacobian(f: Callable[..., Any], rounding: Rounding | None = None) -> Callable[..., Any]:
    """Enclosure of the Jacobian of f: a function of a box (n,) and of f's further arguments.

    It returns an `Interval` of shape (*out, n) that contains the derivative at every point of the box where f has
    one, and every difference quotient: for a and b in the box, ``f(a) - f(b)`` lies in J (a - b). So where f may
    jump inside the box the bounds are infinite, and where it has a kink they are the hull of both sides.
    Arguments and errors are those of `natural`.

    >>> jacobian(lambda x: jnp.abs(x[0]) + 3 * x[1], rounding="nearest")(Interval([-1.0, 0.0], [1.0, 1.0]))
    Interval([-1.  3.], [1. 3.])

    Source: theory 9.
    """

    @rounded_by("inclusion.jacobian", rounding)
    def bounds(box: Interval, *args: Any) -> Any:
        box = _typed("jacobian", box, args)
        return _run(f, box, partial(_variable, derivative=True), args, _finish_jacobian)

    return bounds


@named_arguments
def mean_value(f: Callable[..., Any], rounding: Rounding | None = None) -> Callable[..., Any]:
    """Mean-value form ``f(c) + J (box - c)`` around the center c of the box; arguments and errors as `natural`.

    Source: theory 9.
    """
    at, slope = natural(f), jacobian(f)

    @rounded_by("inclusion.mean_value", rounding)
    @by_numpy
    def bounds(box: Interval, *args: Any) -> Any:
        box = _typed("mean_value", box, args)
        center = box.center
        around = distance(box, center)
        middle, enclosure = at(Interval.unchecked(center, center), *args), slope(box, *args)

        def combine(value: Interval, jac: Interval) -> Interval:
            moved = product(jac, around)
            return guard(box_sum(value, Interval.unchecked(sum_down(moved.lower), sum_up(moved.upper))))

        return jax.tree.map(combine, middle, enclosure, is_leaf=lambda v: isinstance(v, Interval))

    return bounds


def distance(box: Interval, point: Any) -> Interval:
    """Bounds of ``x - point`` over the box."""
    lower, upper = down(box.lower - point), up(box.upper - point)
    # A side on which the box ends at the point itself is exactly 0.
    return Interval.unchecked(where(box.lower == point, 0, lower), where(box.upper == point, 0, upper))


def _typed(call: str, box: Any, args: tuple[Any, ...]) -> Interval:
    """The box in the floating type of the computation, rounded outward where that is narrower."""
    if not isinstance(box, Interval) or len(box.shape) != 1:
        got = f"a box of shape {box.shape}" if isinstance(box, Interval) else repr(box)
        raise ValueError(f"inclusion.{call}: the first argument must be an Interval of shape (n,), got {got}")
    return box.astype(_dtype(box, args))


def _dtype(box: Interval, args: tuple[Any, ...]) -> Any:
    leaves = [leaf for leaf in jax.tree.leaves(args) if jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)]
    return jnp.result_type(box.lower, box.upper, *leaves)


def _variable(box: Interval, derivative: bool = False) -> Node:
    eye = np.eye(box.lower.shape[0], dtype=box.lower.dtype)
    zero = np.zeros(box.shape, box.lower.dtype)
    jac = Interval.unchecked(eye, eye) if derivative else None
    return Node(box, Form(eye, Interval.unchecked(zero, zero), InputBox.of(box)), jac)


def _run(
    f: Callable[..., Any],
    box: Interval,
    start: Callable[[Interval], Node],
    args: tuple[Any, ...],
    finish: Callable[[Node, Interval], Any],
) -> Any:
    """Trace f on shapes alone, interpret what comes out, and give the results f's own structure."""

    def is_box(value: Any) -> bool:
        return isinstance(value, Interval)

    def convert(arg: Any) -> Any:
        if is_box(arg):
            return arg.astype(box.lower.dtype)
        arg = as_array(arg) if isinstance(arg, np.ndarray | np.generic) else jnp.asarray(arg)
        return arg.astype(box.lower.dtype) if jnp.issubdtype(arg.dtype, jnp.floating) else arg

    values = jax.tree.map(convert, args, is_leaf=is_box)
    shapes = jax.tree.map(lambda v: jax.ShapeDtypeStruct(v.shape, v.dtype), values, is_leaf=is_box)
    if not callable(f):
        raise ValueError(f"inclusion: bounds are of a function of x, got {type(f).__name__}")
    closed, out = _traced(f, jax.ShapeDtypeStruct(box.shape, box.lower.dtype), *shapes)
    _check_results(closed, box.shape)
    given = jax.tree.leaves(values, is_leaf=is_box)

    def found(box: Interval) -> list[Any]:
        x = start(box)
        inputs = [x, *(Node(value) if is_box(value) else value for value in given)]
        results = evaluate(closed.jaxpr, closed.consts, inputs)
        nodes = [v if is_node(v) else as_node(v, jnp.shape(v), x.dtype) for v in results]
        nodes = [v if jnp.issubdtype(v.dtype, jnp.floating) else _as_numbers(v, x.dtype) for v in nodes]
        return [finish(_in_type(node, x.dtype), box) for node in nodes]

    return jax.tree.unflatten(jax.tree.structure(out), in_numpy(found, box, (given, closed.consts)))


def _traced(f: Callable[..., Any], x: Any, *args: Any) -> tuple[Any, Any]:
    """f as a jaxpr, and the structure of what it returns. One of the user's is called twice: it might draw numbers."""
    signature = None
    with contextlib.suppress(ValueError, TypeError):  # none to be found
        signature = inspect.signature(f)
    try:
        if signature is not None:
            signature.bind(x, *args)
    except TypeError as error:
        raise ValueError(
            f"inclusion: the function takes {signature}, and is called with x and {len(args)} further arguments "
            f"({error}); bounds(box, *args) hands args on, functools.partial binds parameters"
        ) from None
    ours = (getattr(f, "__module__", None) or type(f).__module__).startswith("gsisio_jax.")
    with explained(f"inclusion: calling the function with x of shape {x.shape}"):
        try:
            found = jax.make_jaxpr(f, return_shape=True)(x, *args)
        except TypeError as error:
            if "not a valid JAX type" not in str(error):
                raise
            raise ValueError(f"inclusion: the function must return an array; {str(error).splitlines()[0]}") from None
        if not ours:
            refuse_change("inclusion: the function", found[0], jax.make_jaxpr(lambda *given: f(*given))(x, *args))
    return found


def _check_results(closed: Any, shape: tuple[int, ...]) -> None:
    """Refuse what would get bounds that are none, without a word."""
    refuse_trace(
        "inclusion: the function",
        closed,
        "Give the random number as a further argument, a box of all its values",
        f"the box has shape {shape}",
    )
    if not closed.out_avals:
        raise ValueError("inclusion: the function returns nothing (None); let it return an array")
    for out in closed.out_avals:
        if jnp.issubdtype(out.dtype, jnp.complexfloating):
            raise ValueError(
                f"inclusion: the function must return real numbers, it returns {out.dtype}; return real and imaginary "
                "parts, jnp.stack([z.real, z.imag])"
            )


def _in_type(node: Node, dtype: Any) -> Node:
    """What a constant of f has promoted comes back in the type of the box, rounded outward."""
    if node.dtype == dtype:
        return node
    form = node.form
    if form is not None:
        slope, info = jnp.asarray(form.slope).astype(dtype), jnp.finfo(dtype)

        def raised(lost: Any, some: Any) -> Any:
            """In the narrower type, in which what is lost of a small slope would vanish."""
            return lost.astype(dtype) + where(some, info.tiny, 0).astype(dtype)

        lost = raised(2 * float(info.eps) * abs(slope), form.slope != 0)
        slack = sum_slack(lost, None if form.slack is None else raised(2 * form.slack, form.slack != 0))
        domain = InputBox(
            *(jnp.asarray(side).astype(dtype) for side in (form.box.lower, form.box.upper, form.box.magnitude))
        )
        form = Form(slope, form.offset.astype(dtype), domain, slack)
    return Node(node.range.astype(dtype), form, None if node.jac is None else node.jac.astype(dtype))


def _as_numbers(node: Node, dtype: Any) -> Node:
    """Truth values that leave f count as 0 and 1."""
    return Node(Interval.unchecked(node.range.lower.astype(dtype), node.range.upper.astype(dtype)), None, node.jac)


def _finish_range(node: Node) -> Interval:
    return guard(node.range)


def _finish_affine(node: Node, box: Interval) -> AffineForm:
    slope, offset = slope_of(node, InputBox.of(box)), guard(node.offset if node.form is None else node.form.folded())
    # Slopes that overflowed say nothing: slope 0 does.
    bounds = guard(node.range)
    if is_known(slope):
        return AffineForm(jnp.asarray(np.moveaxis(slope, 0, -1)), jax.tree.map(jnp.asarray, offset), bounds)
    good = jnp.isfinite(add_up(jnp.abs(slope), 0))
    return AffineForm(jnp.moveaxis(where(good, slope, 0), 0, -1), choose(good, offset, bounds), bounds)


def affine_with_slack(f: Callable[..., Any]) -> Callable[..., Any]:
    """`affine`, but the offset belongs to a slope that is known to within a slack only, returned beside: (*out, n).

    On infinite boxes that is more than an offset which holds for the slope as it stands.
    """

    def bounds(box: Interval, *args: Any) -> Any:
        return _run(f, _typed("affine", box, args), _variable, args, _finish_with_slack)

    return bounds


def affine_and_jacobian(f: Callable[..., Any], with_slack: bool = False) -> Callable[..., Any]:
    """`affine` (or `affine_with_slack`) and `jacobian`, which has all that the former needs: one walk through f."""
    affine = _finish_with_slack if with_slack else _finish_affine

    def bounds(box: Interval, *args: Any) -> Any:
        box = _typed("affine", box, args)
        start = partial(_variable, derivative=True)
        return _run(f, box, start, args, lambda node, box: (affine(node, box), _finish_jacobian(node, box)))

    return bounds


def _finish_with_slack(node: Node, box: Interval) -> tuple[AffineForm, Any]:
    slope = slope_of(node, InputBox.of(box))
    slope, slack = (jnp.moveaxis(jnp.asarray(v), 0, -1) for v in (slope, slack_of(node, slope)))
    good, bounds = jnp.isfinite(add_up(abs(slope))), guard(node.range)
    slope, slack = (where(good[..., None], v, 0) for v in (slope, slack))
    return AffineForm(slope, choose(good, guard(node.offset), bounds), bounds), slack


def _finish_jacobian(node: Node, box: Interval) -> Interval:
    jac = guard(jac_of(node, box.lower.shape[0]))
    return Interval.unchecked(jnp.moveaxis(jac.lower, 0, -1), jnp.moveaxis(jac.upper, 0, -1))
