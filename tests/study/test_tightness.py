"""Widths over those of the exact hull, against other linear programs and against recursions of intervals."""

from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from oracles.record_hull import exact_hull
from scipy.optimize import brentq

import gsisio_jax as gx
from gsisio_jax import Interval, plot
from gsisio_jax.study import hulls

A = np.array([[0.8, 0.2, 0], [-0.1, 0.9, 0.3], [0.05, -0.2, 0.7]])
C = np.vstack([np.eye(3), [[1, 1, 0], [0, 1, -1]]])
G, H = np.array([[0.5, 0], [0, 1], [0, 0.4]]), np.eye(5, 2)
B, D = np.array([[1.0], [0.5], [0]]), np.array([[0], [0], [0.3], [0], [0]])
OFFSET, SHIFT = np.array([0.1, -0.2, 0.3]), np.array([0, 1.0, 0, -2.0, 0])
W, V, START = np.full(3, 0.02), np.full(5, 0.1), np.full(3, 2.0)
STEPS = 14
FADING = np.linspace(1, 0.5, STEPS)[:, None]  # the noise bounds over time
FAST = {"missing": False, "sweeps": 1, "window": 1}


class Record:
    """A record of an affine plant with known and unknown inputs, constants, lost entries and noise that fades."""

    def __init__(self):
        system = gx.System(lambda x, u: A @ x + OFFSET + jnp.sin(u[0]), lambda x: C @ x + SHIFT, G=G, H=H, B=B, D=D)
        noise = gx.Noise(Interval.symmetric(W), Interval.symmetric(V))
        self.initial = Interval.symmetric(START)
        self.noise = gx.Noise(Interval.symmetric(FADING * W), Interval.symmetric(FADING * V))
        self.observer = gx.design_observer(system, noise, Interval.entire(3), u_region=Interval([-2.0], [2.0]), **FAST)
        rng = np.random.default_rng(4)
        self.u, d = 2 * np.sin(0.7 * np.arange(STEPS))[:, None], rng.normal(size=(STEPS, 2))
        x, free = rng.uniform(-START, START), np.zeros(3)
        states, rest, seen = [], [], []
        for k in range(STEPS):
            states.append(x)
            rest.append(C @ free + D @ self.u[k] + SHIFT)  # what is measured without x[0], d and noise
            seen.append(C @ x + D @ self.u[k] + SHIFT + H @ d[k] + FADING[k] * rng.uniform(-V, V))
            known = OFFSET + np.sin(self.u[k, 0]) + B @ self.u[k]
            x = A @ x + known + G @ d[k] + FADING[k] * rng.uniform(-W, W)
            free = A @ free + known
        self.x, self.y = np.array(states), np.array(seen)
        self.y[3], self.y[8, 1:4] = np.nan, np.nan
        self.without = self.y - np.array(rest)

    def run(self, **options):
        return gx.tightness(self.observer, self.initial, self.y, self.u, self.noise, **options)


@pytest.fixture(scope="module")
def affine():
    return Record()


@pytest.fixture(scope="module")
def found(affine):
    return affine.run(steps=[0, 3, 8, -1])


def test_the_hull_is_that_of_the_oracle(affine, found):
    assert found.exact
    assert found.steps.tolist() == [0, 3, 8, 13]
    for k, width in zip(found.steps, found.hull_width, strict=True):
        share = FADING[: k + 1]
        oracle = exact_hull(A, C, share * W, share * V, START, affine.without[: k + 1], G, H)
        np.testing.assert_allclose(width, oracle, rtol=1e-7)
    truth = affine.x[found.steps]
    assert ((found.hull_lower <= truth) & (truth <= found.hull_upper)).all()
    assert found.ratio.min() >= 1 - 1e-9
    assert (found.lower <= found.hull_lower + 1e-9).all()
    assert (found.hull_upper <= found.upper + 1e-9).all()
    assert found.worst.max() > 1.01  # or one would not see a ratio that is upside down


def test_a_horizon_lies_between_hull_and_box(affine, found):
    short, whole = affine.run(steps=[8, 13], horizon=2), affine.run(steps=[8, 13], horizon=13)
    assert (found.hull_width[2:] <= short.hull_width * (1 + 1e-9)).all()
    assert (short.hull_width > 1.001 * found.hull_width[2:]).any()
    assert short.ratio.min() >= 1 - 1e-9
    np.testing.assert_allclose(whole.hull_width, found.hull_width[2:], rtol=1e-9)


def test_runs_of_an_affine_plant_span_its_hull(affine, found, monkeypatch):
    """Inputs, lost entries and fading noise on the way that nonlinear plants go."""
    monkeypatch.setattr(hulls, "affine_plant", lambda *_: None)
    runs = affine.run(steps=[0, 3, 8, -1])
    assert not runs.exact
    np.testing.assert_allclose(runs.hull_width, found.hull_width, rtol=1e-5)
    assert (runs.hull_width <= found.hull_width * (1 + 1e-9)).all()


def test_a_contradiction_leaves_no_hull(affine):
    changed = affine.y.copy()
    changed[10] += [0, 0, 3, -3, 3]
    found = gx.tightness(affine.observer, affine.initial, changed, affine.u, affine.noise, steps=[9, 10, 13])
    assert np.isnan(found.ratio).all(axis=1).tolist() == [False, True, True]
    assert "no run agrees with the record at steps 10, 13" in str(found)
    np.testing.assert_array_equal(found.worst, found.ratio[0])


def same(x):
    return x


def scalar(f, g=same, **options):
    """x+ = f(x, u) + w, y = g(x) + v: what is known of x[k] is an interval, if f and g increase."""
    design = {name: options.pop(name) for name in ("form", "u_region") if name in options}
    system = gx.System(f, g, G=np.zeros((1, 0)), H=np.zeros((1, 0)), **options)
    noise = gx.Noise(Interval([-0.1], [0.2]), Interval([-0.6], [0.5]))
    fast = {} if "form" in design else FAST
    return gx.design_observer(system, noise, Interval.symmetric([3.0]), **fast, **design)


def recursion(f, y, u, start, predicted=False, inverse=same):
    """Intervals of x[k] from y[0..k], or from y[0..k-1]; `inverse` is that of g."""
    low, high, found = *start, []
    for k in range(len(y)):
        before = (low, high)
        if np.isfinite(y[k, 0]):
            low, high = max(low, inverse(y[k, 0] - 0.5)), min(high, inverse(y[k, 0] + 0.6))
        found.append(before if predicted else (low, high))
        low, high = f(low, u[k]) - 0.1, f(high, u[k]) + 0.2
    return np.array(found)


U = np.array([[0.2], [0.9], [0.5], [0.1], [0.7], [0.3]])


def measured(f, g=same):
    """A record from x[0] = 1.5; the third row is lost."""
    rng, x, y = np.random.default_rng(6), 1.5, []
    for u in U:
        y.append([g(x) + rng.uniform(-0.6, 0.5)])
        x = float(np.squeeze(f(x, u))) + rng.uniform(-0.1, 0.2)
    return np.array([*y[:2], [np.nan], *y[3:]])


def test_slopes_that_depend_on_a_known_input():
    def f(x, u):
        return x - u[0] * x

    observer, y = scalar(f, m=1, u_region=Interval([0.0], [1.0])), measured(f)
    found = gx.tightness(observer, Interval([-3.0], [3.0]), y, U)
    exact = recursion(f, y, U, (-3.0, 3.0))
    assert found.exact
    assert found.steps.tolist() == list(range(6))
    np.testing.assert_allclose(np.hstack([found.hull_lower, found.hull_upper]), exact, atol=1e-9)


def test_runs_of_a_nonlinear_plant_are_inside_the_hull_and_reach_its_sides():
    def f(x, u=None):
        return 0.7 * x + 0.6 * (np if isinstance(x, float) else jnp).sin(x)

    def g(x):
        return x + 0.45 * (np if isinstance(x, float) else jnp).sin(2 * x)

    def inverse(y):
        return brentq(lambda x: g(float(x)) - y, -9, 9, xtol=1e-13)

    observer, y = scalar(lambda x: f(x), g), measured(f, g)
    found = gx.tightness(observer, Interval([-3.0], [3.0]), y)
    exact = recursion(f, y, U, (-3.0, 3.0), inverse=inverse)
    assert not found.exact
    assert "at least as wide" in str(found)
    assert (exact[:, :1] - 1e-9 <= found.hull_lower).all()
    assert (found.hull_upper <= exact[:, 1:] + 1e-9).all()
    assert (found.hull_width >= 0.998 * (exact[:, 1:] - exact[:, :1])).all()
    # A horizon begins in the observer's own box.
    short = gx.tightness(observer, Interval([-3.0], [3.0]), y, steps=[4], horizon=1)
    box = gx.estimate(observer, Interval([-3.0], [3.0]), y).state
    sides = float(box.lower[3, 0]), float(box.upper[3, 0])
    np.testing.assert_allclose(
        short.hull_width[0], np.diff(recursion(f, y[3:5], U, sides, inverse=inverse)[-1]), rtol=2e-3
    )


def test_the_prediction_form_is_held_against_what_it_knows():
    observer = scalar(lambda x: 0.5 * x, form="prediction")
    y = measured(lambda x, u: 0.5 * x)
    y[2] = 0.3
    found = gx.tightness(observer, Interval([-3.0], [3.0]), y)
    exact = recursion(lambda x, u: 0.5 * x, y, U, (-3.0, 3.0), predicted=True)
    np.testing.assert_allclose(np.hstack([found.hull_lower, found.hull_upper]), exact, atol=1e-9)


def test_bounds_of_states_and_inputs_count():
    """x+ = x + d with 0 <= x and d in [0, 1], nothing measured: x[2] <= 2.9; infinite without."""
    noise = gx.Noise(Interval([-0.1], [0.2]), Interval.symmetric([0.1]))
    start, y = Interval([-1.0], [0.5]), np.full((3, 1), np.nan)
    common = {"G": [[1.0]], "H": [[0.0]]}
    known = {"state_bounds": Interval([0.0], [np.inf]), "input_bounds": Interval([0.0], [1.0])}
    region = Interval([0.0], [4.0])
    system = gx.System(lambda x: x, lambda x: x, **common, **known)
    found = gx.tightness(gx.design_observer(system, noise, region, sweeps=1), start, y)
    np.testing.assert_allclose(found.hull_lower[:, 0], 0, atol=1e-9)
    np.testing.assert_allclose(found.hull_upper[:, 0], [0.5, 1.7, 2.9])
    free = gx.design_observer(gx.System(lambda x: x, lambda x: x, **common), noise, region, sweeps=1)
    found = gx.tightness(free, start, y, steps=[2])
    assert np.isinf([found.hull_lower, found.hull_upper]).all()
    assert found.ratio.tolist() == [[1.0]]


def test_table_and_picture(found):
    lines = str(found).splitlines()
    assert lines[0] == "Widths of boxes over those of the exact hull of the whole record, 4 steps from 0 to 13"
    name, mean, worst, step, width, hull = lines[3].split()
    assert name == "x2"
    values = [found.mean[1], found.worst[1], found.width[:, 1].mean(), found.hull_width[:, 1].mean()]
    np.testing.assert_allclose([float(v) for v in (mean, worst, width, hull)], values, rtol=1e-3)
    assert found.ratio[found.steps.tolist().index(int(step)), 1] == found.ratio[:, 1].max()
    axis = found.plot()
    for i, ratio in enumerate(found.ratio.T):
        (line,) = [line for line in axis.lines if line.get_label() == f"x{i + 1}"]
        np.testing.assert_array_equal(line.get_ydata(), np.where(np.isinf(ratio), np.nan, ratio))
    assert axis.get_ylabel() == "width / width of the hull"
    with pytest.raises(ValueError, match=r"result of gsisio_jax\.tightness"):
        plot.tightness(SimpleNamespace())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"steps": [14]}, "record of 14 rows"), ({"steps": []}, "list of integers"), ({"steps": [0.5]}, "list of int"),
        ({"horizon": 0}, "at least 1"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(affine, options, words):
    with pytest.raises(ValueError, match=f"tightness: .*{words}"):
        affine.run(**options)


def test_angles_are_refused(affine):
    system = gx.System(
        lambda x, u: A @ x + u[0], lambda x: C @ x, G=G, H=np.zeros((5, 2)), m=1, periodic={4: 2 * np.pi}
    )
    with pytest.raises(ValueError, match=r"periodic.*numpy\.unwrap"):
        gx.tightness(replace(affine.observer, system=system), affine.initial, affine.y, affine.u)
