"""One bad sample, a gap or an unknown start must not end the observer: boxes are finite again as soon as measurements
determine the state at all, and certain."""

from fractions import Fraction
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval

ROWS, FAULT = 30, 10
C_, S_ = 0.95 * np.cos(0.3), 0.95 * np.sin(0.3)


def plant(A, C, G=None, H=None, w=0.02, v=0.1):
    A, C = np.atleast_2d(A).astype(float), np.atleast_2d(C).astype(float)
    n, l = len(A), len(C)
    G = np.zeros((n, 0)) if G is None else np.atleast_2d(G).astype(float)
    H = np.zeros((l, G.shape[1])) if H is None else np.atleast_2d(H).astype(float)
    return A, C, G, H, np.broadcast_to(w, n).astype(float), np.broadcast_to(v, l).astype(float)


def random_plant(seed):
    """n = 2..6, of which an input drives some and biases an output."""
    rng = np.random.default_rng(seed)
    n = 2 + seed % 5
    l, p = max(2, n - 1), 1 + (n > 4)
    A = rng.normal(size=(n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    G, H = rng.normal(size=(n, p)), np.zeros((l, p))
    if p == 2:
        G[:, 1], H[0, 1] = 0, 1
    return plant(A, rng.normal(size=(l, n)), G, H)


CHAIN = np.block(
    [[np.eye(3), 0.2 * np.eye(3)], [0.6 * np.array([[-2, 1, 0], [1, -2, 1], [0, 1, -2.0]]), 0.9 * np.eye(3)]]
)
PLANTS = {
    "one output": plant([[0, -0.5], [1, 1]], [[-2, 1]], w=[0.12, 0.02], v=0.2),
    "rotation": plant([[C_, -S_], [S_, C_]], np.eye(2), v=[0.05, 2.0]),
    "one state seen": plant([[C_, -S_], [S_, C_]], [[1, 0]]),
    "chain": plant(
        CHAIN, np.eye(6)[[0, 1, 2, 4]], np.eye(6)[:, [4]], w=0.01,
    ),
    "biased outputs": plant(
        [[0.8, 0.2, 0], [-0.1, 0.9, 0.3], [0.05, -0.2, 0.7]], np.vstack([np.eye(3), [[1, 1, 0], [0, 1, -1]]]),
        [[0.5, 0, 1], [0, 1, 0], [0, 0, 0.4]], np.vstack([np.eye(3), np.zeros((2, 3))]),
    ),
    **{f"random {seed}": random_plant(seed) for seed in range(5)},
}  # fmt: skip


@cache
def designed(name):
    A, C, G, H, w, v = PLANTS[name]
    system = gx.System(lambda x: A @ x, lambda x: C @ x, G=G, H=H)
    noise = gx.Noise(Interval.symmetric(w), Interval.symmetric(v))
    return gx.design_observer(system, noise, Interval.symmetric(np.full(len(A), 5.0)), certify=False)


def records(name, seeds, rows=ROWS, size=1.0):
    """States (S, T, n) and measurements (S, T, l)."""
    A, C, G, H, w, v = PLANTS[name]
    rng = np.random.default_rng(seeds)
    count = 1 if np.isscalar(seeds) else len(seeds)
    x = rng.uniform(-2, 2, (count, len(A)))
    states, seen = [], []
    for _ in range(rows):
        d = size * rng.normal(size=(count, G.shape[1]))
        states.append(x)
        seen.append(x @ C.T + d @ H.T + rng.uniform(-v, v, (count, len(C))))
        x = x @ A.T + d @ G.T + rng.uniform(-w, w, x.shape)
    return np.stack(states, 1), np.stack(seen, 1)


def steps_until_determined(name):
    """N such that y[0..N] determine x[N] whatever x[0] and the inputs are: no run that is not seen at all moves it."""
    A, C, G, H, *_ = PLANTS[name]
    n, p = G.shape
    # Every state and output as a linear map of x[0] and all inputs.
    for steps in range(n + 1):
        size = n + (steps + 1) * p
        x, rows = np.eye(n, size), []
        for k in range(steps + 1):
            d = np.zeros((p, size))
            d[:, n + k * p : n + (k + 1) * p] = np.eye(p)
            rows.append(C @ x + H @ d)
            x, now = A @ x + G @ d, x
        _, values, rest = np.linalg.svd(np.vstack(rows))
        unseen = rest[int((values > 1e-9).sum()) :]
        if np.abs(now @ unseen.T).max(initial=0.0) < 1e-9:
            return steps
    return None


def finite(box):
    return np.isfinite(np.asarray(box.width)).all(-1)


@pytest.mark.parametrize("name", PLANTS)
def test_boxes_are_finite_again_as_soon_as_the_state_is_determined(name):
    observer, n = designed(name), len(PLANTS[name][0])
    x, y = records(name, 1)
    faulty, lost = y.copy(), y.copy()
    faulty[:, FAULT, 0] += 100
    lost[:, FAULT : FAULT + 3] = np.nan
    initial = Interval.symmetric(np.full(n, 2.0))
    unknown = Interval.entire(n)
    starts = Interval(
        *(np.stack([getattr(b, side) for b in (initial, initial, unknown, initial)]) for side in ("lower", "upper"))
    )
    est = jax.vmap(lambda box, y: gx.estimate(observer, box, y))(starts, np.concatenate([y, faulty, y, lost]))
    undisturbed, width = np.asarray(est.state.width)[0], np.asarray(est.state.width)
    N = steps_until_determined(name)
    assert N is not None
    assert observer.certificate.recoverable
    ok = finite(est.state)
    assert ok[0].all()
    assert np.flatnonzero(ok[2])[0] == N
    assert ok[2, N:].all()
    assert max(observer.certificate.recovery_steps, default=N) == N
    # A conflict may show one step late; nothing up to the step where it shows is believed.
    status = np.asarray(est.status)
    shown = np.flatnonzero(status[1] & gx.Status.CONFLICT)
    if shown.size:  # else the input explains the fault
        assert FAULT in (shown[0], shown[0] - 1)
        assert ok[1, shown[-1] + 1 + N :].all()
    assert ok[1, -1].all()
    assert ok[3, FAULT + 3 + N :].all()
    for run in (2, 3):
        assert est.state.contains(x[0])[run].all()
    assert (width[1:, -1] <= 1.05 * undisturbed[-1] + 1e-12).all()
    if N:  # what the certificate says of the first finite box
        assert (width[2, N] <= np.asarray(observer.certificate.recovery_width) * (1 + 1e-6)).all()


@pytest.mark.parametrize(("name", "dtype"), [("one output", "float32"), ("chain", "float64"), ("chain", "float32")])
def test_rows_hold_for_inputs_and_states_of_any_size(name, dtype):
    """From R^n, the state far away and the input a million times the noise: what rounding leaves is bounded by y."""
    observer, n, single = designed(name), len(PLANTS[name][0]), dtype == "float32"
    rng = np.random.default_rng(3)
    A, C, G, H, w, v = (np.asarray(part, np.longdouble) for part in PLANTS[name])
    unknown = Interval.entire(n).astype(dtype)

    @jax.jit
    def run(y, v):
        noise = gx.Noise(observer.noise.w, Interval(-v, v)).astype(dtype)
        return jax.vmap(lambda y: gx.estimate(observer, unknown, y, noise=noise).state)(y)

    for size in (1.0, 30.0) if single else (1.0, 1e3, 1e6):
        x, states, seen = size * rng.normal(size=(500, n)).astype(np.longdouble), [], []
        for _ in range(observer.recovery.length + 2):  # noise at its vertices
            d = size * rng.normal(size=(500, G.shape[1]))
            states.append(x)
            seen.append(x @ C.T + d @ H.T + v * rng.choice([-1, 1], (500, len(C))))
            x = x @ A.T + d @ G.T + w * rng.choice([-1, 1], (500, n))
        y = np.stack(seen, 1)
        rounded = y.astype(dtype)
        off = np.abs(rounded - y).max((0, 1))  # a measurement is the number that the machine holds
        box = run(rounded, np.asarray(v + off, np.float64) * (1 + 1e-12))
        assert np.isfinite(box.width[:, observer.recovery.length :]).all()
        states = np.stack(states, 1)
        # The plant itself is that of the type: its constants are off by half an ulp.
        slack = 40 * size * np.finfo(dtype).eps
        assert ((np.asarray(box.lower) - slack <= states) & (states <= np.asarray(box.upper) + slack)).all()


@pytest.mark.parametrize("name", ["chain", "biased outputs", "random 3"])
def test_what_rows_leave_is_bounded_by_what_is_measured(name):
    """A run without noise in fractions, its inputs a billion: the stored row misses the state, by less than its slack
    allows for measurements of that size."""
    rows = designed(name).recovery
    A, C, G, H, *_ = (np.vectorize(Fraction, otypes=[object])(part) for part in PLANTS[name])
    exact = np.vectorize(Fraction, otypes=[object])
    rng, N, n, missed = np.random.default_rng(4), rows.length, len(A), []
    for _ in range(20):
        x, seen = exact(rng.normal(size=n)), []
        for _ in range(N + 1):
            d = exact(1e9 * rng.normal(size=G.shape[1]))
            seen.append(C.dot(x) + H.dot(d))
            x, last = A.dot(x) + G.dot(d), x
        outputs = exact(rows.multipliers[:, :, n:])
        found = exact(rows.output).dot(seen[-1]) - sum(outputs[t].dot(seen[N - 1 - t]) for t in range(N))
        left = [abs(found[r] - last[state]) for r, state in enumerate(rows.targets)]
        size = max(rows.scales[n + j] * abs(float(y[j])) for y in seen for j in range(len(C)))
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
    observer = gx.design_observer(system, noise, Interval.symmetric([3.0, 3.0]), certify=False)
    rng = np.random.default_rng(0)
    x, states, seen = rng.uniform(-50, 50, (200, 2)), [], []
    for _ in range(6):
        states.append(x)
        seen.append(x[:, :1] + rng.uniform(-0.05, 0.05, (200, 1)))
        x = x @ A.T + 0.1 * np.sin(x) + rng.uniform(-0.01, 0.01, x.shape)
    box = jax.vmap(lambda y: gx.estimate(observer, Interval.entire(2), y).state)(np.stack(seen, 1))
    assert box.contains(np.stack(states, 1)).all()
    assert observer.certificate.recovery_steps == (1, 1)
    assert (np.asarray(box.width[:, 1]) <= np.asarray(observer.certificate.recovery_width) * (1 + 1e-6)).all()
