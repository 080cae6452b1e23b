"""Offline design: gains, certificate, existence. The only part of the package that imports cvxpy."""

from gsisio_jax.design.build import design_observer

__all__ = ["design_observer"]
