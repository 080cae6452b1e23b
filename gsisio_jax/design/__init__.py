"""Offline design: gains, certificate, existence. With the co-design of `tuning` the only part that imports cvxpy."""

from gsisio_jax.design.build import design_observer

__all__ = ["design_observer"]
