"""What a delay would give where boxes are as wide as the state bounds. There an unknown input does not show at once,
and these bounds alone make a design possible, so that no error says it.
"""

from __future__ import annotations

import numpy as np

from gsisio_jax.design.assemble import Plan
from gsisio_jax.design.delay import noise_of
from gsisio_jax.design.feedthrough import factorise
from gsisio_jax.design.gain_selection import main_gain
from gsisio_jax.errors import NoDesignFound, ObserverDoesNotExist
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.observer.enclosures import slopes_of
from gsisio_jax.plant.lift import lifted, output_of
from gsisio_jax.plant.system import System

_AS_WIDE = 0.99  # of the state bounds
_WORTH = 0.5  # of the width without a delay
_LONGEST = 3


def what_a_delay_gives(plan: Plan, certificate: Certificate, region: Interval) -> str:
    """A note of the states whose boxes settle at their bounds, and of the first delay that halves one of them; empty
    where there are none.

    Args:
        plan: of the plant.
        certificate: of its observer.
        region: of the design.
    """
    system = plan.system
    if not (system.p and certificate.certified and output_of(system) is None):
        return ""
    limits = np.asarray(system.state_bounds.width)
    steady = np.asarray(certificate.steady_width)
    known = np.isfinite(limits) & (limits > 0)
    wide = known & (steady >= _AS_WIDE * np.where(known, limits, np.inf))
    if not wide.any():
        return ""
    named = ", ".join(str(i + 1) for i in np.flatnonzero(wide))
    note = f"of state {named} no more is promised than the state bounds"
    if system.periodic or system.periodic_states:  # no delay goes with these
        return note
    shown = system.l
    for delay in range(1, min(system.n, _LONGEST) + 1):
        longer = lifted(system, delay)
        before, shown = shown, longer.l
        if shown == before:  # no later output is free of the unknown input: the plant as it was
            continue
        found = _steady(plan, longer, region)
        better = np.flatnonzero(wide & (found <= _WORTH * steady))
        if len(better):
            widths = ", ".join(f"{found[i]:.4g} of state {i + 1}" for i in better)
            return (
                f"{note}: what the unknown input does shows later. delay={delay} promises a width of {widths} (tried)"
            )
    return note


def _steady(plan: Plan, longer: System, region: Interval) -> np.ndarray:
    """Steady widths of a lifted plant, infinite where it gives no design."""
    endless = np.full(plan.system.n, np.inf)
    try:
        feedthrough = factorise(np.asarray(longer.H))
        slopes = slopes_of(longer, feedthrough.T2, plan.u_region)(region)
        if not slopes.finite:
            return endless
        problem = Plan(longer, noise_of(longer, plan.noise), feedthrough, plan.u_region).problem(slopes)
        return np.asarray(problem.steady_width(main_gain(problem, region)))
    except (NoDesignFound, ObserverDoesNotExist):
        return endless
