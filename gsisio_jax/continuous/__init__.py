"""Continuous plants: discretisation with a guaranteed bound of its error, and state-space models of other libraries.

Source: theory 15.
"""

from gsisio_jax.continuous.discretize import discretize
from gsisio_jax.continuous.result import Discretization
from gsisio_jax.continuous.state_space import from_state_space

__all__ = ["Discretization", "discretize", "from_state_space"]
