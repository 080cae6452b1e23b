"""The recursion of the current form, one step at a time (design 4.3).

`begin` takes the box of x[0] and the first measurement, `advance` takes one measurement more. `estimation.estimate` is
nothing but these two in a `lax.scan`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gsisio_jax.inclusion import AffineForm
from gsisio_jax.inclusion.intersection import bound
from gsisio_jax.inclusion.transforms import affine_with_slack
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import (
    Interval,
    add,
    choose,
    entire_like,
    held,
    image,
    intersect,
    nan_to_unbounded,
    reach,
    slip,
    spread,
    widen,
)
from gsisio_jax.interval.minmax import smaller
from gsisio_jax.interval.xla import multiplied, once
from gsisio_jax.observer.contractors import (
    CancellationResidual,
    Evidence,
    LinearBounds,
    Terms,
    centred_form,
    contract_affine_rows,
    magnitude,
    solve_remainder,
)
from gsisio_jax.observer.measurement import current_input, in_box, inside, output_box, point, value_at
from gsisio_jax.observer.status import Source, Status, bit_mask
from gsisio_jax.observer.types import Carry, Observer, StepOutput
from gsisio_jax.plant.system import Noise


@rounding.by_observer
def begin(
    observer: Observer, initial: Interval, y: Any, u: Any, noise: Noise, hold: bool = False
) -> tuple[Carry, StepOutput]:
    """Step 0: the initial box met with the state bounds and with y[0]. Arrays must have their final dtype."""
    bounds = observer.system.state_bounds
    z = image(observer.T2, output_box(observer.system, y, u, noise.v))
    scale = magnitude(y, initial.lower, initial.upper)
    evidence = prior = Evidence(bounds, scale).meet(initial[None], Source.INITIAL)
    form = _first_form(observer, bounds, u)  # valid on every smaller box: the first sweep serves the fallback too
    fallback = prior if hold else contract_affine_rows(Evidence(bounds, scale), form, z)
    for sweep in range(observer.sweeps):
        form = _first_form(observer, evidence.box, u) if sweep == 0 else _free_output(observer, evidence.box, u)
        evidence = contract_affine_rows(evidence, form, z)
    return _finish(observer, evidence, fallback, None, None, y, u, noise, hold)


@rounding.by_observer
def advance(
    observer: Observer, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool = False
) -> tuple[Carry, StepOutput]:
    """One step of design 4.3, from the box of x[k-1] to that of x[k]. Arrays must have their final dtype.

    After a conflict the recursion goes on from a box that does not contain the contradiction: y[k] and the state bounds
    alone (restart), or the past alone, with y[k] taken as missing (`hold`).
    """
    evidence, fallback, d = _contract(observer, carry, y, u, noise)
    if hold:
        fallback, _, _ = _contract(observer, carry, jnp.full_like(y, jnp.nan), u, noise)
    return _finish(observer, evidence, fallback, carry, d, y, u, noise, hold)


def _contract(observer: Observer, carry: Carry, y: Any, u: Any, noise: Noise) -> tuple[Evidence, Evidence, Interval]:
    """Steps 1-6: the box of x[k], the box that y[k] and the state bounds alone give, and the box of d[k-1]."""
    system, gains, inverses = observer.system, observer.gains, observer.inverses
    before, bounds = carry.state, system.state_bounds
    n = system.n

    # What is known beforehand, as boxes: everything of identity (*) but h(x[k-1]) and psi(x[k]).
    output = output_box(system, y, u, noise.v)
    drift = add(image(system.B, point(carry.u)), carry.noise.w)
    seen = output_box(system, carry.y, carry.u, carry.noise.v)
    shift = Interval.unchecked(jnp.concatenate([drift.lower, -seen.upper]), jnp.concatenate([drift.upper, -seen.lower]))
    terms = Terms(
        shift, output, image(observer.bounded_states, bounds), image(observer.bounded_inputs, system.input_bounds)
    )

    # 1. Bounds of h = [f; g] on the old box, once for all gains (the last step has left them). 2. The right side of (*)
    # without psi, jointly.
    h = carry.h
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=1), gains.flat(), inverses.flat())
    bound = both.predict(h, before, terms)[0]
    bound = held(bound)
    right = Interval.unchecked(*(x[: gains.rows].reshape(-1, n) for x in (bound.lower, bound.upper)))
    shape = inverses.residual.shape[:2]
    d_fixed = Interval.unchecked(*(x[gains.rows :].reshape(shape) for x in (bound.lower, bound.upper)))
    f_now = add(h.range[:n], drift)

    # 3.-5. Contract from the state bounds; y[k] alone first, because a restart begins there.
    z = image(observer.T2, output)
    evidence = alone = Evidence(bounds, magnitude(y, carry.y, before.lower, before.upper))
    form, affine = _first_form(observer, bounds, u), observer.first.affine_output
    evidence = alone = contract_affine_rows(evidence, form, z)
    missed = _Missed(observer, d_fixed)
    evidence = _meet_first_boxes(observer, evidence, right, missed, u)
    right = held(widen(right, missed.of(observer.rounding_constants.gains, evidence.box)))
    d_fixed = held(widen(d_fixed, missed.of(observer.rounding_constants.inverses, evidence.box)))
    for sweep in range(observer.sweeps):
        if affine:
            form = _first_form(observer, evidence.box, u)
        elif sweep > 0:
            form = _free_output(observer, evidence.box, u)
        if sweep > 0 or affine:
            evidence = contract_affine_rows(evidence, form, z)
        evidence = evidence.meet(_solved(observer, right, form, evidence.box), Source.STATE)
    if system.p:
        # The paper's own loop x = f + B u + G d + w: no way to a first box, but a contraction of a correct one.
        d, _ = _inputs(observer, evidence, d_fixed, form)
        evidence = evidence.meet(add(f_now, image(system.G, d))[None], Source.DYNAMICS)

    # 6. The certified bound, where both boxes lie in the region. (The form of the last sweep holds on smaller boxes.)
    evidence, promised = _certified(observer, evidence, before, right, terms, missed, carry.u, u)
    d, evidence = _inputs(observer, evidence, d_fixed, form)
    d, evidence = _certified_input(observer, evidence, promised, missed, d)
    d, evidence = _exact_input(observer, evidence, add(h.range, shift), terms, d, missed)
    return evidence, alone, d


class _Missed:
    """How far the bounds can be off because the gains do not cancel exactly (design 6).

    ``|d[k-1]| <= inputs + input_state |x[k]|`` from every left inverse, and by the input bounds.
    """

    def __init__(self, observer: Observer, d_fixed: Interval):
        rounding_constants, bounds = observer.rounding_constants, observer.system.input_bounds
        self.rounding_constants, self.limit = rounding_constants, reach(bounds)
        self.inputs = jnp.full_like(self.limit, jnp.inf)
        if rounding.outward():
            for i, j in enumerate(rounding_constants.direct):
                self.inputs = jnp.minimum(self.inputs, slip(rounding_constants.input_inverses[i], reach(d_fixed[j])))

    def input_reach(self, box: Interval) -> Any:
        """Bound of ``|d[k-1]|``, (p,), from a box of x[k]."""
        return once(jnp.minimum(self.limit, self.inputs + slip(self.rounding_constants.input_state, reach(box))))

    def of(self, residual: CancellationResidual, box: Interval) -> Any:
        """Radius (K, r) by which a bank's bounds are to be widened; None to nearest."""
        if not rounding.outward():
            return None
        return residual.radius(reach(box), self.input_reach(box))

    def of_inputs(self, weights: Any, box: Interval) -> Any:
        """The same for rows that leave only d[k-1], (..., p)."""
        return slip(weights, self.input_reach(box)) if rounding.outward() else None


def _meet_first_boxes(observer: Observer, evidence: Evidence, right: Interval, missed: _Missed, u: Any) -> Evidence:
    """Bounds that need no box to begin with, for x[k] is unknown still, and with it what the gains leave of it: the
    contraction |N_z| R < 1 on the state bounds, and the linear form of T2 g there."""
    first, gains, rounding_constants = observer.first, observer.gains, observer.rounding_constants
    if rounding.outward():
        # What d leaves, but for its part in x[k], which is in the cancellation residual of `first`.
        inputs = jnp.minimum(missed.inputs, missed.limit)
        right = widen(right, slip(rounding_constants.gains.d, inputs))
    if first.gains:
        chosen, N_z, left = _taken(first.gains, right, gains.remainder, first.cancellation_residual)
        bounded = _psi_box(observer, u)
        boxes = jax.vmap(
            lambda box, N, V, L: centred_form(box, N, V, _psi(observer, u), bounded, observer.system.state_bounds, L)
        )(chosen, N_z, first.inverses, left)
        boxes = choose(in_box(u, observer.u_region), boxes, entire_like(boxes))
        evidence = evidence.meet(boxes, Source.STATE)
    if first.linear and first.form is not None:
        chosen, N_z = _taken(first.linear, right, gains.remainder)
        boxes = image(first.maps, add(chosen, image(-N_z, first.form.offset)))
        if rounding.outward():
            far = jnp.minimum(spread(first.bounds, reach(boxes)), reach(evidence.box))
            boxes = widen(boxes, slip(first.left, far))
        evidence = evidence.meet(boxes, Source.STATE)
    return evidence


def _taken(indices: tuple[int, ...], *stacks: Any) -> Any:
    """Entries of stacks, without a gather."""
    return jax.tree.map(lambda x: jnp.stack([x[k] for k in indices]), stacks)


def _solved(observer: Observer, right: Interval, form: AffineForm, box: Interval) -> Interval:
    """Box (K, n) of x[k] from ``x + N_z psi(x) in right``; where psi is affine it is known as it stands."""
    if not observer.first.affine_output:
        return solve_remainder(observer.gains, right, form, observer.C, box)
    psi = add(image(form.slope - observer.C, box), form.offset)
    return add(right, image(-observer.gains.remainder, psi))


def _certified(
    observer: Observer,
    evidence: Evidence,
    before: Interval,
    right: Interval,
    terms: Terms,
    missed: _Missed,
    u_before: Any,
    u: Any,
) -> tuple[Evidence, _Promised]:
    """Step 6 for the first gain: the right side around the centre of the old box, with the design's constant A."""
    certificate, region, system = observer.certificate, observer.certificate.region, observer.system
    applies = jnp.asarray(False)
    if certificate.promised:
        applies = inside(before, region) & inside(evidence.box, region)
        applies = applies & in_box(u_before, observer.u_region) & in_box(u, observer.u_region)
    # Outside, stand on a finite point of the region instead: a masked NaN would still poison gradients.
    c = jnp.where(applies, before.center, region.center)
    far = rounding.up(jnp.maximum(before.upper - c, c - before.lower))
    promised = _Promised(applies, c, jnp.where(applies, far, 0), None, terms)
    if not certificate.promised:
        return evidence, promised
    promised = promised._replace(value=value_at(system.maps, c, u_before))
    gain = jax.tree.map(lambda x: x[0], observer.gains)
    around = widen(
        _around(gain, observer.rounding_constants.growth, promised),
        _first(missed.of(observer.rounding_constants.gains, evidence.box)),
    )
    joint, slack = intersect(right[0], around)
    evidence = evidence.weigh(jnp.where(applies, slack, jnp.inf), Source.STATE)
    safe = choose(applies, evidence.box, Interval.unchecked(c, c))
    box = centred_form(joint, gain.remainder, observer.region_inverse, _psi(observer, u), _psi_box(observer, u), safe)
    return evidence.meet(choose(applies, box, entire_like(box))[None], Source.CERTIFICATE), promised


def _certified_input(
    observer: Observer, evidence: Evidence, promised: _Promised, missed: _Missed, d: Interval
) -> tuple[Interval, Evidence]:
    """The same centred form for d[k-1] with the first left inverse."""
    certificate = observer.certificate
    if not certificate.promised or not observer.system.p:
        return d, evidence
    inverse = jax.tree.map(lambda x: x[0], observer.inverses)
    around = _around(inverse, observer.rounding_constants.input_growth, promised)
    around = widen(around, _first(missed.of(observer.rounding_constants.inverses, evidence.box)))
    box = add(image(inverse.state, evidence.box), around)
    met, slack = intersect(d, choose(promised.applies, nan_to_unbounded(box), entire_like(box)))
    return met, evidence.weigh(slack, Source.INPUT)


class _Promised(NamedTuple):
    """Where the promise of the certificate applies; the old box there, by centre and radius; [f; g] at that centre."""

    applies: Any
    center: Any
    radius: Any
    value: Any
    terms: Terms


def _around(row: LinearBounds, slope: Any, promised: _Promised) -> Interval:
    """A linear bound without its terms in x[k]: its value at the centre of the old box, give or take ``slope radius``.

    No Jacobian is evaluated online: `slope` is a constant of the design, valid on the region.
    """
    at = image(row.residual, promised.value)
    return add(widen(at, spread(slope, promised.radius)), row.linear(promised.terms))


def _first(radius: Any) -> Any:
    return None if radius is None else radius[0]


def _inputs(observer: Observer, evidence: Evidence, fixed: Interval, form: AffineForm) -> tuple[Interval, Evidence]:
    """Box of d[k-1] from every left inverse, given the box of x[k] (design 4.5)."""
    inverses, box = observer.inverses, evidence.box
    # state x[k] - remainder psi(x[k]) with psi = (S - C) x + [e], slopes combined before the box is applied.
    difference = once(form.slope - observer.C)
    slope = once(inverses.state - multiplied(inverses.remainder, difference))
    now = add(image(slope, box), image(-inverses.remainder, form.offset), fixed)
    if rounding.outward():
        # Of the slopes before they cancelled.
        lost = slip(abs(inverses.state), reach(box)) + slip(abs(inverses.remainder), slip(abs(difference), reach(box)))
        now = widen(now, rounding.error(lost, difference.shape[0] + 6.0))
    d = Evidence(observer.system.input_bounds, evidence.scale).meet(now, Source.INPUT)
    return d.box, evidence.weigh(d.slacks[0], Source.INPUT) if d.slacks else evidence


def _exact_input(
    observer: Observer, evidence: Evidence, known: Interval, terms: Terms, d: Interval, missed: _Missed | None = None
) -> tuple[Interval, Evidence]:
    """The exact box of d[k-1] for ``[G; H] d`` in a box, that of ``[x[k]; 0] - known`` (paper, Lemma 3; design 4.5)."""
    exact, box = observer.exact, evidence.box
    if not observer.system.p:
        return d, evidence
    zero = jnp.zeros(observer.system.l, box.dtype)
    explained = add(
        Interval.unchecked(jnp.concatenate([box.lower, zero]), jnp.concatenate([box.upper, zero])),
        Interval.unchecked(-known.upper, -known.lower),
    )
    rows = add(image(exact.rows, explained), image(exact.known, terms.known))
    rows = rows if missed is None else widen(rows, missed.of_inputs(observer.rounding_constants.rows, box))
    met = Evidence(d, evidence.scale).meet(rows, Source.INPUT)
    evidence = evidence.weigh(met.slacks[0], Source.INPUT)
    # Some d must reach the box at all: every combination of rows that is free of d contains 0.
    balance = add(image(exact.circuits, explained), image(exact.circuits_known, terms.known))
    balance = balance if missed is None else widen(balance, missed.of_inputs(observer.rounding_constants.circuits, box))
    return met.box, evidence.weigh(smaller(balance.upper, -balance.lower), Source.BALANCE)


def _finish(
    observer: Observer,
    evidence: Evidence,
    fallback: Evidence,
    carry: Carry | None,
    d: Interval | None,
    y: Any,
    u: Any,
    noise: Noise,
    hold: bool,
) -> tuple[Carry, StepOutput]:
    """Choose what to believe after a conflict, and report."""
    system, certificate = observer.system, observer.certificate
    conflict = evidence.conflict
    # Even the fallback may contradict itself (y[k] against the state bounds): then only the state bounds are left.
    restart = choose(fallback.conflict, system.state_bounds, fallback.box)
    state = choose(conflict, restart, evidence.box)
    believed = ~conflict if hold else ~conflict | ~fallback.conflict
    y_kept = jnp.where(believed, y, jnp.nan)

    d = system.input_bounds if d is None else choose(conflict, system.input_bounds, d)
    h = bound(system.maps, observer.bounds, observer.abstraction)(state, u)
    d_now = current_input(observer.current, h, state, output_box(system, y_kept, u, noise.v))

    applies = in_box(u, observer.u_region)
    if carry is not None:
        applies = applies & in_box(carry.u, observer.u_region)
    if certificate.region_matters:
        applies = applies & inside(state, certificate.region)
        if carry is not None:
            applies = applies & inside(carry.state, certificate.region)
    bits = (
        (conflict, Status.CONFLICT),
        (~jnp.isfinite(y).all(), Status.MISSING),
        (~(jnp.isfinite(state.lower) & jnp.isfinite(state.upper)).all(), Status.UNBOUNDED),
        (~applies, Status.OUTSIDE_REGION),
    )
    return Carry(state, h, y_kept, u, noise), StepOutput(state, d, d_now, bit_mask(bits), *evidence.tightest())


def _free_output(observer: Observer, box: Interval, u: Any) -> AffineForm:
    """Bounds of T2 g on a box of x[k]."""
    return bound(_free_map(observer), observer.bounds, observer.output_abstraction)(box, u)


def _first_form(observer: Observer, box: Interval, u: Any) -> AffineForm:
    """Affine bounds of T2 g on the state bounds: the one method that serves on infinite boxes. For x in `box`."""
    known, slack = observer.first.form, observer.first.slack
    if known is None:
        known, slack = affine_with_slack(_free_map(observer))(observer.system.state_bounds, u)
    if not rounding.outward():
        return known
    return AffineForm(known.slope, widen(known.offset, slip(slack, reach(box))), known.range)


def _free_map(observer: Observer) -> Any:
    return lambda x, u: observer.T2 @ observer.system.measurement(x, u)


def _psi(observer: Observer, u: Any) -> Any:
    """The remainder T2 g(x) - C x."""
    return lambda x: observer.T2 @ observer.system.measurement(x, u) - observer.C @ x


def _psi_box(observer: Observer, u: Any) -> Any:
    """The same at a point, as a box."""
    if not rounding.outward():
        return lambda x: point(_psi(observer, u)(x))

    def box(x: Any) -> Interval:
        g = value_at(observer.system.measurement, x, u)
        sides = (jnp.concatenate([g.lower, x]), jnp.concatenate([g.upper, x]))
        return image(jnp.concatenate([observer.T2, -observer.C], axis=1), Interval.unchecked(*sides))

    return box
