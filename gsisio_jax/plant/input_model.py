"""What is known of how the unknown input moves with time: a bound of its steps, or that it is constant over blocks."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import is_whole, read_array


def read_rate(value: Any, p: int) -> Interval | None:
    """`input_rate` of a `System` as a box (p,) of d[k] - d[k-1]; None where nothing is known."""
    if value is None:
        return None
    _check_some("input_rate", p)
    needed = f"System: `input_rate` bounds |d[k] - d[k-1]| of every unknown input, so it needs the shape ({p},)"
    if not isinstance(value, Interval):
        size = np.asarray(read_array("System", "input_rate", value), np.float64)
        if size.shape != (p,):
            raise ValueError(f"{needed}, got {size.shape}; use inf where nothing is known")
        if not (size >= 0).all():
            raise ValueError(
                f"System: `input_rate` must not be negative, got {size.tolist()}; for an input that only falls or "
                "rises give a box of d[k] - d[k-1], such as gx.Interval([-0.1], [0.0])"
            )
        value = Interval(-size, size)
    if value.shape != (p,):
        raise ValueError(f"{needed}, got {value.shape}; use -inf and inf where nothing is known")
    finite = np.isfinite(np.asarray(value.lower)) | np.isfinite(np.asarray(value.upper))
    return value if finite.any() else None


def read_constant(value: Any, p: int) -> int | None:
    """`input_constant` of a `System`, in steps; None where it says nothing."""
    if value is None:
        return None
    _check_some("input_constant", p)
    if not is_whole(value) or value < 1:
        raise ValueError(
            f"System: `input_constant` must be a whole number of steps of at least 1, got {value!r}; for an input that "
            f"never changes give input_rate={[0.0] * p}"
        )
    return int(value) if value > 1 else None


def _check_some(name: str, p: int) -> None:
    if p == 0:
        raise ValueError(f"System: `{name}` is given, but there is no unknown input (G has no columns); leave it out")
