"""`estimate`, `start`, `step` and `resume` without XLA: the very same program, run in NumPy equation by equation.

Compiling a program takes three times as long as tracing it, and tests run most programs once. So this is how all
modules of tests run the recursion (tests/conftest.py), but those that are about what XLA makes of it (`COMPILED`);
tests/observer/test_uncompiled.py compares both."""

from __future__ import annotations

import time
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
from oracles import uncompiled_calls
from oracles.uncompiled_calls import MOST
from oracles.uncompiled_calls import in_numpy as in_numpy

from gsisio_jax.interval.cast import as_array
from gsisio_jax.observer import estimation
from gsisio_jax.scalar.numpy_program import numpy_function, numpy_program

MOST_SECONDS = 3.0
"""Records of a batch that take so long at most are run one by one: to trace a step for many takes longer."""

NAMES = ("_estimate", "_start", "_step", "_resume")
_programs: dict[Any, Callable[..., Any]] = {}


def is_about_xla(request: pytest.FixtureRequest) -> bool:
    """Of the module of a fixture: it says ``COMPILED = True``. Doctests have modules that say nothing."""
    return getattr(getattr(request.node, "obj", None), "COMPILED", False)


@contextmanager
def uncompiled() -> Iterator[None]:
    """Within, calls are run in NumPy, also under `jax.vmap`; where they are differentiated or part of a larger program
    they are what they always are."""
    with pytest.MonkeyPatch.context() as patch:
        for name in NAMES:
            patch.setattr(estimation, name, _through_numpy(getattr(estimation, name)))
        uncompiled_calls.replaced(patch)
        yield
    _programs.clear()


def _through_numpy(compiled: Callable[..., Any]) -> Callable[..., Any]:
    def run(static: Any, traced: Any, box: Any, y: Any, u: Any, noise: Any, hold: bool) -> Any:
        if static is None or (y.ndim == 2 and len(y) > MOST):
            return compiled(static, traced, box, y, u, noise, hold)
        leaves, structure = jax.tree.flatten((traced, box, y, u, noise))
        leaves = [as_array(leaf) for leaf in leaves]
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


def _values(args: Sequence[Any], program: _Traced, axes: Any) -> Sequence[Any]:
    if axes and (found := _one_by_one(args, program, axes)) is not None:
        return found
    key = program, axes, tuple(arg.shape for arg in args)
    if key not in _programs:
        _programs[key] = numpy_function(program.mapped(axes), *args) if axes else numpy_program(program.closed)
    return _programs[key](*args)


def _one_by_one(args: Sequence[Any], program: _Traced, axes: Any) -> list[Any] | None:
    """Of a batch; None where the third record shows that all of them would take long."""
    count = _size(axes[-1], [arg.shape for arg in args])
    found: list[Sequence[Any]] = []
    for i in range(count):
        began = time.perf_counter()
        row = [arg if axis is None else arg[i] for arg, axis in zip(args, axes[-1], strict=True)]
        found.append(_values(row, program, axes[:-1]))
        if i == 2 and (time.perf_counter() - began) * count > MOST_SECONDS:  # before it may be made, or become code
            return None
    return [np.stack(column) for column in zip(*found, strict=True)] if found else None


def _size(along: Sequence[int | None], shapes: Sequence[tuple[int, ...]]) -> int:
    return next(shape[0] for shape, axis in zip(shapes, along, strict=True) if axis == 0)


def _in_numpy(*args: Any, program: _Traced, axes: Any) -> list[Any]:
    return [as_array(value) for value in _values([np.asarray(arg) for arg in args], program, axes)]


def _batch(args: Any, dims: Any, *, program: _Traced, axes: Any) -> tuple[list[Any], list[int]]:
    args = [jax.numpy.moveaxis(arg, axis, 0) if axis else arg for arg, axis in zip(args, dims, strict=True)]
    along = tuple(None if axis is None else 0 for axis in dims)
    out = _numpy.bind(*args, program=program, axes=(*axes, along))
    return out, [0] * len(out)


def _types(*args: Any, program: _Traced, axes: Any) -> list[ShapedArray]:
    sizes: tuple[int, ...] = ()
    shapes = [arg.shape for arg in args]
    for along in axes[::-1]:  # the outermost first
        sizes += (_size(along, shapes),)
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
