"""Programs of single numbers as NumPy operations, without tracing them again."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from gsisio_jax.scalar.graph import Number, is_constant
from gsisio_jax.scalar.numpy_library import plain
from gsisio_jax.scalar.numpy_operations import operation_of
from gsisio_jax.scalar.program import ScalarProgram, bound
from gsisio_jax.scalar.unroll import ArrayOperation

SAME = {"stop_gradient", "fusion_barrier", "copy", "wave", "falling_wave"}
"""Operations that leave their first argument as it is."""


class Kind(NamedTuple):
    shape: tuple[int, ...]
    dtype: Any


class Operations(Protocol):
    """What a program is appended to (`numpy_program`)."""

    def place(self, value: Any = None) -> int: ...
    def append(
        self, function: Any, operands: list[int], given: Any, found: Any, primitive: Any = None
    ) -> list[int]: ...
    def equation(self, eqn: Any, operands: list[int]) -> list[int]: ...
    def add(self, jaxpr: Any, consts: Sequence[Any], inputs: list[int]) -> list[int]: ...


def has_numbers_of_numpy(program: ScalarProgram) -> bool:
    """Rather than random keys."""
    numbers = (*program.operations, *program.inputs)
    return all(number.name == "array" or isinstance(number.dtype, np.dtype) for number in numbers)


def add_numbers(into: Operations, program: ScalarProgram, inputs: Sequence[int]) -> list[int]:
    """Append the operations of a program of numbers to whose arguments these places belong; places of its results."""
    places: dict[int, int] = {id(number): i for number, i in zip(program.inputs, inputs, strict=True)}
    entries: dict[int, list[int]] = {}

    def of(value: Any) -> int:
        return places[id(value)] if isinstance(value, Number) else into.place(np.asarray(value))

    def computed(name: str, given: Sequence[Any], dtype: Any, number: Any = None) -> int:
        kinds, found = [Kind((), value.dtype) for value in given], [Kind((), dtype)]
        params = number.equation.params if number is not None and number.equation is not None else {}
        params = {"new_dtype": dtype} if name == "convert_element_type" else params
        return into.append(_function(name, number, params, kinds), [*map(of, given)], kinds, found, (name, params))[0]

    for number in program.operations:
        operands, name = number.operands, number.name
        if name == "array":
            known = isinstance(number.equation, ArrayOperation)
            entries[id(number)] = (_array if known else _traced)(into, number.equation, operands, of)
        elif name == "part":
            places[id(number)] = entries[id(operands[0])][number.equation]
        elif name in SAME or (name == "convert_element_type" and operands[0].dtype == number.dtype):
            places[id(number)] = of(operands[0])
        else:
            places[id(number)] = computed(name, operands, number.dtype, number)
    return [
        of(value) if value.dtype == dtype else computed("convert_element_type", [value], np.dtype(dtype))
        for value, dtype in zip(program.outputs, program.types, strict=True)
    ]


def _function(name: str, number: Any, params: Any, kinds: Sequence[Any]) -> Callable[..., Sequence[Any]]:
    primitive = number.equation.primitive if isinstance(number, Number) and number.equation is not None else None
    function = operation_of(name, primitive, params, kinds)
    return function or (lambda *args: (plain(bound(number, list(args))),))


def _array(into: Operations, operation: Any, flat: Sequence[Any], of: Callable[[Any], int]) -> list[int]:
    """Places of the entries of all results of an equation over arrays that is fed with numbers."""
    args, start = [], 0
    for shape, atom in zip(operation.shapes, operation.eqn.invars, strict=True):
        values, dtype = flat[start : start + math.prod(shape)], atom.aval.dtype
        start += len(values)
        if all(map(is_constant, values)):
            args.append(into.place(np.array(list(values), dtype).reshape(shape)))
        elif not shape and values[0].dtype == dtype:
            args.append(of(values[0]))
        else:
            args.append(_stacked(into, [*map(of, values)], [Kind((), value.dtype) for value in values], shape, dtype))
    found = []
    for place, atom in zip(into.equation(operation.eqn, args), operation.eqn.outvars, strict=True):
        shape, dtype = atom.aval.shape, atom.aval.dtype
        if not shape:
            found.append(place)
            continue
        kinds = [Kind((), dtype)] * math.prod(shape)
        found += into.append(lambda x: [*np.ravel(x)], [place], [Kind(shape, dtype)], kinds)
    return found


def _traced(into: Operations, operation: Any, flat: Sequence[Any], of: Callable[[Any], int]) -> list[int]:
    """The same of one that is JAX's business: a derivative of such an equation."""
    moving = [value for value in flat if isinstance(value, Number)]

    def entries(*given: Any) -> Any:
        left = iter(given)
        return operation([next(left) if isinstance(value, Number) else value for value in flat])

    closed = jax.make_jaxpr(entries)(*(jax.ShapeDtypeStruct((), value.dtype) for value in moving))
    return into.add(closed.jaxpr, closed.consts, [*map(of, moving)])


def _stacked(into: Operations, places: list[int], kinds: list[Any], shape: tuple[int, ...], dtype: Any) -> int:
    def stacked(*values: Any) -> Sequence[Any]:
        return (np.array(values, dtype).reshape(shape),)

    return into.append(stacked, places, kinds, [Kind(shape, dtype)])[0]
