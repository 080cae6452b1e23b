"""Every box contains the truth: the test systems with known states and known inputs, faces and corners included."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems

import gsisio_jax as gx

COMPILED = True

# (case, runs): at least 20,000 steps each.
CASES = {
    "S4b": (systems.s4(True), 200),
    "S4a, no certificate": (systems.s4(False), 200),
    "S5": (systems.s5(), 100),
    "S5 without unknown inputs": (systems.s5(unknown_inputs=False), 100),
    "S7": (systems.s7(), 100),
    "S7, no certificate": (systems.s7_negative(), 400),
    "S9": (systems.s9(), 500),
}


OUTWARD = ("S4b", "S5", "S7")
UNOPTIMISED = {"xla_backend_optimization_level": 0}


def run_many(case: systems.Case, constant: gx.Observer | None = None):
    """Compiled batches of runs of a case; observer, noise and size of d may change without compiling anew.

    An observer that is a constant of the program takes less than half as long to compile: its zeros fall away. The
    simulation is a program of its own: what is compiled as users do it is the observer.
    """
    u = jnp.asarray(case.u(case.steps))
    # Whatever the simulation's code, the record is one: the truth that it returns is what y was made of.
    simulate = jax.jit(jax.vmap(case.simulate, (0, None, None)), compiler_options=UNOPTIMISED)

    @jax.jit
    @partial(jax.vmap, in_axes=(None, 0, None))
    def estimate(observer, y, noise):
        return gx.estimate(constant or observer, case.initial, y, u, noise)

    def run(observer, runs, noise=None, d_scale=1.0):
        noise = noise or case.noise
        record, d = simulate(jax.random.split(jax.random.key(7), runs), noise, d_scale)
        est, x, d = jax.device_get((estimate(None if constant else observer, record.y, noise), record.x, d))
        now = d @ np.asarray(observer.current_input_directions)
        truth = (est.state, x[:, :-1]), (est.input, d[:, :-1]), (est.current_input, now)
        return est, np.stack([contained(*pair) for pair in truth], -1), np.isfinite(x).all()

    return run


def contained(box, value):
    """Of every run, is all of it in its boxes?

    Noise on a vertex is reached up to rounding of the simulated sum only; so are the boxes.
    """
    room = 1e-12 * (1 + np.abs(value).max((1, 2), initial=0.0, keepdims=True))
    return ((box.lower - room <= value) & (value <= box.upper + room)).all((1, 2))


@pytest.fixture(scope="module")
def run_s1():
    return run_many(systems.s1())


def check(est, inside, simulated):
    assert simulated
    assert inside.all(0).tolist() == [True, True, True]  # state, input, current input
    assert not (np.asarray(est.status) & (gx.Status.CONFLICT | gx.Status.UNBOUNDED)).any()
    assert np.asarray(est.margin).min() >= 0
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(est))


# The variants of other plants run at night.
VARIANTS = ("S4a, no certificate", "S5 without unknown inputs", "S7, no certificate")
SLICE = [pytest.param(name, marks=pytest.mark.soak) if name in VARIANTS else name for name in CASES]


@pytest.mark.plain_xla
@pytest.mark.parametrize("name", SLICE)
def test_zero_violations(name):
    case, runs = CASES[name]
    assert runs * case.steps >= 20_000
    observer = case.design(missing=False)
    if name not in OUTWARD:  # to nearest there is less to compile; rounding is no matter of the plant
        observer = observer.with_rounding("nearest")
    # Here the observer is a constant, as for most users; in the runs of S1 below it is an argument.
    check(*run_many(case, constant=observer)(observer, runs))


@pytest.mark.parametrize("d_scale", [1.0, 1e3])
def test_zero_violations_of_the_papers_example_in_200_000_steps(run_s1, d_scale):
    """And the mean of the last widths (theory 13): (1.229, 1.937) to within 5 %, at noise .2, gain of [-1,1]^2."""
    found = run_s1(systems.s1(region=(1.0, 1.0)).design(missing=False, sweeps=3), 3400, d_scale=d_scale)
    check(*found)
    if d_scale == 1.0:
        assert (np.asarray(found[0].state.width)[:, -1].mean(0) <= 1.05 * np.array([1.229, 1.937])).all()


@pytest.mark.parametrize("level", [0.2, 0.1, 0.02])
def test_widths_keep_the_certificates_promise(run_s1, level):
    """Theory 6: where two successive boxes lie in the region, no step is wider than the recursion of the certificate.

    Region [-1,1] x [-1.5,1.5] holds its steady width; d is small, so that boxes stay inside most of the time.
    """
    noise = gx.Noise(systems.ball([level] * 2), systems.ball([level] * 2))
    observer = systems.s1(region=(1.0, 1.5)).design(missing=False, sweeps=3)
    est, inside, _ = run_s1(observer, 3400, noise=noise, d_scale=0.1)
    assert inside.all()
    certificate = observer.certificate
    assert certificate.self_consistent
    kept = (np.asarray(est.status) & gx.Status.OUTSIDE_REGION)[:, 1:] == 0
    assert kept.sum() >= 34_000  # three noise levels: more than 100,000 steps
    width = np.asarray(est.state.width)
    promised = certificate.next_width(width[:, :-1], noise)
    excess = width[:, 1:] - promised
    assert excess[kept].max() <= 1e-9
    inputs = certificate.input_width_after(width[:, 1:], width[:, :-1], noise)
    assert (np.asarray(est.input.width) - inputs)[kept].max() <= 1e-9
    # The promise is no triviality: some steps come close to it.
    assert (excess / promised)[kept].max() > -0.25
