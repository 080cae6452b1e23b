"""Differentiable tuning: noise bounds from logged data, which sensor is worth improving, the cheapest sensors."""

from gsisio_jax.tuning.fit import tune_noise
from gsisio_jax.tuning.fold import fold
from gsisio_jax.tuning.records import Records
from gsisio_jax.tuning.result import HeldOut, TunedNoise

__all__ = ["HeldOut", "Records", "TunedNoise", "fold", "tune_noise"]
