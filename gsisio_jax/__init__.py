"""Guaranteed boxes for the state and the unknown input of a nonlinear system: a compiled batch interval observer."""

from typing import TYPE_CHECKING, Any

from gsisio_jax import (
    _quiet,  # noqa: F401  # before everything that takes time to import
    inclusion,
)
from gsisio_jax._version import __version__ as __version__
from gsisio_jax.errors import ContainmentLost, FramerNotGuaranteed, NoDesignFound, ObserverDoesNotExist
from gsisio_jax.interval import Interval, hull, intersect, linear_image
from gsisio_jax.observer import estimation
from gsisio_jax.observer.alarms import Alarm
from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.observer.delayed import DelayedObserver
from gsisio_jax.observer.estimation import Estimate, estimate, start, step
from gsisio_jax.observer.prediction_step import PredictionObserver
from gsisio_jax.observer.status import Status
from gsisio_jax.observer.tolerant import TolerantObserver
from gsisio_jax.observer.types import Carry, Observer, StepOutput
from gsisio_jax.plant.periodic import nearest, wrapped
from gsisio_jax.plant.simulation import Simulation, simulate
from gsisio_jax.plant.system import Noise, System

if TYPE_CHECKING:
    from gsisio_jax import dataset, examples, paper, plot, study, tuning
    from gsisio_jax.continuous import Discretization, discretize, from_state_space
    from gsisio_jax.design import design_observer, mean_input
    from gsisio_jax.files import load_carry, load_observer, save_carry
    from gsisio_jax.study import grid, monte_carlo, sweep, tightness
    from gsisio_jax.tuning import allocate, tune_noise, width_sensitivity

__all__ = [
    "Alarm",
    "Carry",
    "Certificate",
    "ContainmentLost",
    "DelayedObserver",
    "Discretization",
    "Estimate",
    "FramerNotGuaranteed",
    "Interval",
    "NoDesignFound",
    "Noise",
    "Observer",
    "ObserverDoesNotExist",
    "PredictionObserver",
    "Simulation",
    "Status",
    "StepOutput",
    "System",
    "TolerantObserver",
    "allocate",
    "dataset",
    "design_observer",
    "discretize",
    "estimate",
    "estimation",
    "examples",
    "from_state_space",
    "grid",
    "hull",
    "inclusion",
    "intersect",
    "linear_image",
    "load_carry",
    "load_observer",
    "mean_input",
    "monte_carlo",
    "nearest",
    "paper",
    "plot",
    "save_carry",
    "simulate",
    "start",
    "step",
    "study",
    "sweep",
    "tightness",
    "tune_noise",
    "tuning",
    "width_sensitivity",
    "wrapped",
]

_LAZY = {
    "Discretization": "gsisio_jax.continuous",
    "allocate": "gsisio_jax.tuning",
    "design_observer": "gsisio_jax.design",
    "discretize": "gsisio_jax.continuous",
    "from_state_space": "gsisio_jax.continuous",
    "grid": "gsisio_jax.study",
    "load_carry": "gsisio_jax.files",
    "load_observer": "gsisio_jax.files",
    "mean_input": "gsisio_jax.design",
    "monte_carlo": "gsisio_jax.study",
    "save_carry": "gsisio_jax.files",
    "sweep": "gsisio_jax.study",
    "tightness": "gsisio_jax.study",
    "tune_noise": "gsisio_jax.tuning",
    "width_sensitivity": "gsisio_jax.tuning",
    "dataset": "",
    "examples": "",
    "paper": "",
    "plot": "",
    "study": "",
    "tuning": "",
}


def __dir__() -> list[str]:
    """The public names, those that are loaded on first use among them."""
    return sorted(__all__)


def __getattr__(name: str) -> Any:
    """Load on first use what an online run does not need: the solver, studies, tables and pictures."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    if _LAZY[name]:
        return getattr(importlib.import_module(_LAZY[name]), name)
    return importlib.import_module(f"{__name__}.{name}")
