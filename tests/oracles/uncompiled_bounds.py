"""`inclusion.natural`, `affine`, `jacobian` and `mean_value` on boxes of numbers without XLA, traced and run in NumPy.

Called outside of `jax.jit`, they give hundreds of small operations to JAX one at a time, each compiled for each shape
that it meets. Within `bounds_in_numpy` such calls are traced as `jax.jit` would and evaluated in NumPy; calls within a
trace (`jax.jit`, `jax.vmap`, `jax.grad`), or with further arguments, whose numbers are known outside of a trace, are
what they always are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np
import pytest
from oracles.uncompiled import in_numpy

from gsisio_jax import Interval, inclusion
from gsisio_jax.interval.box import is_concrete
from gsisio_jax.interval.rounding import outward
from gsisio_jax.scalar.numpy_program import numpy_function

NAMES = ("natural", "affine", "jacobian", "mean_value")

_programs: dict[Any, Callable[..., Any]] = {}


@contextmanager
def bounds_in_numpy() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name in NAMES:
            patch.setattr(inclusion, name, _through_numpy(getattr(inclusion, name)))
        yield
    _programs.clear()


def _through_numpy(transform: Callable[..., Any]) -> Callable[..., Any]:
    def transformed(f: Callable[..., Any], rounding: Any = None) -> Callable[..., Any]:
        usual = transform(f, rounding)

        def bounds(box: Any, *args: Any) -> Any:
            if args or not isinstance(box, Interval) or not (is_concrete(box.lower) and is_concrete(box.upper)):
                return usual(box, *args)
            point = box.lower is box.upper  # known to be one
            key = transform, f, rounding, outward(), point, box.shape, box.dtype
            if key not in _programs:
                _programs[key] = numpy_function(_of_a_point(usual) if point else usual, box)
            return _programs[key](box)

        return bounds

    return transformed


def _of_a_point(bounds: Callable[..., Any]) -> Callable[..., Any]:
    return lambda box: bounds(Interval.unchecked(box.lower, box.lower))


def at_points(f: Callable[..., Any], points: Any) -> np.ndarray:
    """Values of f at many points, (many, n): `jax.vmap` in NumPy."""
    return np.asarray(_vmapped(f)(np.asarray(points)))


def _vmapped(f: Callable[..., Any]) -> Callable[..., Any]:
    if ("values", f) not in _programs:
        _programs["values", f] = in_numpy(jax.vmap(f))
    return _programs["values", f]
