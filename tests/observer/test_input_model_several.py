"""How several inputs are known to move: against the exact program, with a held fault, in a sweep, with a delay."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.input_record_hull import exact_input_hull

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.design import input_rows
from gsisio_jax.observer.residuals import input_row_residual

A = np.array([[0.9, 0.2], [-0.1, 0.8]])
G, H = np.array([[0.5, 0.0], [0.1, 0.0]]), np.array([[0.0, 0.3], [0.0, 0.0], [0.0, 0.0]])
C = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
W, V, START = np.full(2, 1e-3), np.full(3, 0.1), np.ones(2)
NOISE = gx.Noise(Interval.symmetric(W), Interval.symmetric(V))
INITIAL, REGION = Interval.symmetric(START), Interval.symmetric([9.0, 9.0])
RATE, BLOCK, T = np.array([0.05, 0.02]), 4, 24
KNOWN = {"rate": {"input_rate": RATE}, "blocks": {"input_constant": BLOCK}, "nothing": {}}


@pytest.fixture(autouse=True, scope="module")
def short_rows():
    """Rows over 6 steps: they compile in a third of the time of 16."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(input_rows, "_STEPS", 6)
        yield


def designed(kind):
    """The second input is an offset of the first output, and shows at once; the first one a step later."""
    system = gx.System(lambda x: A @ x, lambda x: C @ x, G, H, **KNOWN[kind])
    return gx.design_observer(system, NOISE, REGION, missing=False, sweeps=1)


def record(kind, seed=0, vertices=False):
    """With `vertices` all noise, moves and the start stand on their bounds."""
    rng = np.random.default_rng(seed)
    unit = (lambda size: rng.choice([-1.0, 1.0], size)) if vertices else (lambda size: rng.uniform(-1, 1, size))
    levels = np.repeat(rng.normal(size=(T // BLOCK, 2)), BLOCK, axis=0)
    moving = np.array([2.0, -1.0]) + np.cumsum(unit((T, 2)) * RATE, axis=0)
    d = levels if kind == "blocks" else moving
    x = [START * unit(2)]
    for k in range(T - 1):
        x.append(A @ x[-1] + G @ d[k] + W * unit(2))
    return np.array(x), d, np.array(x) @ C.T + d @ H.T + V * unit((T, 3))


def exact(kind, y, k, j, mean=1):
    known = {"rate": {"rate": RATE}, "blocks": {"constant": BLOCK}, "nothing": {}}[kind]
    return exact_input_hull(A, G, C, W, V, START, y, k, H=H, of=j, mean=mean, **known)


def compared(kind, box, y, steps, **options):
    """Widths over the exact ones, (steps, 2), after it has been seen that every box holds the exact one."""
    ratios = []
    for k in steps:
        for j in range(2):
            lower, upper = exact(kind, y, k, j, **options)
            row = k - options.get("mean", 1) + 1
            own = np.asarray(box.lower)[row, j], np.asarray(box.upper)[row, j]
            assert own[0] <= lower + 1e-8
            assert upper - 1e-8 <= own[1]
            ratios.append((own[1] - own[0]) / (upper - lower))
    return np.reshape(ratios, (-1, 2))


@pytest.fixture(scope="module")
def rated():
    observer, (x, d, y) = designed("rate"), record("rate")
    return observer, x, d, y, gx.estimate(observer, INITIAL, y)


@pytest.fixture(scope="module")
def blocked():
    return designed("blocks")


@pytest.mark.parametrize(("kind", "limits"), [("rate", (1.2, 1.1)), ("blocks", (1.25, 1.15))])
def test_several_inputs_against_the_exact_program(kind, limits, request):
    """A bank holds some dozen rows, and the program has more vertices: boxes are wider than it, never narrower."""
    if kind == "rate":
        _, x, d, y, found = request.getfixturevalue("rated")
    else:
        x, d, y = record(kind)
        found = gx.estimate(request.getfixturevalue("blocked"), INITIAL, y)
    assert np.asarray(found.state.contains(x)).all()
    assert np.asarray(found.input.contains(d[:-1])).all()
    assert (compared(kind, found.input, y, range(1, T - 1)).mean(0) < limits).all()


@pytest.mark.parametrize(("kind", "limits"), [("rate", (1.4, 1.8)), ("blocks", (1.3, 1.5))])
def test_noise_on_its_vertices(kind, limits, request):
    """The exact box may be a point there, so widths are added up over four records before they are divided."""
    observer = request.getfixturevalue("rated" if kind == "rate" else "blocked")
    observer = observer[0] if kind == "rate" else observer
    own, best = np.zeros(2), np.zeros(2)
    for seed in range(4):
        x, d, y = record(kind, seed, vertices=True)
        inside = y * (1 - 1e-9)  # a record rounds noise on its bound
        found = gx.estimate(observer, INITIAL, inside)
        slack = 1e-7
        for box, truth in ((found.state, x), (found.input, d[:-1])):
            assert (np.asarray(box.lower) <= truth + slack).all()
            assert (truth - slack <= np.asarray(box.upper)).all()
        for k in range(4, T - 1, 3):
            for j in range(2):
                lower, upper = exact(kind, y, k, j)
                box = np.asarray(found.input.lower)[k, j], np.asarray(found.input.upper)[k, j]
                assert box[0] <= lower + slack
                assert upper - slack <= box[1]
                own[j], best[j] = own[j] + box[1] - box[0], best[j] + upper - lower
    assert (own < np.multiply(limits, best)).all(), own / best


def test_what_rows_leave_of_the_input_of_y_k_is_counted(rated):
    """Rows use y[k], in which d[k] shows; what they leave of it is computed in fractions."""
    rows = rated[0].input_rows
    _, left = input_row_residual(rows, rated[0].system, np.zeros((3, 2)))
    assert (np.asarray(rows.ahead)[:, 1] != 0).any()
    assert (np.asarray(rows.left_now) >= left).all()
    assert left.max() < 1e-12


def test_a_held_fault_is_the_program_without_that_row(rated):
    observer, x, d, y, _ = rated
    lies = y.copy()
    lies[10] += 40.0
    found = gx.estimate(observer, INITIAL, lies, on_conflict="hold")
    assert np.flatnonzero(np.asarray(found.status) & gx.Status.CONFLICT).tolist() == [10]
    assert np.asarray(found.state.contains(x)).all()
    assert np.asarray(found.input.contains(d[:-1])).all()
    lies[10] = np.nan
    assert compared("rate", found.input, lies, [*range(1, 9), *range(12, T - 1)]).mean() < 1.4


def test_a_sweep_gives_the_boxes_of_estimate(rated):
    observer, _, _, y, found = rated
    swept = gx.sweep(observer, INITIAL, np.stack([y, y]), reduce=None)
    for of in ("state", "input"):
        for side in ("lower", "upper"):
            one = np.asarray(getattr(getattr(found, of), side))
            np.testing.assert_allclose(swept[f"{of}_{side}"][1, : len(one)], one, rtol=1e-12, atol=1e-12)


def test_means_of_several_inputs_are_exact():
    observer, (_, _, y) = designed("nothing"), record("rate", 1)
    box = gx.mean_input(observer, gx.estimate(observer, INITIAL, y), y, steps=4)
    ratios = compared("nothing", box, y, [4, 12, 22], mean=4)
    assert ratios.mean() < 1.01
    assert ratios.max() < 1.03


@pytest.mark.parametrize("bounds", [("affine", "natural"), ("mean_value",)])
def test_a_bent_output_that_the_input_is_in(bounds, monkeypatch):
    """g is bounded on the box of x[k] for rows that use y[k]; over arrays, where the methods ask for it."""
    monkeypatch.setattr(input_rows, "_STEPS", 3)
    system = gx.System(
        lambda x: A @ x, lambda x: C @ x + 0.05 * jnp.sin(x[0]) * np.array([1.0, 0, 0]), G, H, input_rate=RATE
    )
    observer = gx.design_observer(system, NOISE, INITIAL, missing=False, sweeps=1, bounds=bounds)
    x, d, _ = record("rate")
    y = x @ C.T + 0.05 * np.sin(x[:, :1]) * [1.0, 0, 0] + d @ H.T + V * np.random.default_rng(5).uniform(-1, 1, (T, 3))
    assert (np.asarray(observer.input_rows.ahead) != 0).any()
    found = gx.estimate(observer, INITIAL, y)
    assert np.asarray(found.state.contains(x)).all()
    assert np.asarray(found.input.contains(d[:-1])).all()


def test_with_a_delay():
    """A force, where the position is measured: it shows two steps later."""
    F, P, Q = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]]), np.array([[1.0, 0.0]])
    noise, rng = gx.Noise(Interval.symmetric(W), Interval.symmetric([0.01])), np.random.default_rng(0)
    d = 3 + np.cumsum(rng.uniform(-1, 1, (T, 1)) * 0.05, axis=0)
    widths = []
    for known in ({"input_rate": [0.05]}, {}):
        system = gx.System(lambda x: F @ x, lambda x: Q @ x, P, [[0.0]], **known)
        observer = gx.design_observer(system, noise, REGION, delay="auto", missing=False, sweeps=1)
        truth = gx.simulate(system, jax.random.key(0), [0.3, -0.2], d, noise)
        found = gx.estimate(observer, INITIAL, truth.y)
        assert np.asarray(found.state.contains(np.asarray(truth.x)[: len(found.state.lower)])).all()
        assert np.asarray(found.input.contains(d[: len(found.input.lower)])).all()
        widths.append(np.asarray(found.input.width)[8:])
    assert (widths[0] <= widths[1] * (1 + 1e-9)).all()
    assert widths[0].mean() < 0.8 * widths[1].mean()
