"""The certified bound: what keeps the width promise of a design, where boxes lie in its region (theory 5.6)."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gsisio_jax.inclusion.atoms import States, wider
from gsisio_jax.interval.box import Interval, center_and_radius, choose, intersect
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.image import plain_image
from gsisio_jax.interval.minmax import cut, raised
from gsisio_jax.interval.primitives import matmul, scale
from gsisio_jax.observer.bank import Known
from gsisio_jax.observer.contractors import Newton, centred_form, repeated
from gsisio_jax.observer.domain import Domain
from gsisio_jax.observer.lost import plainly_wider
from gsisio_jax.observer.maps import Maps, at_point
from gsisio_jax.observer.measurement import everything_unless, in_box, inside
from gsisio_jax.observer.status import Source
from gsisio_jax.observer.types import Carry, RoundingConstants


class Promised(NamedTuple):
    """Where the promise of the certificate applies; around the centre of the old box, its radius, and atoms there."""

    applies: Any
    center: Any
    center_error: Any
    radius: Any
    atoms: Any


@jax.named_scope("certified")
def certified(
    maps: Maps,
    domain: Domain,
    past: States,
    carry: Carry,
    right: Interval,
    known: Known,
    left: Any,
    newton: Newton | None,
    u: Any,
) -> tuple[Domain, Promised | None]:
    """Step 6 for the first gain: the right side around the centre of the old box, with the design's constant A."""
    observer, certificate, before = maps.observer, maps.observer.certificate, carry.state
    if not certificate.promised:
        return domain, None
    region = certificate.region
    applies = inside(before, region) & inside(domain.box, region) & carry.believed & ~carry.starts
    applies = applies & in_box(carry.u, observer.u_region) & in_box(u, observer.u_region)
    # Outside, stand on a finite point of the region instead: a masked NaN would still poison gradients.
    c = where(applies, past.center, jnp.asarray(region.center, right.dtype))
    radius = where(applies, past.radius, 0)
    promised = Promised(applies, c, wider(abs(c), maps.terms), radius, (carry.h.value, carry.h.value_error))
    gains, constants = observer.gains, observer.rounding_constants
    around = _around(maps, gains.residual[0], _reach(constants, before, promised), promised, known.right[0])
    around = plainly_wider(around, _first(left))
    joint, slack = intersect(right[0], around)
    domain = domain.record_margin(where(applies, slack, jnp.inf), Source.STATE)
    joint = choose(applies, joint, Interval.unchecked(c, c))
    safe = choose(applies, domain.box, Interval.unchecked(c, c))

    def psi(x: Any) -> tuple[Any, Any]:
        return at_point(maps.remainder, x, wider(abs(x), maps.terms), *maps.free_at(x, u))

    N_z, V, steps = gains.remainder[0], observer.region_inverse, observer.corrections
    found = []
    if steps or not constants.rounds:
        improve = newton if steps else None
        written = steps if maps.expansion is not None else maps.written
        box = centred_form(joint, N_z, V, psi, safe, maps.terms, None, improve, steps, written)
        safe = Interval.unchecked(raised(safe.lower, box.lower), cut(safe.upper, box.upper))
        found.append(everything_unless(applies, box))
    if constants.rounds:
        whole = _bounded(region, observer.system.state_bounds, right.dtype)
        rounds, written = constants.rounds, maps.written
        box = _recentred(joint, N_z, constants.implicit, psi, safe, whole, maps.terms, rounds, written)
        found.append(everything_unless(applies, box))
    return domain.intersect(jax.tree.map(lambda *sides: jnp.stack(sides), *found), Source.CERTIFICATE), promised


def _bounded(region: Interval, bounds: Interval, dtype: Any) -> Interval:
    """The part of the region within the state bounds; 0 for a state without bounds, on which psi does not depend."""
    lower, upper = raised(region.lower, bounds.lower), cut(region.upper, bounds.upper)
    known = jnp.isfinite(lower) & jnp.isfinite(upper)
    return Interval.unchecked(*(where(known, side, 0).astype(dtype) for side in (lower, upper)))


def _recentred(
    right: Interval,
    N_z: Any,
    implicit: Any,
    remainder: Any,
    within: Interval,
    whole: Interval,
    terms: int,
    rounds: int,
    written: int,
) -> Interval:
    """Bound x, where ``x + N_z psi(x) in right`` and x lies in `within`, about the middle of what is left of that.

    With ``mid +- rad = right`` and b the middle of a box of radius rho, ``|x - (mid - N_z psi(b))|`` is at most
    ``rad + |N_z| R rho``: whatever b misses of the solution, the new box is no wider than that. The first of several
    rounds stands on the middle of the region: its psi is a constant, if g takes no known input.

    Args:
        right: box (n,).
        N_z: (n, q).
        implicit: ``|N_z| R`` on `whole`, (n, n).
        remainder: psi at a point, as center and radius (q,).
        within: box (n,), finite.
        whole: box (n,) that holds `within`, finite.
        terms: of a row, for rounding.
        rounds: how often, at least 1.
        written: more are a loop, in which psi is compiled once.

    Source: theory 5.6.
    """
    middle, radius = center_and_radius(right)
    radius = radius + wider(abs(middle) + radius, terms)
    size = abs(N_z)

    def turn(box: Interval, about: Interval) -> Interval:
        half = 0.5 * (about.upper - about.lower)
        value, error = remainder(about.lower + half)
        center = middle - matmul(N_z, value)
        far = radius + matmul(size, error) + scale(implicit, half).sum(-1)
        far = far + wider(abs(center) + abs(middle) + matmul(size, abs(value)) + far, terms)
        return Interval.unchecked(raised(box.lower, center - far), cut(box.upper, center + far))

    if rounds > 1:
        within = turn(within, whole)
        rounds -= 1
    return repeated(lambda box: turn(box, box), within, rounds, written)


def _reach(constants: RoundingConstants, before: Interval, promised: Promised) -> tuple[Any, Any]:
    """How far the certified gain may be below and above its value at the centre of the old box.

    No Jacobian is evaluated online: slopes are constants of the design, valid on the region.
    """
    if constants.slices is None:
        reach = matmul(jnp.asarray(constants.growth, promised.radius.dtype), promised.radius)
        return reach, reach
    lower, upper = (where(promised.applies, side, promised.center) for side in (before.lower, before.upper))
    return constants.slices.reach(lower, promised.center, upper)


def _around(maps: Maps, weights: Any, reach: tuple[Any, Any], promised: Promised, known: Interval) -> Interval:
    """A linear bound without its terms in x[k]: its value at the centre of the old box, and how far around."""
    center, error = at_point(maps.rows(weights), promised.center, promised.center_error, *promised.atoms)

    def far(reach: Any) -> Any:
        radius = error + reach
        return radius + wider(abs(center) + radius, 0)

    below = far(reach[0])
    above = below if reach[1] is reach[0] else far(reach[1])
    return Interval.unchecked(center - below + known.lower, center + above + known.upper)


def _first(radius: Any) -> Any:
    return None if radius is None else radius[0]


def certified_input(
    maps: Maps,
    domain: Domain,
    states: States,
    promised: Promised | None,
    known: Known,
    left: Any,
    d: Interval,
) -> tuple[Interval, Domain]:
    """The same centred form for d[k-1] with the first left inverse."""
    observer = maps.observer
    if promised is None or not observer.system.p:
        return d, domain
    inverses, constants = observer.inverses, observer.rounding_constants
    reach = matmul(jnp.asarray(constants.input_growth, promised.radius.dtype), promised.radius)
    around = _around(maps, inverses.residual[0], (reach, reach), promised, known.inputs[0])
    around = plainly_wider(around, _first(left))
    now = plain_image(inverses.state[0], states.wide)
    box = Interval.unchecked(now.lower + around.lower, now.upper + around.upper)
    met, slack = intersect(d, everything_unless(promised.applies, box))
    return met, domain.record_margin(slack, Source.INPUT)
