"""The known input where f and g take it, as a matrix beside B and D: for rows that ask for affine maps of x alone."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax
import numpy as np

from gsisio_jax.inclusion.input_parts import input_parts
from gsisio_jax.interval.box import Interval, add
from gsisio_jax.interval.image import image
from gsisio_jax.observer.maps import Plain
from gsisio_jax.observer.measurement import point


def input_matrix(system: Any, dtype: Any) -> np.ndarray | None:
    """M (n + l, m) of ``[f; g](x, u) = [f; g](x, 0) + M u``, every entry rounded once; None where f and g are not of
    that form, or entries are so small or large that more than rounding would be lost."""
    return _matrix(Plain(system), np.dtype(dtype), bool(jax.config.read("jax_enable_x64")))


@lru_cache(maxsize=64)
def _matrix(plain: Plain, dtype: Any, wide: bool) -> np.ndarray | None:
    del wide  # a part of the key: what type constants are of where x is of 32 bits
    parts = input_parts(plain.maps, plain.n, plain.m, dtype)
    if parts is None:
        return None
    found, (least, most) = np.zeros((len(parts), plain.m), dtype), _range(dtype)
    for row, part in zip(found, parts, strict=True):
        for j, factor in part.items():
            if not least <= abs(factor) <= most:
                return None
            row[j] = float(factor)
    found.flags.writeable = False  # it is kept
    return found


def _range(dtype: Any) -> tuple[float, float]:
    info = np.finfo(dtype)
    return float(info.tiny), float(info.max)


def moved(matrix: np.ndarray, u: Any, box: Interval) -> Interval:
    """The box and ``matrix @ u``, outward; a matrix that was rounded entry by entry stands for the exact one."""
    return add(box, image(matrix, point(u)))
