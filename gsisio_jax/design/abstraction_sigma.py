"""Affine abstraction: f and its derivatives on many boxes, and sigma, the interpolation error on a cell."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion import affine, jacobian
from gsisio_jax.inclusion.rules.makers import library_function
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.rounding import outward
from gsisio_jax.scalar.numpy_program import numpy_function

_BATCH = 1024  # boxes per call of a program
_REMEDIES = 'give `constant`, or take another class: "Lipschitz" where f has kinks, "C0" with the modulus of continuity'


def refusal(text: str) -> ValueError:
    """An error of `affine_abstraction`, to be raised."""
    return ValueError(f"affine_abstraction: {text}")


def amount(name: str, value: Any, m: int) -> np.ndarray:
    """A nonnegative argument as an array (m,)."""
    try:
        number = np.broadcast_to(np.asarray(value, np.float64), (m,))
    except (TypeError, ValueError):
        number = np.full(m, np.nan)
    if not (number >= 0).all() or not np.isfinite(number).all():
        raise refusal(f"`{name}` must be a nonnegative number or {m} of them, got {value!r}")
    return number


_QUESTIONS: dict[str, Callable[[Any, Interval], Any]] = {
    "value": lambda f, box: f(box.lower),
    "bounds": lambda f, box: (affine(f)(box), f(0.5 * box.lower + 0.5 * box.upper)),
    "first": lambda f, box: (jacobian(f)(box), None),
    "second": lambda f, box: (jacobian(f)(box), jacobian(jax.jacfwd(f))(box)),
}


def on_boxes(question: str, f: Any, lower: np.ndarray, upper: np.ndarray) -> Any:
    """Results on all boxes (boxes, n), as NumPy arrays; in batches of one size, the last one filled up."""
    program = _program(question, f, lower.shape[1], outward())
    parts = []
    for start in range(0, len(lower), _BATCH):
        index = np.minimum(np.arange(start, start + _BATCH), len(lower) - 1)
        parts.append(program(lower[index], upper[index]))
    return jax.tree.map(lambda *rows: np.concatenate(rows)[: len(lower)], parts[0], *parts[1:])


# Kept for the next boxes, and for a second mesh; it rounds as it did when it was traced.
@lru_cache(16)
def _program(question: str, f: Any, n: int, rounds_outward: bool) -> Callable[..., Any]:
    """In NumPy: XLA would take ten times as long to compile second derivatives as all boxes take here."""
    ask, batch = _QUESTIONS[question], np.zeros((_BATCH, n))
    return numpy_function(jax.vmap(lambda a, b: ask(f, Interval.unchecked(a, b))), batch, batch)


def with_hash(f: Any) -> Any:
    """The function itself if it has a hash, by which programs are kept; else a new one that does the same, so that
    nothing is kept for the next call: what has no hash may have changed by then (unlike the maps of `as_static`)."""
    try:
        hash(f)
    except TypeError:
        return lambda x: f(x)
    return f


def values_at(f: Any, corners: np.ndarray) -> np.ndarray:
    """f at the vertices of all cells (cells, vertices, m)."""
    flat = corners.reshape(-1, corners.shape[-1])
    out = jax.eval_shape(f, flat[0])
    if len(getattr(out, "shape", ())) != 1 or not jnp.issubdtype(out.dtype, jnp.floating):
        raise refusal(f"f must map an array {flat.shape[1:]} to a floating array (m,), got {out}; jnp.ravel its result")
    found = on_boxes("value", f, flat, flat)
    if not np.isfinite(found).all():
        where, i = np.argwhere(~np.isfinite(found))[0]
        raise refusal(f"component {i} of f is {found[where, i]} at the vertex {flat[where]}; take a smaller region")
    return found.reshape(*corners.shape[:2], -1)


def sigma_of(
    f: Any, lower: np.ndarray, upper: np.ndarray, smoothness: str, constant: Any, m: int, tighten: bool
) -> np.ndarray:
    """sigma per cell and component (cells, m)."""
    half = 0.5 * (upper - lower)
    delta = np.linalg.norm(half, axis=1)[:, None]
    if smoothness == "C0":
        if not callable(constant):
            raise refusal(
                f'smoothness="C0" needs `constant`, a function omega with |f(x) - f(y)| <= omega(|x - y|), got '
                f'{constant!r}; smoothness="Lipschitz" needs no constant'
            )
        return 2 * np.array([amount("constant(delta)", constant(float(d)), m) for d in delta[:, 0]])
    if constant is not None:
        number = amount("constant", constant, m)
        return number * delta if smoothness != "C2" else 0.5 * number * delta**2
    first, second = _enclosed_derivatives(f, lower, upper, smoothness == "C2")
    moving = (half > 0)[:, None, :]
    size = _magnitude(first, moving, "the derivative", smoothness)
    if second is None:
        # |f(x) - f(v)| <= sum |f'_j| |x_j - v_j|, of mean at most half_j; a common slope of f and both planes is free.
        printed = np.linalg.norm(size, axis=-1) * delta
        sharp = np.einsum("kij,kj->ki", np.where(moving, first.radius, 0.0), half)
    else:
        size = _magnitude(second, moving[..., None] & moving[..., None, :], "the second derivative", smoothness)
        # The norm of a matrix is at most that of its magnitudes; the second form does not depend on the units of x.
        printed = 0.5 * np.linalg.norm(size, 2, axis=(-2, -1)) * delta**2
        sharp = 0.5 * np.einsum("kj,kijl,kl->ki", half, size, half)
    return np.minimum(printed, sharp) if tighten else printed


def _enclosed_derivatives(f: Any, lower: np.ndarray, upper: np.ndarray, second: bool) -> tuple[Any, Any]:
    obstacle = _foreign_rule(jax.make_jaxpr(f)(lower[0]).jaxpr) if second else None
    if obstacle is not None:
        raise refusal(f"f uses {obstacle}, so JAX's second derivative may not be the true one; {_REMEDIES}")
    try:
        return on_boxes("second" if second else "first", f, lower, upper)
    except (TypeError, ValueError, NotImplementedError) as error:
        raise refusal(f"the derivatives of f cannot be enclosed ({error}); {_REMEDIES}") from error


def _magnitude(box: Interval, moving: np.ndarray, what: str, smoothness: str) -> np.ndarray:
    """Largest magnitude in each enclosure, 0 along axes on which the cell has no width."""
    size = np.where(moving, np.maximum(np.abs(box.lower), np.abs(box.upper)), 0.0)
    if not np.isfinite(size).all():
        cell, i = np.argwhere(~np.isfinite(size))[0][:2]
        raise refusal(
            f'smoothness="{smoothness}" needs {what} bounded, but that of component {i} has no finite bound on cell '
            f"{cell} (a kink, a jump, a pole, or a box too large for the bounds); {_REMEDIES}"
        )
    return size


def _foreign_rule(jaxpr: Any) -> str | None:
    """What makes JAX differentiate something other than f: a custom rule that is not JAX's own, or stop_gradient."""
    for eqn in jaxpr.eqns:
        name, values = eqn.primitive.name, list(eqn.params.values())
        bodies = [body for value in values if hasattr(body := getattr(value, "jaxpr", value), "debug_info")]
        if name == "stop_gradient":
            return "stop_gradient"
        if name.startswith("custom_") and not (bodies and all(map(library_function, bodies))):
            sources = [getattr(body.debug_info, "func_src_info", None) or "" for body in bodies]
            return f"a custom derivative rule ({', '.join(sources)})"
        nested = [getattr(v, "jaxpr", v) for value in values for v in (value if isinstance(value, tuple) else [value])]
        for inner in nested:
            if hasattr(inner, "eqns") and (found := _foreign_rule(inner)) is not None:
                return found
    return None
