"""A program of NumPy operations as one function of Python, for what runs more than a few times.

Calling a NumPy function on a single number takes twenty times as long as Python's own operator does on the same
`numpy.float64`, with the same result; and looking operations up one by one takes as long again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np


class Operation(NamedTuple):
    """Values at `operands` to those at `results`; where these are single numbers, also as Python's operator."""

    function: Callable[..., Sequence[Any]]
    operands: list[int]
    results: list[int]
    operator: str | None = None


_ZERO = {f"zero_{kind.__name__}": kind(0) for kind in (np.float32, np.float64)}
_OPERATORS = {
    "add": "{0} + {1}", "sub": "{0} - {1}", "mul": "{0} * {1}", "div": "{0} / {1}", "neg": "-{0}", "abs": "abs({0})",
    "square": "{0} * {0}", "lt": "{0} < {1}", "le": "{0} <= {1}", "gt": "{0} > {1}", "ge": "{0} >= {1}",
    "eq": "{0} == {1}", "ne": "{0} != {1}", "and": "{0} & {1}", "or": "{0} | {1}", "xor": "{0} ^ {1}",
    "max": "{0} if {0} >= {1} or {0} != {0} else {1}", "min": "{0} if {0} <= {1} or {0} != {0} else {1}",
    "raised": "{1} if {1} > {0} else {0}", "cut": "{1} if {1} < {0} else {0}", "select_n": "{2} if {0} else {1}",
    "scale": "{0} * {1} if {0} != 0 else abs({0})", "times": "p if (p := {0} * {1}) == p else {zero}",
    **dict.fromkeys(("stop_gradient", "fusion_barrier", "optimization_barrier", "copy"), "{0}"),
    **dict.fromkeys(("wave", "falling_wave"), "{0}"),
}  # fmt: skip
_OPERATORS |= {"larger": _OPERATORS["max"], "smaller": _OPERATORS["min"]}


def single_numbers(name: str, dtype: np.dtype) -> str | None:
    """The elementwise operation of this name on single numbers, with the operands' places as {0}, {1}, ...; NaN, zeros
    and infinities as NumPy has them. None if there is none."""
    text = _OPERATORS.get(name)
    return text and text.replace("{zero}", f"zero_{dtype.name}")


def as_code(
    operations: Sequence[Operation], values: Sequence[Any], inputs: Sequence[int], outputs: Sequence[int]
) -> Callable[..., Sequence[Any]]:
    """The function of the values at `inputs` to those at `outputs`; `values` are the constants, None elsewhere."""
    known: dict[str, Any] = dict(_ZERO)
    for place, value in enumerate(values):
        if value is not None:
            # A number of its own type, not an array without axes; random keys stay with JAX.
            known[f"v{place}"] = value if isinstance(value, jax.Array) else np.asarray(value)[()]
    lines = [f"def program({', '.join(f'v{place}' for place in inputs)}):"]
    for i, (function, operands, results, text) in enumerate(operations):
        names = [f"v{place}" for place in operands]
        if text:
            lines.append(f" v{results[0]} = {text.format(*names)}")
        else:
            known[f"f{i}"] = function
            lines.append(f" {''.join(f'v{place}, ' for place in results)} = f{i}({', '.join(names)})")
    lines.append(f" return [{', '.join(f'v{place}' for place in outputs)}]")
    exec(compile("\n".join(lines), "<numpy program>", "exec"), known)
    return known["program"]
