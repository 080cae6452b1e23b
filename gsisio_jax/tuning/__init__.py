"""Differentiable tuning: noise bounds from logged data, which sensor is worth improving, the cheapest sensors."""

from typing import TYPE_CHECKING, Any

from gsisio_jax.tuning.fit import tune_noise
from gsisio_jax.tuning.fold import fold
from gsisio_jax.tuning.records import Records
from gsisio_jax.tuning.result import HeldOut, TunedNoise
from gsisio_jax.tuning.sensitivity import width_sensitivity

if TYPE_CHECKING:
    from gsisio_jax.tuning.allocation import Allocation, allocate
    from gsisio_jax.tuning.codesign import optimal_widths

__all__ = [
    "Allocation",
    "HeldOut",
    "Records",
    "TunedNoise",
    "allocate",
    "fold",
    "optimal_widths",
    "tune_noise",
    "width_sensitivity",
]

_OFFLINE = {"Allocation": "allocation", "allocate": "allocation", "optimal_widths": "codesign"}


def __getattr__(name: str) -> Any:
    """What solves the design's programs is loaded on first use."""
    if name not in _OFFLINE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(f"gsisio_jax.tuning.{_OFFLINE[name]}"), name)
