"""Boxes of every kind, points in them, and how many of the points a bound misses. A miss is a miss by any amount that
the oracle can tell, a hundredth of an ulp."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from oracles.real_functions import BALLS, FUNCTIONS, LONG, ROOM, Real

from gsisio_jax import Interval, inclusion
from gsisio_jax.rounding import Rounding

KINDS = ("usual", "thin", "point", "huge", "tiny", "subnormal", "half infinite", "infinite", "across", "far ends")


def function(name: str) -> Real:
    return FUNCTIONS[name] if name in FUNCTIONS else BALLS[name]


def boxes(rng: np.random.Generator, count: int, dtype: Any, real: Real) -> tuple[np.ndarray, np.ndarray]:
    """`count` intervals of all kinds in the domain of a function; lower and upper ends (count,)."""
    info = np.finfo(dtype)
    kind = rng.integers(len(KINDS), size=count)
    far = np.exp2(rng.uniform(1, np.log2(float(info.max)) - 1, (2, count))) * rng.choice([-1, 1], (2, count))
    near = np.exp2(rng.uniform(np.log2(float(info.tiny)), -1, (2, count))) * rng.choice([-1, 1], (2, count))
    below = rng.uniform(-1, 1, (2, count)) * float(info.tiny)
    middle = rng.uniform(-8, 8, count) * np.exp2(rng.integers(-3, 4, count))
    width = np.exp2(rng.uniform(-30, 3, count))
    ends = np.stack([middle - width, middle + width])
    thin = np.stack([middle, middle * (1 + float(info.eps) * rng.integers(-9, 9, count))])
    both = np.stack([np.full(count, -np.inf), np.full(count, np.inf)])
    half = np.where(rng.random(count) < 0.5, [middle, both[1]], [both[0], middle])
    across = np.stack([-width, width * rng.uniform(0, 2, count)])
    mixed = np.where(rng.random(count) < 0.5, [middle, far[0]], [near[0], far[1]])
    found = [ends, thin, [middle, middle], far, near, below, half, both, across, mixed]
    pair = np.select([kind == i for i in range(len(KINDS))], [np.asarray(x) for x in found])
    pair = np.sort(np.clip(pair, *real.domain), axis=0)
    with np.errstate(over="ignore"):
        pair = pair.astype(dtype)
    pair[0] = np.where(pair[0] == np.inf, info.max, pair[0])
    pair[1] = np.where(pair[1] == -np.inf, info.min, pair[1])
    return pair[0], pair[1]


def points(rng: np.random.Generator, lower: Any, upper: Any, count: int, real: Real) -> np.ndarray:
    """Floating numbers of every interval, ends included: (boxes, count)."""
    info = np.finfo(lower.dtype)
    with np.errstate(all="ignore"):
        a, b = (np.clip(x, info.min, info.max)[:, None] for x in (lower, upper))
        share = rng.uniform(0, 1, (len(lower), count)) ** rng.choice([1, 4, 12], (len(lower), count))
        inner = np.where(
            rng.random(share.shape) < 0.5, a + share * (b / 2 - a / 2) * 2, b - share * (b / 2 - a / 2) * 2
        )
        wild = np.exp2(rng.uniform(-30, 30, share.shape)) * rng.choice([-1, 1], share.shape)
        inner = np.where(rng.random(share.shape) < 0.25, wild, inner)
        inner[:, 0], inner[:, 1] = a[:, 0], b[:, 0]
        inner = np.clip(np.nan_to_num(inner), a, b).astype(lower.dtype)
    return np.clip(inner, a, b)


@lru_cache(maxsize=256)
def compiled(name: str, rounding: Rounding, jit: bool) -> Any:
    """Range, form and derivative on a batch of intervals."""
    real = function(name)

    def call(lower: Any, upper: Any) -> Any:
        box = Interval.unchecked(lower[None], upper[None])
        form = inclusion.affine(lambda x: real.fn(x[0]), rounding)(box)
        natural = inclusion.natural(lambda x: real.fn(x[0]), rounding)(box)
        jac = inclusion.jacobian(lambda x: real.fn(x[0]), rounding)(box)
        return natural, form.range, form.slope[0], form.offset, Interval.unchecked(jac.lower[0], jac.upper[0])

    return jax.jit(jax.vmap(call)) if jit else jax.vmap(call)


def count_misses(
    name: str, seed: int, many: int, each: int, dtype: Any, rounding: Rounding = "outward", jit: bool = False
) -> tuple[int, int, list[Any]]:
    """Checks and misses of one function on random intervals, and examples of the latter."""
    rng, real = np.random.default_rng([seed, sum(map(ord, name))]), function(name)
    lower, upper = boxes(rng, many, dtype, real)
    bounds = jax.tree.map(np.asarray, compiled(name, rounding, jit)(jnp.asarray(lower), jnp.asarray(upper)))
    natural, met, slope, offset, jac = bounds
    for box in (natural, met, offset, jac):
        assert box.lower.dtype == dtype, f"{name}: promoted to {box.lower.dtype}"
        assert not np.isnan(box.lower).any(), f"{name}: NaN"
        assert not np.isnan(box.upper).any(), f"{name}: NaN"
        assert (box.lower <= box.upper).all(), f"{name}: crossed"
    t = points(rng, lower, upper, each, real)
    low, high = real.domain
    with np.errstate(all="ignore"):
        wide = t.astype(LONG)
        value, steep = real.value(wide), real.slope(wide)
        usable = (np.abs(wide) <= real.largest) & (wide >= low) & (wide <= high)
        if low > -np.inf or high < np.inf:
            usable &= (wide > low) & (wide < high)
        rest = value - slope[:, None].astype(LONG) * wide
        room = ROOM * (np.abs(value) + np.abs(slope[:, None].astype(LONG) * wide))
        tests = [
            ("natural", natural, value, ROOM * np.abs(value)),
            ("range", met, value, ROOM * np.abs(value)),
            ("offset", offset, rest, room),
            ("derivative", jac, steep, ROOM * np.abs(steep)),
        ]
        checks, misses, examples = 0, 0, []
        for what, box, truth, margin in tests:
            seen = usable & np.isfinite(truth)
            bad = seen & ((truth + margin < box.lower[:, None]) | (truth - margin > box.upper[:, None]))
            checks, misses = checks + int(seen.sum()), misses + int(bad.sum())
            for i, j in np.argwhere(bad)[:3]:
                examples.append((name, what, lower[i], upper[i], t[i, j], truth[i, j], box.lower[i], box.upper[i]))
    return checks, misses, examples
