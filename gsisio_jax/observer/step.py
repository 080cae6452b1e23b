"""One step of the current form, from the box of x[k-1] to that of x[k] (design 4.3).

`advance` is all there is: a start is a step whose past says nothing (`blank`), "hold" is the same step with y[k]
missing. It is written over small arrays; `gsisio_jax.scalar` compiles it over single numbers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.expansion import AtomBounds, States, wider
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import (
    Interval,
    add,
    choose,
    entire_like,
    image,
    is_concrete,
    nan_to_unbounded,
    plain_image,
    reach,
    slip,
    widened,
)
from gsisio_jax.interval.minmax import cut, raised, smaller
from gsisio_jax.interval.primitives import matmul, scale
from gsisio_jax.observer.bank import CancellationResidual, LinearBounds, Terms
from gsisio_jax.observer.contractors import (
    Affine,
    affine_rows,
    centred_form,
    contract_affine_rows,
    solve_remainder,
)
from gsisio_jax.observer.domain import Domain, largest_magnitude
from gsisio_jax.observer.initial import first_form, initial_boxes
from gsisio_jax.observer.maps import Maps, at_point
from gsisio_jax.observer.measurement import in_box, inside, output_box, point
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
    return Carry(initial, h, jnp.full(l, jnp.nan, dtype), jnp.zeros(m, dtype), noise, yes, no)


@rounding.by_observer
def advance(observer: Observer, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool = False) -> Any:
    """One step of design 4.3. Arrays must have their final dtype.

    After a conflict the recursion goes on from a box that does not contain the contradiction: y[k] and the state bounds
    alone (restart), or the past alone, with y[k] taken as missing (`hold`).

    Returns:
        The next `Carry`, and a `StepOutput`.
    """
    maps = Maps.of(observer, y.dtype)
    domain, fallback, d = _contract(maps, carry, y, u, noise)
    if hold:
        fallback, _, _ = _contract(maps, carry, jnp.full_like(y, jnp.nan), u, noise)
    return _finish(maps, domain, fallback, carry, d, y, u, noise, hold)


class _Known(NamedTuple):
    """What a step knows without any box of x: shared by all boxes that see the same record and noise.

    Attributes:
        terms: boxes that enter gains and left inverses linearly.
        right, inputs: their part of the bounds of x[k], (K, n), and of d[k-1], (K, p).
        z: box (q,) of T2 (y - D u - v).
    """

    terms: Terms
    right: Interval
    inputs: Interval
    z: Interval


@_stage("known")
def _known(observer: Observer, carry: Carry, y: Any, u: Any, noise: Noise) -> _Known:
    system, bounds = observer.system, observer.system.state_bounds
    output = output_box(system, y, u, noise.v)
    drift = add(image(system.B, point(carry.u)), carry.noise.w) if system.m else carry.noise.w
    seen = output_box(system, carry.y, carry.u, carry.noise.v)
    shift = Interval.unchecked(jnp.concatenate([drift.lower, -seen.upper]), jnp.concatenate([drift.upper, -seen.lower]))
    terms = Terms(
        shift, output, image(observer.bounded_states, bounds), image(observer.bounded_inputs, system.input_bounds)
    )
    return _Known(
        terms,
        observer.gains.linear(terms),
        observer.inverses.linear(terms),
        plain_image(observer.T2, widened(output, system.l)),
    )


def _contract(maps: Maps, carry: Carry, y: Any, u: Any, noise: Noise) -> tuple[Domain, Domain, Interval]:
    """The box of x[k], the box that y[k] and the state bounds alone give, and the box of d[k-1]."""
    observer, system, constants = maps.observer, maps.observer.system, maps.observer.rounding_constants
    known, before, bounds = _known(observer, carry, y, u, noise), carry.state, system.state_bounds
    size = largest_magnitude(y, carry.y, before.lower, before.upper)

    # 1. Bounds of h = [f; g] on the old box were left by the last step. 2. The right side of (*) without psi, jointly.
    with _stage("predict"):
        past = maps.states(before)
        right = _predicted(maps, observer.gains, past, carry, known.right)
        d_fixed = _predicted(maps, observer.inverses, past, carry, known.inputs, ranges=False)

    # 3. y[k] and the state bounds, which are all that a restart begins with, and the initial box, if this is the start;
    # then what needs no box to begin with.
    with _stage("initial"):
        form = first_form(observer, bounds, u)
        nothing = Domain.of(_typed(bounds, y.dtype), size)
        alone = _output(nothing, maps.states(bounds), form, known.z)
        domain = nothing.intersect(_if(carry.starts, before)[None], Source.INITIAL)
        domain = _output(domain, maps.states(domain.box), first_form(observer, domain.box, u), known.z)
        lost = _Lost(observer, d_fixed)
        domain = initial_boxes(maps, domain, right, lost.inputs, u)
        # What the gains leave of x[k] and d[k-1]: smaller boxes to come can only make it smaller.
        left = [lost.radius(of, domain.box) for of in (constants.gains, constants.inverses)]
        right, d_fixed = _plainly_wider(right, left[0]), _plainly_wider(d_fixed, left[1])

    # 4. Sweeps: T2 g on the box so far, every row solved for every state, and (*) solved for x[k].
    with _stage("sweeps"):
        states, psi = maps.states(domain.box), Affine(form.slope - observer.C, form.center, form.radius)
        covered = set(observer.first.linear) >= set(range(observer.gains.residual.shape[0]))
        for sweep in range(observer.sweeps):
            rows = None
            if sweep == 0 or observer.first.affine_output:
                form = first_form(observer, domain.box, u)
                psi = Affine(form.slope - observer.C, form.center, form.radius)
                if sweep == 0 and covered and not observer.first.affine_output:
                    continue  # the initial contraction was this
            else:
                atoms = maps.free_bounds(states, domain.box, u)
                form = affine_rows(maps.free, states, atoms)
                psi = affine_rows(maps.remainder, states, atoms)
            if sweep > 0 or observer.first.affine_output:
                rows, slack = contract_affine_rows(states, form, known.z)
                domain = domain.record_margin(slack, Source.OUTPUT)
            solved = solve_remainder(observer.gains.remainder, right, psi, states, maps.terms)
            domain = domain.intersect(solved, Source.STATE, quiet=rows)
            states = maps.states(domain.box)

    # 5. d[k-1] from every left inverse, and with it the plant's own equation; then the certified bound, where both
    # boxes lie in the region.
    with _stage("inputs"):
        d, domain = _inputs(maps, domain, states, d_fixed, psi)
        moved = _moved(maps, past, carry, known.terms)
        domain = _dynamics(maps, domain, moved, d)
    domain, promised = _certified(maps, domain, past, carry, right, known, left[0], u)
    with _stage("inputs"):
        states = maps.states(domain.box)
        d, domain = _certified_input(maps, domain, states, promised, known, left[1], d)
        d, domain = _exact_input(maps, domain, moved, carry, known.terms, d, lost)
    return domain, alone, d


def _output(domain: Domain, states: States, form: Affine, z: Interval) -> Domain:
    """Contract with ``T2 g(x) in z``."""
    rows, slack = contract_affine_rows(states, form, z)
    return domain.record_margin(slack, Source.OUTPUT).intersect(None, Source.STATE, quiet=rows)


def _plainly_wider(box: Interval, radius: Any) -> Interval:
    """A linear bound, wider by what gains leave; the rounding of one more sum is in what was widened before."""
    return box if radius is None else Interval.unchecked(box.lower - radius, box.upper + radius)


def _if(mask: Any, box: Interval) -> Interval:
    """The box where the mask holds, else everything."""
    return choose(mask, box, entire_like(box))


def _predicted(
    maps: Maps, bank: LinearBounds, past: States, carry: Carry, known: Interval, ranges: bool = True
) -> Interval:
    """All terms of a bank but those in x[k], (K, r); slopes are combined before the box is applied, so that what
    cancels cancels exactly: that is what keeps widths finite on nonlinear systems (design 4.3, step 2)."""
    rows, shape = bank.residual.reshape(-1, bank.residual.shape[-1]), bank.residual.shape[:2]
    found = maps.rows(rows).bounds(past, carry.h) if ranges else maps.rows(rows).joint_box(past, carry.h)
    n = maps.observer.system.n
    # Rows that use a measurement that is not believed say nothing.
    uses = (rows[:, n:] != 0).any(-1)
    known = _if(jnp.logical_or(carry.believed, ~uses), Interval.unchecked(known.lower.ravel(), known.upper.ravel()))
    return Interval.unchecked((found.lower + known.lower).reshape(shape), (found.upper + known.upper).reshape(shape))


def _moved(maps: Maps, past: States, carry: Carry, terms: Terms) -> Interval:
    """Box (n + l,) of [f + B u + w; g + D u + v - y][k-1]: of what [G; H] d does not explain."""
    n, l = maps.observer.system.n, maps.observer.system.l
    found = maps.rows(np.eye(n + l)).natural(past, carry.h)
    return Interval.unchecked(found.lower + terms.shift.lower, found.upper + terms.shift.upper)


def _dynamics(maps: Maps, domain: Domain, moved: Interval, d: Interval) -> Domain:
    """``x = f + B u + G d + w``: no way to a first box, but a contraction of a correct one (paper, Algorithm 1)."""
    system = maps.observer.system
    through = plain_image(system.G, widened(d, system.p + 2))
    moved = widened(moved[: system.n], 2)
    now = Interval.unchecked(moved.lower + through.lower, moved.upper + through.upper)
    return domain.intersect(now[None], Source.DYNAMICS)


class _Lost:
    """How far the bounds can be off because the gains do not cancel exactly (design 6).

    ``|d[k-1]| <= inputs + input_state |x[k]|`` from every left inverse, and by the input bounds.
    """

    def __init__(self, observer: Observer, d_fixed: Interval):
        self.constants, self.limit = observer.rounding_constants, reach(observer.system.input_bounds)
        self.inputs = jnp.asarray(self.limit)
        if rounding.outward():
            for i, j in enumerate(self.constants.direct):
                self.inputs = cut(self.inputs, slip(self.constants.input_inverses[i], reach(d_fixed[j])))

    def reaches(self, box: Interval) -> tuple[Any, Any]:
        """Bounds of ``|x[k]|`` (n,) and ``|d[k-1]|`` (p,), from a box of x[k]."""
        x = reach(box)
        return x, cut(jnp.asarray(self.limit), self.inputs + slip(self.constants.input_state, x))

    def radius(self, residual: CancellationResidual, box: Interval) -> Any:
        """Radius (K, r) by which a bank's bounds are to be widened; None to nearest."""
        if not rounding.outward():
            return None
        return slip(jnp.concatenate([residual.x, residual.d], -1), jnp.concatenate(self.reaches(box)))

    def of_inputs(self, weights: Any, box: Interval) -> Any:
        """The same for rows that leave only d[k-1], (..., p)."""
        return slip(weights, self.reaches(box)[1]) if rounding.outward() else None


class _Promised(NamedTuple):
    """Where the promise of the certificate applies; around the centre of the old box, its radius, and atoms there."""

    applies: Any
    center: Any
    slip: Any
    radius: Any
    atoms: Any


@_stage("certified")
def _certified(
    maps: Maps, domain: Domain, past: States, carry: Carry, right: Interval, known: _Known, left: Any, u: Any
) -> tuple[Domain, _Promised | None]:
    """Step 6 for the first gain: the right side around the centre of the old box, with the design's constant A."""
    observer, certificate, before = maps.observer, maps.observer.certificate, carry.state
    if not certificate.promised:
        return domain, None
    region = certificate.region
    applies = inside(before, region) & inside(domain.box, region) & carry.believed & ~carry.starts
    applies = applies & in_box(carry.u, observer.u_region) & in_box(u, observer.u_region)
    # Outside, stand on a finite point of the region instead: a masked NaN would still poison gradients.
    c = jnp.where(applies, past.center, jnp.asarray(region.center, right.dtype))
    radius = jnp.where(applies, past.radius, 0)
    promised = _Promised(applies, c, wider(abs(c), maps.terms), radius, (carry.h.value, carry.h.slip))
    gains, constants = observer.gains, observer.rounding_constants
    around = _around(maps, gains.residual[0], constants.growth, promised, known.right[0])
    around = _plainly_wider(around, _first(left))
    joint, slack = _met(right[0], around)
    domain = domain.record_margin(jnp.where(applies, slack, jnp.inf), Source.STATE)
    joint = choose(applies, joint, Interval.unchecked(c, c))
    safe = choose(applies, domain.box, Interval.unchecked(c, c))

    def psi(x: Any) -> tuple[Any, Any]:
        return at_point(maps.remainder, x, wider(abs(x), maps.terms), *maps.free_at(x, u))

    box = centred_form(joint, gains.remainder[0], observer.region_inverse, psi, safe, maps.terms)
    return domain.intersect(_if(applies, box)[None], Source.CERTIFICATE), promised


def _met(a: Interval, b: Interval) -> tuple[Interval, Any]:
    """Intersection and slack; the first box where they miss each other."""
    lower, upper = raised(a.lower, b.lower), cut(a.upper, b.upper)
    empty = upper < lower
    slack = smaller(a.upper - b.lower, b.upper - a.lower)
    return Interval.unchecked(jnp.where(empty, a.lower, lower), jnp.where(empty, a.upper, upper)), slack


def _around(maps: Maps, weights: Any, slope: Any, promised: _Promised, known: Interval) -> Interval:
    """A linear bound without its terms in x[k]: its value at the centre of the old box, give or take ``slope radius``.

    No Jacobian is evaluated online: `slope` is a constant of the design, valid on the region.
    """
    center, radius = at_point(maps.rows(weights), promised.center, promised.slip, *promised.atoms)
    radius = radius + matmul(jnp.asarray(slope, radius.dtype), promised.radius)
    radius = radius + wider(abs(center) + radius, 0)
    return Interval.unchecked(center - radius + known.lower, center + radius + known.upper)


def _first(radius: Any) -> Any:
    return None if radius is None else radius[0]


def _inputs(maps: Maps, domain: Domain, states: States, fixed: Interval, psi: Affine) -> tuple[Interval, Domain]:
    """Box of d[k-1] from every left inverse, given the box of x[k] (design 4.5)."""
    observer = maps.observer
    inverses, limits = observer.inverses, _typed(observer.system.input_bounds, fixed.dtype)
    # state x[k] - remainder psi(x[k]) with psi = D x + [e], slopes combined before the box is applied.
    slope = inverses.state - matmul(inverses.remainder, psi.slope)  # (K, p, n)
    middle = matmul(slope, states.center) - matmul(inverses.remainder, psi.center)
    loose = scale(abs(slope), states.radius).sum(-1) + scale(abs(inverses.remainder), psi.radius).sum(-1)
    # What rounding the slope has lost, where it was combined.
    combined = jnp.where((inverses.remainder != 0).any(-1, keepdims=True), abs(inverses.state), 0)
    loose = loose + scale(combined, states.slip).sum(-1)
    now = Interval.unchecked(fixed.lower + (middle - loose), fixed.upper + (middle + loose))
    d = Domain.of(limits, 0.0).intersect(now, Source.INPUT)
    return d.box, domain.taken(d)


def _typed(box: Interval, dtype: Any) -> Interval:
    return Interval.unchecked(jnp.asarray(box.lower, dtype), jnp.asarray(box.upper, dtype))


def _certified_input(
    maps: Maps,
    domain: Domain,
    states: States,
    promised: _Promised | None,
    known: _Known,
    left: Any,
    d: Interval,
) -> tuple[Interval, Domain]:
    """The same centred form for d[k-1] with the first left inverse."""
    observer = maps.observer
    if promised is None or not observer.system.p:
        return d, domain
    inverses, constants = observer.inverses, observer.rounding_constants
    around = _around(maps, inverses.residual[0], constants.input_growth, promised, known.inputs[0])
    around = _plainly_wider(around, _first(left))
    now = plain_image(inverses.state[0], states.wide)
    box = Interval.unchecked(now.lower + around.lower, now.upper + around.upper)
    met, slack = _met(d, _if(promised.applies, box))
    return met, domain.record_margin(slack, Source.INPUT)


def _exact_input(
    maps: Maps, domain: Domain, moved: Interval, carry: Carry, terms: Terms, d: Interval, lost: _Lost
) -> tuple[Interval, Domain]:
    """The exact box of d[k-1] for ``[G; H] d`` in the box of ``[x[k]; 0]`` minus what has moved without it."""
    zero = jnp.zeros(maps.observer.system.l, d.dtype)
    explained = Interval.unchecked(
        jnp.concatenate([domain.box.lower, zero]) - moved.upper, jnp.concatenate([domain.box.upper, zero]) - moved.lower
    )
    new = _beyond_inverses(maps.observer)
    return exact_input(maps.observer, domain, explained, terms.known, d, lost, carry.believed, new)


def exact_input(
    observer: Observer,
    domain: Domain,
    explained: Interval,
    known: Interval,
    d: Interval,
    lost: Any,
    believed: Any,
    new: Any = True,
) -> tuple[Interval, Domain]:
    """The exact box of d[k-1] for ``[G; H] d in explained`` (paper, Lemma 3; design 4.5), and conflicts that it shows.

    Args:
        observer: for its rows.
        domain: of x[k].
        explained: box (n + l,).
        known: bounds of the inputs that have them (b,).
        d: what is known of d[k-1] so far, (p,).
        lost: bounds what the rows leave of d[k-1]; None if they leave nothing.
        believed: the measurement behind `explained` is.
        new: mask (K, p) of rows that say something new.
    """
    exact, constants = observer.exact, observer.rounding_constants
    if not observer.system.p:
        return d, domain
    terms = explained.shape[0] + known.shape[0]
    joined = widened(_joined(explained, known), terms)

    def image_of(rows: Any, of_known: Any, residual: Any) -> Interval:
        found = plain_image(jnp.concatenate([rows, of_known], -1), joined)
        return found if lost is None else _plainly_wider(found, lost.of_inputs(residual, domain.box))

    rows = _if(new, image_of(exact.rows, exact.known, constants.rows))
    met = Domain.of(d, 0.0).intersect(_if(believed, rows), Source.INPUT)
    domain = domain.taken(met)
    # Some d must reach the box at all: every combination of rows that is free of d contains 0.
    balance = image_of(exact.circuits, exact.circuits_known, constants.circuits)
    slack = smaller(balance.upper, -balance.lower)
    return met.box, domain.record_margin(jnp.where(believed, slack, jnp.inf), Source.BALANCE)


def _joined(*boxes: Interval) -> Interval:
    return Interval.unchecked(*(jnp.concatenate([getattr(b, side) for b in boxes]) for side in ("lower", "upper")))


def _beyond_inverses(observer: Observer) -> Any:
    """Which rows of the exact box (K, p) are not those of a left inverse as well, which bounds f and g jointly."""
    exact, inverses = observer.exact.rows, observer.inverses
    if not all(map(is_concrete, jax.tree.leaves((exact, inverses)))):
        return True
    exact, inverses = jax.tree.map(np.asarray, (exact, inverses))
    direct = [j for j in range(len(inverses.residual)) if not (inverses.remainder[j].any() or inverses.output[j].any())]
    old = np.zeros(exact.shape[:2], bool)
    for j in direct:
        old |= (exact == -inverses.residual[j]).all(-1)
    return ~old


@_stage("finish")
def _finish(
    maps: Maps, domain: Domain, fallback: Domain, carry: Carry, d: Interval, y: Any, u: Any, noise: Noise, hold: bool
) -> tuple[Carry, StepOutput]:
    """Choose what to believe after a conflict, and report."""
    observer, system = maps.observer, maps.observer.system
    certificate, dtype = observer.certificate, y.dtype
    conflict = domain.conflict
    # Even the fallback may contradict itself (y[k] against the state bounds): then only the state bounds are left.
    restart = choose(fallback.conflict, _typed(system.state_bounds, dtype), fallback.box)
    state = _limited(choose(conflict, restart, domain.box))
    believed = ~conflict if hold else ~conflict | ~fallback.conflict

    d = choose(conflict, _typed(system.input_bounds, dtype), d)
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
        (~(jnp.isfinite(state.lower) & jnp.isfinite(state.upper)).all(), Status.UNBOUNDED),
        (~applies, Status.OUTSIDE_REGION),
    )
    after = Carry(state, h, y, u, noise, jnp.asarray(False), believed)
    return after, StepOutput(state, d, d_now, bit_mask(bits), *domain.report())


def _limited(box: Interval) -> Interval:
    """Numbers so large that the next step would overflow count as infinite."""
    most = float(jnp.finfo(box.dtype).max) ** (2 / 3)
    return Interval.unchecked(
        jnp.where(box.lower > -most, box.lower, -jnp.inf), jnp.where(box.upper < most, box.upper, jnp.inf)
    )


def _current_input(maps: Maps, states: States, h: AtomBounds, output: Interval, believed: Any) -> Interval:
    """Box of ``V1' d = current (y - g - D u - v)``, slopes combined before the box is applied (paper, Lemma 4)."""
    current, n = maps.observer.current, maps.observer.system.n
    xp = np if is_concrete(current) else jnp
    weights = xp.concatenate([xp.zeros((current.shape[0], n)), -current], 1)
    found = maps.rows(weights).bounds(states, h)
    seen = plain_image(current, widened(output, output.shape[0]))
    return _if(believed, nan_to_unbounded(Interval.unchecked(found.lower + seen.lower, found.upper + seen.upper)))
