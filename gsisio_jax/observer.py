"""The observer: what a design leaves for the online recursion, and that recursion, one step at a time.

`start` takes the box of x_0 and the first measurement, `step` takes one measurement more. `estimation.estimate` is
nothing but these two in a `lax.scan`.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from gsisio_jax import inclusion
from gsisio_jax.certificate import Certificate
from gsisio_jax.contraction import Bank, Evidence, Terms, centred, magnitude, solve_remainder, strips
from gsisio_jax.inclusion import AffineForm
from gsisio_jax.interval import Interval, add, image, intersect, scale
from gsisio_jax.status import Source, Status
from gsisio_jax.system import Noise, System


class FirstSweep(eqx.Module):
    """How a step begins: with what is known offline of the outputs on the state bounds.

    Attributes:
        form: affine bounds of T2 g there, or None where g takes u.
        inverses: ``(I - |N_z| R)^{-1}`` there, for the gains named in `gains`.
        gains: indices of the gains for which ``|N_z| R`` contracts there.
        affine_output: T2 g is affine on the state bounds, so psi is zero.

    Source: design 4.3, step 3.
    """

    form: AffineForm | None
    inverses: Any
    gains: tuple[int, ...] = eqx.field(static=True)
    affine_output: bool = eqx.field(static=True)


class Observer(eqx.Module):
    """A designed observer; a pytree whose structure holds f and g. Made by `design_observer`.

    Attributes:
        system: the plant.
        noise: the bounds it was designed for (any others are legal at run time).
        certificate: what the design promises; print it.
        gains: K bounds of x[k]; the first is the certified one.
        inverses: bounds of d[k-1]; the first is the certified one.
        T2, C: unknown-input-free outputs (q, l) and the slopes chosen for them (q, n).
        bounded_states: (s, n) rows of the identity; bounded_inputs: (b, p).
        region_inverse: ``(I - |N_z| R)^{-1}`` of the first gain on the region (n, n).
        u_region: box (m,) of known inputs for which the enclosures hold; all of R^m where f and g do not take u.
        first: how every step begins.
        current: (p_H, l), ``V1' d = current @ (y - g - D u - v)``.
        current_input_directions: V1 (p, p_H).
        output_rows: for every row of T2 the outputs that enter it.
        sweeps: how often the box is contracted in a step.
    """

    system: System
    noise: Noise
    certificate: Certificate
    gains: Bank
    inverses: Bank
    T2: Any
    C: Any
    bounded_states: Any
    bounded_inputs: Any
    region_inverse: Any
    u_region: Interval
    first: FirstSweep
    current: Any
    current_input_directions: Any
    output_rows: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    sweeps: int = eqx.field(static=True)

    def astype(self, dtype: Any) -> Observer:
        """The same observer in another floating type; boxes are rounded outward."""
        return jax.tree.map(
            lambda leaf: leaf.astype(dtype) if isinstance(leaf, Interval) else jnp.asarray(leaf, dtype),
            self,
            is_leaf=lambda leaf: isinstance(leaf, Interval),
        )


class Carry(eqx.Module):
    """What one step hands to the next; a pytree of arrays that can be saved and resumed.

    Attributes:
        state: box of x[k], (n,).
        h: affine bounds of [f; g] on that box, (n + l,).
        y: (l,) measurement k, NaN where missing or not believed.
        u: (m,) known input k.
        noise: bounds of w[k] and v[k].
    """

    state: Interval
    h: AffineForm
    y: Any
    u: Any
    noise: Noise


class StepOutput(eqx.Module):
    """Result of one step k.

    Attributes:
        state: box of x[k] from y[0..k], (n,).
        input: box of d[k-1] from y[0..k], (p,); at k = 0 the input bounds.
        current_input: box of V1' d[k] from y[0..k], (p_H,).
        status: `Status` bit mask.
        margin: signed slack of the tightest intersection.
        source: which one it was (`Source`).
    """

    state: Interval
    input: Interval
    current_input: Interval
    status: Any
    margin: Any
    source: Any


def begin(
    observer: Observer, initial: Interval, y: Any, u: Any, noise: Noise, hold: bool = False
) -> tuple[Carry, StepOutput]:
    """Step 0: the initial box met with the state bounds and with y[0]. Arrays must have their final dtype."""
    bounds = observer.system.state_bounds
    z = image(observer.T2, _output_box(observer.system, y, u, noise.v))
    scale = magnitude(y, initial.lower, initial.upper)
    evidence = prior = Evidence(bounds, scale).meet(initial[None], Source.INITIAL)
    form = _first_form(observer, u)  # valid on every smaller box: the first sweep serves the fallback too
    fallback = prior if hold else strips(Evidence(bounds, scale), form, z)
    for sweep in range(observer.sweeps):
        form = form if sweep == 0 else _free_output(observer, evidence.box, u)
        evidence = strips(evidence, form, z)
    return _finish(observer, evidence, fallback, None, None, y, u, noise, hold)


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
    output = _output_box(system, y, u, noise.v)
    drift = add(_point(system.B @ carry.u), carry.noise.w)
    seen = _output_box(system, carry.y, carry.u, carry.noise.v)
    shift = Interval.unchecked(jnp.concatenate([drift.lower, -seen.upper]), jnp.concatenate([drift.upper, -seen.lower]))
    terms = Terms(
        shift, output, image(observer.bounded_states, bounds), image(observer.bounded_inputs, system.input_bounds)
    )

    # 1. Bounds of h = [f; g] on the old box, once for all gains (the last step has left them). 2. The right side of (*)
    # without psi, jointly.
    h = carry.h
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=1), gains.flat(), inverses.flat())
    bound = both.explicit(h, before, terms)[0]
    right = Interval.unchecked(*(x[: gains.rows].reshape(-1, n) for x in (bound.lower, bound.upper)))
    shape = inverses.residual.shape[:2]
    d_fixed = Interval.unchecked(*(x[gains.rows :].reshape(shape) for x in (bound.lower, bound.upper)))
    f_now = add(h.range[:n], drift)

    # 3.-5. Contract from the state bounds; y[k] alone first, because a restart begins there.
    z = image(observer.T2, output)
    evidence = alone = Evidence(bounds, magnitude(y, carry.y, before.lower, before.upper))
    form, affine = _first_form(observer, u), observer.first.affine_output
    for sweep in range(observer.sweeps):
        form = form if sweep == 0 or affine else _free_output(observer, evidence.box, u)
        evidence = strips(evidence, form, z)
        if sweep == 0:
            alone = evidence
            evidence = _meet_closed_form(observer, evidence, right, u)
        solved = right if affine else solve_remainder(gains, right, form, observer.C)
        evidence = evidence.meet(solved, Source.STATE)
    if system.p:
        # The paper's own loop x = f + B u + G d + w: no way to a first box, but a contraction of a correct one.
        d, _ = _inputs(observer, evidence, d_fixed, form)
        evidence = evidence.meet(add(f_now, image(system.G, d))[None], Source.DYNAMICS)

    # 6. The certified bound, where both boxes lie in the region. (The form of the last sweep holds on smaller boxes.)
    evidence, inside = _certified(observer, evidence, before, right, terms, carry.u, u)
    d, evidence = _inputs(observer, evidence, d_fixed, form)
    d, evidence = _certified_input(observer, evidence, before, inside, terms, carry.u, d)
    return evidence, alone, d


def _meet_closed_form(observer: Observer, evidence: Evidence, right: Interval, u: Any) -> Evidence:
    """Bounds that need no box to begin with: the contraction |N_z| R < 1 on the state bounds."""
    chosen = observer.first.gains
    if not chosen:
        return evidence
    right, N_z = jax.tree.map(lambda x: jnp.stack([x[k] for k in chosen]), (right, observer.gains.remainder))
    boxes = jax.vmap(centred, in_axes=(0, 0, 0, None, None))(
        right, N_z, observer.first.inverses, _psi(observer, u), observer.system.state_bounds
    )
    return evidence.meet(_where(_in_u_region(observer, u), boxes, _entire(boxes)), Source.STATE)


def _certified(
    observer: Observer, evidence: Evidence, before: Interval, right: Interval, terms: Terms, u_before: Any, u: Any
) -> tuple[Evidence, Any]:
    """Step 6 for the first gain: the right side around the centre of the old box, with the design's constant A."""
    certificate = observer.certificate
    if not certificate.promised:
        return evidence, jnp.asarray(False)
    region = certificate.region
    inside = _inside(before, region) & _inside(evidence.box, region)
    inside = inside & _in_u_region(observer, u_before) & _in_u_region(observer, u)
    # Outside, stand on a finite point of the region instead: a masked NaN would still poison gradients.
    c = jnp.where(inside, before.center, region.center)
    gain, system = jax.tree.map(lambda x: x[0], observer.gains), observer.system
    at_center = jnp.concatenate([system.dynamics(c, u_before), system.measurement(c, u_before)])
    spread = scale(certificate.growth, jnp.where(inside, before.radius, 0)).sum(-1)
    middle = (gain.residual * at_center).sum(-1)
    around = add(Interval.unchecked(middle - spread, middle + spread), gain.linear(terms))
    joint = intersect(right[0], around)[0]
    safe = Interval.unchecked(jnp.where(inside, evidence.box.lower, c), jnp.where(inside, evidence.box.upper, c))
    box = centred(joint, gain.remainder, observer.region_inverse, _psi(observer, u), safe)
    return evidence.meet(_where(inside, box, _entire(box))[None], Source.CERTIFICATE), inside


def _certified_input(
    observer: Observer, evidence: Evidence, before: Interval, inside: Any, terms: Terms, u_before: Any, d: Interval
) -> tuple[Interval, Evidence]:
    """The same centred form for d[k-1] with the first left inverse."""
    certificate, system = observer.certificate, observer.system
    if not certificate.promised or not system.p:
        return d, evidence
    inverse = jax.tree.map(lambda x: x[0], observer.inverses)
    c = jnp.where(inside, before.center, certificate.region.center)
    at_center = jnp.concatenate([system.dynamics(c, u_before), system.measurement(c, u_before)])
    spread = scale(certificate.input_state_before, jnp.where(inside, before.radius, 0)).sum(-1)
    middle = (inverse.residual * at_center).sum(-1)
    now = image(inverse.state, evidence.box)
    box = add(Interval.unchecked(middle - spread, middle + spread), now, inverse.linear(terms))
    met, slack = intersect(d, _where(inside, box, _entire(box)))
    return met, evidence.weigh(slack, Source.INPUT)


def _inputs(observer: Observer, evidence: Evidence, fixed: Interval, form: AffineForm) -> tuple[Interval, Evidence]:
    """Box of d[k-1] from every left inverse, given the box of x[k] (design 4.5)."""
    inverses, box = observer.inverses, evidence.box
    # state x[k] - remainder psi(x[k]) with psi = (S - C) x + [e], slopes combined before the box is applied.
    slope = inverses.state - (inverses.remainder[..., None] * (form.slope - observer.C)).sum(-2)
    now = add(image(slope, box), image(-inverses.remainder, form.offset), fixed)
    d = Evidence(observer.system.input_bounds, evidence.scale).meet(now, Source.INPUT)
    return d.box, evidence.weigh(d.slacks[0], Source.INPUT) if d.slacks else evidence


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
    restart = _where(fallback.conflict, system.state_bounds, fallback.box)
    state = _where(conflict, restart, evidence.box)
    believed = ~conflict if hold else ~conflict | ~fallback.conflict
    y_kept = jnp.where(believed, y, jnp.nan)

    d = system.input_bounds if d is None else _where(conflict, system.input_bounds, d)
    h = inclusion.affine(lambda x, u: jnp.concatenate([system.dynamics(x, u), system.measurement(x, u)]))(state, u)
    current_input = _current_input(observer, h, state, _output_box(system, y_kept, u, noise.v))

    applies = _in_u_region(observer, u)
    if carry is not None:
        applies = applies & _in_u_region(observer, carry.u)
    if certificate.region_matters:
        applies = applies & _inside(state, certificate.region)
        if carry is not None:
            applies = applies & _inside(carry.state, certificate.region)
    bits = (
        (conflict, Status.CONFLICT),
        (~jnp.isfinite(y).all(), Status.MISSING),
        (~(jnp.isfinite(state.lower) & jnp.isfinite(state.upper)).all(), Status.UNBOUNDED),
        (~applies, Status.OUTSIDE_REGION),
    )
    status = sum(jnp.where(condition, int(bit), 0).astype(jnp.int32) for condition, bit in bits)
    margin, source = evidence.tightest()
    return Carry(state, h, y_kept, u, noise), StepOutput(state, d, current_input, status, margin, source)


def _current_input(observer: Observer, h: AffineForm, state: Interval, output: Interval) -> Interval:
    """Box of ``V1' d = current (y - g - D u - v)``, slopes combined before the box is applied (paper, Lemma 4)."""
    n, weights = observer.system.n, -observer.current
    slope = (weights[..., None] * h.slope[n:]).sum(-2)
    joint = add(image(slope, state), image(weights, h.offset[n:]))
    return add(intersect(joint, image(weights, h.range[n:]))[0], image(observer.current, output))


def _output_box(system: System, y: Any, u: Any, v: Interval) -> Interval:
    """Box of ``y - D u - v``: of ``g(x) + H d``; all of R where y is NaN (or infinite: batches cannot refuse it)."""
    missing = ~jnp.isfinite(y)
    known = jnp.where(missing, 0, y) - system.D @ u
    return Interval.unchecked(
        jnp.where(missing, -jnp.inf, known - v.upper), jnp.where(missing, jnp.inf, known - v.lower)
    )


def _free_output(observer: Observer, box: Interval, u: Any) -> AffineForm:
    """Affine bounds of T2 g on a box of x[k]."""
    system = observer.system
    return inclusion.affine(lambda x, u: observer.T2 @ system.measurement(x, u))(box, u)


def _first_form(observer: Observer, u: Any) -> AffineForm:
    """Affine bounds of T2 g on the state bounds."""
    known = observer.first.form
    return _free_output(observer, observer.system.state_bounds, u) if known is None else known


def _psi(observer: Observer, u: Any) -> Any:
    """The remainder T2 g(x) - C x."""
    return lambda x: observer.T2 @ observer.system.measurement(x, u) - observer.C @ x


def _point(value: Any) -> Interval:
    return Interval.unchecked(value, value)


def _entire(box: Interval) -> Interval:
    return Interval.unchecked(jnp.full_like(box.lower, -jnp.inf), jnp.full_like(box.upper, jnp.inf))


def _inside(box: Interval, region: Interval) -> Any:
    return ((region.lower <= box.lower) & (box.upper <= region.upper)).all()


def _in_u_region(observer: Observer, u: Any) -> Any:
    """Do the design's enclosures of the derivatives hold for this known input?"""
    return _inside(_point(u), observer.u_region)


def _where(condition: Any, a: Interval, b: Interval) -> Interval:
    return Interval.unchecked(jnp.where(condition, a.lower, b.lower), jnp.where(condition, a.upper, b.upper))
