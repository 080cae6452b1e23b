"""When no observer exists, and when none was found: two different answers, kept apart.

`ObserverDoesNotExist` is raised only where an input direction v is proved invisible: ``H v = 0`` and
``T2 g(x + a G v) = T2 g(x)`` for all x and a, with no bound on a state or an input that v touches.
"""

from __future__ import annotations

import numpy as np

from gsisio_jax.design.feedthrough import Feedthrough
from gsisio_jax.design.problem import GainProblem, beyond_rounding
from gsisio_jax.errors import NoDesignFound, ObserverDoesNotExist
from gsisio_jax.observer.enclosures import Slopes
from gsisio_jax.plant.system import System

_ZERO = 1e-9  # in units of normalised directions


def check_existence(system: System, feedthrough: Feedthrough, everywhere: Slopes) -> None:
    """Raise `ObserverDoesNotExist` where an invisible input direction is proved.

    Args:
        system: the plant.
        feedthrough: factorisation of H.
        everywhere: enclosures of the Jacobians on the state bounds.
    """
    if system.p == 0:
        return
    G = system.G
    bounded_inputs = np.isfinite(np.asarray(system.input_bounds.width))
    bounded_states = np.isfinite(np.asarray(system.state_bounds.width))
    # T2 g is constant along G v if it is affine in every state that G v moves, to rounding, and has no slope there.
    nonlinear_states = (beyond_rounding(everywhere.Z_radius, everywhere.Z) > 0).any(axis=0)
    conditions = [
        _rows(system.H),
        _rows(np.where(nonlinear_states, 0.0, everywhere.Z) @ G),
        _rows(G[nonlinear_states | bounded_states]),
        np.eye(system.p)[bounded_inputs],
    ]
    direction = null_direction(np.vstack(conditions))
    if direction is None:
        return
    raise ObserverDoesNotExist(
        f"design_observer: no observer exists. The unknown input direction d = {_show(direction)} reaches "
        "no output: H d = 0, and the outputs that are free of d do not change when the state moves along "
        f"G d = {_show(G @ direction)}. Remedies: measure a state that it moves, or give `input_bounds` or "
        "`state_bounds` along this direction."
    )


def check_rank(problem: GainProblem) -> None:
    """Raise `NoDesignFound` where the chosen slopes cannot cancel the unknown input."""
    seen = problem.seen[:, problem.free]
    if not seen.shape[1]:
        return
    direction = null_direction(_rows(seen))
    if direction is None:
        return
    raise NoDesignFound(
        f"design_observer: with the slopes at the centre of the region, the unknown input direction "
        f"d = {_show(direction)} (free inputs only) does not show in [H; C G], so no gain cancels it. "
        f"{problem.how_inputs_show()} It may be visible elsewhere: choose a region around another point; or give "
        "`state_bounds` or `input_bounds`, or more outputs."
    )


def null_direction(matrix: np.ndarray) -> np.ndarray | None:
    """A unit vector that the matrix (rows of length about 1) sends to zero, or None. Inputs may have any units."""
    columns = matrix.shape[1]
    if not len(matrix):
        return np.eye(columns)[0]
    size = np.linalg.norm(matrix, axis=0)
    size = np.where(size > 0, size, 1.0)
    _, singular, right = np.linalg.svd(_rows(matrix / size))
    if len(singular) == columns and singular[-1] > _ZERO * singular[0]:
        return None
    direction = np.where(np.abs(right[-1]) < 1e-12, 0.0, right[-1]) / size
    direction = direction / np.linalg.norm(direction)
    return direction * np.sign(direction[np.abs(direction).argmax()])


def _rows(matrix: np.ndarray) -> np.ndarray:
    """Rows scaled to length 1: rank must not depend on units."""
    norms = np.linalg.norm(matrix, axis=1, keepdims=True)
    return matrix / np.where(norms > 0, norms, 1.0)


def _show(vector: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in vector) + ")"
