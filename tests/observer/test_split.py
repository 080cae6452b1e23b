"""`design_observer(split=)`: slopes that count slice by slice, and the promise of widths that comes of it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.observer.slices import Slices

REGION = Interval([8.0, 5.0, 0.6, 0.2], [20.0, 25.0, 4.0, 5.0])


@pytest.fixture(scope="module")
def tank():
    return replace(systems.s7(), region=REGION)


@pytest.fixture(scope="module")
def observer(tank):
    return tank.design(missing=False, split=8)


def test_the_tank_has_a_certificate_that_is_not_empty(tank, observer):
    found = observer.certificate
    assert found.self_consistent
    assert (found.steady_width <= [0.081, 17.5, 0.72, 4.4]).all()
    # A promise for every noise: more of it is wider, twenty times as much does not fit.
    levels = np.array([0.2, 1.0, 20.0])[:, None]
    noise = gx.Noise(*(Interval(levels * b.lower, levels * b.upper) for b in (tank.noise.w, tank.noise.v)))
    widths = found.widths(noise)
    assert (np.diff(widths, axis=0) >= 0).all()
    np.testing.assert_allclose(widths[1], found.steady_width, rtol=1e-6)
    assert (widths[2] > REGION.width).any()
    # Widths do settle there: the promise of one step, again and again, from boxes as wide as the region.
    width = np.asarray(REGION.width)
    for _ in range(3_000):
        width = found.next_width(width, tank.noise)
    np.testing.assert_allclose(width, found.steady_width, rtol=1e-6)


def test_an_empty_certificate_says_that_slices_help(tank):
    """And nothing where they do not, or are there."""
    empty = tank.design(missing=False, window=1).certificate
    split = tank.design(missing=False, window=1, split=4).certificate
    assert not empty.self_consistent
    assert split.self_consistent
    widths = ", ".join(f"{width:.3g}" for width in split.steady_width)
    assert empty.notes[-1].startswith("with split=4 it is not empty: ")
    assert empty.notes[-1].endswith(widths)
    assert "split=" not in str(split)
    assert "split=" not in str(systems.s1(region=(1.0, 1.0)).design(missing=False, window=1).certificate)


def test_the_unicycle_has_one_on_its_whole_arena():
    """Positions are no wider than the arena, and the heading is then known to 2.29 rad, whatever it was before."""
    arena = Interval([-6.0, -5.0, -1.2], [4.0, 6.0, 1.2])
    found = replace(systems.s9(), region=arena).design(missing=False, window=1, split=4).certificate
    assert found.self_consistent
    np.testing.assert_allclose(found.steady_width, [10.0, 11.0, 2.29124], rtol=1e-5)


def test_no_box_of_the_region_gets_wider_than_promised(tank, observer):
    """Boxes of every size, one step; the promise is nearly reached. The first measurement says nothing of the levels 2,
    measured with a bias, 3 and 4."""
    rng, runs, system = np.random.default_rng(1), 400, tank.system
    u = np.full((2, 2), 3.0)
    low, high = np.sort(rng.uniform(REGION.lower + 0.2, REGION.upper - 0.2, (2, runs, 4)), axis=0)
    wide = rng.random(runs) < 0.3
    low[wide], high[wide] = REGION.lower + 0.2, REGION.upper - 0.2
    x0 = rng.uniform(low, high)
    x1 = np.asarray(jax.vmap(lambda x: system.dynamics(x, u[0]))(x0)) + rng.choice([-0.01, 0.01], (runs, 4))
    truth = np.stack([x0, x1], 1)
    y = 0.5 * truth[:, :, :2] + rng.choice([-0.02, 0.02], (runs, 2, 2))
    boxes = jax.vmap(lambda box, y: gx.estimate(observer, box, y, u).state)(Interval(low, high), y)
    lower, upper, width = (np.asarray(side) for side in (boxes.lower, boxes.upper, boxes.width))
    assert (lower <= truth).all()
    assert (truth <= upper).all()
    within = ((lower >= REGION.lower) & (upper <= REGION.upper)).all((1, 2))
    assert within.sum() > 300
    promised = observer.certificate.next_width(width[within, 0], tank.noise)
    assert (width[within, 1] <= promised * (1 + 1e-9)).all()
    plain = width[within, 0] @ np.asarray(observer.certificate.growth).T + observer.certificate.noise_width(tank.noise)
    assert (promised <= plain * (1 + 1e-9)).all()
    assert (promised < 0.99 * plain).any(0)[[1, 3]].all()
    assert (width[within, 1] / promised).max(0).min() > 0.95


def test_slices_reach_no_further_than_their_growth():
    """Random slopes of both signs, random boxes; growth is reached where a row only rises or only falls."""
    rng = np.random.default_rng(0)
    n, K = 3, 5
    edges = np.sort(rng.uniform(-1, 1, (n, K + 1)), 1)
    edges[2, 3:] = edges[2, 3]  # slices may be empty
    rising, falling = rng.uniform(0, 1, (2, 4, n, K)) * (np.diff(edges) > 0)
    rising[0], falling[1] = 0, 0
    slices = Slices(edges, rising, falling)
    box = np.sort(rng.uniform(edges[:, 0], edges[:, -1], (2, 2_000, n)), axis=0)
    below, above = jax.vmap(slices.reach)(box[0], box.mean(0), box[1])
    total, width = np.asarray(below + above), box[1] - box[0]
    growth = slices.growth(width)
    assert (total <= growth * (1 + 1e-12)).all()
    assert (slices.growth(0.7 * width) <= growth).all()
    # A map whose slope is that of the slices keeps to the reach, and attains it in row 0 and 1.
    for i, slope in ((0, -falling[0]), (1, rising[1])):
        at = [np.concatenate([[0], np.cumsum(slope[j] * np.diff(edges[j]))]) for j in range(n)]
        value = [[np.interp(side[:, j], edges[j], at[j]) for j in range(n)] for side in box]
        np.testing.assert_allclose(np.abs(np.sum(value[1], 0) - np.sum(value[0], 0)), total[:, i], rtol=1e-9)
    # The whole region: the sum over all slices.
    whole = (np.maximum(rising, falling) * np.diff(edges)).sum((1, 2))
    np.testing.assert_allclose(slices.growth(np.full(n, 9.0))[:2], whole[:2], rtol=1e-12)


def test_widths_settle_where_the_largest_slope_alone_promises_nothing(tmp_path):
    """The slope of x - c x^3 is 1 at 0: no rate below 1 on any region around it, but wide boxes shrink."""
    system = gx.System(lambda x: x - 0.1 * x**3, lambda x: 0 * x, G=np.zeros((1, 0)), H=np.zeros((1, 0)))
    noise = gx.Noise(Interval.symmetric([0.01]), Interval.symmetric([0.1]))
    fast = {"missing": False, "window": 1, "sweeps": 1}
    plain, cut = (gx.design_observer(system, noise, Interval([-1.0], [1.0]), split=s, **fast) for s in (1, 16))
    assert not plain.certificate.certified
    assert cut.certificate.self_consistent
    for dtype, room in (("float64", 1e-9), ("float32", 1e-4)):
        est = gx.estimate(cut, Interval([-1.0], [1.0]).astype(dtype), np.zeros((200, 1), dtype))
        width = np.asarray(est.state.width, np.float64)
        assert (width[1:] <= cut.certificate.next_width(width[:-1], noise) * (1 + room)).all()
        assert (width[-1] <= cut.certificate.steady_width * (1 + room)).all()
        assert width[-1] > 0.5 * cut.certificate.steady_width
    again = gx.load_observer(cut.save(tmp_path / "cut.npz") or tmp_path / "cut.npz", system)
    np.testing.assert_array_equal(again.certificate.widths(noise), cut.certificate.widths(noise))
    np.testing.assert_array_equal(again.rounding_constants.slices.rising, cut.rounding_constants.slices.rising)


def test_a_state_without_bounds_has_one_slice():
    """x1 turns without end; the slope on x2 varies. The promise is that of one step, repeated."""
    system = gx.System(
        lambda x: jnp.stack([0.5 * x[0] + 0.1 * x[1] ** 2, 0.9 * x[1] - 0.05 * x[1] ** 3]), lambda x: 0 * x[:1],
        G=np.zeros((2, 0)), H=np.zeros((1, 0)),
    )  # fmt: skip
    noise = gx.Noise(Interval.symmetric([0.01, 0.05]), Interval.symmetric([0.1]))
    region = Interval([-np.inf, -1.0], [np.inf, 1.0])
    fast = {"missing": False, "window": 1}
    plain, cut = (gx.design_observer(system, noise, region, split=s, **fast).certificate for s in (1, 8))
    assert (cut.steady_width < 0.999 * plain.steady_width).all()
    np.testing.assert_allclose(cut.next_width(cut.steady_width, noise), cut.steady_width, rtol=1e-6)
    # The slope of x1 on x2 changes its sign: half an interval of the steepest part, twice.
    part = cut.slices.growth(np.array([0.0, 0.4]))[0]
    assert 0.2 * 2 * 0.1 * 0.9 * 2 < part <= 0.4 * 0.2 + 1e-9


def test_an_affine_plant_needs_no_slices():
    system = gx.System(lambda x: 0.9 * x, lambda x: x, G=np.zeros((1, 0)), H=np.zeros((1, 0)))
    noise = gx.Noise(Interval.symmetric([0.01]), Interval.symmetric([0.1]))
    observer = gx.design_observer(system, noise, Interval([-1.0], [1.0]), split="auto", missing=False, window=1)
    assert observer.certificate.slices is None
