"""Where no width can be promised: the true reason, the line of the model, and an observer all the same."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.inclusion.culprits import culprits

ANCHORS = [[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]]
SQUARE = Interval([-1.0, -1.0], [1.0, 1.0])


def _noise(n, l, dw=0.01, dv=0.05):
    return gx.Noise(systems.ball([dw] * n), systems.ball([dv] * l))


def _ranges(anchors):
    anchors = np.asarray(anchors, float)
    return lambda x: jnp.sqrt((x[0] - anchors[:, 0]) ** 2 + (x[1] - anchors[:, 1]) ** 2)


def _contains(box, truth):
    return (np.asarray(box.lower) <= truth).all() and (truth <= np.asarray(box.upper)).all()


@pytest.mark.parametrize(
    ("function", "operation", "fault"),
    [
        (lambda x: jnp.sqrt(x[0] + 1), "sqrt", "has an unbounded derivative"),
        (lambda x: jnp.sign(x[0]) * x[1], "sign", "may jump"),
        (lambda x: jnp.floor(x[0]), "floor", "may jump"),
        (lambda x: jnp.mod(x[0], 0.5), "remainder", "may jump"),
        (lambda x: (x[0] > 0) * x[1], "convert_element_type", "may jump"),
        (lambda x: x[0] / x[1], "div", "has no bound"),
        (lambda x: jnp.log(x[0]), "log", "has no bound"),
        (lambda x: jnp.arccos(x), "acos", "has an unbounded derivative"),
    ],
)
def test_the_operation_and_the_line_are_named(function, operation, fault):
    (found,) = culprits(function, SQUARE)
    assert (found.operation, found.fault) == (operation, fault)
    assert found.place.endswith(f"{__file__.rsplit('/', 1)[-1]}:{function.__code__.co_firstlineno}")


def test_a_long_loop_is_judged_as_a_whole():
    def function(x):
        turned, _ = jax.lax.scan(lambda carry, _: (0.9 * carry + jnp.sqrt(jnp.abs(carry)), None), x, None, length=40)
        return turned

    (found,) = culprits(function, SQUARE)
    assert (found.operation, found.fault) == ("scan", "has an unbounded derivative")


def test_what_is_bounded_has_no_culprit():
    assert culprits(lambda x: jnp.sqrt(x[0] + 2) + jnp.abs(x[1]) ** 1.5, SQUARE) == []


def test_a_plant_that_jumps_runs_without_a_certificate():
    """A relay: f jumps, so no width can be promised, and every box is finite and holds the truth."""

    def f(x):
        return jnp.stack([0.9 * x[0] + 0.1 * x[1], 0.8 * x[1] - 0.2 * jnp.sign(x[0])])

    system = gx.System(f, lambda x: x[:1], G=np.zeros((2, 0)), H=np.zeros((1, 0)))
    observer = gx.design_observer(system, _noise(2, 1), region=SQUARE, missing=False)
    assert not observer.certificate.certified
    assert np.isinf(observer.certificate.steady_width).all()
    text = str(observer.certificate)
    assert "NONE" in text
    assert "`sign`, used at" in text
    assert "may jump" in text
    rng = np.random.default_rng(0)
    x, states, y = np.array([0.3, -0.2]), [], []
    for _ in range(40):
        states.append(x)
        y.append(x[:1] + rng.uniform(-0.05, 0.05, 1))
        x = np.asarray(f(x)) + rng.uniform(-0.01, 0.01, 2)
    est = gx.estimate(observer, SQUARE, np.array(y))
    assert _contains(est.state, np.array(states))
    assert np.isfinite(est.state.width).all()
    assert float(est.state.width[-1].max()) < 1.0


def test_certify_false_serves_where_a_derivative_is_unbounded():
    system = gx.System(
        lambda x: 0.5 * jnp.sqrt(x) + 0.4, lambda x: x, [[1.0]], [[0.0]], state_bounds=Interval([0.0], [np.inf])
    )
    region = Interval([0.0], [1.0])
    with pytest.raises(gx.NoDesignFound, match=r"certify=False. Scaled by 0\.98"):
        gx.design_observer(system, _noise(1, 1), region=region, missing=False)
    observer = gx.design_observer(system, _noise(1, 1), region=region, missing=False, certify=False)
    assert "unbounded derivative" in str(observer.certificate)
    x = np.array([[0.25], [0.65], [0.80311289], [0.84808]])
    est = gx.estimate(observer, region, x)
    assert _contains(est.state, x)
    np.testing.assert_array_less(est.state.width, 0.1001)


def test_a_direction_that_slopes_hide_is_explained():
    """Three anchors near the target: the slopes of the ranges vary more than the input shows in them."""

    def plant(bounds):
        return gx.System(lambda x: x, _ranges(ANCHORS), 0.1 * np.eye(2), np.zeros((3, 2)), state_bounds=bounds)

    system = plant(None)
    region = Interval([1.0, 0.0], [9.0, 8.0])
    with pytest.raises(gx.NoDesignFound) as error:
        gx.design_observer(system, _noise(2, 3, 1e-3), region=region, missing=False)
    text = str(error.value)
    shown, varies = re.search(r"singular values ([\d.]+), [\d.]+, while .* vary by up to \+-(\d+\.\d+)", text).groups()
    assert float(varies) > 0.3 * float(shown)
    # Without state bounds the first box would be infinite with any region, so no smaller one is proposed.
    for words in ("A smaller region about the same centre alone does not help", "more outputs", "certify=False"):
        assert words in text, text
    bounded = plant(Interval([-20.0] * 2, [20.0] * 2))
    quick = {"missing": False, "window": 1, "sweeps": 1}
    gx.design_observer(bounded, _noise(2, 3, 1e-3), region=region, **quick)
    free = gx.design_observer(system, _noise(2, 3, 1e-3), region=region, certify=False, **quick)
    assert not free.certificate.certified
    assert "singular values" in str(free.certificate)


def test_state_bounds_that_were_given_are_not_asked_for():
    """The outputs are too nonlinear on the state bounds, but these are finite where the input reaches a state."""
    bounds = Interval([-20.0] * 2, [20.0] * 2)
    region = Interval([4.5, 3.5], [5.5, 4.5])
    system = gx.System(lambda x: x, _ranges(ANCHORS), G=0.1 * np.eye(2), H=np.zeros((3, 2)), state_bounds=bounds)
    quick = {"missing": False, "window": 1, "sweeps": 1}
    observer = gx.design_observer(system, _noise(2, 3, 1e-3), region=region, **quick)
    x = np.array([5.0, 4.0])
    y = np.repeat(np.asarray(_ranges(ANCHORS)(x))[None], 5, axis=0)
    est = gx.estimate(observer, Interval(x - 0.4, x + 0.4), y)
    assert _contains(est.state, x)
    assert np.isfinite(est.state.width).all()
    without = gx.System(lambda x: x, _ranges(ANCHORS), G=0.1 * np.eye(2), H=np.zeros((3, 2)))
    with pytest.raises(gx.NoDesignFound, match="finite for states 1, 2, which the unknown input reaches"):
        gx.design_observer(without, _noise(2, 3, 1e-3), region=region, missing=False)
    free = gx.design_observer(without, _noise(2, 3, 1e-3), region=region, certify=False, **quick)
    est = gx.estimate(free, Interval(x - 0.4, x + 0.4), y)
    assert _contains(est.state, x)


def test_no_gain_cancels_the_input_but_boxes_are_certain():
    """The slope of x2^2 vanishes at the centre of the region; what is measured still bounds the state."""
    system = gx.System(lambda x: 0.5 * x, lambda x: jnp.stack([x[0] + x[1] ** 2, x[0]]), [[0.0], [1.0]], [[0.0], [0.0]])
    region = SQUARE
    with pytest.raises(gx.NoDesignFound, match="region around another point"):
        gx.design_observer(system, _noise(2, 2), region=region, missing=False)
    observer = gx.design_observer(system, _noise(2, 2), region=region, missing=False, certify=False)
    x = [np.array([0.5, 0.5])]
    for d in (0.3, -0.6, 0.2):
        x.append(0.5 * x[-1] + np.array([0.0, d]))
    y = np.array([[v[0] + v[1] ** 2, v[0]] for v in x])
    est = gx.estimate(observer, region, y)
    assert _contains(est.state, np.array(x))
    assert np.isfinite(est.state.width[:, 0]).all()


def test_a_region_is_looked_for_in_vain_without_a_certificate():
    case = systems.s1()
    loud = gx.Noise(systems.ball([2.0] * 2), systems.ball([2.0] * 2))
    with pytest.raises(gx.NoDesignFound, match="region='auto'"):
        gx.design_observer(case.system, loud, "auto", missing=False)
    certificate = gx.design_observer(case.system, loud, "auto", missing=False, certify=False).certificate
    assert not certificate.self_consistent


def test_an_affine_plant_that_drifts_runs_without_a_certificate():
    """f is the identity, and nothing says anything of the second state: its box grows by the noise of every step."""
    system = gx.System(lambda x: x, lambda x: x[:1], G=[[1.0], [0.0]], H=[[0.0]])
    noise = _noise(2, 1, dw=0.125, dv=0.5)
    observer = gx.design_observer(system, noise, region=Interval.entire(2))
    assert not observer.certificate.certified
    boxes = gx.estimate(observer, systems.ball([4.0, 1.0]), np.zeros((5, 1)))
    np.testing.assert_allclose(boxes.state.width[:, 1], 2.0 + 0.25 * np.arange(5), rtol=1e-12)
    np.testing.assert_allclose(boxes.state.width[:, 0], 1.0, rtol=1e-12)
