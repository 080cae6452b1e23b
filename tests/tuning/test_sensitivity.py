"""The sensitivity table against differences of runs and of certificates."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems
from oracles.uncompiled_calls import compiled

import gsisio_jax as gx
from gsisio_jax.tuning.model import with_model
from gsisio_jax.tuning.sensitivity import _certificate

STEP = 1e-6
ROWS = 12


def model(theta):
    """The axis with another coupling of speed into position."""
    f = lambda x: jnp.stack([x[0] + theta["step"] * x[1], x[1]])  # noqa: E731
    return gx.System(f, lambda x: x, G=[[0.005], [0.1]], H=np.zeros((2, 1)))


@pytest.fixture(scope="module")
def table(axis):
    names = {"state": ["position", "speed"], "output": ["radar", "doppler"], "input": ["acceleration"]}
    with pytest.MonkeyPatch.context() as patch:
        compiled(patch)
        return gx.width_sensitivity(
            axis.observer, axis.initial, axis.y[0, :ROWS], model=model, theta={"step": 0.1}, names=names
        )


def widths(axis, noise, observer=None):
    est = gx.estimate(observer or axis.observer, axis.initial, axis.y[0, :ROWS], noise=noise)
    return jnp.concatenate([est.state.width[-1], est.input.width[-1]])


def test_labels(table):
    bounds = ["w position", "w speed", "v radar", "v doppler", "initial position", "initial speed", "step"]
    assert table.bound.values.tolist() == bounds
    assert table.signal.values.tolist() == ["position", "speed", "acceleration"]
    assert table.kind.values.tolist() == ["final", "steady", "certificate"]
    assert table.value.sel(bound="v radar") == pytest.approx(0.2)


def test_noise_bounds_against_differences(axis, table):
    noise = axis.observer.noise
    found, kinked = table.derivative.sel(kind="final").values, 0
    for j, (letter, i) in enumerate([("w", 0), ("w", 1), ("v", 0), ("v", 1)]):

        def at(by, letter=letter, i=i):
            change = 0.5 * by * np.eye(2)[i]
            boxes = {k: getattr(noise, k) for k in "wv"}
            box = boxes[letter]
            boxes[letter] = gx.Interval(box.lower - change, box.upper + change)
            return widths(axis, gx.Noise(**boxes)), axis.observer.certificate.widths(gx.Noise(**boxes))

        (ahead, promised), (behind, before), (here, _) = at(STEP), at(-STEP), at(0.0)
        left, right = (here - behind) / STEP, (ahead - here) / STEP
        low, high = np.minimum(left, right) - 1e-6, np.maximum(left, right) + 1e-6
        assert ((low <= found[:, j]) & (found[:, j] <= high)).all()
        kinked += (np.abs(left - right) > 1e-5).sum()
        np.testing.assert_allclose(
            table.derivative.sel(kind="certificate").values[:2, j], (promised - before) / (2 * STEP), atol=1e-7
        )
    assert kinked <= 4
    assert (np.abs(found[:, :4]) > 1e-3).sum() >= 4


def test_model_parameter_against_differences(axis, table):
    @jax.jit
    def run(step):
        return widths(axis, axis.observer.noise, with_model(axis.observer, model({"step": step})))

    ahead, here, behind = (np.asarray(run(0.1 + by)) for by in (STEP, 0.0, -STEP))
    found = table.derivative.sel(kind="final", bound="step").values
    sides = np.sort([(ahead - here) / STEP, (here - behind) / STEP], axis=0)
    assert ((sides[0] - 1e-5 <= found) & (found <= sides[1] + 1e-5)).all()
    designed = [
        gx.design_observer(model({"step": 0.1 + by}), axis.observer.noise, gx.Interval.entire(2), missing=False)
        for by in (1e-5, -1e-5)
    ]
    promised = (designed[0].certificate.steady_width - designed[1].certificate.steady_width) / 2e-5
    np.testing.assert_allclose(table.derivative.sel(kind="certificate", bound="step").values[:2], promised, atol=1e-5)


def test_elasticity_is_the_share(table):
    np.testing.assert_allclose(
        table.elasticity, table.derivative * table.value / table.width, rtol=1e-12, equal_nan=True
    )


def test_errors(axis):
    with pytest.raises(ValueError, match="belong together"):
        gx.width_sensitivity(axis.observer, axis.initial, axis.y[0], model=model)
    other = lambda theta: gx.System(lambda x: x, lambda x: x, G=[[0.0], [0.1]], H=np.zeros((2, 1)))  # noqa: E731
    with pytest.raises(ValueError, match="share the matrix G"):
        with_model(axis.observer, other(None))
    with pytest.raises(ValueError, match="must hold 2 names"):
        gx.width_sensitivity(axis.observer, axis.initial, axis.y[0], names={"state": ["a"]})


def test_the_promise_of_rows_over_several_steps_and_of_slices_against_differences():
    """`window` and `split` promise less than the certified gain alone, and what they promise has other slopes."""
    turn = 0.98 * np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    none = {"G": np.zeros((2, 0)), "H": np.zeros((1, 0))}
    linear = gx.System(lambda x: turn @ x, lambda x: x[:1], **none)
    noise = gx.Noise(gx.Interval.symmetric([0.02, 0.03]), gx.Interval.symmetric([0.1]))
    tank = replace(systems.s7(), region=gx.Interval([8.0, 5.0, 0.6, 0.2], [20.0, 25.0, 4.0, 5.0]))
    for observer in (
        gx.design_observer(linear, noise, gx.Interval.entire(2), missing=False, sweeps=1, window=4),
        tank.design(missing=False, sweeps=1, window=1, split=4),
    ):
        noise, certificate, n = observer.noise, observer.certificate, observer.system.n
        width, found = _certificate(observer, noise, None, jnp.zeros(0), None)
        size = np.concatenate([noise.w.width, noise.v.width])

        def at(size, certificate=certificate, n=n):
            noise = gx.Noise(*map(gx.Interval.symmetric, np.split(size / 2, [n])))
            return np.concatenate([certificate.widths(noise), certificate.input_widths(noise)])

        np.testing.assert_allclose(at(size), width)
        differences = [(at(size + h) - at(size - h)) / (2 * h.sum()) for h in 1e-4 * np.diag(size)]
        np.testing.assert_allclose(found[:, : len(size)], np.transpose(differences), rtol=1e-4, atol=1e-6)
