"""Is the first contraction of a step finite? Known offline, because it starts from the state bounds at every step."""

from __future__ import annotations

import numpy as np

from gsisio_jax.design.problem import GainProblem
from gsisio_jax.errors import NoDesignFound
from gsisio_jax.inclusion import AffineForm
from gsisio_jax.observer.types import Observer

_SINGULAR = 1e-6  # determinants (of matrices near the identity) below this are not divided by


def check_initial_contraction(problem: GainProblem, gain: np.ndarray, observer: Observer, form: AffineForm) -> None:
    """Raise `NoDesignFound` where the box of x[k] would never become finite with the first gain.

    It becomes finite if ``|N_z| R`` contracts on the state bounds, or if the affine bounds there have a finite
    remainder in the rows that the gain uses and ``I + N_z (S - C)`` can be inverted. A finite box stays finite by
    ``f + B u + G d + w`` alone where free inputs reach no state but those with bounds of their own.
    """
    if 0 in observer.first.gains or 0 in observer.first.linear:
        return
    reached = (problem.G[:, problem.free] != 0).any(axis=1)
    if np.isfinite(np.asarray(observer.system.state_bounds.width))[reached].all():
        return
    N_z = problem.split(gain)[1]
    used = (N_z != 0).any(axis=0)
    matrix = np.eye(problem.n) + N_z[:, used] @ (form.slope - problem.C[: problem.q])[used]
    finite = (np.isfinite(form.offset.lower) & np.isfinite(form.offset.upper))[used].all()
    if observer.system.g_takes_u and finite and abs(np.linalg.det(matrix)) > _SINGULAR:
        return
    raise NoDesignFound(
        "design_observer: the box of x[k] would never become finite. On the state bounds the affine bounds of the "
        f"outputs {'lose a direction' if finite else 'have an infinite remainder'}, and they are too nonlinear "
        "for the closed form (rho(|N_z| R) >= 1 there). Give `state_bounds` that are finite for "
        f"{_states(reached)}, which the unknown input reaches; a smaller region alone does not help. certify=False "
        "gives an observer all the same."
    )


def _states(reached: np.ndarray) -> str:
    names = [str(i + 1) for i in np.flatnonzero(reached)]
    return f"state{'s' * (len(names) > 1)} {', '.join(names)}"
