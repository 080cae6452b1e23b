"""The plant with the bounds of its noise, and simulated records of it."""

from gsisio_jax.plant.simulation import Simulation, simulate
from gsisio_jax.plant.system import Noise, System

__all__ = ["Noise", "Simulation", "System", "simulate"]
