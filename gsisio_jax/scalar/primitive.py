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
from jax import lax
from jax.interpreters import ad, batching, mlir

from gsisio_jax._collector import rare_collection
from gsisio_jax._room import with_room
from gsisio_jax.interval.devices import agreeing, is_meshed, merged
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
    return _program.bind(*agreeing(args), program=program, levels=())


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
    meshed = [i for i, arg in enumerate(args) if is_meshed(arg)]
    types = []
    for k, dtype in enumerate(program.types):
        axes = _axes(results, k)
        shape = tuple(sizes[depth] for depth in axes)
        own = [_axes(levels, i) for i in meshed]
        places = [[mine.index(depth) if depth in mine else None for depth in axes] for mine in own]
        types.append(merged([args[i] for i in meshed], shape, dtype, places))
    return types


def _axes(levels: Levels, i: int) -> list[int]:
    """Levels of the axes of one argument or result, from its first axis to its last."""
    return [depth for depth, marks in enumerate(levels) if marks[i]][::-1]


@with_room
@rare_collection()
def _lowered(*args: Any, program: ScalarProgram, levels: Levels) -> Any:
    return _function(program, levels)(*args)


def _derivative(primals: Any, tangents: Any, program: ScalarProgram, levels: Levels) -> tuple[Any, Any]:
    out = _program.bind(*primals, program=program, levels=levels)
    moving = tuple(type(t) is not ad.Zero for t in tangents)
    reaches = reached(program, moving)
    results = [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in out]
    places = [k for k, is_reached in enumerate(reaches) if is_reached]
    if places:
        own = [t for t, moves in zip(tangents, moving, strict=True) if moves]
        both = tuple((*marks, *(m for m, moves in zip(marks, moving, strict=True) if moves)) for marks in levels)
        found = _tangent.bind(*primals, *own, program=program, moving=moving, levels=both)
        have, wanted = _result_levels(tangent_program(program, moving), both), _result_levels(program, levels)
        for i, k in enumerate(places):
            axes = ([marks[i] for marks in have], [marks[k] for marks in wanted])
            results[k] = _spread(_apart(found[i], *axes), *axes, out[k])
    return out, results


def _apart(value: Any, has: Sequence[bool], wants: Sequence[bool]) -> Any:
    """The value without the axes that are not wanted: along these all entries are the same."""
    present = [want for h, want in zip(has, wants, strict=True) if h][::-1]
    return value if all(present) else value[tuple(slice(None) if want else 0 for want in present)]


def _spread(value: Any, has: Sequence[bool], wants: Sequence[bool], like: Any) -> Any:
    """The value with the axes that are wanted, as `like` has them: its own and others, along which it is the same."""
    kept = [h for h, want in zip(has, wants, strict=True) if want][::-1]
    if all(kept):
        return value
    sharding = jax.typeof(like).sharding if is_meshed(jax.typeof(like)) else None
    return lax.broadcast_in_dim(value, like.shape, [i for i, h in enumerate(kept) if h], out_sharding=sharding)


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
    """Cotangents of the tangents that come in, one program for all results that have the same axes.

    Say result k has the axes A (those of everything that it depends on, whatever it does to it), the tangent j that
    comes in the axes T, and t[i] means the entry of t at those axes of the index i that t has. Then

        result_k[i] = sum over j of P_kj[i] * tangent_j[i]    for every index i over A (P_kj is 0 if T is not in A),

    so what result k adds to the cotangent of j at an index over T is the sum of ``P_kj[i] * cotangent_k[i]`` over the
    axes of A that j lacks. A program of cotangents, mapped over its arguments, computes the sum of these products over
    k for each i. Only where all k have the same axes can that sum be summed over axes: a cotangent without an axis (of
    what a step hands on unchanged and all cases share) would count once for every entry of it.
    """
    primals, linear = args[: len(moving)], args[len(moving) :]
    out = _result_levels(tangent_program(program, moving), levels)
    groups: dict[Mask, set[int]] = {}
    for k, cotangent in enumerate(cotangents):
        if type(cotangent) is not ad.Zero:
            groups.setdefault(tuple(marks[k] for marks in out), set()).add(k)
    reaches = reached(program, moving)
    totals: list[Any] = [None] * len(linear)
    for axes, members in groups.items():
        results = iter(range(len(cotangents)))
        wanted = tuple(is_reached and next(results) in members for is_reached in reaches)
        own = [cotangents[k] for k in sorted(members)]
        found = _pulled_back(cotangent_program(program, moving, wanted), primals, own, linear, axes, levels)
        totals = [a if b is None else b if a is None else a + b for a, b in zip(totals, found, strict=True)]
    return [*(None for _ in primals), *totals]


def _pulled_back(
    back: ScalarProgram, primals: Any, cotangents: Any, linear: Any, axes: Mask, levels: Levels
) -> list[Any]:
    """What results that have these axes, one mark for every level, add to the cotangents of `linear`; None: nothing."""
    count = len(primals)
    marks_back = [(*marks[:count], *(mark for _ in cotangents)) for marks, mark in zip(levels, axes, strict=True)]
    kept = [any(marks) for marks in marks_back]  # an axis of other results or of tangents alone is none here
    levels_back = tuple(marks for marks, keep in zip(marks_back, kept, strict=True) if keep)
    found = _program.bind(*primals, *cotangents, program=back, levels=levels_back)
    out = iter(_result_levels(back, levels_back))
    have = [next(out) if keep else (False,) * len(linear) for keep in kept]
    own = sum(1 << i for i in range(count, count + len(cotangents)))

    def fitted(j: int) -> Any:
        wants = [marks[count + j] for marks in levels]
        # Without a cotangent it is a constant, 0; with an axis that no result of these has, none depends on it.
        if not back.sources()[j] & own or any(want and not axis for want, axis in zip(wants, axes, strict=True)):
            return None
        return _fitted(found[j], [marks[j] for marks in have], axes, wants)

    return [fitted(j) if ad.is_undefined_primal(arg) else None for j, arg in enumerate(linear)]


def _fitted(value: Any, has: Sequence[bool], axes: Sequence[bool], wants: Sequence[bool]) -> Any:
    """A cotangent with the axes that its argument has: the others are summed over.

    It has all of `axes`. What it has beyond these comes of primals that simplifying removed from the results but not
    from here: it does not depend on them.
    """
    value = _apart(value, has, axes)
    present = [want for axis, want in zip(axes, wants, strict=True) if axis][::-1]
    spare = tuple(place for place, want in enumerate(present) if not want)
    return value.sum(spare) if spare else value


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
