"""A JAX function as a program of NumPy operations: for what runs a few times only, compiling takes all of the time.

Its operations are those of `numpy_operations`; what runs often becomes Python's code (`numpy_source`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import jax
import jax.extend.core as jex
import numpy as np

from gsisio_jax._collector import rare_collection
from gsisio_jax._room import with_room
from gsisio_jax.scalar.numpy_library import plain
from gsisio_jax.scalar.numpy_numbers import SAME, add_numbers, has_numbers_of_numpy
from gsisio_jax.scalar.numpy_operations import numpy_operation
from gsisio_jax.scalar.numpy_source import Operation, as_code
from gsisio_jax.scalar.primitive import numbers_of, written
from gsisio_jax.scalar.unroll import called_jaxpr

_CALLS = {
    "jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint", "custom_jvp_call", "custom_vjp_call",
    "custom_vjp_call_jaxpr",
}  # fmt: skip
_MOST_TURNS = 1000  # of a loop: a longer one is worth compiling
_FEW_RUNS = 6  # a program that runs oftener becomes Python's code, which takes about as long as these


_MAYBE_SAME = {"reshape", "squeeze", "expand_dims", "broadcast_in_dim", "convert_element_type"}


@with_room
@rare_collection()
def numpy_function(function: Callable[..., Any], *example: Any) -> Callable[..., Any]:
    """`function` of pytrees of arrays, traced once for the shapes and types of `example`.

    What depends on constants alone is computed once. Arithmetic is IEEE (nothing is flushed or contracted); a sum or a
    matrix product may be taken in any order.
    """
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*example)
    program, structure = numpy_program(closed), jax.tree.structure(shape)
    return lambda *args: jax.tree.unflatten(structure, program(*jax.tree.leaves(args)))


@with_room
@rare_collection()
def numpy_functions(function: Callable[..., Any], *example: Any) -> list[Callable[..., Any]]:
    """`numpy_function` for each of the results of a function that returns several: it is traced once for all of them,
    and a program computes what its result needs."""
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*example)
    found, first = [], 0
    for shape in shapes:
        leaves, structure = jax.tree.flatten(shape)
        last = first + len(leaves)
        found.append(_Part(_leading_to(closed, closed.jaxpr.outvars[first:last]), structure))
        first = last
    return found


class _Part:
    """A program that is made when it is called for the first time."""

    def __init__(self, closed: Any, structure: Any):
        self._closed, self._structure = closed, structure

    def __call__(self, *args: Any) -> Any:
        return jax.tree.unflatten(self._structure, self._program(*jax.tree.leaves(args)))

    @cached_property
    def _program(self) -> Callable[..., list[Any]]:
        return numpy_program(self._closed)


def _leading_to(closed: Any, results: Sequence[Any]) -> Any:
    """The jaxpr of these results alone."""
    needed, kept = {v for v in results if not isinstance(v, jex.Literal)}, []
    for eqn in reversed(closed.jaxpr.eqns):
        if not needed.isdisjoint(eqn.outvars):
            needed.update(v for v in eqn.invars if not isinstance(v, jex.Literal))
            kept.append(eqn)
    info = closed.jaxpr.debug_info._replace(result_paths=None)
    return jex.ClosedJaxpr(closed.jaxpr.replace(eqns=kept[::-1], outvars=list(results), debug_info=info), closed.consts)


@with_room
@rare_collection()
def numpy_program(closed: Any) -> Callable[..., list[Any]]:
    """The program of a jaxpr: its arguments to its results, arrays all."""
    program = _Program(closed)
    given, found = ([v.aval.dtype for v in group] for group in (closed.jaxpr.invars, closed.jaxpr.outvars))

    def run(*args: Any) -> list[Any]:
        leaves = [plain(leaf, dtype)[()] for leaf, dtype in zip(args, given, strict=True)]
        with np.errstate(all="ignore"), jax.ensure_compile_time_eval():
            values = program.runner()(leaves)
        return [plain(value, dtype) for value, dtype in zip(values, found, strict=True)]

    return run


class _Program:
    """Values by their places, None where they are not known yet, and the operations that compute these, in order."""

    def __init__(self, closed: Any) -> None:
        self.values: list[Any] = []
        self.operations: list[Operation] = []
        self.kinds = [v.aval for v in closed.jaxpr.invars]
        self.inputs = [self.place() for _ in self.kinds]
        with np.errstate(all="ignore"), jax.ensure_compile_time_eval():
            self.outputs = self.add(closed.jaxpr, closed.consts, self.inputs)
        self.drop_unused()
        self._runs = 0
        self._code: Any = None

    def runner(self, times: int = 1) -> Callable[[Sequence[Any]], Sequence[Any]]:
        """What takes leaves to results, for so many more runs; NumPy's types only where it is not code."""
        self._runs += times
        if self._code is None and self._runs >= _FEW_RUNS:
            code = as_code(self.operations, self.values, self.inputs, self.kinds, self.outputs)
            self._code = lambda leaves: code(*leaves)
        return self._code or self._run

    def place(self, value: Any = None) -> int:
        self.values.append(value)
        return len(self.values) - 1

    def add(self, jaxpr: Any, consts: Sequence[Any], inputs: list[int]) -> list[int]:
        """Append the operations of a jaxpr; places of its results."""
        fixed = [self.place(plain(const)) for const in consts]
        places: dict[Any, int] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*fixed, *inputs], strict=True))

        def of(atom: Any) -> int:
            if not isinstance(atom, jex.Literal):
                return places[atom]
            kind: Any = atom.aval
            return self.place(np.asarray(atom.val, kind.dtype))

        for eqn in jaxpr.eqns:
            operands = [of(atom) for atom in eqn.invars]
            places.update(zip(eqn.outvars, self.equation(eqn, operands), strict=True))
        return [of(atom) for atom in jaxpr.outvars]

    def equation(self, eqn: Any, operands: list[int]) -> list[int]:
        """Append one equation of any kind; places of its results."""
        if (program := numbers_of(eqn)) is not None and has_numbers_of_numpy(program):
            return add_numbers(self, program, operands)
        if (function := written(eqn)) is not None:
            body = jax.make_jaxpr(function)(*(atom.aval for atom in eqn.invars))
            return self.add(body.jaxpr, body.consts, operands)
        if eqn.primitive.name in _CALLS:
            return self.add(*called_jaxpr(eqn), operands)
        if _is_same(eqn):
            return operands[:1]
        given, found = ([v.aval for v in group] for group in (eqn.invars, eqn.outvars))
        return self.append(_operation(eqn), operands, given, found, (eqn.primitive.name, eqn.params))

    def drop_unused(self) -> None:
        """Leave operations out whose results nothing needs."""
        needed, kept = set(self.outputs), []
        for operation in reversed(self.operations):
            if not needed.isdisjoint(operation.results):
                needed.update(operation.operands)
                kept.append(operation)
        self.operations = kept[::-1]

    def _run(self, leaves: Sequence[Any]) -> list[Any]:
        """Operation by operation."""
        values = list(self.values)
        for place, leaf in zip(self.inputs, leaves, strict=True):
            values[place] = leaf
        for operation in self.operations:
            found = operation.function(*[values[i] for i in operation.operands])
            for place, value in zip(operation.results, found, strict=True):
                values[place] = value
        return [values[i] for i in self.outputs]

    def append(
        self, function: Callable[..., Sequence[Any]], operands: list[int], given: Sequence[Any], found: Sequence[Any],
        primitive: tuple[str, Any] | None = None,
    ) -> list[int]:  # fmt: skip
        """An operation on values of kinds `given`, with results of kinds `found`; at once where its operands are
        known."""
        known = [self.values[i] for i in operands]
        if all(value is not None for value in known):
            return [self.place(value) for value in function(*known)]
        results = [self.place() for _ in found]
        self.operations.append(Operation(function, operands, results, given, found, primitive))
        return results


def _is_same(eqn: Any) -> bool:
    name = eqn.primitive.name
    if name in _MAYBE_SAME:
        before, after = eqn.invars[0].aval, eqn.outvars[0].aval
        return len(eqn.invars) == 1 and before.shape == after.shape and before.dtype == after.dtype
    return name in SAME or (name == "optimization_barrier" and len(eqn.invars) == 1)


def _operation(eqn: Any) -> Callable[..., Sequence[Any]]:
    short_loop = eqn.primitive.name == "scan" and eqn.params["length"] <= _MOST_TURNS
    return _scan(eqn) if short_loop else numpy_operation(eqn)


def _scan(eqn: Any) -> Callable[..., Sequence[Any]]:
    """Turn by turn: compiled it would be one large program."""
    params = eqn.params
    body, length = _Program(params["jaxpr"]), params["length"]
    first, kept = params["num_consts"], params["num_carry"]
    order = range(length)[::-1] if params["reverse"] else range(length)
    kinds = [v.aval for v in eqn.outvars]

    def run(*args: Any) -> Sequence[Any]:
        fixed, carry, rows = args[:first], args[first : first + kept], args[first + kept :]
        stacked = [np.zeros(kind.shape, kind.dtype) for kind in kinds[kept:]]
        turn = body.runner(length)
        for i in order:
            found = turn([*fixed, *carry, *[row[i] for row in rows]])
            carry = found[:kept]
            for column, value in zip(stacked, found[kept:], strict=True):
                column[i] = value
        return [*(plain(value, kind.dtype) for value, kind in zip(carry, kinds[:kept], strict=True)), *stacked]

    return run
