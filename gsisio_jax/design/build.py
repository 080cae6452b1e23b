"""`design_observer`: from a plant and its noise bounds to a verified gain and what it promises."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gsisio_jax.certificate import Certificate
from gsisio_jax.contraction import Bank
from gsisio_jax.design.bank import distinct, gains_for_missing, main_gain, profile_bank, typical_width, units
from gsisio_jax.design.enclosures import Slopes, slopes_on
from gsisio_jax.design.existence import check_existence, check_rank
from gsisio_jax.design.feedthrough import Feedthrough, factorise
from gsisio_jax.design.first_sweep import check_first_sweep, contracting_gains, first_form
from gsisio_jax.design.gains import optimal_gain
from gsisio_jax.design.inputs import input_bank
from gsisio_jax.design.problem import GainProblem, without_rounding
from gsisio_jax.design.recovery import recovers
from gsisio_jax.design.region import find_region
from gsisio_jax.errors import NoDesignFound
from gsisio_jax.interval import Interval
from gsisio_jax.observer import FirstSweep, Observer
from gsisio_jax.system import Noise, System


def design_observer(
    system: System,
    noise: Noise,
    region: Interval | Literal["auto"],
    form: Literal["current"] = "current",
    gains: int = 1,
    u_region: Interval | None = None,
    missing: bool = True,
    sweeps: int = 3,
) -> Observer:
    """Design the gains of an interval observer offline, and certify the width of its boxes.

    Args:
        system: the plant.
        noise: constant bounds of w and v.
        region: convex box (n,) of states for which the gain is optimised and on which the width promise holds. It does
            not limit the observer: boxes are certain anywhere. Infinite sides are legal where f and g are affine or
            have bounded slopes. "auto" looks for a region that fits its own steady width.
        form: "current" (uses y[k] for the box of x[k]).
        gains: size of the bank: the certified gain, and ``gains - 1`` more that are best for larger boxes.
        u_region: box (m,) of known inputs for which the design holds; needed where f or g takes u.
        missing: also keep gains for steps where entries of y[k] or y[k-1] are missing.
        sweeps: contractions per step; more are tighter and slower.

    Returns:
        An `Observer`; ``print(observer.certificate)`` says what it promises. A certificate may be absent or empty: the
        boxes are certain all the same.

    Raises:
        ObserverDoesNotExist: an input direction is proved invisible.
        NoDesignFound: no gain with finite boxes was found; says what failed and what may help.
        ValueError: shapes do not agree, or an argument is out of range.

    Source: design 4.1, 4.2 and 4.4.
    """
    given, u_region = _check(system, noise, region, form, gains, u_region, sweeps)
    feedthrough = factorise(np.asarray(system.H))
    everywhere = slopes_on(system, feedthrough.T2, system.state_bounds, u_region)
    check_existence(system, feedthrough, everywhere)
    plan = _Plan(system, noise, feedthrough, u_region)
    box = find_region(system, lambda box: _steady_width(plan, box)) if given is None else given
    slopes = slopes_on(system, feedthrough.T2, box, u_region)
    if not slopes.finite:
        raise NoDesignFound(
            f"design_observer: the derivatives of f or g are not bounded on the region {box}. Give a smaller region "
            "that keeps away from points where they are infinite (a square root at 0, say)."
        )
    problem = plan.problem(slopes)
    check_rank(problem)
    main = main_gain(problem, box)
    bank = [main, *profile_bank(problem, main, box, gains - 1)]
    if missing:
        bank.extend(gains_for_missing(problem, main, box, feedthrough))
    bank = distinct(bank)
    first = first_form(system, feedthrough.T2, u_region)
    contracting = contracting_gains(problem, bank, everywhere)
    check_first_sweep(problem, bank[0], first, contracting[0] is not None)
    steady = problem.steady_width(bank[0])
    width = units(steady) if np.isfinite(steady).all() else typical_width(problem, box)
    # Where f and g are affine no enclosure depends on the region, so there is no region to leave.
    promised_on = box if not everywhere.affine else Interval.entire(system.n)
    start = FirstSweep(
        form=None if system.g_takes_u else first,
        inverses=np.array([inverse for inverse in contracting if inverse is not None]).reshape(-1, system.n, system.n),
        gains=tuple(k for k, inverse in enumerate(contracting) if inverse is not None),
        affine_output=not everywhere.Z_radius.any(),
    )
    observer = _assemble(plan, problem, promised_on, bank, start, input_bank(problem, width), sweeps)
    if not missing:
        return observer
    certificate = replace(observer.certificate, recoverable=recovers(observer, width, u_region))
    return replace(observer, certificate=certificate)


@dataclass(frozen=True)
class _Plan:
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
            F_radius=slopes.F_radius,
            E=slopes.E,
            E_radius=slopes.E_radius,
            T2=self.feedthrough.T2,
            C=np.vstack([slopes.Z, np.eye(system.n)[bounded]]),
            R=slopes.Z_radius,
            G=np.asarray(system.G),
            H=np.asarray(system.H),
            free=~np.isfinite(input_width),
            dw=np.asarray(self.noise.w.width, dtype=np.float64),
            dv=np.asarray(self.noise.v.width, dtype=np.float64),
            ds=state_width[bounded],
            dd=input_width[np.isfinite(input_width)],
        )


def _check(
    system: System,
    noise: Noise,
    region: Interval | str,
    form: str,
    gains: int,
    u_region: Interval | None,
    sweeps: int,
) -> tuple[Interval | None, Interval]:
    if form != "current":
        raise ValueError(f'design_observer: `form` must be "current", got {form!r}')
    if gains < 1 or sweeps < 1:
        raise ValueError(f"design_observer: `gains` and `sweeps` must be at least 1, got {gains} and {sweeps}")
    for name, box, size in (("w", noise.w, system.n), ("v", noise.v, system.l)):
        if box.shape != (size,):
            raise ValueError(
                f"design_observer: the noise bounds of `{name}` must have shape ({size},), got {box.shape}"
            )
    if region != "auto" and (not isinstance(region, Interval) or region.shape != (system.n,)):
        raise ValueError(
            f'design_observer: `region` must be an Interval of shape ({system.n},) or "auto", got {region!r}'
        )
    if u_region is None:
        if system.f_takes_u or system.g_takes_u:
            raise ValueError(
                "design_observer: f or g takes u; give `u_region`, the box of known inputs for which the design holds"
            )
        u_region = Interval(np.zeros(system.m), np.zeros(system.m))
    if u_region.shape != (system.m,):
        raise ValueError(f"design_observer: `u_region` must have shape ({system.m},), got {u_region.shape}")
    return (region if isinstance(region, Interval) else None), u_region


def _steady_width(plan: _Plan, region: Interval) -> np.ndarray:
    """Steady width of the optimal gain on a region; infinite where there is none. Serves region='auto'."""
    slopes = slopes_on(plan.system, plan.feedthrough.T2, region, plan.u_region)
    if not slopes.finite:
        return np.full(plan.system.n, np.inf)
    problem = plan.problem(slopes)
    gain = optimal_gain(problem, np.ones(problem.n), typical_width(problem, region))
    return np.full(problem.n, np.inf) if gain is None else problem.steady_width(gain)


def _assemble(
    plan: _Plan,
    problem: GainProblem,
    region: Interval,
    bank: list[np.ndarray],
    start: FirstSweep,
    inverses: Bank,
    sweeps: int,
) -> Observer:
    system, feedthrough = plan.system, plan.feedthrough
    main, l, q = bank[0], problem.l, problem.q
    P = without_rounding(np.eye(problem.n) - main[:, l:] @ problem.C)
    N_y, N_z, N_s = problem.split(main)
    J1, J2 = -inverses.residual[0][:, : problem.n], -inverses.residual[0][:, problem.n :]
    growth, implicit = problem.growth(main), problem.implicit(main)
    steady = problem.steady_width(main)
    before = np.abs(J1 @ problem.F + J2 @ problem.E) + np.abs(J1) @ problem.F_radius + np.abs(J2) @ problem.E_radius
    certified = bool(np.isfinite(steady).all())
    input_width = np.full(len(J1), np.inf)
    if certified:
        input_width = np.abs(J1) @ (steady + problem.dw) + before @ steady + np.abs(J2) @ problem.dv
    certificate = Certificate(
        region=Interval(np.array(region.lower, np.float64), np.array(region.upper, np.float64)),
        region_matters=bool(np.isfinite(np.concatenate([region.lower, region.upper])).any()),
        growth=growth,
        implicit=implicit,
        noise_w=np.abs(P),
        noise_v=np.abs(N_y) + np.abs(N_z @ problem.T2),
        noise_fixed=np.abs(N_s) @ problem.ds + np.abs(problem.residual(main)[:, ~problem.free]) @ problem.dd,
        input_state_now=np.abs(J1),
        input_state_before=before,
        input_noise_v=np.abs(J2),
        steady_width=steady,
        input_width=input_width,
        equality_residual=np.abs(problem.residual(main)[:, problem.free]).max(initial=0.0),
        promised=certified,
        recoverable=None,
        notes=(feedthrough.note,) if feedthrough.note else (),
    )
    stacked = np.stack(bank)
    P_all = without_rounding(np.eye(problem.n) - stacked[:, :, l:] @ problem.C)
    region_inverse = (
        np.maximum(np.linalg.inv(np.eye(problem.n) - implicit), 0.0) if certified else np.zeros_like(implicit)
    )
    residual = np.asarray(system.G) - stacked @ problem.seen
    return Observer(
        system=system,
        noise=plan.noise,
        certificate=certificate,
        gains=Bank(
            residual=np.concatenate([P_all, -stacked[:, :, :l]], axis=2),
            output=without_rounding(stacked[:, :, l : l + q] @ problem.T2),
            remainder=stacked[:, :, l : l + q],
            bounds=stacked[:, :, l + q :],
            known=residual[:, :, ~problem.free],
        ),
        inverses=inverses,
        T2=feedthrough.T2,
        C=problem.C[:q],
        bounded_states=problem.C[q:],
        bounded_inputs=np.eye(problem.G.shape[1])[~problem.free],
        region_inverse=region_inverse,
        u_region=plan.u_region if system.f_takes_u or system.g_takes_u else Interval.entire(system.m),
        first=start,
        current=feedthrough.current,
        current_input_directions=feedthrough.V1,
        output_rows=tuple(tuple(int(j) for j in np.flatnonzero(row)) for row in feedthrough.T2),
        sweeps=sweeps,
    )
