"""The prediction form: the paper's recursion (eq:xup)-(eq:hlow), with the box of x[k] from y[0..k-1] alone.

It is a framer only where rho(|G||J1|) < 1 (design 3, P3), which no rank-deficient feedthrough allows. Elsewhere its
boxes cross; then they bound nothing, every such step carries the status CROSSED, and the recursion goes on from the
sorted corners.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from gsisio_jax.inclusion.intersection import bound
from gsisio_jax.inclusion.planes import Abstraction
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, intersect, nan_to_unbounded, scale
from gsisio_jax.interval.rounding import Rounding
from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.observer.contractors import Evidence, magnitude
from gsisio_jax.observer.measurement import current_input, in_box, inside, output_box
from gsisio_jax.observer.status import Source, Status, bit_mask
from gsisio_jax.observer.types import Carry, StepOutput, cast
from gsisio_jax.plant.system import Noise, System


class PredictionObserver(eqx.Module):
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
    def guaranteed(self) -> bool:
        """False: what J [G; H] leaves of the identity by rounding is not bounded in this form, and d has no bound."""
        return False

    def with_rounding(self, rounding: Rounding) -> PredictionObserver:
        """The same observer with another rounding."""
        return replace(self, rounding=rounding)

    def astype(self, dtype: Any) -> PredictionObserver:
        """The same observer in another floating type; boxes are rounded outward."""
        return cast(self, dtype)


@rounding.by_observer
def begin(
    observer: PredictionObserver, initial: Interval, y: Any, u: Any, noise: Noise, hold: bool = False
) -> tuple[Carry, StepOutput]:
    """Step 0: no measurement comes before it, so the box of x[0] is the initial one (met with the state bounds)."""
    system = observer.system
    return _finish(observer, initial, system.input_bounds, None, y, u, noise)


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
    return _finish(observer, x, d, carry, y, u, noise)


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
    observer: PredictionObserver, x: Interval, d: Interval, carry: Carry | None, y: Any, u: Any, noise: Noise
) -> tuple[Carry, StepOutput]:
    """Meet with what is known anyway (where the boxes are framers), and report."""
    system, certificate = observer.system, observer.certificate
    evidence = Evidence(x, magnitude(y, x.lower, x.upper))
    if observer.framer:
        # In exact arithmetic these are never crossed; sorting undoes rounding.
        evidence = Evidence(system.state_bounds, evidence.scale).meet(_sorted(x)[None], Source.STATE)
        d, slack = intersect(system.input_bounds, _sorted(d))
        evidence = evidence.weigh(slack, Source.INPUT)
        d = choose(evidence.conflict, system.input_bounds, d)
    x = choose(evidence.conflict, system.state_bounds, evidence.box)
    h = bound(system.maps, observer.bounds, observer.abstraction, observer.derivative)(_sorted(x), u)
    applies = in_box(u, observer.u_region)
    if certificate.region_matters:
        applies = applies & inside(x if carry is None else carry.state, certificate.region)
    bits = (
        (evidence.conflict, Status.CONFLICT),
        (~jnp.isfinite(y).all(), Status.MISSING),
        (~(jnp.isfinite(x.lower) & jnp.isfinite(x.upper)).all(), Status.UNBOUNDED),
        (~applies, Status.OUTSIDE_REGION),
        ((x.lower > x.upper).any() | (d.lower > d.upper).any(), Status.CROSSED),
    )
    d1 = current_input(observer.current, h, _sorted(x), output_box(system, y, u, noise.v))
    return Carry(x, h, y, u, noise), StepOutput(x, d, d1, bit_mask(bits), *evidence.tightest())


def _sorted(box: Interval) -> Interval:
    return Interval.unchecked(jnp.minimum(box.lower, box.upper), jnp.maximum(box.lower, box.upper))
