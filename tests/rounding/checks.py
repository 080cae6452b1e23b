"""How many values of a function, or of its derivatives, lie outside of the bounds that the package gives on a box.

A miss is a miss by any amount at all: crival's intervals decide where they are tight enough, balls where not."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import ival
import jax
import jax.numpy as jnp
import numpy as np
from flint import arb, ctx
from oracles.real_all import FUNCTIONS
from sampling import boxes, points

from gsisio_jax import Interval, inclusion
from gsisio_jax.interval.rounding import Rounding

MOST_BALLS = 1000  # numbers of one kind and batch that are decided by balls


@dataclass
class Tally:
    """What was looked at.

    Attributes:
        points: (function, box, point) with its value in bounds from below and above, for every way to bound a value.
        checks: comparisons of a number with a pair of bounds, those of offsets and derivatives included.
        misses: how many of these failed.
        balls: how many were decided by balls.
        skipped: how many were not decided, because there were too many for the balls; not among `checks`.
        closest: for every function, how near a true value comes to a bound, in eps of the value (0: it is the bound).
        examples: some misses.
    """

    points: int = 0
    checks: int = 0
    misses: int = 0
    balls: int = 0
    skipped: int = 0
    closest: dict[str, float] = field(default_factory=dict)
    examples: list[Any] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        for name in ("points", "checks", "misses", "balls", "skipped"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name, room in other.closest.items():
            self.closest[name] = min(room, self.closest.get(name, np.inf))
        self.examples = (self.examples + other.examples)[:20]


@lru_cache(maxsize=512)
def bounds_of(name: str, rounding: Rounding, jit: bool, batched: bool = True) -> Any:
    """Range, affine range, slope, offset and derivatives on a batch of boxes (or on one)."""
    fn = FUNCTIONS[name].fn

    def call(lower: Any, upper: Any) -> Any:
        box = Interval.unchecked(lower, upper)
        form = inclusion.affine(fn, rounding)(box)
        return inclusion.natural(fn, rounding)(box), form.range, form.slope, form.offset, _jacobian(fn, rounding, box)

    batch = jax.vmap(call) if batched else call
    return jax.jit(batch) if jit else batch


def _jacobian(fn: Any, rounding: Rounding, box: Interval) -> Interval:
    return inclusion.jacobian(fn, rounding)(box)


def check(
    name: str, seed: int, many: int, each: int, dtype: Any, rounding: Rounding = "outward", jit: bool = True
) -> Tally:
    """One function on `many` random boxes with `each` points; bounds from one compiled (or eager) batch."""
    real, rng = FUNCTIONS[name], np.random.default_rng([seed, sum(map(ord, name))])
    lower, upper = boxes(rng, many, dtype, real)
    found = jax.tree.map(np.asarray, bounds_of(name, rounding, jit)(jnp.asarray(lower), jnp.asarray(upper)))
    return compare(name, lower, upper, found, points(rng, lower, upper, each, real))


FORMS = ("mean_value", "decomposition", "remainder", "tight")


@lru_cache(maxsize=64)
def forms_of(name: str, rounding: Rounding) -> Any:
    """The bounds that are made of others, on a batch of boxes."""
    fn = FUNCTIONS[name].fn
    forms = [getattr(inclusion, form)(fn, rounding=rounding) for form in FORMS]

    def call(lower: Any, upper: Any) -> Any:
        found = [form(Interval.unchecked(lower, upper)) for form in forms]
        return [(box.lower, box.upper) for box in found]

    return jax.jit(jax.vmap(call))


def check_forms(name: str, seed: int, many: int, each: int, dtype: Any, rounding: Rounding = "outward") -> Tally:
    """As `check`, for the values alone: mean-value form, decompositions, remainder form."""
    real, rng, tally = FUNCTIONS[name], np.random.default_rng([seed, sum(map(ord, name)), 1]), Tally()
    lower, upper = boxes(rng, many, dtype, real)
    found = jax.tree.map(np.asarray, forms_of(name, rounding)(jnp.asarray(lower), jnp.asarray(upper)))
    t = points(rng, lower, upper, each, real)
    args = [ival.Interval(t[..., i].astype(np.float64)) for i in range(t.shape[-1])]
    inside, value = (t[..., 0] >= real.domain[0]) & (t[..., 0] <= real.domain[1]), real.value(*args)

    def ball(i: int, j: int) -> Any:
        return real.ball(*(arb(float(v)) for v in t[i, j]))

    for form, box in zip(FORMS, found, strict=True):
        _judge(tally, name, form, Interval.unchecked(*box), value, inside, ball, (lower, upper, t))
        tally.points += int((inside & ~np.isnan(value.lo)).sum())
    return tally


def compare(name: str, lower: np.ndarray, upper: np.ndarray, bounds: Any, t: np.ndarray) -> Tally:
    """Points t (boxes, each, n) of the boxes (boxes, n) against the bounds there."""
    natural, met, slope, offset, jac = bounds
    assert natural.lower.dtype == lower.dtype, f"{name}: promoted to {natural.lower.dtype}"
    assert np.isfinite(slope).all(), f"{name}: slope"
    real, tally = FUNCTIONS[name], Tally()
    (_, each, n), args = t.shape, [ival.Interval(t[..., i].astype(np.float64)) for i in range(t.shape[-1])]
    inside = (t[..., 0] >= real.domain[0]) & (t[..., 0] <= real.domain[1])
    strictly = (t[..., 0] > real.domain[0]) & (t[..., 0] < real.domain[1])
    value = real.value(*args)
    slopes = [ival.Interval(np.repeat(slope[:, i, None].astype(np.float64), each, 1)) for i in range(n)]
    if real.linear is None:
        rest = value - sum((s * arg for s, arg in zip(slopes[1:], args[1:], strict=True)), slopes[0] * args[0])
    else:
        parts = [(c - s) * arg for c, s, arg in zip(real.linear, slopes, args, strict=True)]
        rest = sum(parts[1:], parts[0])

    def ball(i: int, j: int) -> Any:
        return real.ball(*(arb(float(v)) for v in t[i, j]))

    def ball_rest(i: int, j: int) -> Any:
        return ball(i, j) - sum(arb(float(s)) * arb(float(v)) for s, v in zip(slope[i], t[i, j], strict=True))

    quantities: list[Any] = [
        ("natural", natural, value, inside, ball),
        ("affine", met, value, inside, ball),
        ("offset", offset, rest, inside, ball_rest),
    ]
    for k, (partial, other) in enumerate(zip(real.partials, real.ball_partials, strict=True)):
        quantities.append(
            (
                f"derivative {k}",
                Interval.unchecked(jac.lower[:, k], jac.upper[:, k]),
                partial(*args),
                strictly,
                lambda i, j, other=other: other(*(arb(float(v)) for v in t[i, j])),
            )
        )
    for what, box, truth, where, exact in quantities:
        checks, good, low, high = _judge(tally, name, what, box, truth, where, exact, (lower, upper, t))
        tally.points += checks if what == "natural" else 0
        if what == "affine":
            tally.closest[name] = _room(truth, low, high, good, np.finfo(lower.dtype))
    return tally


def _judge(
    tally: Tally, name: str, what: str, box: Interval, truth: Any, where: Any, exact: Any, given: tuple[Any, Any, Any]
) -> tuple[int, Any, Any, Any]:
    """True values (boxes, each) against one pair of bounds for every box; counted in `tally`."""
    lower, upper, t = given
    # Not a number, or crossed: all that lies there is missed.
    broken = (np.isnan(box.lower) | np.isnan(box.upper) | (box.lower > box.upper))[:, None]
    low, high = (np.broadcast_to(v[:, None].astype(np.float64), truth.lo.shape) for v in (box.lower, box.upper))
    seen = where & ~np.isnan(truth.lo)
    good = seen & ~broken & (low <= truth.lo) & (truth.hi <= high)
    bad = seen & (broken | (truth.hi < low) | (truth.lo > high))
    for count, (i, j) in enumerate(np.argwhere(seen & ~good & ~bad)):
        if count >= MOST_BALLS:
            break
        verdict = _by_ball(exact, i, j, low[i, j], high[i, j])
        good[i, j], bad[i, j] = verdict is True, verdict is False
        tally.balls += 1
    checks = int(good.sum()) + int(bad.sum())
    unseen = int((broken[:, 0] & ~seen.any(1)).sum())
    tally.checks, tally.misses = tally.checks + checks + unseen, tally.misses + int(bad.sum()) + unseen
    tally.skipped += int(seen.sum()) - checks
    for i, j in np.argwhere(bad)[:3]:
        ends = (lower[i].tolist(), upper[i].tolist(), t[i, j].tolist())
        tally.examples.append((name, what, *ends, float(truth.lo[i, j]), float(low[i, j]), float(high[i, j])))
    return checks, good, low, high


def _by_ball(exact: Any, i: int, j: int, low: float, high: float) -> bool | None:
    """Does the true number lie in [low, high]? None where it cannot be told, as where it has no value."""
    before = ctx.prec
    try:
        for precision in (128, 512, 2400):
            ctx.prec = precision
            truth = exact(i, j)
            if not truth.is_finite():
                continue
            if truth >= arb(low) and truth <= arb(high):
                return True
            if truth < arb(low) or truth > arb(high):
                return False
    finally:
        ctx.prec = before
    return None


def _room(truth: Any, low: Any, high: Any, good: Any, info: Any) -> float:
    """Smallest distance of a true value (not 0, not subnormal) from its bounds, in eps of the value."""
    size = np.minimum(np.abs(truth.lo), np.abs(truth.hi))
    with np.errstate(all="ignore"):
        usable = good & (size > 1e8 * float(info.tiny)) & (np.abs(truth.hi) < float(info.max) / 2)
        usable &= (truth.hi - truth.lo) < 2.3e-16 * size
        room = np.minimum(truth.lo - low, high - truth.hi) / (size * float(info.eps))
    return float(np.min(room, where=usable, initial=np.inf))
