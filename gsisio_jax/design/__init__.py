"""Offline design: gains, certificate, existence. With the co-design of `tuning` the only part that solves programs.

Small linear ones go to Clarabel directly; cvxpy is imported where it is first needed.
"""

from gsisio_jax.design.build import design_observer
from gsisio_jax.design.mean_input import mean_input

__all__ = ["design_observer", "mean_input"]
