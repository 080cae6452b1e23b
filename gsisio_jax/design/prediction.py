"""Design of the prediction form: the paper's Theorem 1 with its missing condition, rho(|G||J1|) < 1 (theory 2.3)."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from gsisio_jax import inclusion
from gsisio_jax.design.feedthrough import factorise
from gsisio_jax.design.framer import FramerGains, framer_gains
from gsisio_jax.design.left_inverse import smallest_radius_inverse
from gsisio_jax.design.planes import plane_bounds
from gsisio_jax.design.region import Near, find_region, grown_around
from gsisio_jax.errors import FramerNotGuaranteed
from gsisio_jax.inclusion.mixed_monotone import width_gain
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.certificate import Certificate, spectral_radius
from gsisio_jax.observer.prediction_step import PredictionObserver
from gsisio_jax.plant.system import Noise, System

LeftInverse = Literal["pseudo", "feedthrough", "smallest"]
DEFAULT_BOUNDS = ("affine", "natural", "decomposition", "mean_value")


def design_prediction(
    system: System,
    noise: Noise,
    region: Interval | None,
    u_region: Interval,
    bounds: tuple[str, ...],
    left_inverse: LeftInverse | Any = "pseudo",
    allow_uncertified: bool = False,
    derivative: Interval | None = None,
    around: Near | None = None,
) -> PredictionObserver:
    """The paper's observer; arguments as in `design_observer`, which calls this.

    Raises:
        FramerNotGuaranteed: rho(|G||J1|) >= 1 and `allow_uncertified` is not set.
        ValueError: `left_inverse` is unknown or no left inverse.

    Source: paper, Theorem 1; theory 2.1-2.3 and 2.6.
    """
    if derivative is not None and derivative.shape != (system.n + system.l, system.n):
        raise ValueError(
            f"design_observer: `derivative` must have shape {(system.n + system.l, system.n)}, that of the derivative "
            f"of [f; g], got {derivative.shape}"
        )
    feedthrough = factorise(np.asarray(system.H))
    gains = framer_gains(system, _choose(system, left_inverse))
    if not gains.guaranteed and not allow_uncertified:
        raise FramerNotGuaranteed(_reason(system, gains, left_inverse))

    def promise(box: Interval) -> Certificate:
        return _certificate(system, noise, gains, box, u_region, bounds, derivative)

    box = region
    if box is None:
        box = find_region(system, lambda box: promise(box).steady_width, around)
    certificate = promise(box)
    if region is None and certificate.region_matters:
        certificate = certificate.with_notes(grown_around(around, box))
    abstraction = plane_bounds(system, system.maps, box, u_region) if "abstraction" in bounds else None
    return PredictionObserver(
        system=system,
        noise=noise,
        certificate=certificate,
        left_inverse=gains.J,
        state_gain=np.hstack([gains.M_f, gains.M_g, gains.M_w, gains.M_v, gains.M_y, gains.M_u]),
        input_gain=np.block([[gains.N11, gains.N12], [gains.N21, gains.N22]]),
        rho=np.float64(gains.rho),
        u_region=u_region if system.takes_u else Interval.entire(system.m),
        abstraction=abstraction,
        derivative=derivative,
        current=feedthrough.current,
        current_input_directions=feedthrough.V1,
        framer=gains.guaranteed,
        bounds=bounds,
        output_rows=feedthrough.output_rows,
    )


def _choose(system: System, left_inverse: LeftInverse | Any) -> Any:
    """J: the paper's pseudo-inverse, [0 pinv(H)] (the closed form P6), or the one with the smallest rho."""
    if not isinstance(left_inverse, str):
        return left_inverse
    G, H = np.asarray(system.G), np.asarray(system.H)
    if left_inverse == "pseudo":
        return None
    if left_inverse == "smallest":
        return smallest_radius_inverse(G, H)
    if left_inverse != "feedthrough":
        raise ValueError(
            'design_observer: `left_inverse` must be "pseudo", "feedthrough", "smallest" or a matrix '
            f"({system.p}, {system.n + system.l}), got {left_inverse!r}"
        )
    if np.linalg.matrix_rank(H) < system.p:
        raise ValueError(
            'design_observer: left_inverse="feedthrough" needs H of full column rank, it has rank '
            f'{np.linalg.matrix_rank(H)} and {system.p} columns; use form="current"'
        )
    return np.hstack([np.zeros((system.p, system.n)), np.linalg.pinv(H)])


def _reason(system: System, gains: FramerGains, left_inverse: Any) -> str:
    H = np.asarray(system.H)
    said = (
        f'design_observer: form="prediction" is no framer here: rho(|G||J1|) = {gains.rho:.4g}, and boxes are certain '
        "only below 1 (docs/theory.md, section 2.3). "
    )
    if np.linalg.matrix_rank(H) < system.p:
        said += (
            f"H has rank {np.linalg.matrix_rank(H)} with {system.p} unknown inputs: then every left inverse has "
            'rho >= 1, and y[k] is needed for the box of x[k]. Use form="current"'
        )
    else:
        said += 'H has full column rank: left_inverse="feedthrough" has rho = 0'
    return said + "; allow_uncertified=True runs the recursion as printed and marks crossed steps."


def _certificate(
    system: System,
    noise: Noise,
    gains: FramerGains,
    region: Interval,
    u_region: Interval,
    bounds: tuple[str, ...],
    given: Interval | None,
) -> Certificate:
    """Width recursion of the prediction form, from (eq:framerx) with the elementwise width gains of P11.

    ``(I - |G||J1|) width_k <= (I + |G||J1|)(W_f width + dw) + |G||J2| (W_g width + dv)`` where [W_f; W_g] bounds how
    much wider than the box the bounds of f and g are. That is known for the mean-value and the decomposition forms;
    other methods in use can only make the boxes smaller.
    """
    n = system.n
    enclosure = inclusion.jacobian(system.maps)(region, u_region)
    derivative = Interval.unchecked(np.asarray(enclosure.lower), np.asarray(enclosure.upper))
    if "mean_value" in bounds:
        gain = np.maximum(np.abs(derivative.lower), np.abs(derivative.upper))
    elif "decomposition" in bounds or "remainder" in bounds:
        gain = np.asarray(width_gain(derivative if given is None else given))
    else:
        gain = np.full(derivative.shape, np.inf)
    G1, G2 = np.abs(system.G) @ np.abs(gains.J1), np.abs(system.G) @ np.abs(gains.J2)
    eye, W_f, W_g = np.eye(n), gain[:n], gain[n:]
    finite = bool(np.isfinite(gain).all())
    growth = (eye + G1) @ W_f + G2 @ W_g if finite else np.full((n, n), np.inf)
    certified = finite and gains.guaranteed and spectral_radius(np.linalg.solve(eye - G1, growth)) < 1
    dw, dv = (np.asarray(box.width, dtype=np.float64) for box in (noise.w, noise.v))
    steady = np.linalg.solve(eye - G1 - growth, (eye + G1) @ dw + G2 @ dv) if certified else np.full(n, np.inf)
    before = np.abs(gains.J1) @ W_f + np.abs(gains.J2) @ W_g if finite else np.full((system.p, n), np.inf)
    input_width = np.full(system.p, np.inf)
    if certified:
        input_width = np.abs(gains.J1) @ (steady + dw) + before @ steady + np.abs(gains.J2) @ dv
    stacked = np.vstack([system.G, system.H])
    # Bounds of affine functions hold everywhere: there is no region to leave.
    affine = bool((derivative.lower == derivative.upper).all())
    return Certificate(
        region=Interval.entire(n) if affine else Interval(np.array(region.lower), np.array(region.upper)),
        region_matters=not affine and bool(np.isfinite(np.concatenate([region.lower, region.upper])).any()),
        growth=growth,
        implicit=G1,
        noise_w=eye + G1,
        noise_v=G2,
        noise_fixed=np.zeros(n),
        input_state_now=np.abs(gains.J1),
        input_state_before=before,
        input_noise_v=np.abs(gains.J2),
        input_fixed=np.zeros(system.p),
        steady_width=steady,
        input_width=input_width,
        equality_residual=np.abs(gains.J @ stacked - np.eye(system.p)).max(initial=0.0),
        promised=certified,
        recoverable=None,
        notes=(f"prediction form, rho(|G||J1|) = {gains.rho:.4g}",),
        framer=gains.guaranteed,
    )
