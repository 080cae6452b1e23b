"""Random functions of three variables, put together from the table: nothing may leave its bounds, anywhere."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from inclusion_points import points
from oracles.uncompiled_bounds import at_points

from gsisio_jax import inclusion
from gsisio_jax.interval import Interval

# Smooth on all of R, and growing slowly enough that three of them in a row stay finite on the boxes below.
SMOOTH = {
    "sin": jnp.sin,
    "cos": jnp.cos,
    "tanh": jnp.tanh,
    "atan": jnp.arctan,
    "asinh": jnp.arcsinh,
    "logistic": jax.nn.sigmoid,
    "erf": jax.lax.erf,
    "softplus": jax.nn.softplus,
    "bell": lambda t: jnp.exp(-t * t),
    "root": lambda t: jnp.sqrt(1 + t * t),
    "fraction": lambda t: 1 / (2 + jnp.cos(t)),
    "logarithm": lambda t: jnp.log(1.5 + jnp.sin(t)),
    "cube": lambda t: 0.1 * t**3,
    "square": jnp.square,
    "half": lambda t: -0.5 * t + 0.3,
    "reverse": lambda t: t[::-1],
    "cumsum": jnp.cumsum,
    "mix": lambda t: jnp.array([[0.5, -0.2, 0.1], [0.0, 0.3, -0.4], [0.7, 0.0, 0.2]]) @ t,
    "norm": lambda t: t / jnp.sqrt(1 + t @ t),
}
KINKED = {
    "abs": jnp.abs,
    "relu": jax.nn.relu,
    "clip": lambda t: jnp.clip(t, -0.4, 0.7),
    "highest": lambda t: t - jnp.max(t),
    "lowest": lambda t: jnp.minimum(t, jnp.roll(t, 1)),
}
JUMPING = {
    "sign": jnp.sign,
    "floor": jnp.floor,
    "ceil": jnp.ceil,
    "round": jnp.round,
    "mod": lambda t: jnp.mod(t, 0.7),
    "fmod": lambda t: jnp.fmod(t, 0.7),
    "where": lambda t: jnp.where(t < 0.2, t + 2, -t - 1),
    "both": lambda t: jnp.where((t > -0.5) & (jnp.roll(t, 1) > 0), t * t, -t),
    "angle": lambda t: jnp.arctan2(t, jnp.roll(t, 1)),
}
PAIRS = {
    "add": jnp.add,
    "sub": jnp.subtract,
    "mul": jnp.multiply,
    "max": jnp.maximum,
    "quotient": lambda a, b: a / (1 + b * b),
    "angle": lambda a, b: jnp.arctan2(a, 1 + b * b),
    "softmax": jnp.logaddexp,
}


def build(names, pairs):
    """A chain: apply a function of one argument, then combine the result with the value of one step before."""
    table = SMOOTH | KINKED | JUMPING

    def f(x):
        before, now = x, x
        for name, pair in zip(names, pairs, strict=True):
            before, now = now, PAIRS[pair](table[name](now), before) if pair else table[name](now)
        return now

    return f


def programs(names):
    step = st.tuples(st.sampled_from(sorted(names)), st.sampled_from([None, *PAIRS]))
    return st.lists(step, min_size=1, max_size=3)


boxes = st.lists(st.tuples(st.floats(-2, 2), st.sampled_from([0.0, 1e-9, 0.05, 0.5, 1.0, 3.0])), min_size=3, max_size=3)


def to_box(sides):
    lower = np.array([a for a, _ in sides])
    return Interval(lower, lower + np.array([w for _, w in sides]))


def ulps(*arrays):
    """Room for rounding: bounds are exact in real arithmetic only."""
    return 1e-11 * (1 + sum(np.where(np.isfinite(a), np.abs(a), 0) for a in arrays))


def assert_inside(bounds, value, label):
    room = ulps(bounds.lower, bounds.upper)
    assert (bounds.lower - room <= value).all(), label
    assert (value <= bounds.upper + room).all(), label


def assert_legal(*bounds):
    for b in bounds:
        assert (b.lower <= b.upper).all()
        assert (b.lower < np.inf).all()
        assert (b.upper > -np.inf).all()


def check_values(f, box, x):
    value = at_points(f, x)
    natural, form = inclusion.natural(f)(box), inclusion.affine(f)(box)
    assert_legal(natural, form.range, form.offset)
    assert_inside(natural, value, "natural")
    assert_inside(form.range, value, "range")
    assert_inside(form.offset, value - x @ np.asarray(form.slope).T, "offset")
    assert_inside(form.over(box), value, "over")
    assert (form.range.lower >= natural.lower - ulps(natural.lower)).all(), "meeting never loses"
    assert (form.range.upper <= natural.upper + ulps(natural.upper)).all(), "meeting never loses"
    assert (form.offset.width <= natural.width + ulps(natural.lower, natural.upper)).all(), "never worse than slope 0"


def check_slopes(f, box, x, smooth):
    jac = inclusion.jacobian(f)(box)
    assert_legal(jac)
    if smooth:
        assert_inside(jac, at_points(jax.jacfwd(f), x), "derivative")
    assert_inside(inclusion.mean_value(f)(box), at_points(f, x), "mean value")
    # Difference quotients, which know nothing of JAX's derivative conventions at kinks and jumps.
    value = at_points(f, x)
    step, change = (x - np.roll(x, 7, axis=0))[:, None, :], value - np.roll(value, 7, axis=0)
    with np.errstate(invalid="ignore"):
        ends = [np.where(step == 0, 0, np.asarray(side) * step) for side in (jac.lower, jac.upper)]
    low, high = np.minimum(*ends).sum(-1), np.maximum(*ends).sum(-1)
    room = 1e-11 * (1 + np.abs(change)) + 1e-11 * np.abs(value)
    assert (low - room <= change).all(), "difference"
    assert (change <= high + room).all(), "difference"


@settings(max_examples=20, deadline=None)
@given(programs(SMOOTH), boxes)
def test_smooth_functions(program, sides):
    f, box = build(*zip(*program, strict=True)), to_box(sides)
    x = points(box.lower, box.upper)
    check_values(f, box, x)
    check_slopes(f, box, x, smooth="max" not in [pair for _, pair in program])


@settings(max_examples=20, deadline=None)
@given(programs(SMOOTH | KINKED | JUMPING), boxes)
@example([("abs", "add"), ("clip", None)], [(-0.5, 1.0)] * 3)  # hinges that end in a call
@example([("clip", "max"), ("norm", None)], [(0.0, 1.0)] * 3)  # hinges under a known expression
def test_functions_with_kinks_and_jumps(program, sides):
    f, box = build(*zip(*program, strict=True)), to_box(sides)
    x = points(box.lower, box.upper)
    value = at_points(f, x)
    with np.errstate(invalid="ignore"):
        # At a jump, rounding in f itself may take the other side: look only where f does not move with x.
        steady = (np.abs(at_points(f, x * (1 + 1e-12) + 1e-13) - value) < 1e-6).all(1)
        steady &= (np.abs(at_points(f, x * (1 - 1e-12) - 1e-13) - value) < 1e-6).all(1)
    if steady.sum() > 8:
        x = x[np.resize(np.flatnonzero(steady), len(x))]
        check_values(f, box, x)
        check_slopes(f, box, x, smooth=False)


@settings(max_examples=10, deadline=None)
@given(programs(SMOOTH | KINKED | JUMPING), st.tuples(*[st.sampled_from(["R", "up", "down", "no"])] * 3))
def test_infinite_boxes(program, kinds):
    f = build(*zip(*program, strict=True))
    sides = {"R": (-np.inf, np.inf), "up": (-0.5, np.inf), "down": (-np.inf, 0.5), "no": (-1.0, 1.0)}
    lower, upper = np.array([sides[kind] for kind in kinds]).T
    box = Interval(lower, upper)
    form, jac = inclusion.affine(f)(box), inclusion.jacobian(f)(box)
    assert_legal(inclusion.natural(f)(box), form.range, form.offset, form.over(box), jac, inclusion.mean_value(f)(box))
    assert np.isfinite(form.slope).all()
    x = points(lower, upper)
    x = x[np.abs(x).max(1) < 50]
    if len(x):
        value = at_points(f, x)
        assert_inside(inclusion.natural(f)(box), value, "natural")
        assert_inside(form.range, value, "range")
        rest = value - x @ np.asarray(form.slope).T
        room = ulps(value) + 1e-11 * (np.abs(x) @ np.abs(np.asarray(form.slope)).T)
        assert (form.offset.lower - room <= rest).all()
        assert (rest <= form.offset.upper + room).all()


@pytest.mark.parametrize("name", [*SMOOTH, *KINKED])
def test_bounds_shrink_with_the_box(name):
    """Widths go to 0 with the box; the rest of the affine form faster than the range, for smooth functions."""
    f = (SMOOTH | KINKED)[name]
    center = np.array([0.31, -0.77, 1.13])
    widths = []
    for radius in (1e-1, 1e-3):
        box = Interval(center - radius, center + radius)
        form = inclusion.affine(f)(box)
        widths.append([inclusion.natural(f)(box).width.max(), form.offset.width.max(), form.range.width.max()])
    (wide, rest, meet), (wide_small, rest_small, meet_small) = widths
    assert wide_small < 0.02 * wide
    assert meet <= wide
    assert meet_small <= wide_small
    assert rest_small <= 2e-4 * max(rest, 1e-9) + 1e-12 if name in SMOOTH else rest_small <= 0.02 * rest + 1e-12
