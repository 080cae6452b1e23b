"""What a study is given, checked and in arrays: records, bounds, lengths, the truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import read_array
from gsisio_jax.plant.system import Noise, System
from gsisio_jax.study.axes import Axis, Truth, bare

_BLOCK = 1 << 16  # rows looked at together, so that checking a large record does not double it


def prepare(call: str, system: System, arguments: Mapping[str, Any]) -> tuple[dict[str, Any], Any]:
    """Check the arguments of a study, bare or wrapped, and bring them to NumPy arrays of one floating type.

    Args:
        call: what messages name.
        system: the plant.
        arguments: initial, y, noise, u, length and truth, as in `sweep`.

    Returns:
        The arguments, bounds rounded outward where the type is narrower, and the type.

    Raises:
        ValueError: a shape or a number is not legal.
    """
    system.check_unchanged(call)
    initial, y, noise = (bare(arguments[name]) for name in ("initial", "y", "noise"))
    if not isinstance(initial, Interval) or not isinstance(noise, Noise):
        name, kind = ("noise", "Noise") if isinstance(initial, Interval) else ("initial", "Interval")
        got = type(bare(arguments[name])).__name__
        raise ValueError(f"{call}: `{name}` must be a gsisio_jax.{kind}, bare or wrapped by gx.grid; got {got}")
    y = np.asarray(read_array(call, "y", y, missing=True))
    _expect(call, "y", y, [(None, system.l)])
    steps = y.shape[-2]
    if steps == 0:
        raise ValueError(f"{call}: `y` has no rows (shape {y.shape}); give at least one measurement per record")
    _expect(call, "initial", initial.lower, [(system.n,)])
    for name, box, size in (("noise.w", noise.w, system.n), ("noise.v", noise.v, system.l)):
        if np.ndim(box.lower) == 3:
            _expect(call, name, box.lower, [(steps, size)])
        else:
            _expect(call, name, box.lower, [(size,)], ", (S, T, .) or (1, T, .) for bounds that change with time")
    _refuse(call, "y", y, np.isinf, "infinite; mark missing entries with NaN")
    try:
        Interval(initial.lower, initial.upper)
        Noise(Interval(noise.w.lower, noise.w.upper), Interval(noise.v.lower, noise.v.upper))
    except ValueError as error:
        raise ValueError(f"{call}: a bound of `initial` or `noise` is not legal. {error}") from error

    dtype = jnp.result_type(initial.dtype, y.dtype)
    dtype = jax.dtypes.canonicalize_dtype(dtype if jnp.issubdtype(dtype, jnp.floating) else float)
    cast: dict[str, Any] = {
        "initial": jax.tree.map(np.asarray, initial.astype(dtype)),
        "y": np.asarray(y, dtype),
        "noise": jax.tree.map(np.asarray, noise.astype(dtype)),
        "u": _known_input(call, system, bare(arguments["u"]), steps, dtype),
        "length": _lengths(call, bare(arguments["length"]), steps),
        "truth": _truth(call, system, bare(arguments["truth"]), steps, dtype),
    }
    for name, argument in arguments.items():
        if isinstance(argument, Axis):
            cast[name] = replace(argument, value=cast[name])
    return cast, dtype


def _known_input(call: str, system: System, u: Any, steps: int, dtype: Any) -> np.ndarray:
    if u is None:
        if system.m > 0:
            raise ValueError(f"{call}: the system has {system.m} known inputs; give `u` of shape ({steps}, {system.m})")
        return np.zeros((steps, 0), dtype)
    u = np.asarray(read_array(call, "u", u), dtype)
    _expect(call, "u", u, [(steps, system.m)])
    _refuse(call, "u", u, lambda a: ~np.isfinite(a), "not finite; a known input cannot be missing")
    return u


def _lengths(call: str, length: Any, steps: int) -> np.ndarray | None:
    if length is None:
        return None
    length = np.ma.filled(length, -1) if isinstance(length, np.ma.MaskedArray) else np.asarray(length)
    _expect(call, "length", length, [()])
    if not np.issubdtype(length.dtype, np.integer):
        raise ValueError(f"{call}: `length` must hold integers, got {length.dtype}")
    bad = (length < 1) | (length > steps)
    if bad.any():
        raise ValueError(
            f"{call}: `length` must lie between 1 and the {steps} rows of `y`, got {int(length[bad][0])}; leave "
            "records without rows out"
        )
    return length.astype(np.int32)


def _truth(call: str, system: System, truth: Any, steps: int, dtype: Any) -> Truth | None:
    if truth is None:
        return None
    if not isinstance(truth, tuple) or len(truth) != 2:
        raise ValueError(f"{call}: `truth` must be a pair (x, d), d may be None; got {type(truth).__name__}")
    x, d = (None if part is None else np.asarray(read_array(call, "truth", part), dtype) for part in truth)
    if x is None:
        raise ValueError(f"{call}: `truth` must hold the true states: truth=(x, d) or (x, None)")
    _expect(call, "truth", x, [(steps, system.n), (steps + 1, system.n)])
    if d is not None:
        _expect(call, "truth", d, [(steps - 1, system.p), (steps, system.p)])
    for part in (x, d):
        if part is not None:
            _refuse(call, "truth", part, lambda a: ~np.isfinite(a), "not finite; shorten the record with `length`")
    return Truth(x, d)


def _expect(call: str, name: str, value: Any, legal: list[tuple[int | None, ...]], besides: str = "") -> None:
    """The shape of one case, or that with one axis in front; None stands for any number of rows."""
    shape = np.shape(value)
    for core in legal:
        tail = shape[len(shape) - len(core) :]
        if len(shape) - len(core) in (0, 1) and all(b in (None, a) for a, b in zip(tail, core, strict=True)):
            return
    one = [tuple("T" if size is None else size for size in core) for core in legal]
    said = [str(core).replace("'", "") for core in (*one, ("S", *one[0]))]
    raise ValueError(
        f"{call}: `{name}` must have shape {' or '.join(said[:-1])}, or {said[-1]} for a batch{besides}; got {shape}"
    )


def _refuse(call: str, name: str, value: np.ndarray, bad: Callable[[Any], Any], why: str) -> None:
    if value.size == 0:
        return
    rows = value.reshape(-1, value.shape[-1])
    for start in range(0, len(rows), _BLOCK):
        wrong = bad(rows[start : start + _BLOCK])
        if wrong.any():
            place = np.argwhere(wrong)[0]
            index = np.unravel_index((start + place[0]) * rows.shape[1] + place[1], value.shape)
            raise ValueError(f"{call}: `{name}` is {why} (at index {[int(i) for i in index]})")
