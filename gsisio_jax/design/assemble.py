"""What a design leaves: the plan that its gain problems share, and the observer assembled from verified gains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsisio_jax.design.feedthrough import Feedthrough
from gsisio_jax.design.inputs import InputBounds
from gsisio_jax.design.planes import plane_bounds
from gsisio_jax.design.problem import GainProblem, beyond_rounding, left_of_states
from gsisio_jax.design.rounds import with_rounds
from gsisio_jax.inclusion.planes import Abstraction
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.bank import LinearBounds
from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.observer.enclosures import Slopes
from gsisio_jax.observer.rounding_constants import with_output
from gsisio_jax.observer.types import Observer
from gsisio_jax.plant.system import Noise, System


@dataclass(frozen=True)
class Plan:
    """What every gain problem of one design shares."""

    system: System
    noise: Noise
    feedthrough: Feedthrough
    u_region: Interval

    def problem(self, slopes: Slopes) -> GainProblem:
        system = self.system
        state_width, input_width = (np.asarray(b.width) for b in (system.state_bounds, system.input_bounds))
        bounded = np.isfinite(state_width)
        return GainProblem(
            F=slopes.F,
            F_radius=beyond_rounding(slopes.F_radius, slopes.F),
            E=slopes.E,
            E_radius=beyond_rounding(slopes.E_radius, slopes.E),
            T2=self.feedthrough.T2,
            C=np.vstack([slopes.Z, np.eye(system.n)[bounded]]),
            R=beyond_rounding(slopes.Z_radius, slopes.Z),
            G=np.asarray(system.G),
            H=np.asarray(system.H),
            free=~np.isfinite(input_width),
            dw=np.asarray(self.noise.w.width, dtype=np.float64),
            dv=np.asarray(self.noise.v.width, dtype=np.float64),
            ds=state_width[bounded],
            dd=input_width[np.isfinite(input_width)],
        )


def assemble(
    plan: Plan,
    problem: GainProblem,
    region: Interval,
    bank: list[np.ndarray],
    inputs: InputBounds,
    affine: bool,
    bounds: tuple[str, ...],
    sweeps: int,
) -> Observer:
    """The observer of a verified bank of gains, the first of which is the certified one.

    `with_rounding_constants` completes it.

    Args:
        plan: plant, noise and feedthrough of the design.
        problem: the gain problem on the region.
        region: of the design.
        bank: gains (n, columns).
        inputs: bounds of the unknown input.
        affine: f and g are affine on the state bounds, so the promise holds everywhere.
        bounds: the methods that bound f and g online.
        sweeps: contractions per step.
    """
    system, feedthrough = plan.system, plan.feedthrough
    l, q = problem.l, problem.q
    # Where f and g are affine no enclosure depends on the region, so there is no region to leave.
    certificate = _certificate(plan, problem, Interval.entire(system.n) if affine else region, bank[0], inputs)
    certificate = with_rounds(certificate, plan.noise, system.state_bounds)

    def planes(function: Callable[[Any, Any], Any]) -> Abstraction | None:
        return plane_bounds(system, function, region, plan.u_region) if "abstraction" in bounds else None

    stacked = np.stack(bank)
    P = left_of_states(stacked[:, :, l:], problem.C)
    residual = np.asarray(system.G) - stacked @ problem.seen
    unfinished: Any = None
    return Observer(
        system=system,
        noise=plan.noise,
        certificate=certificate,
        gains=with_output(
            LinearBounds(
                residual=np.concatenate([P, -stacked[:, :, :l]], axis=2),
                output=np.zeros((len(bank), problem.n, l)),
                remainder=stacked[:, :, l : l + q],
                bounds=stacked[:, :, l + q :],
                known=residual[:, :, ~problem.free],
            ),
            problem.T2,
        ),
        inverses=with_output(inputs.inverses, problem.T2),
        exact=inputs.exact,
        T2=feedthrough.T2,
        C=problem.C[:q],
        bounded_states=problem.C[q:],
        bounded_inputs=np.eye(problem.G.shape[1])[~problem.free],
        region_inverse=unfinished,
        u_region=plan.u_region if system.takes_u else Interval.entire(system.m),
        first=unfinished,
        current=feedthrough.current,
        current_input_directions=feedthrough.V1,
        abstraction=planes(system.maps),
        output_abstraction=planes(lambda x, u: feedthrough.T2 @ system.measurement(x, u)),
        rounding_constants=unfinished,
        output_rows=feedthrough.output_rows,
        bounds=bounds,
        sweeps=sweeps,
    )


def _certificate(
    plan: Plan, problem: GainProblem, region: Interval, main: np.ndarray, inputs: InputBounds
) -> Certificate:
    """What the first gain and the first left inverse promise on the region."""
    n, l = problem.n, problem.l
    P = left_of_states(main[:, l:], problem.C)
    N_y, N_z, N_s = problem.split(main)
    inverses = inputs.inverses
    J1, J2 = -inverses.residual[0][:, :n], -inverses.residual[0][:, n:]
    steady = problem.steady_width(main)
    before = np.abs(J1 @ problem.F + J2 @ problem.E) + np.abs(J1) @ problem.F_radius + np.abs(J2) @ problem.E_radius
    certified = bool(np.isfinite(steady).all())
    input_fixed = np.abs(inverses.known[0]) @ problem.dd
    input_width = np.full(len(J1), np.inf)
    if certified:
        input_width = np.abs(J1) @ (steady + problem.dw) + before @ steady + np.abs(J2) @ problem.dv + input_fixed
    return Certificate(
        region=Interval(np.array(region.lower, np.float64), np.array(region.upper, np.float64)),
        region_matters=bool(np.isfinite(np.concatenate([region.lower, region.upper])).any()),
        growth=problem.growth(main),
        implicit=problem.implicit(main),
        noise_w=np.abs(P),
        noise_v=np.abs(N_y) + np.abs(N_z @ problem.T2),
        noise_fixed=np.abs(N_s) @ problem.ds + np.abs(problem.residual(main)[:, ~problem.free]) @ problem.dd,
        input_state_now=np.abs(J1),
        input_state_before=before,
        input_noise_v=np.abs(J2),
        input_fixed=input_fixed,
        steady_width=steady,
        input_width=input_width,
        equality_residual=np.abs(problem.residual(main)[:, problem.free]).max(initial=0.0),
        promised=certified,
        recoverable=None,
        notes=tuple(note for note in (plan.feedthrough.note, inputs.note) if note),
    )
