"""A JAX function as a program of NumPy operations: for what runs a few times only, compiling takes all of the time.

Its operations are those of `numpy_operations`; what runs often becomes Python's code (`numpy_source`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.extend.core as jex
import numpy as np

from gsisio_jax._collector import rare_collection
from gsisio_jax.scalar.numpy_operations import numpy_operation, operator, plain
from gsisio_jax.scalar.numpy_source import Operation, as_code
from gsisio_jax.scalar.primitive import written
from gsisio_jax.scalar.unroll import called_jaxpr

_CALLS = {
    "jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint", "custom_jvp_call", "custom_vjp_call",
    "custom_vjp_call_jaxpr",
}  # fmt: skip
_MOST_TURNS = 1000  # of a loop: a longer one is worth compiling
_FEW_RUNS = 6  # a program that runs oftener becomes Python's code, which takes about as long as these


@rare_collection()
def numpy_function(function: Callable[..., Any], *example: Any) -> Callable[..., Any]:
    """`function` of pytrees of arrays, traced once for the shapes and types of `example`.

    What depends on constants alone is computed once. Arithmetic is IEEE (nothing is flushed or contracted); a sum or a
    matrix product may be taken in any order.
    """
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*example)
    program, structure = _flat(closed), jax.tree.structure(shape)
    return lambda *args: jax.tree.unflatten(structure, program(*jax.tree.leaves(args)))


def _flat(closed: Any) -> Callable[..., list[Any]]:
    """The program of a jaxpr: its arguments to its results, arrays all."""
    program = _Program()
    inputs = [program.place() for _ in closed.jaxpr.invars]
    with np.errstate(all="ignore"), jax.ensure_compile_time_eval():
        outputs = program.add(closed.jaxpr, closed.consts, inputs)
    program.drop_unused(outputs)
    given, found = ([v.aval.dtype for v in group] for group in (closed.jaxpr.invars, closed.jaxpr.outvars))
    runs, code = 0, None

    def run(*args: Any) -> list[Any]:
        nonlocal runs, code
        runs += 1
        if code is None and runs >= _FEW_RUNS:
            code = as_code(program.operations, program.values, inputs, outputs)
        leaves = [plain(leaf, dtype)[()] for leaf, dtype in zip(args, given, strict=True)]
        with np.errstate(all="ignore"), jax.ensure_compile_time_eval():
            values = code(*leaves) if code else program.run(inputs, leaves, outputs)
        return [plain(value, dtype) for value, dtype in zip(values, found, strict=True)]

    return run


class _Program:
    """Values by their places, None where they are not known yet, and the operations that compute these, in order."""

    def __init__(self) -> None:
        self.values: list[Any] = []
        self.operations: list[Operation] = []

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
            if (function := written(eqn)) is not None:
                body = jax.make_jaxpr(function)(*(atom.aval for atom in eqn.invars))
                found = self.add(body.jaxpr, body.consts, operands)
            elif eqn.primitive.name in _CALLS:
                found = self.add(*called_jaxpr(eqn), operands)
            else:
                found = self._append(eqn, operands)
            places.update(zip(eqn.outvars, found, strict=True))
        return [of(atom) for atom in jaxpr.outvars]

    def drop_unused(self, outputs: Sequence[int]) -> None:
        """Leave operations out whose results nothing needs."""
        needed, kept = set(outputs), []
        for operation in reversed(self.operations):
            if not needed.isdisjoint(operation.results):
                needed.update(operation.operands)
                kept.append(operation)
        self.operations = kept[::-1]

    def run(self, inputs: Sequence[int], leaves: Sequence[Any], outputs: Sequence[int]) -> list[Any]:
        """Operation by operation."""
        values = list(self.values)
        for place, leaf in zip(inputs, leaves, strict=True):
            values[place] = leaf
        for operation in self.operations:
            found = operation.function(*(values[i] for i in operation.operands))
            for place, value in zip(operation.results, found, strict=True):
                values[place] = value
        return [values[i] for i in outputs]

    def _append(self, eqn: Any, operands: list[int]) -> list[int]:
        known, function = [self.values[i] for i in operands], _operation(eqn)
        if all(value is not None for value in known):
            return [self.place(value) for value in function(*known)]
        found = [self.place() for _ in eqn.outvars]
        self.operations.append(Operation(function, operands, found, operator(eqn)))
        return found


def _operation(eqn: Any) -> Callable[..., Sequence[Any]]:
    short_loop = eqn.primitive.name == "scan" and eqn.params["length"] <= _MOST_TURNS
    return _scan(eqn) if short_loop else numpy_operation(eqn)


def _scan(eqn: Any) -> Callable[..., Sequence[Any]]:
    """Turn by turn: compiled it would be one large program."""
    params = eqn.params
    turn, length = _flat(params["jaxpr"]), params["length"]
    first, kept = params["num_consts"], params["num_carry"]
    order = range(length)[::-1] if params["reverse"] else range(length)

    def run(*args: Any) -> Sequence[Any]:
        fixed, carry, rows = args[:first], args[first : first + kept], args[first + kept :]
        stacked = [np.zeros(v.aval.shape, v.aval.dtype) for v in eqn.outvars[kept:]]
        for i in order:
            found = turn(*fixed, *carry, *(row[i] for row in rows))
            carry = found[:kept]
            for column, value in zip(stacked, found[kept:], strict=True):
                column[i] = value
        return [*carry, *stacked]

    return run
