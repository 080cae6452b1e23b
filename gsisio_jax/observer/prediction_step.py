"""The prediction form: the paper's recursion (eq:xup)-(eq:hlow), with the box of x[k] from y[0..k-1] alone.

It is a framer only where rho(|G||J1|) < 1 (theory 2.3), which no rank-deficient feedthrough allows. Elsewhere its
boxes cross; then they bound nothing, every such step carries the status CROSSED, and the recursion goes on from the
sorted corners.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from gsisio_jax._memo import Remembers, once
from gsisio_jax.inclusion import AffineForm
from gsisio_jax.inclusion.intersection import bound
from gsisio_jax.inclusion.planes import Abstraction
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, add, choose, intersect, magnitude, nan_to_unbounded, widen
from gsisio_jax.interval.image import image, loose_matvec_upper
from gsisio_jax.interval.primitives import multiplied, scale
from gsisio_jax.interval.rounding import Rounding, check_rounding
from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.observer.domain import Domain, largest_magnitude
from gsisio_jax.observer.measurement import in_box, inside, output_box
from gsisio_jax.observer.periodic import unwrap
from gsisio_jax.observer.status import Source, Status, bit_mask
from gsisio_jax.observer.types import Carry, StepOutput, cast_once
from gsisio_jax.plant.system import Noise, System


class PredictionObserver(Remembers, eqx.Module):
    """The paper's observer; a pytree whose structure holds f and g. Made by `design_observer(form="prediction")`.

    Attributes:
        system: the plant.
        noise: the bounds it was designed for (any others are legal at run time).
        certificate: what the design promises; print it.
        left_inverse: J of [G; H], (p, n + l).
        state_gain: [M_f M_g M_w M_v M_y M_u] of Theorem 1, (2n, 4n + 4l + l + m).
        input_gain: [N11 N12; N21 N22] of (eq:dup), (2p, 2(n + l)).
        rho: spectral radius of |G||J1|.
        abstraction: affine planes of [f; g], where the bounds use them.
        derivative: bounds of the derivative of [f; g] that the decomposition uses, or None: enclosed on every box.
        current, current_input_directions: as in `Observer` (Lemma 4).
        framer: rho < 1, so the boxes are framers.
        bounds: the methods of Corollary 1 in use.
    """

    system: System
    noise: Noise
    certificate: Certificate
    left_inverse: Any
    state_gain: Any
    input_gain: Any
    rho: Any
    u_region: Interval
    abstraction: Abstraction | None
    derivative: Interval | None
    current: Any
    current_input_directions: Any
    framer: bool = eqx.field(static=True)
    bounds: tuple[str, ...] = eqx.field(static=True)
    output_rows: tuple[tuple[int, ...], ...] = eqx.field(static=True, default=())
    rounding: Rounding = eqx.field(static=True, default="outward")

    @property
    def delay(self) -> int:
        """0: boxes of x[k] come with y[k]; a `DelayedObserver` has another."""
        return 0

    @property
    def guaranteed(self) -> bool:
        """False: what J [G; H] leaves of the identity by rounding is not bounded in this form, and d has no bound."""
        return False

    def with_rounding(self, rounding: Rounding) -> PredictionObserver:
        """The same observer with another rounding."""
        check_rounding("PredictionObserver.with_rounding", rounding)
        return once(self, ("rounding", rounding), lambda: replace(self, rounding=rounding))

    def astype(self, dtype: Any) -> PredictionObserver:
        """The same observer in another floating type; boxes are rounded outward."""
        return cast_once(self, dtype)

    def save(self, path: str | os.PathLike[str]) -> None:
        """As `Observer.save`."""
        from gsisio_jax.files import save_observer

        save_observer(path, self)


def blank(observer: PredictionObserver, initial: Interval) -> Carry:
    """The past of a first step: nothing is known but the initial box."""
    n, l, m = observer.system.n, observer.system.l, observer.system.m
    zero = jnp.zeros(n + l, initial.dtype)
    nothing = Interval.unchecked(zero, zero)
    h = AffineForm(jnp.zeros((n + l, n), initial.dtype), nothing, nothing)
    noise = Noise.unchecked(nothing[:n], nothing[n:])
    return Carry(initial, h, zero[n:], zero[:1].repeat(m, 0), noise, jnp.asarray(True), jnp.asarray(True))


@rounding.by_observer
def advance(
    observer: PredictionObserver, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool = False
) -> tuple[Carry, StepOutput]:
    """One step of the paper's recursion, from the box of x[k-1] to that of x[k] and of d[k-1].

    y[k] does not enter the box of x[k] (it serves the current input and the next step), so `hold` changes nothing.
    """
    system = observer.system
    n, p = system.n, system.p
    h, w, v = carry.h.range, carry.noise.w, carry.noise.v
    known = jnp.concatenate(
        [h.upper[:n], h.lower[:n], h.upper[n:], h.lower[n:], w.upper, w.lower, v.upper, v.lower, carry.y, carry.u]
    )
    x = _rows(observer.state_gain, known, n)
    # (eq:hup), (eq:hlow): what is left for G d and H d.
    output = carry.y - system.D @ carry.u
    known_f = system.B @ carry.u
    upper = jnp.concatenate([x.upper - h.lower[:n] - known_f - w.lower, output - h.lower[n:] - v.lower])
    lower = jnp.concatenate([x.lower - h.upper[:n] - known_f - w.upper, output - h.upper[n:] - v.upper])
    d = _rows(observer.input_gain, jnp.concatenate([upper, lower]), p)
    # No measurement comes before the first step, so the box of x[0] is the initial one.
    x = choose(carry.starts, carry.state, x)
    return _finish(observer, x, choose(carry.starts, system.input_bounds, d), carry, y, u, noise)


def _rows(matrix: Any, value: Any, size: int) -> Interval:
    """``matrix @ value``, its first `size` rows upper and the others lower bounds; infinite where a weight meets a
    number that is not finite (a missing measurement, an infinite side)."""
    finite = jnp.isfinite(value)
    terms = scale(matrix, jnp.where(finite, value, 0))
    lost = ((matrix != 0) & ~finite).any(-1)
    upper, lower = rounding.sum_up(terms)[:size], rounding.sum_down(terms)[size:]
    return nan_to_unbounded(
        Interval.unchecked(jnp.where(lost[size:], -jnp.inf, lower), jnp.where(lost[:size], jnp.inf, upper))
    )


def _finish(
    observer: PredictionObserver, x: Interval, d: Interval, carry: Carry, y: Any, u: Any, noise: Noise
) -> tuple[Carry, StepOutput]:
    """Meet with what is known anyway (where the boxes are framers), and report."""
    system, certificate = observer.system, observer.certificate
    domain = Domain.of(x, largest_magnitude(y, x.lower, x.upper))
    if observer.framer:
        # In exact arithmetic these are never crossed; sorting undoes rounding.
        bounds = system.state_bounds.astype(x.dtype)
        domain = domain.with_box(bounds).intersect(_sorted(x)[None], Source.STATE)
        d, slack = intersect(system.input_bounds, _sorted(d))
        domain = domain.record_margin(slack, Source.INPUT)
        d = choose(domain.conflict, system.input_bounds, d)
    x = choose(domain.conflict, system.state_bounds, domain.box)
    h = bound(system.maps, observer.bounds, observer.abstraction, observer.derivative)(_sorted(x), u)
    missing, ambiguous = ~jnp.isfinite(y).all(), []
    if system.periodic:  # y[k] does not enter the box of x[k], so that box tells the multiple
        outputs = h.range[np.array([system.n + j for j, _ in system.periodic])]
        seen = unwrap(system, outputs, y, u, noise)
        domain = domain.record_margin(seen.slack, Source.PERIODIC)
        y, noise = jnp.where(seen.slack < 0, jnp.nan, seen.y), seen.noise
        ambiguous = [(seen.open.any(), Status.AMBIGUOUS)]
    applies = in_box(u, observer.u_region)
    if certificate.region_matters:
        applies = applies & inside(choose(carry.starts, x, carry.state), certificate.region)
    bits = (
        (domain.conflict, Status.CONFLICT),
        (missing, Status.MISSING),
        (~(jnp.isfinite(x.lower) & jnp.isfinite(x.upper)).all(), Status.UNBOUNDED),
        (~applies, Status.OUTSIDE_REGION),
        ((x.lower > x.upper).any() | (d.lower > d.upper).any(), Status.CROSSED),
        *ambiguous,
    )
    d1 = _current_input(observer.current, h, _sorted(x), output_box(system, y, u, noise.v))
    after = Carry(x, h, y, u, noise, jnp.asarray(False), jnp.asarray(True))
    return after, StepOutput(x, d, d1, bit_mask(bits), *domain.report())


def _current_input(current: Any, h: AffineForm, state: Interval, output: Interval) -> Interval:
    """Box of ``V1' d = current (y - g - D u - v)``, slopes combined before the box is applied (paper, Lemma 4)."""
    n, weights = state.shape[0], -current
    slope = multiplied(weights, h.slope[n:])
    joint = add(image(slope, state), image(weights, h.offset[n:]))
    if rounding.outward():
        # Of the slopes before they cancelled.
        lost = loose_matvec_upper(abs(weights), loose_matvec_upper(abs(h.slope[n:]), magnitude(state)))
        joint = widen(joint, rounding.error(lost, h.slope.shape[0] - n + 6.0))
    return nan_to_unbounded(add(intersect(joint, image(weights, h.range[n:]))[0], image(current, output)))


def _sorted(box: Interval) -> Interval:
    return Interval.unchecked(jnp.minimum(box.lower, box.upper), jnp.maximum(box.lower, box.upper))
