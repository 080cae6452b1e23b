"""The cheapest noise bounds that certify a required width, with the gain re-optimised.

For one gain N the steady width is linear in the noise bounds, and it bounds the width of the best gain from above. So
every gain gives a convex program (convex cost in the logarithms of the bounds, posynomial constraints) whose solution
is allowed, and solving gains and bounds in turn never raises the cost. The problem as a whole is not convex, a minimum
over gains of such programs, so this is done from several starts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax._extras import need
from gsisio_jax._room import with_room
from gsisio_jax.design.assemble import Plan
from gsisio_jax.design.build import design_observer
from gsisio_jax.design.existence import check_existence, check_rank
from gsisio_jax.design.feedthrough import factorise
from gsisio_jax.design.gain_selection import main_gain, units
from gsisio_jax.design.gains import optimal_gain
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.errors import NoDesignFound
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import check_type, read_array
from gsisio_jax.observer.enclosures import slopes_of
from gsisio_jax.observer.types import Observer
from gsisio_jax.plant.system import Noise, System

_MARGIN = 1e-7  # share of the required width that is left to the solvers
_ROUNDS = 30
_MOST_DESIGNS = 3  # searches for what a fresh design promises
_NEAR = 0.06  # share by which that may be wider than what was searched for


@dataclass(frozen=True)
class Allocation:
    """The cheapest noise bounds found, and the observer designed for them afresh.

    Attributes:
        noise: the bounds.
        cost: their price; `start_cost` that of the bounds given, whatever these certify.
        observer: from `design_observer` for `noise`; its certificate keeps the requirement.
        width: (n,) its steady widths; required: (n,) the requirement.
        history: cost after every round from the start that won.
    """

    noise: Noise
    cost: float
    start_cost: float
    observer: Observer
    width: np.ndarray
    required: np.ndarray
    history: np.ndarray

    def __str__(self) -> str:
        lines = [f"Cheapest noise bounds found: cost {self.cost:.6g} (start {self.start_cost:.6g})"]
        lines.append(f"  {'bound':<8}{'lower':>14}{'upper':>14}")
        for letter, box in (("w", self.noise.w), ("v", self.noise.v)):
            for i, (low, high) in enumerate(zip(box.lower, box.upper, strict=True)):
                lines.append(f"  {letter + str(i + 1):<8}{low:>14.6g}{high:>14.6g}")
        lines.append(f"  {'state':<8}{'steady width':>14}{'required':>14}")
        for i, (width, wanted) in enumerate(zip(self.width, self.required, strict=True)):
            lines.append(f"  {'x' + str(i + 1):<8}{width:>14.6g}{wanted:>14.6g}")
        return "\n".join(
            [*lines, "  designed afresh for these bounds; the best of several starts, not a proven minimum"]
        )


@with_room
@named_arguments
def allocate(
    system: System,
    noise: Noise,
    region: Interval,
    required: Any,
    price: Mapping[str, Any] | Callable[[Noise], Any],
    *,
    limits: tuple[float, float] = (1e-3, 1e3),
    u_region: Interval | None = None,
    **design: Any,
) -> Allocation:
    """The cheapest noise bounds whose certificate keeps every state within a required width.

    Args:
        system: the plant.
        noise: bounds to start from; those that are bought are scaled, the others stay.
        region: as in `design_observer`, a box.
        required: (n,) widths in units of the states, ``inf`` where nothing is required.
        price: of a unit of precision, 2 / width of a bound: ``{"v": (l,), "w": (n,)}``; bounds of price 0, or left
            out, are not for sale. Or a JAX function of `Noise`, decreasing in every width; then all bounds of v are for
            sale.
        limits: least and largest factor on a bound.
        u_region: as in `design_observer`.
        **design: for the fresh design, as in `design_observer`.

    Returns:
        `Allocation`.

    Raises:
        ValueError: even the smallest bounds do not certify the required width, or an argument does not fit.
        NoDesignFound: no gain contracts, whatever the noise.

    Source: theory 4 and 6.
    """
    check_type("allocate", "system", system, System)
    check_type("allocate", "noise", noise, Noise, "gx.Noise(w, v)")
    if not isinstance(region, Interval) or region.shape != (system.n,):
        raise ValueError(f"allocate: `region` must be an Interval of shape ({system.n},), got {region!r}")
    required = np.asarray(read_array("allocate", "required", required), float)
    if required.shape != (system.n,) or not (required > 0).all() or not np.isfinite(required).any():
        raise ValueError(
            f"allocate: `required` must hold {system.n} positive widths, inf where none is required, got {required}"
        )
    if design.get("tolerate"):
        raise ValueError(
            f"allocate: `tolerate` must be 0, got {design['tolerate']!r}: no width is promised while outputs may be "
            "wrong; buy bounds without it, and design with it afterwards"
        )
    market = _Market(system, noise, region, required, price, limits, u_region)
    best, history = market.search()
    for _ in range(_MOST_DESIGNS):
        found = market.noise(best)
        observer = design_observer(system, found, region, u_region=u_region, **design)
        width = np.asarray(observer.certificate.steady_width)
        if (width <= market.limit).all() or not (width <= market.limit * (1 + _NEAR)).all():
            break
        # The promise counts how outputs are solved for the state (theory 5.6), which the search does not.
        market.limit = market.limit * np.minimum(market.limit / width, 1.0) * (1 - 1e-6)
        best, history = market.search()
    if not ((width <= required).all() and observer.certificate.self_consistent):
        raise ValueError(
            f"allocate: designed afresh, the bounds found give the widths {width} in place of {required}, or widths "
            "that do not fit into the region; give a larger region, or one in better units"
        )
    return Allocation(
        found, market.cost(best), market.cost(np.ones(market.count)), observer, width, required, np.array(history)
    )


class _Market:
    """Gains and prices of one `allocate`."""

    def __init__(self, system: System, noise: Noise, region: Interval, required: Any, price: Any, limits: Any, u: Any):
        self.base, self.region, self.required, self.limits = noise, region, required, limits
        boxes = noise.w, noise.v
        self.width = np.concatenate([np.asarray(box.width, float) for box in boxes])
        self.n, l = system.n, system.l
        self.function: Callable[[Noise], Any] | None = None
        prices = np.zeros(self.n + l)
        if isinstance(price, Mapping):
            for name, part, size in (("w", slice(0, self.n), self.n), ("v", slice(self.n, None), l)):
                value = np.asarray(price.get(name, np.zeros(size)), float)
                if value.shape != (size,) or not (np.isfinite(value) & (value >= 0)).all() or set(price) - {"w", "v"}:
                    raise ValueError(
                        f'allocate: `price` takes "w" of shape ({self.n},) and "v" of shape ({l},), finite and not '
                        f"negative; got {dict(price)!r}"
                    )
                prices[part] = value
            sale = prices > 0
        else:
            self.function = price
            sale = np.arange(self.n + l) >= self.n
        self.index = np.flatnonzero(sale & (self.width > 0))
        self.count = len(self.index)
        if not self.count:
            raise ValueError("allocate: nothing is for sale; give a positive price to a bound that is not zero wide")
        self.prices = prices[self.index]
        if not 0 < limits[0] < limits[1]:
            raise ValueError(f"allocate: `limits` must be two increasing positive factors, got {limits}")
        feedthrough = factorise(np.asarray(system.H))
        u_region = Interval(np.zeros(system.m), np.zeros(system.m)) if u is None else u
        if system.takes_u and u is None:
            raise ValueError("allocate: f or g takes u; give `u_region`, the box of known inputs")
        slopes_on = slopes_of(system, feedthrough.T2, u_region)
        check_existence(system, feedthrough, slopes_on(system.state_bounds))
        slopes = slopes_on(region)
        if not slopes.finite:
            raise NoDesignFound(f"allocate: the derivatives of f or g are not bounded on the region {region}")
        # Where slopes vary, the certificate also asks that the boxes fit into the region.
        self.limit = required if slopes.affine else np.minimum(required, np.asarray(region.width))
        self.problem = Plan(system, noise, feedthrough, u_region).problem(slopes)
        check_rank(self.problem)

    def noise(self, factors: Any) -> Noise:
        """Bounds for factors (count,) on those that are for sale, scaled around the point nearest to 0."""
        spread = np.zeros((len(self.width), self.count))
        spread[self.index, np.arange(self.count)] = 1
        scale = (spread.sum(axis=1) == 0) + spread @ factors
        boxes = []
        for box, part in ((self.base.w, scale[: self.n]), (self.base.v, scale[self.n :])):
            lower, upper = np.asarray(box.lower, float), np.asarray(box.upper, float)
            anchor = np.clip(0.0, lower, upper)
            boxes.append(Interval.unchecked(anchor - part * (anchor - lower), anchor + part * (upper - anchor)))
        return Noise.unchecked(*boxes)

    def cost(self, factors: np.ndarray) -> float:
        if self.function is not None:
            return float(np.asarray(self.function(self.noise(factors))))
        return float((self.prices * 2 / (self.width[self.index] * factors)).sum())

    def cost_gradient(self, factors: np.ndarray) -> tuple[float, np.ndarray]:
        function = self.function
        if function is not None:
            price = jax.value_and_grad(lambda at: jax.numpy.asarray(function(self.noise(at))))
            value, slope = price(jax.numpy.asarray(factors))
            return float(value), np.asarray(slope, float)
        each = self.prices * 2 / (self.width[self.index] * factors)
        return float(each.sum()), -each / factors

    def at(self, factors: np.ndarray) -> GainProblem:
        width = self.width.copy()
        width[self.index] *= factors
        return replace(self.problem, dw=width[: self.n], dv=width[self.n :])

    def linear(self, factors: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """For the best gain at these factors: slope (n, count) and constant (n,) of the width of ALL factors."""
        problem = self.at(factors)
        N = main_gain(problem, self.region)
        if not np.isfinite(problem.steady_width(N)).all():
            return None
        inverse = np.maximum(np.linalg.inv(np.eye(self.n) - problem.growth(N) - problem.implicit(N)), 0)
        constant = problem.steady_width(N)
        unit = np.zeros_like(self.width)
        slope = np.zeros((self.n, self.count))
        for j, i in enumerate(self.index):
            unit[:] = 0
            unit[i] = self.width[i]
            alone = replace(problem, dw=unit[: self.n], dv=unit[self.n :], ds=0 * problem.ds, dd=0 * problem.dd)
            slope[:, j] = inverse @ alone.noise_width(N)
        return slope, constant - slope @ factors

    def allowed(self, factors: np.ndarray) -> bool:
        """Does the best gain keep the limit? One linear program, not polished."""
        problem = self.at(factors)
        N = optimal_gain(problem, np.ones(self.n), self.scale)
        return N is not None and bool((problem.steady_width(N) <= self.limit).all())

    def search(self) -> tuple[np.ndarray, list[float]]:
        low = np.full(self.count, self.limits[0])
        first = self.linear(low)
        if first is None:
            raise NoDesignFound("allocate: no gain contracts on this region, whatever the noise")
        least = first[0] @ low + first[1]
        if not (least <= self.limit * (1 - _MARGIN)).all():
            raise ValueError(
                f"allocate: the required widths {self.limit} (at most those of the region, where the certificate has "
                f"one) cannot be certified: even {self.limits[0]:g} times the bounds for sale give {least}. Improve "
                "the other bounds too, or ask for less."
            )
        self.scale = units(least)
        best: tuple[float, np.ndarray, list[float]] | None = None
        for tilt in self.tilts():
            factors = self._ray(tilt)
            history = [self.cost(factors)]
            for _ in range(_ROUNDS):
                model = self.linear(factors)
                if model is None:
                    break
                factors = self._buy(model, self.limit * (1 - _MARGIN), factors)
                history.append(self.cost(factors))
                if history[-1] >= history[-2] * (1 - 1e-7):
                    break
            if best is None or history[-1] < best[0]:
                best = history[-1], factors, history
        assert best is not None
        return best[1], best[2]

    def tilts(self) -> list[np.ndarray]:
        """Proportions of the factors to start from: every gain has its own cheapest bounds, so they are spread wide."""
        rows = [np.zeros(self.count)]
        if self.count > 1:
            rows += [share * unit for unit in np.eye(self.count) for share in (-1.5, -0.5, 0.5, 1.5)]
            if self.count > 2:
                rows += list(np.random.default_rng(0).normal(size=(4 * self.count, self.count)))
        return [10.0**row for row in rows]

    def _ray(self, tilt: np.ndarray) -> np.ndarray:
        """The largest allowed factors in the proportions of `tilt`, by bisection in the logarithm: widths only grow."""
        low, high = np.log(self.limits[0] / tilt.max()), np.log(self.limits[1] / tilt.min())

        def at(size: float) -> np.ndarray:
            return np.clip(np.exp(size) * tilt, *self.limits)

        if self.allowed(at(high)):
            return at(high)
        for _ in range(9):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.allowed(at(middle)) else (low, middle)
        return at(low)

    def _buy(self, model: tuple[np.ndarray, np.ndarray], limit: np.ndarray, start: np.ndarray) -> np.ndarray:
        """The cheapest factors for one gain, in their logarithms; never dearer than the start, never forbidden."""
        optimize = need("scipy.optimize", extra="tune", purpose="allocating noise bounds")
        slope, constant = model
        rows = np.isfinite(limit)
        slope, left = slope[rows], (limit - constant)[rows]
        unit = abs(self.cost(start)) or 1.0

        def price(z: np.ndarray) -> tuple[float, np.ndarray]:
            value, derivative = self.cost_gradient(np.exp(z))
            return value / unit, derivative * np.exp(z) / unit

        rule = {
            "type": "ineq",
            "fun": lambda z: 1 - slope @ np.exp(z) / left,
            "jac": lambda z: -slope * np.exp(z) / left[:, None],
        }
        found = optimize.minimize(
            price, np.log(start), jac=True, method="SLSQP", bounds=[tuple(np.log(self.limits))] * self.count,
            constraints=[rule], options={"maxiter": 200, "ftol": 1e-12},
        )  # fmt: skip
        factors = np.clip(np.exp(found.x), *self.limits)
        # A solver ends within a tolerance of the constraints: step back to where they hold.
        use = slope @ factors / left
        if use.max() > 1:
            factors = np.clip(factors / use.max(), *self.limits)
        allowed = np.isfinite(factors).all() and (slope @ factors <= left * (1 + 1e-12)).all()
        return factors if allowed and self.cost(factors) < self.cost(start) else start
