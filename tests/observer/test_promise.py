"""The width promise where slopes vary most: ranges to four beacons, and a gain that uses the new measurement alone."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval

BEACONS = np.array([[0.0, 0], [200, 0], [0, 200], [200, 200]])
LOWER, UPPER = np.array([60.0, 60]), np.array([150.0, 150])
NOISE = gx.Noise(w=Interval.symmetric([0.05] * 2), v=Interval.symmetric([0.5] * 4))


def test_widths_keep_the_promise_from_any_box_of_the_region():
    system = gx.System(
        lambda x: x,
        lambda x: jnp.sqrt((x[0] - BEACONS[:, 0]) ** 2 + (x[1] - BEACONS[:, 1]) ** 2),
        G=np.eye(2),
        H=np.zeros((4, 2)),
        state_bounds=Interval([0.0, 0], [200.0, 200]),
        input_bounds=Interval.symmetric([2.0, 2]),
    )
    observer = gx.design_observer(system, NOISE, Interval(LOWER, UPPER), missing=False, sweeps=1, window=1)
    assert observer.certificate.self_consistent
    assert observer.certificate.implicit_rate > 0.8

    rng = np.random.default_rng(0)
    runs = 300
    x0 = rng.uniform(LOWER + 3, UPPER - 3, (runs, 2))
    x1 = x0 + rng.uniform(-2, 2, (runs, 2)) + rng.choice([-0.05, 0.05], (runs, 2))
    truth = np.stack([x0, x1], 1)
    y = np.asarray(jax.vmap(jax.vmap(lambda x: system.measurement(x, None)))(truth)) + rng.choice([-0.5, 0.5], (2, 4))
    box = Interval(x0 - rng.uniform(0, 1, (runs, 2)) * (x0 - LOWER), x0 + rng.uniform(0, 1, (runs, 2)) * (UPPER - x0))
    # A first measurement that says next to nothing, so that the second one meets boxes of every size.
    v = np.array([[300.0] * 4, [0.5] * 4])
    noise = gx.Noise(w=Interval.symmetric(np.full((2, 2), 0.05)), v=Interval.symmetric(v))
    boxes = jax.vmap(lambda box, y: gx.estimate(observer, box, y, noise=noise).state)(box, y)

    lower, upper, width = np.asarray(boxes.lower), np.asarray(boxes.upper), np.asarray(boxes.width)
    assert (lower <= truth).all()
    assert (truth <= upper).all()
    within = ((lower >= LOWER) & (upper <= UPPER)).all((1, 2))
    assert within.sum() > 200
    assert width[within, 0].mean() > 30
    promised = np.asarray(observer.certificate.next_width(width[within, 0], NOISE))
    assert (width[within, 1] <= promised * (1 + 1e-9)).all()


def test_no_box_of_the_unicycle_is_wider_than_promised():
    """Solving ranges and a bearing for the position leaves something of a box (theory 5.6): the promise counts it."""
    example = gx.examples.load("unicycle")
    record = example.record()
    observer = gx.design_observer(
        example.system, example.noise, example.region, u_region=example.u_region, **example.design, window=1
    )
    est = gx.estimate(observer, example.initial, record.y[:100], record.u[:100])
    certificate, width = observer.certificate, np.asarray(est.state.width)
    assert (np.asarray(est.status) == 0).all()
    assert (width[1:] <= certificate.next_width(width[:-1], example.noise) * (1 + 1e-9)).all()
    assert (width[50:].max(0) > 0.5 * certificate.steady_width).all()
    # The promise stays near what it would be if the outputs were solved without error.
    solved = replace(certificate, rounds=0, excess=0.0).widths(example.noise)
    assert (certificate.steady_width <= 1.0025 * solved).all()


def test_a_gain_of_the_new_measurement_alone_needs_no_past():
    """What a solver leaves of ``I - N_z C`` (1e-12) would ask for a bound of the past."""
    system = gx.System(
        lambda x: x, lambda x: jnp.stack([x[0] + x[1] / 3, x[1] / 3, x[0] - x[1] / 7]), G=np.eye(2), H=np.zeros((3, 2))
    )
    noise = gx.Noise(ball(0.1, 2), ball(0.2, 3))
    observer = gx.design_observer(system, noise, Interval.entire(2), missing=False, sweeps=1, window=1)
    boxes = gx.estimate(observer, Interval.entire(2), np.zeros((2, 3)))
    assert np.isfinite(boxes.state.width).all()


@pytest.mark.parametrize("state_bounds", [False, True], ids=["", "state bounds"])
@pytest.mark.parametrize("inputs", ["free", "one bounded", "bounded"])
def test_widths_of_states_and_inputs_with_every_combination_of_bounds(state_bounds, inputs):
    """Linear plants: no box settles wider than promised, whatever is known of states and inputs."""
    rng = np.random.default_rng(len(inputs))
    A, C = 0.5 * rng.standard_normal((3, 3)), rng.standard_normal((4, 3))
    known = {"free": [np.inf] * 2, "one bounded": [0.4, np.inf], "bounded": [0.4, 0.05]}[inputs]
    system = gx.System(
        lambda x: A @ x,
        lambda x: C @ x,
        G=rng.standard_normal((3, 2)),
        H=np.diag([0.0, 1.0, 0.0, 0.0])[:, :2],
        state_bounds=ball(3.0, 3) if state_bounds else None,
        input_bounds=Interval.symmetric(known),
    )
    noise = gx.Noise(ball(0.02, 3), ball(0.3, 4))
    observer = gx.design_observer(system, noise, ball(3.0, 3), missing=False, sweeps=1)
    d = rng.uniform(-1, 1, (40, 2)) * np.minimum(known, 0.05)
    record = gx.simulate(system, jax.random.key(0), np.zeros(3), d, noise)
    boxes = gx.estimate(observer, ball(3.0, 3), record.y)
    certificate = observer.certificate
    assert certificate.certified
    assert (np.asarray(boxes.state.width)[-10:] <= certificate.steady_width * (1 + 1e-9)).all()
    assert (np.asarray(boxes.input.width)[-10:] <= certificate.input_width * (1 + 1e-9)).all()
    assert np.isfinite(certificate.input_width).all()


def test_the_input_width_counts_bounds_that_are_known():
    """Noise so large that the measurements say nothing: what is left of the input is its bound, 0.2 wide."""
    system = gx.System(lambda x: 0.9 * x, lambda x: x, G=[[1.0]], H=[[0.0]], input_bounds=ball(0.1, 1))
    observer = gx.design_observer(system, gx.Noise(ball(0.01, 1), ball(1.0, 1)), ball(2.0, 1), missing=False, sweeps=1)
    np.testing.assert_allclose(observer.certificate.input_width, 0.2)


def ball(radius: float, size: int) -> Interval:
    return Interval.symmetric(np.full(size, radius))
