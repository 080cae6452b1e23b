"""Functions of JAX's own libraries that are known as a whole: a call is replaced, not its body walked.

Matched by name, and only where the body comes from JAX itself. Options of such a function are no arguments of its call:
they are in the body. Which of several functions a body is, is found by evaluating it at a few points while tracing; a
body that agrees with none of them is walked as any other. Every rule takes the equation and its arguments; it returns
the results, or None where it does not apply.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gsisio_jax.inclusion.form_arithmetic import known_if_concrete
from gsisio_jax.inclusion.node import Node, as_node, is_node, normalised
from gsisio_jax.inclusion.rules import activations, factors, solving, vectors
from gsisio_jax.inclusion.rules.comparison import select, step
from gsisio_jax.inclusion.rules.functions import CURVES
from gsisio_jax.inclusion.rules.gates import GATES
from gsisio_jax.inclusion.rules.linear import add, move, multiple, negative, subtract, total
from gsisio_jax.inclusion.rules.order import count_below
from gsisio_jax.inclusion.rules.periodic_tables import PeriodicTable, periodic
from gsisio_jax.inclusion.rules.tables import PiecewiseLinear, interpolation
from gsisio_jax.inclusion.rules.univariate import apply
from gsisio_jax.interval.box import Interval, choose, entire_like
from gsisio_jax.scalar.numpy_program import numpy_function

Rule = Callable[..., list[Any] | None]
_TABLES: dict[Any, PiecewiseLinear | PeriodicTable | None] = {}
_MOST_TABLES = 256  # kept of one process


def _concrete(*values: Any) -> bool:
    return not any(is_node(v) or isinstance(v, Tracer) for v in values)


def _body_at(eqn: Any, *args: Any) -> list[np.ndarray]:
    """Results of the body for concrete arguments."""
    return numpy_function(jex.jaxpr_as_fun(eqn.params["jaxpr"]), *args)(*args)


def _sample(eqn: Any, place: int = 0) -> np.ndarray:
    """Numbers in the shape of an argument."""
    aval = eqn.invars[place].aval
    return np.random.default_rng(0).uniform(-2, 2, aval.shape).astype(aval.dtype)


def _agree(eqn: Any, found: np.ndarray, expected: Any) -> bool:
    """But for rounding: a norm of order 2.0001 is not the Euclidean one."""
    tolerance = 32 * float(np.finfo(eqn.outvars[0].aval.dtype).eps)
    return np.shape(expected) == found.shape and bool(np.allclose(found, expected, rtol=tolerance, atol=tolerance))


# Tables ---------------------------------------------------------------------------------------------------------------
def _interp(eqn: Any, x: Any, knots: Any, values: Any, *others: Any) -> list[Any] | None:
    """A constant table at a node, or at a number that is not known while tracing."""
    if not _concrete(knots, values, *others):
        return None
    out, given = eqn.outvars[0].aval, eqn.invars[0].aval
    knots, values = np.asarray(knots, out.dtype), np.asarray(values, out.dtype)
    others = tuple(np.asarray(known_if_concrete(v)) for v in others)
    key = (str(eqn.params["jaxpr"]), knots.tobytes(), values.tobytes(), *(v.tobytes() for v in others))
    if key not in _TABLES:
        if len(_TABLES) >= _MOST_TABLES:
            _TABLES.pop(next(iter(_TABLES)))  # the oldest
        _TABLES[key] = interpolation(eqn, knots, values, others) or periodic(eqn, knots, values, others)
    table = _TABLES[key]
    if table is None:
        return None
    x = x if is_node(x) else as_node(x, given.shape, given.dtype)
    if x.dtype != out.dtype:
        x = move(lambda v: v.astype(out.dtype), x)
    return [apply(table, x)]


def _searchsorted(eqn: Any, table: Any, query: Any, *sorter: Any) -> list[Any] | None:
    shape = eqn.invars[0].aval.shape
    if len(shape) != 1 or sorter:
        return None
    ordered = np.arange(1.0, shape[0] + 1).astype(eqn.invars[0].aval.dtype)
    probe = np.full(eqn.invars[1].aval.shape, ordered[0], eqn.invars[1].aval.dtype)
    found = _body_at(eqn, ordered, probe)[0]
    right = bool((found == 1).all())
    if not (right or (found == 0).all()):
        return None
    return [count_below(table, query, right)]


# Linear algebra -------------------------------------------------------------------------------------------------------
def _norm(eqn: Any, x: Any) -> list[Any] | None:
    """The Euclidean norm over all entries or over one axis."""
    sample = _sample(eqn)
    (found,) = _body_at(eqn, sample)
    for axes in (tuple(range(sample.ndim)), *((axis,) for axis in range(sample.ndim))):
        count = math.prod(sample.shape[axis] for axis in axes)
        for keeps in (False, True):
            if count > 64 or not _agree(eqn, found, np.sqrt((sample**2).sum(axes, keepdims=keeps))):
                continue
            rest = tuple(n for axis, n in enumerate(sample.shape) if axis not in axes)

            def rows(v: Any, axes: Any = axes, count: int = count, rest: Any = rest) -> Any:
                return jnp.moveaxis(v, axes, range(len(axes))).reshape(count, *rest)

            return [move(lambda v: v.reshape(found.shape), vectors.norm(move(rows, x)))]
    return None


def _hypot(eqn: Any, x: Any, y: Any) -> list[Any]:
    shape, dtype = eqn.outvars[0].aval.shape, eqn.outvars[0].aval.dtype

    def whole(v: Any) -> Any:
        return move(lambda w: jnp.broadcast_to(w, shape).astype(dtype), v)

    return [vectors.hypot(whole(x), whole(y))]


def _copysign(eqn: Any, x: Any, y: Any) -> list[Any] | None:
    """The magnitude of x with the sign of y; that of a zero may be either."""
    if not is_node(y):
        return None
    aval = eqn.outvars[0].aval
    x, y = (v if is_node(v) else as_node(v, np.shape(v), aval.dtype) for v in (x, y))
    x, y = (move(lambda w: jnp.broadcast_to(w, aval.shape).astype(aval.dtype), v) for v in (x, y))
    size = normalised(apply(CURVES["abs"], x))
    below = step(Interval.unchecked(y.range.upper < 0, y.range.lower <= 0), [y])
    return [select(below, size, negative(size))]


def _square(a: Any) -> int | None:
    """Rows of one square matrix, None for a batch of them."""
    shape = a.shape if is_node(a) else np.shape(a)
    return shape[0] if len(shape) == 2 and shape[0] == shape[1] and shape[0] <= solving.MOST_ROWS else None


def _det(eqn: Any, a: Node) -> list[Any] | None:
    return [factors.determinant(a)] if _square(a) else None


def _slogdet(eqn: Any, a: Node) -> list[Any] | None:
    if not _square(a):
        return None
    found = normalised(factors.determinant(a))
    sign = jnp.sign(found.range.lower), jnp.sign(found.range.upper)
    jac = found.jac
    if jac is not None:
        flat = jnp.zeros_like(jac.lower)
        jac = choose((sign[0] == sign[1]) & (sign[0] != 0), Interval.unchecked(flat, flat), entire_like(flat))
    size = normalised(apply(CURVES["abs"], found))
    return [Node(Interval.unchecked(*sign), None, jac), apply(CURVES["log"], size)]


# Functions of one variable --------------------------------------------------------------------------------------------
def _one_of(*pairs: tuple[Any, Callable[[np.ndarray], Any]]) -> Rule:
    """The curve whose function (in NumPy's double precision) the body agrees with."""

    def rule(eqn: Any, x: Any, *others: Any) -> list[Any] | None:
        if others or not jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.floating):
            return None
        sample = _sample(eqn)
        (found,) = _body_at(eqn, sample)
        for curve, exact in pairs:
            if _agree(eqn, found, exact(sample.astype(np.float64))):
                return [apply(curve, x)]
        return None

    return rule


def _logit(eqn: Any, x: Node) -> list[Any]:
    """``log(x / (1 - x))`` as ``2 atanh(2 x - 1)``, with one x."""
    moved = add(multiple(2.0, x), -np.ones(x.shape, x.dtype))
    return [multiple(2.0, apply(CURVES["atanh"], normalised(moved)))]


def _celu(eqn: Any, x: Any, *others: Any) -> list[Any] | None:
    """With the scale that is its second argument, or in its body."""
    if not _concrete(*others) or len(others) > 1:
        return None
    alpha, sample = float(np.asarray(others[0]) if others else 1.0), _sample(eqn)
    if np.ndim(others[0] if others else 1.0) or not alpha > 0:
        return None
    exact = np.maximum(sample, 0) + alpha * np.expm1(np.minimum(sample, 0) / alpha)
    return [apply(activations.celu(alpha), x)] if _agree(eqn, _body_at(eqn, sample, *others)[0], exact) else None


def _std(eqn: Any, x: Any, *others: Any) -> list[Any] | None:
    """The standard deviation of all entries: the norm of their differences from the mean, which has no kink but 0."""
    sample = _sample(eqn)
    count = sample.size
    if not _concrete(*others) or not 1 < count <= 64:
        return None
    (found,) = _body_at(eqn, sample, *others)
    for less in (0, 1):
        if _agree(eqn, found, np.std(sample, ddof=less)):
            flat = move(lambda v: v.reshape(-1), x)
            middle = multiple(np.asarray(1 / count, x.dtype), total(flat, [0]), rounded=True)
            away = subtract(flat, move(lambda v: jnp.broadcast_to(v, (count,)), middle))
            size = vectors.norm(normalised(away))
            return [multiple(np.asarray((count - less) ** -0.5, x.dtype), size, rounded=True)]
    return None


WHOLE: dict[str, Rule] = {
    "_interp": _interp,
    "searchsorted": _searchsorted,
    "norm": _norm,
    "hypot": _hypot,
    "copysign": _copysign,
    "det": _det,
    "slogdet": _slogdet,
    "logit": _logit,
    "silu": _one_of(GATES["silu"]),
    "mish": _one_of(GATES["mish"]),
    "soft_sign": _one_of((activations.SOFT_SIGN, lambda t: t / (1 + np.abs(t)))),
    "sinc": _one_of((activations.SINC, np.sinc)),
    "celu": _celu,
    "_std": _std,
    "_xlogx": lambda eqn, x: [apply(activations.X_LOG_X, x)],
}
# Of these the result is not rounded.
EXACT = {"searchsorted", "copysign"}


# Systems --------------------------------------------------------------------------------------------------------------
def linear_system(eqn: Any, *args: Any) -> list[Any]:
    """``custom_linear_solve``: what ``jnp.linalg.solve``, ``inv`` and the like come to.

    Its matrix is not an argument, but among the constants of the product that it inverts; whether that product is with
    the matrix or its transpose, and how the right side lies, is found by evaluating it.
    """
    counts, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
    consts, right = args[: counts.matvec], args[sum(counts) :]
    if len(consts) != 1 or len(right) != 1 or not (n := _square(consts[0])):
        raise NotImplementedError("of a matrix that is not given as one small array")
    (a,), (b,) = consts, right
    rng = np.random.default_rng(0)
    (aval,) = (atom.aval for atom in eqn.invars[sum(counts) :])
    matrix, vector = rng.standard_normal((n, n)).astype(aval.dtype), rng.standard_normal(aval.shape).astype(aval.dtype)
    with jax.ensure_compile_time_eval():
        found = np.asarray(jex.jaxpr_as_fun(jaxprs.matvec)(matrix, vector)[0])
    for transposed in (False, True):
        for turned in (False, True):
            m = matrix.T if transposed else matrix
            if turned and vector.ndim != 2:
                continue
            if vector.shape[int(turned)] != n:
                continue
            if _agree(eqn, found, (m @ vector.T).T if turned else m @ vector):
                a = move(lambda v: v.T, a) if transposed else a
                b = move(lambda v: v.T, b) if turned else b
                x = solving.solve(a, b)
                return [move(lambda v: v.T, x) if turned else x]
    raise NotImplementedError("of a product that is none with one matrix")
