"""One bad sample, a gap or an unknown start must not end the observer: boxes are finite again as soon as measurements
determine the state at all, and certain."""

from fractions import Fraction
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recovery_plants import DETERMINED, PLANTS, designed, records, steps_until_determined

import gsisio_jax as gx
from gsisio_jax import Interval

FAULT = 10


def finite(box):
    return np.isfinite(np.asarray(box.width)).all(-1)


@pytest.mark.parametrize("name", DETERMINED)
def test_boxes_are_finite_again_as_soon_as_the_state_is_determined(name):
    observer, n = designed(name), len(PLANTS[name][0])
    x, y = records(name, 1)
    faulty, gaps = y.copy(), np.tile(y, (3, 1, 1))
    faulty[:, FAULT, 0] += 100
    elsewhere, jumped = records(name, 2)
    jumped[:, :FAULT] = y[:, :FAULT]
    for lost in (1, 2, 3):
        gaps[lost - 1, FAULT : FAULT + lost] = np.nan
    initial = Interval.symmetric(np.full(n, 2.0))
    boxes = initial, initial, Interval.entire(n), *[initial] * 4
    starts = Interval(*(np.stack([getattr(box, side) for box in boxes]) for side in ("lower", "upper")))
    # One by one: to trace a step for all of them takes longer.
    each = [gx.estimate(observer, starts[i], row) for i, row in enumerate([*y, *faulty, *y, *gaps, *jumped])]
    est = jax.tree.map(lambda *parts: np.stack(parts), *each)
    undisturbed, width = np.asarray(est.state.width)[0], np.asarray(est.state.width)
    N = steps_until_determined(name)
    assert N is not None
    assert observer.certificate.recoverable
    ok, held = finite(est.state), np.asarray(est.state.contains(x[0])).all(-1)
    assert ok[0].all()
    assert np.flatnonzero(ok[2])[0] == N
    assert ok[2, N:].all()
    steps = observer.certificate.rows_until_finite()
    assert max(steps, default=N) == N
    np.testing.assert_array_equal(np.argmax(np.isfinite(width[2]), 0), steps)  # some states are known before others
    # A conflict may show one step late; nothing up to the step where it shows is believed.
    status = np.asarray(est.status)
    shown = np.flatnonzero(status[1] & gx.Status.CONFLICT)
    if shown.size:  # else the input explains the fault
        assert FAULT in (shown[0], shown[0] - 1)
        assert ok[1, shown[-1] + 1 + N :].all()
        assert held[1, shown[-1] + 1 :].all()
    shown = np.flatnonzero(status[6] & gx.Status.CONFLICT)
    if shown.size:  # no row leans on what lies before
        assert FAULT in (shown[0], shown[0] - 1)
        assert shown[-1] <= shown[0] + 1
        assert np.asarray(est.state.contains(elsewhere[0])).all(-1)[6, shown[-1] :].all()
    assert ok[1, -1].all()
    assert held[2:6].all()
    assert (width[1:6, -1] <= 1.05 * undisturbed[-1] + 1e-12).all()
    if N:  # what the certificate says of the first finite box
        first = width[2][steps.astype(int), np.arange(n)]
        assert (first <= np.asarray(observer.certificate.recovery_width) * (1 + 1e-6)).all()
    for lost in (1, 2, 3):
        row = FAULT + lost + observer.certificate.rows_until_finite(lost).astype(int)
        assert (width[2 + lost, row, np.arange(n)] <= observer.certificate.recovered_width(lost) * (1 + 1e-6)).all()
    for lost in (1, 2, 3):  # and no later than the exact program after a gap, see test_recovery_certificate.py
        after = np.isinf(width[2 + lost, FAULT + lost :])
        np.testing.assert_array_equal(
            np.where(after.any(0), len(after) - np.argmax(after[::-1], 0), 0),
            observer.certificate.rows_until_finite(lost=lost),
        )


@pytest.mark.parametrize(
    ("name", "dtype", "lost"),
    [
        ("one output", "float32", 0), ("chain", "float64", 0), ("chain", "float32", 0),
        ("random 1", "float64", 1), ("random 1", "float32", 1),
    ],
)  # fmt: skip
def test_rows_hold_for_inputs_and_states_of_any_size(name, dtype, lost):
    """From R^n, or over a gap, the state far away and the input a million times the noise: what rounding leaves is
    bounded by y and the box before the gap."""
    observer, n, single = designed(name), len(PLANTS[name][0]), dtype == "float32"
    rng = np.random.default_rng(3)
    A, C, G, H, w, v = (np.asarray(part, np.longdouble) for part in PLANTS[name])
    first = lost + 1 if lost else int(max(observer.certificate.recovery_steps))

    def run(side, y, v):
        noise = gx.Noise(observer.noise.w, Interval(-v, v)).astype(dtype)
        return jax.vmap(lambda y: gx.estimate(observer, Interval(-side, side), y, noise=noise).state)(y)

    for size in (1.0, 30.0) if single else (1.0, 1e3, 1e6):
        x, states, seen = size * rng.normal(size=(500, n)).astype(np.longdouble), [], []
        for _ in range(first + 2):  # noise at its vertices
            d = size * rng.normal(size=(500, G.shape[1]))
            states.append(x)
            seen.append(x @ C.T + d @ H.T + v * rng.choice([-1, 1], (500, len(C))))
            x = x @ A.T + d @ G.T + w * rng.choice([-1, 1], (500, n))
        y = np.stack(seen, 1)
        y[:, 1 : lost + 1] = np.nan
        rounded = y.astype(dtype)
        off = np.nanmax(np.abs(rounded - y), (0, 1))  # a measurement is the number that the machine holds
        side = np.full(n, 6 * size if lost else np.inf, dtype)
        box = run(side, rounded, np.asarray(v + off, np.float64) * (1 + 1e-12))
        assert np.isfinite(box.width[:, first:]).all()
        states = np.stack(states, 1)
        # The plant itself is that of the type: its constants are off by half an ulp.
        slack = 40 * size * np.finfo(dtype).eps
        assert ((np.asarray(box.lower) - slack <= states) & (states <= np.asarray(box.upper) + slack)).all()


@pytest.mark.parametrize(
    ("name", "group"), [("chain", -1), ("biased outputs", -1), ("random 3", 0), ("random 3", -1), ("random 4", -1)]
)
def test_what_rows_leave_is_bounded_by_what_is_measured(name, group):
    """A run without noise in fractions, its inputs a billion: the stored row misses the state, by less than its slack
    allows for measurements of that size, and for the box of its oldest step if it leans on that."""
    rows = designed(name).recovery[group]
    A, C, G, H, *_ = (np.vectorize(Fraction, otypes=[object])(part) for part in PLANTS[name])
    exact = np.vectorize(Fraction, otypes=[object])
    rng, N, n, missed = np.random.default_rng(4), rows.length, len(A), []
    for _ in range(20):
        x, seen = exact(rng.normal(size=n)), []
        leans = 0 if rows.anchor is None else exact(rows.anchor).dot(x)
        size = 0.0 if rows.anchor is None else (rows.anchor_scales * np.abs(x.astype(float))).max()
        for _ in range(N + 1):
            d = exact(1e9 * rng.normal(size=G.shape[1]))
            seen.append(C.dot(x) + H.dot(d))
            x, last = A.dot(x) + G.dot(d), x
        outputs = exact(rows.multipliers[:, :, n:])
        found = leans + exact(rows.output).dot(seen[-1]) - sum(outputs[t].dot(seen[N - 1 - t]) for t in range(N))
        left = [abs(found[r] - last[state]) for r, state in enumerate(rows.targets)]
        used = [*rows.scales[:-1][::-1, n:], rows.scales[-1, n:]]
        size = max(size, *(scale * abs(float(value)) for row, y in zip(used, seen, strict=True) for scale, value in
                           zip(row, y, strict=True)))  # fmt: skip
        allowed = rows.slack * size
        missed.append(np.array(left, float) / allowed)
    assert np.max(missed) <= 1
    assert np.max(missed) > 0  # there is something to bound


@pytest.mark.parametrize("faults", [2000, pytest.param(50_000, marks=pytest.mark.soak)])
def test_single_faults(faults):
    """Every miss lies at the fault or under a conflict, and none after it."""
    for name in ("one output", "biased outputs"):
        observer, n = designed(name), len(PLANTS[name][0])
        x, y = records(name, range(faults), 20)
        rng = np.random.default_rng(5)
        at, which = rng.integers(4, 12, faults), rng.integers(y.shape[2], size=faults)
        y[np.arange(faults), at, which] += rng.choice([-1, 1], faults) * rng.uniform(50, 500, faults)
        initial = Interval.symmetric(np.full(n, 2.0))
        est = jax.vmap(partial(gx.estimate, observer, initial))(y)
        missed = ~np.asarray(est.state.contains(x)).all(-1)
        conflict = (np.asarray(est.status) & gx.Status.CONFLICT) != 0
        assert conflict.any(1).all()
        runs, steps = np.nonzero(missed)
        # only at the fault itself, or under a conflict
        assert ((steps == at[runs]) | conflict[runs, steps]).all()
        assert (steps <= at[runs] + 1).all()


def test_start_and_step_keep_what_recovery_needs():
    observer = designed("chain")
    _, y = records("chain", 2, 8)
    y[0, 4, 0] += 100
    est = gx.estimate(observer, Interval.entire(6), y[0])
    carry, out = gx.start(observer, Interval.entire(6), y[0, 0])
    for k in range(1, 8):
        carry, out = gx.step(observer, carry, y[0, k])
        np.testing.assert_array_equal(out.state.lower, est.state.lower[k])
        np.testing.assert_array_equal(out.state.upper, est.state.upper[k])


def test_bounded_nonlinearities_count_as_noise():
    """sin(x) lies in [-1, 1] whatever x is, so affine bounds hold on all of R^n; rows from them are certain."""
    A = np.array([[0.9, 0.3], [-0.3, 0.8]])
    system = gx.System(lambda x: A @ x + 0.1 * jnp.sin(x), lambda x: x[:1], G=np.zeros((2, 0)), H=np.zeros((1, 0)))
    noise = gx.Noise(Interval.symmetric([0.01, 0.01]), Interval.symmetric([0.05]))
    observer = gx.design_observer(system, noise, Interval.symmetric([3.0, 3.0]), certify=False, sweeps=1, window=1)
    rng = np.random.default_rng(0)
    x, states, seen = rng.uniform(-50, 50, (200, 2)), [], []
    for _ in range(6):
        states.append(x)
        seen.append(x[:, :1] + rng.uniform(-0.05, 0.05, (200, 1)))
        x = x @ A.T + 0.1 * np.sin(x) + rng.uniform(-0.01, 0.01, x.shape)
    box = jax.vmap(lambda y: gx.estimate(observer, Interval.entire(2), y).state)(np.stack(seen, 1))
    assert box.contains(np.stack(states, 1)).all()
    assert observer.certificate.recovery_steps == (0, 1)
    assert (np.asarray(box.width[:, 1]) <= np.asarray(observer.certificate.recovery_width) * (1 + 1e-6)).all()
