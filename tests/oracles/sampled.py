"""Bounds of a function on a box against an oracle in NumPy, sampled on corners, faces and inside."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from oracles.uncompiled import in_numpy

from gsisio_jax import Interval, inclusion
from gsisio_jax.inclusion.transforms import affine_and_jacobian
from gsisio_jax.interval.rounding import using

SETTINGS = (("outward", np.float64), ("outward", np.float32), ("nearest", np.float64))


def bounds(fn: Callable[..., Any], lower: Any, upper: Any, rounding: str, dtype: Any) -> dict[str, Any]:
    """Range, affine form and Jacobian, computed in NumPy: compiling takes longer than all that is checked here.
    Compiled programs are what tests/rounding checks."""

    ends = (np.asarray(lower, dtype), np.asarray(upper, dtype))
    found = _program(fn, rounding)(*ends)
    return jax.tree.map(lambda v: np.asarray(v, np.float64), found)


@functools.lru_cache(4)
def _program(fn: Callable[..., Any], rounding: str) -> Callable[..., Any]:
    def call(low: Any, high: Any) -> Any:
        box = Interval.unchecked(low, high)
        natural = inclusion.natural(fn, rounding)(box)  # type: ignore[arg-type]
        if (rounding, low.dtype) == SETTINGS[0]:
            form = inclusion.affine(fn, rounding)(box)  # type: ignore[arg-type]
            jac = inclusion.jacobian(fn, rounding)(box)  # type: ignore[arg-type]
        else:  # what both have in common, which is nearly all, is walked through once
            with using(rounding):  # type: ignore[arg-type]
                form, jac = affine_and_jacobian(fn)(box)
        return {"natural": natural, "affine": form.range, "slope": form.slope, "offset": form.offset, "jacobian": jac}

    return in_numpy(call)


def points(lower: Any, upper: Any, count: int = 300) -> np.ndarray:
    """Corners and the grid between them, which holds points of every face, and random points."""
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    grid = itertools.product(
        *(np.linspace(a, b, 5 if len(lower) < 4 else 3) for a, b in zip(lower, upper, strict=True))
    )
    return np.concatenate([list(grid), np.random.default_rng(0).uniform(lower, upper, (count, len(lower)))])


def check(
    fn: Callable[..., Any],
    oracle: Callable[[np.ndarray], Any],
    lower: Any,
    upper: Any,
    rounding: str,
    dtype: Any,
    loose: float = 1.01,
    slopes: float | None = 1.01,
) -> dict[str, Any]:
    """Are values, what is left of the slope, and difference quotients inside, and is the range tight?

    Args:
        fn: for JAX.
        oracle: the same in NumPy, of one point.
        lower, upper: the box.
        rounding, dtype: of the bounds; points are rounded to that type first.
        loose: how many times as wide as the sampled values the affine range may be.
        slopes: the same for the Jacobian against quotients over small steps; None: no finite bound is expected.
    """
    found = bounds(fn, lower, upper, rounding, dtype)
    low, high = np.asarray(lower, dtype).astype(float), np.asarray(upper, dtype).astype(float)
    x = np.clip(points(lower, upper).astype(dtype).astype(float), low, high)
    values = np.array([oracle(v) for v in x], float)
    eps = 1e-13 * (1 + np.abs(values).max())  # of the oracle; and of bounds rounded to nearest
    for name in ("natural", "affine"):
        _inside(found[name], values, eps, name)
    rest = values - np.einsum("...j,kj->k...", found["slope"], x)
    _inside(found["offset"], rest, eps, "offset")
    quotients(found["jacobian"], x, values, eps)
    width, seen = found["affine"].upper - found["affine"].lower, values.max(0) - values.min(0)
    room = 4e-5 if dtype == np.float32 else 1e-9
    assert (width <= loose * seen + room * (1 + np.abs(values).max())).all(), (width, seen)
    if slopes is None:
        assert not np.isfinite(found["jacobian"].upper - found["jacobian"].lower).all()
    else:
        _tight_slopes(found["jacobian"], oracle, low, high, slopes, dtype)
    return found


def _inside(box: Any, values: np.ndarray, eps: float, name: str) -> None:
    room = (values - box.lower).min(), (box.upper - values).min()
    assert min(room) >= -eps, (name, room)


def quotients(jac: Any, x: np.ndarray, values: np.ndarray, eps: float) -> None:
    """``f(a) - f(b)`` in ``J (a - b)``, for pairs that are far apart and for close ones."""
    order = np.random.default_rng(1).permutation(len(x))
    for shift in (order, np.roll(np.arange(len(x)), 1)):
        step, change = x - x[shift], values - values[shift]
        step = step.reshape(len(x), *(1,) * (values.ndim - 1), -1)
        with np.errstate(invalid="ignore"):
            p, q = (np.where(step == 0, 0, side * step) for side in (jac.lower, jac.upper))
        low, high = np.minimum(p, q).sum(-1), np.maximum(p, q).sum(-1)
        assert (low - 2 * eps <= change).all()
        assert (change <= high + 2 * eps).all()


def _tight_slopes(jac: Any, oracle: Any, lower: Any, upper: Any, loose: float, dtype: Any) -> None:
    """Against central differences inside the box."""
    inner, step = points(lower, upper, 100), 1e-6
    inner = np.clip(inner, lower + 2 * step, upper - 2 * step)
    for k in range(len(lower)):
        move = np.eye(len(lower))[k] * step
        seen = np.array([(np.asarray(oracle(v + move)) - oracle(v - move)) / (2 * step) for v in inner], float)
        width = jac.upper[..., k] - jac.lower[..., k]
        room = 2e-4 if dtype == np.float32 else 1e-5
        assert (width <= loose * (seen.max(0) - seen.min(0)) + room * (1 + np.abs(seen).max())).all(), k
