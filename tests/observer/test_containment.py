"""Every box contains the truth: the test systems with known states and known inputs, faces and corners included."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems

import gsisio_jax as gx

# (case, runs): at least 20,000 steps each, 200,000 for the paper's example.
CASES = {
    "S1": (systems.s1(), 3400),
    "S1, d ~ 1e3 N(0,1)": (systems.s1(d_scale=1e3), 3400),
    "S4b": (systems.s4(True), 200),
    "S4a, no certificate": (systems.s4(False), 200),
    "S5": (systems.s5(), 100),
    "S5 without unknown inputs": (systems.s5(unknown_inputs=False), 100),
    "S7": (systems.s7(), 100),
    "S7, no certificate": (systems.s7_negative(), 400),
    "S9": (systems.s9(), 500),
}


@pytest.mark.parametrize("name", CASES)
def test_zero_violations(name):
    case, runs = CASES[name]
    observer = case.design(missing=False)
    u = jnp.asarray(case.u(case.steps))

    @jax.jit
    @jax.vmap
    def run(key):
        record, d = case.simulate(key)
        est = gx.estimate(observer, case.initial, record.y, u)
        now = d @ observer.current_input_directions
        truth = (est.state, record.x[:-1]), (est.input, d[:-1]), (est.current_input, now)
        # Noise on a vertex is reached up to rounding of the simulated sum only; so are the boxes.
        inside = [box.contains(value, -1e-12 * (1 + jnp.abs(value).max(initial=0.0))) for box, value in truth]
        return est, *inside, jnp.isfinite(record.x).all()

    est, state, unknown, now, simulated = run(jax.random.split(jax.random.key(7), runs))
    assert simulated.all()
    assert runs * case.steps >= 20_000
    assert state.all()
    assert unknown.all()
    assert now.all()
    assert not (np.asarray(est.status) & (gx.Status.CONFLICT | gx.Status.UNBOUNDED)).any()
    assert np.asarray(est.margin).min() >= 0
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(est))


@pytest.mark.parametrize("level", [0.2, 0.1, 0.02])
def test_widths_keep_the_certificates_promise(level):
    """Design 4.4: where two successive boxes lie in the region, no step is wider than the recursion of the certificate.

    Region [-1,1] x [-1.5,1.5] holds its steady width; d is kept small enough for boxes to stay inside most of the time.
    """
    case = systems.s1(noise=0.2, d_scale=0.2)
    noise = gx.Noise(systems.ball([level] * 2), systems.ball([level] * 2))
    observer = case.design(missing=False)
    certificate = observer.certificate

    @jax.jit
    @jax.vmap
    def run(key):
        key_x, key_d, key_s = jax.random.split(key, 3)
        x0 = jax.random.uniform(key_x, (2,), minval=-0.1, maxval=0.1)
        d = 0.2 * jax.random.normal(key_d, (60, 2))
        record = gx.simulate(case.system, key_s, x0, d, noise)
        est = gx.estimate(observer, systems.ball([0.15, 0.15]), record.y, noise=noise)
        return est.state, est.input, est.status

    state, unknown, status = run(jax.random.split(jax.random.key(3), 2400))
    kept = (np.asarray(status) & gx.Status.OUTSIDE_REGION)[:, 1:] == 0
    assert kept.sum() >= 34_000  # three noise levels: more than 100,000 steps
    width = np.asarray(state.width)
    promised = certificate.next_width(width[:, :-1], noise)
    excess = width[:, 1:] - promised
    assert excess[kept].max() <= 1e-9
    inputs = certificate.input_width_after(width[:, 1:], width[:, :-1], noise)
    assert (np.asarray(unknown.width) - inputs)[kept].max() <= 1e-9
    # The promise is no triviality: some steps come close to it.
    assert (excess / promised)[kept].max() > -0.25


def test_mean_last_width_of_the_papers_example():
    """Design 11: (1.229, 1.937) at noise .2 with the gain of [-1,1]^2, to within 5 %."""
    case = systems.s1(region=(1.0, 1.0))
    observer = case.design(missing=False)
    last = jax.jit(jax.vmap(lambda key: gx.estimate(observer, case.initial, case.simulate(key)[0].y).state.width[-1]))(
        jax.random.split(jax.random.key(0), 400)
    )
    assert (np.asarray(last).mean(0) <= 1.05 * np.array([1.229, 1.937])).all()
