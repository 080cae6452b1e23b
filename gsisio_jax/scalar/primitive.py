"""A scalar program as one equation of JAX, with derivatives made on its own graph.

JAX would differentiate thousands of equations one by one, several times over: tangents of all, what to keep of them
for the way back, and the way back. Here the derivative of a program is another program (`derivative`), traced where it
is compiled. Reverse mode keeps the arguments of a program and nothing else; the way back computes the rest again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.interpreters import ad, batching, mlir

from gsisio_jax._collector import rare_collection
from gsisio_jax._room import with_room
from gsisio_jax.scalar.derivative import Mask, cotangent_program, reached, tangent_program
from gsisio_jax.scalar.program import ScalarProgram

Levels = tuple[Mask, ...]
"""For every `jax.vmap`, the innermost first: which arguments have its axis (in front of those of the levels before)."""

_program = jex.Primitive("scalar_program")
_tangent = jex.Primitive("scalar_tangents")
_program.multiple_results = _tangent.multiple_results = True


def run(program: ScalarProgram, args: Sequence[Any]) -> list[Any]:
    """Entries of all results from entries of all arguments, array by array."""
    args = [jnp.asarray(arg, number.dtype) for arg, number in zip(args, program.inputs, strict=True)]
    return _program.bind(*args, program=program, levels=())


def written(eqn: Any) -> Callable[..., Any] | None:
    """JAX operations of an equation that is a program of numbers or its derivative; None for any other."""
    bodies = {_program: _lowered, _tangent: _tangent_function}
    return partial(bodies[eqn.primitive], **eqn.params) if eqn.primitive in bodies else None


def numbers_of(eqn: Any) -> ScalarProgram | None:
    """The program of an equation that is one, or its derivative, on single numbers; None for any other."""
    if eqn.primitive not in (_program, _tangent) or eqn.params["levels"]:
        return None
    program = eqn.params["program"]
    return program if eqn.primitive is _program else tangent_program(program, eqn.params["moving"])


def _function(program: ScalarProgram, levels: Levels) -> Callable[..., Any]:
    def plain(*args: Any) -> Any:
        return program(args)

    function = plain
    for marks, out in zip(levels, _result_levels(program, levels), strict=True):
        axes = [tuple(0 if mark else None for mark in both) for both in (marks, out)]
        function = jax.vmap(function, in_axes=axes[0], out_axes=list(axes[1]))
    return function


def _result_levels(program: ScalarProgram, levels: Levels) -> Levels:
    """Which results have the axis of each level: those that depend on an argument that has it."""
    sources = program.sources()
    bits = (sum(1 << i for i, mark in enumerate(marks) if mark) for marks in levels)
    return tuple(tuple(bool(source & level) for source in sources) for level in bits)


def _types(args: Sequence[Any], program: ScalarProgram, levels: Levels) -> list[Any]:
    sizes = []
    for depth, marks in enumerate(levels):
        which = marks.index(True)
        # Its axis stands in front of those of the levels before that this argument has.
        sizes.append(args[which].shape[-1 - sum(marks_[which] for marks_ in levels[:depth])])
    results = _result_levels(program, levels)
    types = []
    for i, dtype in enumerate(program.types):
        shape = tuple(size for size, out in zip(sizes[::-1], results[::-1], strict=True) if out[i])
        types.append(ShapedArray(shape, dtype))
    return types


@with_room
@rare_collection()
def _lowered(*args: Any, program: ScalarProgram, levels: Levels) -> Any:
    return _function(program, levels)(*args)


def _derivative(primals: Any, tangents: Any, program: ScalarProgram, levels: Levels) -> tuple[Any, Any]:
    out = _program.bind(*primals, program=program, levels=levels)
    moving = tuple(type(t) is not ad.Zero for t in tangents)
    reaches = reached(program, moving)
    found: Any = iter(())
    if any(reaches):
        own = [t for t, moves in zip(tangents, moving, strict=True) if moves]
        both = tuple((*marks, *(m for m, moves in zip(marks, moving, strict=True) if moves)) for marks in levels)
        found = iter(_tangent.bind(*primals, *own, program=program, moving=moving, levels=both))
    zeros = (ad.Zero(jax.typeof(x).to_tangent_aval()) for x in out)
    return out, [next(found) if reaches_ else zero for reaches_, zero in zip(reaches, zeros, strict=True)]


def _batched(primitive: Any) -> Callable[..., Any]:
    def batch(args: Any, dims: Any, *, levels: Levels, **params: Any) -> Any:
        args = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(args, dims, strict=True)]
        levels = (*levels, tuple(d is not None for d in dims))
        out = primitive.bind(*args, levels=levels, **params)
        program = params["program"] if primitive is _program else tangent_program(**params)
        marks = _result_levels(program, levels[-1:])[0]
        return out, [0 if mark else None for mark in marks]

    return batch


def _transposed(cotangents: Any, *args: Any, program: ScalarProgram, moving: Mask, levels: Levels) -> Any:
    primals, linear = args[: len(moving)], args[len(moving) :]
    nonzero = [type(c) is not ad.Zero for c in cotangents]
    if not any(nonzero):
        return [None] * len(args)
    given = iter(nonzero)
    wanted = tuple(r and next(given) for r in reached(program, moving))
    back = cotangent_program(program, moving, wanted)
    out = _result_levels(tangent_program(program, moving), levels)
    levels_back = tuple(
        (*marks[: len(moving)], *(mark for mark, is_given in zip(marks_out, nonzero, strict=True) if is_given))
        for marks, marks_out in zip(levels, out, strict=True)
    )
    own = [c for c, is_given in zip(cotangents, nonzero, strict=True) if is_given]
    found = _program.bind(*primals, *own, program=back, levels=levels_back)
    have = _result_levels(back, levels_back)
    fitted = []
    for i, (value, arg) in enumerate(zip(found, linear, strict=True)):
        has = [marks[i] for marks in have[::-1]]
        wants = [marks[len(moving) + i] for marks in levels[::-1]]
        fitted.append(_fitted(value, has, wants, arg.aval.shape))
    return [*(None for _ in primals), *fitted]


def _fitted(value: Any, has: Sequence[bool], wants: Sequence[bool], shape: tuple[int, ...]) -> Any:
    """A cotangent with the axes that its argument has: others are summed over, missing ones are filled."""
    spare = [h and not w for h, w in zip(has, wants, strict=True) if h]
    value = value.sum(tuple(axis for axis, is_spare in enumerate(spare) if is_spare))
    kept = [h for h, w in zip(has, wants, strict=True) if w]
    own = tuple(size if h else 1 for size, h in zip(shape, kept, strict=True))
    return jnp.broadcast_to(value.reshape(own), shape)


def _tangent_function(*args: Any, program: ScalarProgram, moving: Mask, levels: Levels) -> Any:
    return _program.bind(*args, program=tangent_program(program, moving), levels=levels)


def _tangent_derivative(primals: Any, tangents: Any, **params: Any) -> Any:
    program = tangent_program(params["program"], params["moving"])
    return _derivative(primals, tangents, program, params["levels"])


_program.def_impl(lambda *args, **params: jax.jit(lambda *a: _lowered(*a, **params))(*args))
_tangent.def_impl(_tangent_function)
_program.def_abstract_eval(lambda *args, **params: _types(args, **params))
_tangent.def_abstract_eval(
    lambda *args, program, moving, levels: _types(args, tangent_program(program, moving), levels)
)
mlir.register_lowering(_program, mlir.lower_fun(_lowered, multiple_results=True))
mlir.register_lowering(_tangent, mlir.lower_fun(_tangent_function, multiple_results=True))
ad.primitive_jvps[_program] = _derivative
ad.primitive_jvps[_tangent] = _tangent_derivative
ad.primitive_transposes[_tangent] = _transposed
batching.primitive_batchers[_program] = _batched(_program)
batching.primitive_batchers[_tangent] = _batched(_tangent)
