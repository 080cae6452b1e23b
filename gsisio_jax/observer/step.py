"""One step of the current form, from the box of x[k-1] to that of x[k] (theory 5).

`advance` is all there is: a start is a step whose past says nothing (`blank`), "hold" is the same step with y[k]
missing. It is written over small arrays; `gsisio_jax.scalar` compiles it over single numbers.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from gsisio_jax.inclusion.atoms import AtomBounds, States
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, entire_like, nan_to_unbounded
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.image import image, plain_image, widened_for_sums
from gsisio_jax.observer import cells, input_memory, past_cells, periodic, recovery, restart, window
from gsisio_jax.observer.bank import Known, LinearBounds, Terms
from gsisio_jax.observer.certified import certified, certified_input
from gsisio_jax.observer.contractors import Affine, affine_rows, contract_affine_rows, solve_remainder
from gsisio_jax.observer.domain import Domain, largest_magnitude
from gsisio_jax.observer.initial import FirstForm, initial_boxes
from gsisio_jax.observer.input_boxes import dynamics, exact_from_box, from_inverses, moved_without
from gsisio_jax.observer.lost import Lost, plainly_wider
from gsisio_jax.observer.maps import Maps
from gsisio_jax.observer.measurement import everything_unless, in_box, inside, output_box, shift_box, typed
from gsisio_jax.observer.past import before_all, shifted
from gsisio_jax.observer.status import Source, Status, bit_mask
from gsisio_jax.observer.types import Carry, Observer, StepOutput
from gsisio_jax.plant.system import Noise

_stage = jax.named_scope  # stages are counted one by one (benchmarks/size.py)


def blank(observer: Observer, initial: Interval) -> Carry:
    """The past of a first step: nothing is known but the initial box."""
    n, l, m = observer.system.n, observer.system.l, observer.system.m
    dtype = initial.dtype
    maps = Maps.of(observer, dtype)
    atoms = n + l if maps.expansion is None else len(maps.expansion.atoms)
    entire = Interval.unchecked(jnp.full(atoms, -jnp.inf, dtype), jnp.full(atoms, jnp.inf, dtype))
    zero = jnp.zeros(atoms, dtype)
    noise = Noise.unchecked(*(entire_like(jnp.zeros(size, dtype)) for size in (n, l)))
    values = (zero, zero) if observer.certificate.promised else (None, None)
    h = AtomBounds(jnp.zeros((atoms, n), dtype), zero, zero + jnp.inf, entire, *values)
    yes, no = jnp.asarray(True), jnp.asarray(False)
    carry = Carry(initial, h, jnp.full(l, jnp.nan, dtype), jnp.zeros(m, dtype), noise, yes, no)
    return replace(carry, older=before_all(carry, observer), memory=input_memory.blank(observer, dtype))


@rounding.by_observer
def advance(observer: Observer, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool = False) -> Any:
    """One step (theory 5). Arrays must have their final dtype.

    After a conflict the recursion goes on from a box that does not contain the contradiction. Restart believes that the
    state is elsewhere: y[k] (the largest set of its outputs that agrees) and the state bounds alone, or, where these
    give no whole box, nothing up to k. `hold` believes the past: outputs that contradict it are taken as missing.

    Returns:
        The next `Carry`, and a `StepOutput`.
    """
    maps = Maps.of(observer, y.dtype)
    if observer.system.periodic:
        domain, fallback, d, seen = periodic.contract(_contract, _alone, maps, carry, y, u, noise, hold)
        after, out = _finish(maps, domain, fallback, carry, d, seen.y, u, seen.noise, hold)
        return after, periodic.noted(out, y, seen)
    domain, fallback, d = _contract(maps, carry, y, u, noise)
    if hold:
        fallback, kept = _held(maps, carry, y, u, noise)
        y = where(domain.conflict, kept, y)
    elif restart.can_disagree(observer):
        fallback, kept = restart.agreeing(maps, fallback, y, u, noise)
        y = where(domain.conflict, kept, y)
    return _finish(maps, domain, fallback, carry, d, y, u, noise, hold)


def _held(maps: Maps, carry: Carry, y: Any, u: Any, noise: Noise) -> tuple[Domain, Any]:
    """What the past says with those outputs that agree with it, and these; the others are NaN. Where they contradict
    each other, none of them is used."""
    nothing = jnp.full_like(y, jnp.nan)
    past, _, _ = _contract(maps, carry, nothing, u, noise)
    known = _known(maps.observer, carry, y, u, noise)
    _, slack = contract_affine_rows(maps.states(past.box), FirstForm.of(maps.observer, u).on(past.box), known.z)
    agrees = [slack[i] >= -past.tolerance for i in range(slack.shape[0])]
    rows = [
        [agrees[i] for i, outputs in enumerate(maps.observer.output_rows) if j in outputs] for j in range(y.shape[0])
    ]
    kept = jnp.stack([where(jnp.stack(row).all(), y[j], jnp.nan) if row else y[j] for j, row in enumerate(rows)])
    domain, _, _ = _contract(maps, carry, kept, u, noise)
    box = choose(domain.conflict, past.box, domain.box)
    return past.with_box(box), where(domain.conflict, nothing, kept)


@_stage("known")
def _known(observer: Observer, carry: Carry, y: Any, u: Any, noise: Noise) -> Known:
    system, bounds = observer.system, observer.system.state_bounds
    output = output_box(system, y, u, noise.v)
    shift = shift_box(system, carry.y, carry.u, carry.noise)
    terms = Terms(
        shift, output, image(observer.bounded_states, bounds), image(observer.bounded_inputs, system.input_bounds)
    )
    return Known(
        terms,
        observer.gains.linear(terms),
        observer.inverses.linear(terms),
        plain_image(observer.T2, widened_for_sums(output, system.l)),
    )


def _contract(maps: Maps, carry: Carry, y: Any, u: Any, noise: Noise) -> tuple[Domain, Domain, Interval]:
    """The box of x[k], the box that y[k] and the state bounds alone give, and the box of d[k-1]."""
    observer, system, constants = maps.observer, maps.observer.system, maps.observer.rounding_constants
    known, before, bounds = _known(observer, carry, y, u, noise), carry.state, system.state_bounds
    # 1. Bounds of h = [f; g] on the old box were left by the last step. 2. The right side of (*) without psi, jointly.
    with _stage("predict"):
        past = maps.states(before)
        size = largest_magnitude(y, carry.y, past.magnitude)
        right = _predicted(maps, observer.gains, past, carry, known.right)
        d_fixed = _predicted(maps, observer.inverses, past, carry, known.inputs, ranges=False)

    # 3. y[k] and the state bounds, which are all that a restart begins with, and the initial box, if this is the start;
    # then what needs no box to begin with.
    with _stage("initial"):
        first, nothing = FirstForm.of(observer, u), Domain.of(typed(bounds, y.dtype), size)
        alone = _from_bounds(maps, nothing, first, known)
        domain = nothing.intersect(everything_unless(carry.starts, before)[None], Source.INITIAL)
        if observer.recovery:
            domain = recovery.contract(observer, domain, carry, y, u, noise)
        domain = _output(domain, maps.states(domain.box), first.on(domain.box), known.z)
        lost = Lost(observer, d_fixed)
        domain = initial_boxes(maps, domain, right, lost.inputs, u)
    free_rows = None
    if observer.past_cells:
        right, d_fixed, free_rows = past_cells.contract(maps, domain, carry, known, lost, right, d_fixed)
    if observer.cells:
        loose = plainly_wider(right, lost.radius(constants.gains, domain.box))
        domain = cells.contract(maps, domain, known.z, loose, free_rows, u)
    with _stage("initial"):
        # What the gains leave of x[k] and d[k-1]: smaller boxes to come can only make it smaller.
        left = [lost.radius(of, domain.box) for of in (constants.gains, constants.inverses)]
        right, d_fixed = plainly_wider(right, left[0]), plainly_wider(d_fixed, left[1])

    # 4. Sweeps: T2 g on the box so far, every row solved for every state, and (*) solved for x[k].
    with _stage("sweeps"):
        states = maps.states(domain.box)
        covered = set(observer.first.linear) >= set(range(observer.gains.residual.shape[0]))
        # The initial contraction was the first sweep; but the certified bound needs a solution from one of them.
        skipped = covered and not observer.first.affine_output and not (observer.sweeps == 1 and observer.corrections)
        newton = None
        for sweep in range(observer.sweeps):
            rows = None
            if sweep == 0 or observer.first.affine_output:
                form = first.on(domain.box)
                psi = Affine(form.slope - observer.C, form.center, form.radius)
                if sweep == 0 and skipped:
                    continue
            else:
                atoms = maps.free_bounds(states, domain.box, u)
                form = affine_rows(maps.free, states, atoms)
                psi = affine_rows(maps.remainder, states, atoms)
            if sweep > 0 or observer.first.affine_output:
                rows, slack = contract_affine_rows(states, form, known.z)
                domain = domain.record_margin(slack, Source.OUTPUT)
            solved, newton = solve_remainder(observer.gains.remainder, right, psi, states, maps.terms)
            domain = domain.intersect(solved, Source.STATE, quiet=rows)
            states = maps.states(domain.box)

    # What several steps say jointly.
    if observer.window is not None:
        domain = window.contract(maps, domain, carry, states, psi, y, u, noise, lost)
        states = maps.states(domain.box)

    # 5. d[k-1] from every left inverse, and with it the plant's own equation; then the certified bound, where both
    # boxes lie in the region.
    with _stage("inputs"):
        d, domain = from_inverses(maps, domain, states, d_fixed, psi)
        d, domain = input_memory.contract(maps, domain, carry, d, y, u, noise)
        moved = moved_without(maps, past, carry, known.terms)
        domain = dynamics(maps, domain, moved, d)
    domain, promised = certified(maps, domain, past, carry, right, known, left[0], newton, u)
    with _stage("inputs"):
        states = maps.states(domain.box)
        d, domain = certified_input(maps, domain, states, promised, known, left[1], d)
        d, domain = exact_from_box(maps, domain, moved, carry, known.terms, d, lost)
    return domain, alone, d


def _alone(maps: Maps, carry: Carry, y: Any, u: Any, noise: Noise) -> Domain:
    """The box that y[k] and the state bounds alone give, as `_contract` has it."""
    observer, bounds = maps.observer, maps.observer.system.state_bounds
    size = largest_magnitude(y, carry.y, maps.states(carry.state).magnitude)
    nothing = Domain.of(typed(bounds, y.dtype), size)
    return _from_bounds(maps, nothing, FirstForm.of(observer, u), _known(observer, carry, y, u, noise))


def _from_bounds(maps: Maps, nothing: Domain, first: FirstForm, known: Known) -> Domain:
    """The state bounds contracted with what y[k] says of the outputs."""
    bounds = maps.observer.system.state_bounds
    return _output(nothing, maps.states(bounds), first.on(bounds), known.z)


def _output(domain: Domain, states: States, form: Affine, z: Interval) -> Domain:
    """Contract with ``T2 g(x) in z``."""
    rows, slack = contract_affine_rows(states, form, z)
    return domain.record_margin(slack, Source.OUTPUT).intersect(None, Source.STATE, quiet=rows)


def _predicted(
    maps: Maps, bank: LinearBounds, past: States, carry: Carry, known: Interval, ranges: bool = True
) -> Interval:
    """All terms of a bank but those in x[k], (K, r); slopes are combined before the box is applied, so that what
    cancels cancels exactly: that is what keeps widths finite on nonlinear systems (theory 5.2)."""
    rows, shape = bank.residual.reshape(-1, bank.residual.shape[-1]), bank.residual.shape[:2]
    found = maps.rows(rows).bounds(past, carry.h) if ranges else maps.rows(rows).joint_box(past, carry.h)
    n = maps.observer.system.n
    # Rows that use a measurement that is not believed say nothing.
    uses = (rows[:, n:] != 0).any(-1)
    known = Interval.unchecked(known.lower.ravel(), known.upper.ravel())
    known = everything_unless(jnp.logical_or(carry.believed, ~uses), known)
    return Interval.unchecked((found.lower + known.lower).reshape(shape), (found.upper + known.upper).reshape(shape))


@_stage("finish")
def _finish(
    maps: Maps, domain: Domain, fallback: Domain, carry: Carry, d: Interval, y: Any, u: Any, noise: Noise, hold: bool
) -> tuple[Carry, StepOutput]:
    """Choose what to believe after a conflict, and report."""
    observer, system = maps.observer, maps.observer.system
    certificate, dtype = observer.certificate, y.dtype
    conflict = domain.conflict
    # Even the fallback may contradict itself (y[k] against the state bounds): then only the state bounds are left. So
    # they are where it is no whole box and later rows give one: if y[k] is what was wrong, none of them would tell.
    nothing = fallback.conflict
    if observer.recovery and recovery.covers_all(observer) and not hold:
        nothing = nothing | ~_whole(fallback.box)
    again = choose(nothing, typed(system.state_bounds, dtype), fallback.box)
    state = _limited(choose(conflict, again, domain.box))
    believed = ~conflict if hold else ~conflict | ~nothing

    d = choose(conflict, typed(system.input_bounds, dtype), d)
    states = maps.states(state)
    h = maps.bounds(states, state, u)
    d_now = _current_input(maps, states, h, output_box(system, y, u, noise.v), believed)

    applies = in_box(u, observer.u_region) & (carry.starts | in_box(carry.u, observer.u_region))
    if certificate.region_matters:
        region = certificate.region
        applies = applies & inside(state, region) & (carry.starts | inside(carry.state, region))
    bits = (
        (conflict, Status.CONFLICT),
        (~jnp.isfinite(y).all(), Status.MISSING),
        (~(states.radius < jnp.inf).all(), Status.UNBOUNDED),
        (~applies, Status.OUTSIDE_REGION),
    )
    older = shifted(carry, observer, d, conflict & fallback.conflict if hold else conflict)
    memory = input_memory.after(observer, carry, d, conflict, hold)
    after = Carry(state, h, y, u, noise, jnp.asarray(False), believed, older, memory)
    return after, StepOutput(state, d, d_now, bit_mask(bits), *domain.report())


def _whole(box: Interval) -> Any:
    """No side is infinite."""
    return (jnp.isfinite(box.lower) & jnp.isfinite(box.upper)).all()


def _limited(box: Interval) -> Interval:
    """Numbers so large that the next step would overflow count as infinite."""
    most = float(jnp.finfo(box.dtype).max) ** (2 / 3)
    return Interval.unchecked(
        where(box.lower > -most, box.lower, -jnp.inf), where(box.upper < most, box.upper, jnp.inf)
    )


def _current_input(maps: Maps, states: States, h: AtomBounds, output: Interval, believed: Any) -> Interval:
    """Box of ``V1' d = current (y - g - D u - v)``, slopes combined before the box is applied (paper, Lemma 4)."""
    current = maps.observer.current
    found = maps.rows(maps.on_outputs(-current)).bounds(states, h)
    seen = plain_image(current, widened_for_sums(output, output.shape[0]))
    now = Interval.unchecked(found.lower + seen.lower, found.upper + seen.upper)
    return everything_unless(believed, nan_to_unbounded(now))
