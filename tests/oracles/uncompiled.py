"""`estimate`, `start`, `step` and `resume` without XLA: the very same program, run in NumPy equation by equation.

Compiling a program takes three times as long as tracing it, and tests run most programs once. What XLA makes of the
recursion is tested where it is the question (tests/observer/test_containment.py, test_compiled.py, tests/rounding,
studies, examples); and the first program of every module that uses this is compiled as well, and must say the same."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import jax
import jax.extend.core as jex
import numpy as np
import pytest
from jax.core import ShapedArray
from jax.interpreters import ad, batching, mlir

from gsisio_jax.observer import estimation
from gsisio_jax.scalar.numpy_program import numpy_function

NAMES = ("_estimate", "_start", "_step", "_resume")
MOST = 100
"""Longer records are compiled: a step takes NumPy some ten milliseconds."""


def in_numpy(function: Callable[..., Any]) -> Callable[..., Any]:
    """In place of `jax.jit` for large programs that run a few times; traced once for equal shapes."""
    programs: dict[Any, Callable[..., Any]] = {}

    def run(*args: Any) -> Any:
        leaves, structure = jax.tree.flatten(args)
        key = structure, tuple((np.shape(leaf), np.asarray(leaf).dtype) for leaf in leaves)
        if key not in programs:
            programs[key] = numpy_function(function, *args)
        return programs[key](*args)

    return run


_programs: dict[Any, Callable[..., Any]] = {}
_compared: list[bool] = []


@contextmanager
def uncompiled() -> Iterator[None]:
    """Within, calls are run in NumPy, also under `jax.vmap`; where they are differentiated or part of a larger program
    they are what they always are."""
    with pytest.MonkeyPatch.context() as patch:
        for name in NAMES:
            patch.setattr(estimation, name, _through_numpy(getattr(estimation, name)))
        yield
    _programs.clear()
    _compared.clear()


def _through_numpy(compiled: Callable[..., Any]) -> Callable[..., Any]:
    def run(static: Any, traced: Any, box: Any, y: Any, u: Any, noise: Any, hold: bool) -> Any:
        if static is None or (y.ndim == 2 and len(y) > MOST):
            return compiled(static, traced, box, y, u, noise, hold)
        leaves, structure = jax.tree.flatten((traced, box, y, u, noise))
        leaves = [jax.numpy.asarray(leaf) for leaf in leaves]
        key = compiled, static, hold, structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        if key not in _programs:
            function = partial(compiled.__wrapped__, static, hold=hold)  # type: ignore[attr-defined]
            _programs[key] = _Traced(lambda *given: function(*jax.tree.unflatten(structure, given)), leaves)
        program = _programs[key]
        return jax.tree.unflatten(program.structure, _numpy.bind(*leaves, program=program, axes=()))

    return run


class _Traced:
    """A jaxpr, and the tree of its results."""

    def __init__(self, function: Callable[..., Any], leaves: Sequence[Any]):
        shapes = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves]
        self.closed, shape = jax.make_jaxpr(function, return_shape=True)(*shapes)
        self.structure = jax.tree.structure(shape)

    def mapped(self, axes: Sequence[Sequence[int | None]]) -> Callable[..., Sequence[Any]]:
        """As a function of JAX, under as many `jax.vmap` as there are axes."""
        function = jex.jaxpr_as_fun(self.closed)
        for along in axes:
            function = jax.vmap(function, in_axes=along)
        return function


_numpy = jex.Primitive("in_numpy")
_numpy.multiple_results = True


def _in_numpy(*args: Any, program: _Traced, axes: Any) -> list[Any]:
    key = program, axes, tuple(arg.shape for arg in args)
    if key not in _programs:
        _programs[key] = numpy_function(program.mapped(axes), *args)
    found = [jax.numpy.asarray(value) for value in _programs[key](*args)]
    if not _compared:
        _compared.append(True)
        for own, other in zip(found, jax.jit(program.mapped(axes))(*args), strict=True):
            _same(np.asarray(own), np.asarray(other))
    return found


def _same(own: np.ndarray, other: np.ndarray) -> None:
    """Equal, but for sums that are taken in another order."""
    assert own.dtype == other.dtype
    if own.dtype.kind == "f":
        eps = np.finfo(own.dtype).eps
        np.testing.assert_allclose(own, other, rtol=2.0**13 * eps, atol=2.0**13 * eps)
    else:
        np.testing.assert_array_equal(own, other)


def _batch(args: Any, dims: Any, *, program: _Traced, axes: Any) -> tuple[list[Any], list[int]]:
    args = [arg if axis is None else jax.numpy.moveaxis(arg, axis, 0) for arg, axis in zip(args, dims, strict=True)]
    along = tuple(None if axis is None else 0 for axis in dims)
    out = _numpy.bind(*args, program=program, axes=(*axes, along))
    return out, [0] * len(out)


def _types(*args: Any, program: _Traced, axes: Any) -> list[ShapedArray]:
    sizes: tuple[int, ...] = ()
    shapes = [arg.shape for arg in args]
    for along in axes[::-1]:  # the outermost first
        sizes += (next(shape[0] for shape, axis in zip(shapes, along, strict=True) if axis == 0),)
        shapes = [shape[1:] if axis == 0 else shape for shape, axis in zip(shapes, along, strict=True)]
    return [ShapedArray((*sizes, *out.shape), out.dtype) for out in program.closed.out_avals]


def _derivative(primals: Any, tangents: Any, *, program: _Traced, axes: Any) -> Any:
    tangents = tuple(ad.instantiate_zeros(tangent) for tangent in tangents)
    return jax.jvp(program.mapped(axes), tuple(primals), tangents)


_numpy.def_impl(_in_numpy)
_numpy.def_abstract_eval(_types)
ad.primitive_jvps[_numpy] = _derivative
batching.primitive_batchers[_numpy] = _batch
mlir.register_lowering(
    _numpy, mlir.lower_fun(lambda *args, program, axes: program.mapped(axes)(*args), multiple_results=True)
)
