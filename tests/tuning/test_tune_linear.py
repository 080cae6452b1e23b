"""Fitted noise bounds on a linear plant: the optimum of the linear program of the whole recursion, and nothing less."""

import jax.numpy as jnp
import numpy as np
import pytest
from oracles.noise_program import smallest_noise
from oracles.uncompiled_calls import compiled

import gsisio_jax as gx
from gsisio_jax.tuning import Records, TunedNoise, tune_noise
from gsisio_jax.tuning.identify import is_affine

A = np.array([[1.0, 0.1], [0.0, 1.0]])
WEIGHTS = {"w": [10.0, 3.0], "v": [5.0, 20.0]}


@pytest.fixture(scope="module")
def oracle(axis):
    """Cost and factors of the optimum over the first five records."""
    width = np.concatenate([axis.observer.noise.w.width, axis.observer.noise.v.width])
    price = np.concatenate([WEIGHTS["w"], WEIGHTS["v"]]) * width
    cost, factors = smallest_noise(axis.observer, A, axis.initial, axis.y[:5], price)
    assert cost < 0.9 * price.sum()
    assert (factors > 1e-3).sum() >= 2  # several bounds matter, so the optimum is no single bisection
    return cost, factors


@pytest.fixture(scope="module")
def fitted(axis) -> TunedNoise:
    return tune_noise(axis.observer, axis.records, weights=WEIGHTS)


def conflicts(axis, noise: gx.Noise) -> np.ndarray:
    """Conflicts per record, by `estimate` itself."""
    est = [gx.estimate(axis.observer, axis.initial, y, noise=noise) for y in axis.y]
    return np.array([int(((np.asarray(e.status) & gx.Status.CONFLICT) != 0).sum()) for e in est])


def test_reaches_the_optimum_of_the_linear_program(fitted, oracle):
    assert fitted.method == "lp"
    assert fitted.cost == pytest.approx(oracle[0], rel=2e-3)
    # The lower bound is one, and close: cuts from wrong gradients would cross the optimum.
    assert 0.998 * oracle[0] <= fitted.lower_bound <= oracle[0] * (1 + 1e-5)


def test_the_penalty_reaches_it_as_well(axis, oracle, monkeypatch):
    compiled(monkeypatch)  # hundreds of gradients
    found = tune_noise(axis.observer, axis.records, weights=WEIGHTS, method="optax", iterations=200)
    assert found.method == "optax"
    assert not any("local" in note for note in found.notes)
    assert oracle[0] * (1 - 1e-5) <= found.cost <= 1.01 * oracle[0]


def test_no_fitted_record_is_contradicted_and_less_would_be(axis, fitted):
    assert conflicts(axis, fitted.noise)[:5].sum() == 0
    shrunk = gx.Noise(*(gx.Interval(0.99 * b.lower, 0.99 * b.upper) for b in (fitted.noise.w, fitted.noise.v)))
    assert conflicts(axis, shrunk)[:5].sum() > 0


def test_costs_no_more_than_the_true_bounds(axis, fitted):
    """They explain every record, so they are allowed."""
    assert conflicts(axis, axis.observer.noise).sum() == 0
    assert fitted.cost <= fitted.start_cost * (1 + 1e-9)
    noise = axis.observer.noise
    true = np.dot(WEIGHTS["w"], noise.w.width) + np.dot(WEIGHTS["v"], noise.v.width)
    assert fitted.start_cost == pytest.approx(true)


def test_a_constant_in_the_outputs_is_still_a_linear_program(small):
    def affine(f, g):
        system = gx.System(f, g, G=np.zeros((1, 0)), H=np.zeros((1, 0)))
        return is_affine(gx.design_observer(system, small.noise, gx.Interval([-1.0], [1.0]), missing=False))

    assert affine(lambda x: 0.9 * x, lambda x: x + 1)
    assert not affine(lambda x: 0.9 * x, lambda x: x + 0.1 * jnp.sin(x))
    assert not affine(lambda x: 0.9 * jnp.sin(x), lambda x: x)


def test_held_out_records_are_counted(axis, fitted):
    held = fitted.held_out
    assert (fitted.records, fitted.steps, held.records) == (5, 200, 1)
    assert held.conflicts.tolist() == conflicts(axis, fitted.noise)[5:].tolist()
    assert held.contradicted == int(held.conflicts[0] > 0)
    text = str(fitted)
    assert "evidence, not proof" in text
    assert f"{held.contradicted} of 1 records contradict" in text


def test_deterministic_and_warm(axis, fitted):
    again = tune_noise(axis.observer, axis.records, weights=WEIGHTS, start=fitted)
    assert again.cost == pytest.approx(fitted.cost, rel=2e-3)
    assert again.start_cost == pytest.approx(fitted.cost, rel=2e-2)
    same = tune_noise(axis.observer, axis.records, weights=WEIGHTS)
    assert same.factors == fitted.factors
    assert all((same.history[name] == fitted.history[name]).all() for name in fitted.history)


def test_common_scale_from_a_start_that_is_too_small(axis):
    """Bisection ends just above what is contradicted, whether it comes from above or from below."""
    small = gx.Noise(
        *(gx.Interval(0.01 * b.lower, 0.01 * b.upper) for b in (axis.observer.noise.w, axis.observer.noise.v))
    )
    lines: list[str] = []
    found = tune_noise(axis.observer, axis.records, small, "scale", tolerance=1e-4, progress=lines.append)
    other = tune_noise(axis.observer, axis.records, None, "scale", tolerance=1e-4)
    assert found.method == "bisection"
    assert found.factors["scale"] == pytest.approx(100 * other.factors["scale"], rel=3e-4)
    assert 0.7 < other.factors["scale"] <= 1 + 1e-4
    assert lines


def test_ragged_records_and_missing_rows(axis):
    """A record that is cut, or whose rows are lost, says less: its bounds are never larger."""
    whole = tune_noise(axis.observer, axis.records, None, "scale", held_out=0.0)
    some = np.array(axis.y[1])
    some[5:9] = np.nan
    less = Records(axis.initial, [axis.y[0][:15], some, *axis.y[2:]])
    part = tune_noise(axis.observer, less, None, "scale", held_out=0.0)
    assert part.factors["scale"] <= whole.factors["scale"] * (1 + 1e-3)
    assert part.steps == 5 * 40 + 15
    assert "nothing was held out" in str(part)


def test_widths_as_the_objective(axis):
    """The steady widths are linear in the bounds, so this is the same search with other prices."""
    found = tune_noise(axis.observer, axis.records, objective="widths")
    widths = axis.observer.certificate.widths(found.noise) / axis.observer.certificate.steady_width
    assert found.cost == pytest.approx(widths.sum(), rel=1e-9)
    assert found.cost < 2.0


def test_the_plot_shows_the_search(fitted):
    import matplotlib as mpl

    mpl.use("Agg")
    axes = fitted.plot()
    labels = axes.get_legend_handles_labels()[1]
    assert "proven lower bound" in labels
    best = next(line for line in axes.lines if line.get_label().startswith("best"))
    assert best.get_ydata()[-1] == fitted.cost
