"""How a step begins: with what is known offline of the outputs on the state bounds, where no box of x[k] is known."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gsisio_jax.inclusion.atoms import wider
from gsisio_jax.inclusion.transforms import affine_with_slack
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, entire_like, magnitude
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.image import image, loose_matvec_upper, matvec_upper, plain_image, widened_for_sums
from gsisio_jax.observer.contractors import Affine, centred_form
from gsisio_jax.observer.domain import Domain
from gsisio_jax.observer.maps import Maps, at_point
from gsisio_jax.observer.measurement import in_box
from gsisio_jax.observer.status import Source
from gsisio_jax.observer.types import Observer


class FirstForm(NamedTuple):
    """Affine bounds of T2 g on the state bounds: the one method that serves on infinite boxes.

    The radius lacks what the slope is off by, which is `slack` (q, n) times ``|x|``; see `on`.
    """

    slope: Any
    center: Any
    radius: Any
    slack: Any

    @classmethod
    def of(cls, observer: Observer, u: Any) -> FirstForm:
        """As the design has left it; where g takes u, for the u of this step."""
        known, slack = observer.first.form, observer.first.slack
        if known is None:
            function = affine_with_slack(lambda x, u: observer.T2 @ observer.system.measurement(x, u))
            known, slack = function(observer.system.state_bounds, u)
        center, radius = known.offset.center, known.offset.radius
        if rounding.outward():
            radius = radius + wider(abs(center) + where(jnp.isfinite(radius), radius, 0), 0)
        return cls(known.slope, center, radius, slack)

    def on(self, box: Interval) -> Affine:
        """For x in `box`, a part of the state bounds."""
        radius = self.radius + loose_matvec_upper(self.slack, magnitude(box)) if rounding.outward() else self.radius
        return Affine(self.slope, self.center, radius)


def initial_boxes(maps: Maps, domain: Domain, right: Interval, inputs: Any, u: Any) -> Domain:
    """Bounds that need no box to begin with, for x[k] is unknown still, and with it what the gains leave of it: the
    contraction |N_z| R < 1 on the state bounds, and the linear form of T2 g there.

    Args:
        maps: of the observer.
        domain: what is known of x[k] so far.
        right: right sides of (*) without psi, (K, n).
        inputs: (p,) bound of ``|d[k-1]|`` but for its part in x[k], which is in the residuals of `first`.
        u: known input now.
    """
    observer = maps.observer
    first, gains = observer.first, observer.gains
    if rounding.outward():
        lost = loose_matvec_upper(observer.rounding_constants.gains.d, inputs)
        right = Interval.unchecked(right.lower - lost, right.upper + lost)
    # Where the linear form serves it says as much, and costs no value of g.
    rest = [(i, k) for i, k in enumerate(first.gains) if k not in first.linear]
    if rest:
        bounds = observer.system.state_bounds

        def psi(x: Any) -> tuple[Any, Any]:
            return at_point(maps.remainder, x, wider(abs(x), maps.terms), *maps.free_at(x, u))

        def of_gain(right: Interval, N_z: Any, inverse: Any, left: Any) -> Interval:
            return centred_form(right, N_z, inverse, psi, bounds, maps.terms, left)

        left = first.cancellation_residual if rounding.outward() else None
        each = [(right[k], gains.remainder[k], first.inverses[i], None if left is None else left[k]) for i, k in rest]
        boxes = _each(of_gain, each, together=maps.expansion is None)
        boxes = choose(in_box(u, observer.u_region), boxes, entire_like(boxes))
        domain = domain.intersect(boxes, Source.STATE)
    if first.linear and first.form is not None:
        chosen, N_z = jax.tree.map(lambda x: jnp.stack([x[k] for k in first.linear]), (right, gains.remainder))
        offset = image(-N_z, first.form.offset)
        shifted = Interval.unchecked(chosen.lower + offset.lower, chosen.upper + offset.upper)
        boxes = plain_image(first.maps, widened_for_sums(shifted, first.maps.shape[-1]))
        if rounding.outward():
            far = jnp.minimum(matvec_upper(first.bounds, magnitude(boxes)), magnitude(domain.box))
            left = loose_matvec_upper(first.left, far)
            boxes = Interval.unchecked(boxes.lower - left, boxes.upper + left)
        domain = domain.intersect(boxes, Source.STATE)
    return domain


def _each(function: Any, of: list[Any], together: bool) -> Interval:
    """A box for each of several tuples of arguments, stacked. Over arrays all are computed at once: g is traced and
    compiled once for them. Over numbers one by one: constants stay constants."""
    if together and len(of) > 1:
        return jax.vmap(function)(*jax.tree.map(lambda *rows: jnp.stack(rows), *of))
    return jax.tree.map(lambda *sides: jnp.stack(sides), *(function(*args) for args in of))
