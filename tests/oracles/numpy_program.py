"""Run any JAX function in plain NumPy: its program (jaxpr), operation by operation, without XLA, scan or fusion.

Used as "a plain NumPy loop of the same step": what `estimate` computes in one compiled scan must come out of a Python
loop over NumPy operations too. Every primitive below is written from NumPy's own functions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.extend import core
from scipy import special


def numpy_function(function: Callable[..., Any], *example: Any) -> Callable[..., Any]:
    """`function` as a NumPy program, traced once for the shapes of `example`."""
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*example)
    tree = jax.tree.structure(shape)

    def run(*args: Any) -> Any:
        leaves = [np.asarray(x) for x in jax.tree.leaves(args)]
        with np.errstate(all="ignore"):
            return jax.tree.unflatten(tree, _run(closed.jaxpr, [np.asarray(c) for c in closed.consts], leaves))

    return run


def _run(jaxpr: Any, consts: list[Any], args: list[Any]) -> list[Any]:
    values: dict[Any, Any] = dict(zip(jaxpr.constvars, consts, strict=True))
    values.update(zip(jaxpr.invars, args, strict=True))

    def read(atom: Any) -> Any:
        return np.asarray(atom.val, atom.aval.dtype) if isinstance(atom, core.Literal) else values[atom]

    for eqn in jaxpr.eqns:
        name, inputs, p = eqn.primitive.name, [read(v) for v in eqn.invars], eqn.params
        inner = p.get("call_jaxpr", p.get("jaxpr"))
        if inner is not None:  # jit, custom_jvp_call, ...
            outputs = _run(inner.jaxpr, [np.asarray(c) for c in inner.consts], inputs)
        elif name in ("optimization_barrier", "fusion_barrier"):
            outputs = inputs
        elif name in _ELEMENTWISE:
            outputs = [_ELEMENTWISE[name](*inputs)]
        elif name in _SHAPED:
            outputs = [_SHAPED[name](p, *inputs)]
        else:
            raise NotImplementedError(f"NumPy program: primitive {name}")
        for var, out in zip(eqn.outvars, outputs, strict=True):
            out = np.asarray(out, var.aval.dtype)
            assert out.shape == var.aval.shape, (name, out.shape, var.aval.shape)
            values[var] = out
    return [read(v) for v in jaxpr.outvars]


def _select(which: Any, *cases: Any) -> Any:
    return np.where(which, cases[1], cases[0]) if which.dtype == bool else np.choose(which, cases)


def _integer_pow(p: Any, x: Any) -> Any:
    return x ** float(p["y"])


def _round(p: Any, x: Any) -> Any:
    return np.rint(x) if "EVEN" in str(p["rounding_method"]) else np.trunc(x + np.copysign(0.5, x))


def _broadcast(p: Any, x: Any, *_: Any) -> Any:
    shape = [1] * len(p["shape"])
    for source, target in enumerate(p["broadcast_dimensions"]):
        shape[target] = x.shape[source]
    return np.broadcast_to(x.reshape(shape), p["shape"])


def _dot(p: Any, a: Any, b: Any) -> Any:
    (ca, cb), (ba, bb) = p["dimension_numbers"]
    if ba or bb:
        assert tuple(ba) == tuple(bb) == (0,)
        rows = [_dot({"dimension_numbers": (([i - 1 for i in ca], [i - 1 for i in cb]), ((), ()))}, x, y)
                for x, y in zip(a, b, strict=True)]  # fmt: skip
        return np.stack(rows)
    return np.tensordot(a, b, axes=(list(ca), list(cb)))


def _slice(p: Any, x: Any) -> Any:
    strides = p["strides"] or [1] * x.ndim
    return x[tuple(slice(a, b, s) for a, b, s in zip(p["start_indices"], p["limit_indices"], strides, strict=True))]


def _pad(p: Any, x: Any, value: Any) -> Any:
    assert all(inner == 0 and low >= 0 and high >= 0 for low, high, inner in p["padding_config"])
    return np.pad(x, [(low, high) for low, high, _ in p["padding_config"]], constant_values=value)


_ELEMENTWISE: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "neg": np.negative,
    "abs": np.abs,
    "sign": np.sign,
    "max": np.maximum,
    "min": np.minimum,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "exp": np.exp,
    "log": np.log,
    "sqrt": np.sqrt,
    "rsqrt": lambda x: 1 / np.sqrt(x),
    "rem": np.fmod,
    "tanh": np.tanh,
    "atan": np.arctan,
    "erf": special.erf,
    "logistic": special.expit,
    "square": np.square,
    "pow": np.power,
    "atan2": np.arctan2,
    "floor": np.floor,
    "ceil": np.ceil,
    "is_finite": np.isfinite,
    "stop_gradient": lambda x: x,
    "copy": lambda x: x,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "not": np.invert,
    "clamp": lambda low, x, high: np.clip(x, low, high),
    "select_n": _select,
    # Of the library itself, as their docstrings define them.
    "scale": lambda factor, value: np.where(factor == 0, 0, factor * value),
    "times": lambda a, b: np.where(np.isnan(a * b), 0, a * b),
    "smaller": np.minimum,
    "larger": np.maximum,
    "raised": lambda lower, other: np.where(np.isnan(other), lower, np.maximum(lower, other)),
    "cut": lambda upper, other: np.where(np.isnan(other), upper, np.minimum(upper, other)),
    "wave": lambda value, t, slope: value,
    "falling_wave": lambda value, t, slope: value,
}

_SHAPED: dict[str, Callable[..., Any]] = {
    "convert_element_type": lambda p, x: x.astype(p["new_dtype"]),
    "integer_pow": _integer_pow,
    "round": _round,
    "broadcast_in_dim": _broadcast,
    "reshape": lambda p, x: x.reshape(p["new_sizes"]),
    "squeeze": lambda p, x: np.squeeze(x, tuple(p["dimensions"])),
    "expand_dims": lambda p, x: np.expand_dims(x, tuple(p["dimensions"])),
    "transpose": lambda p, x: np.transpose(x, p["permutation"]),
    "concatenate": lambda p, *x: np.concatenate(x, axis=p["dimension"]),
    "stack": lambda p, *x: np.stack(x, axis=p["axis"]),
    "slice": _slice,
    "rev": lambda p, x: np.flip(x, tuple(p["dimensions"])),
    "pad": _pad,
    "iota": lambda p: _broadcast(
        {"shape": p["shape"], "broadcast_dimensions": (p["dimension"],)}, np.arange(p["shape"][p["dimension"]])
    ),
    "dot_general": _dot,
    "reduce_sum": lambda p, x: x.sum(tuple(p["axes"])),
    "reduce_max": lambda p, x: x.max(tuple(p["axes"])),
    "reduce_min": lambda p, x: x.min(tuple(p["axes"])),
    "reduce_prod": lambda p, x: x.prod(tuple(p["axes"])),
    "reduce_and": lambda p, x: x.all(tuple(p["axes"])),
    "reduce_or": lambda p, x: x.any(tuple(p["axes"])),
    "cumsum": lambda p, x: np.cumsum(np.flip(x, p["axis"]) if p["reverse"] else x, p["axis"]),
}
