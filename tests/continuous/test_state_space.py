"""Linear models of other libraries, and the exponential that samples them."""

import control
import mpmath
import numpy as np
import pytest
import scipy.signal

import gsisio_jax as gx
from gsisio_jax.continuous.exponential import exponential, integral_upper

A, B = np.array([[0.0, 1.0], [-2.0, -0.5]]), np.array([[0.0, 1.0], [3.0, 0.0]])
C, D = np.array([[1.0, 0.0]]), np.array([[0.0, 0.5]])
DISCRETE = np.array([[0.9, 0.1], [-0.2, 0.8]])
X, U = np.array([0.3, -1.2]), np.array([0.7])
MODELS = {
    "control": lambda: control.ss(DISCRETE, B, C, D, 0.1),
    "control, some period": lambda: control.ss(DISCRETE, B, C, D, True),
    "dlti": lambda: scipy.signal.dlti(DISCRETE, B, C, D, dt=0.1),
    "StateSpace": lambda: scipy.signal.StateSpace(DISCRETE, B, C, D, dt=0.1),
    "tuple": lambda: (DISCRETE, B, C, D),
    "tuple with period": lambda: (DISCRETE.tolist(), B, C, D, 0.1),
}


@pytest.mark.parametrize("name", MODELS)
def test_discrete_models(name):
    """The second input is unknown, and there is a second unknown input."""
    system = gx.from_state_space(MODELS[name](), unknown=[1], G=[[0.0], [0.25]])
    np.testing.assert_allclose(system.dynamics(X, U), DISCRETE @ X, rtol=1e-15)
    np.testing.assert_array_equal(system.measurement(X, U), C @ X)
    np.testing.assert_array_equal(system.B, B[:, :1])
    np.testing.assert_array_equal(system.D, D[:, :1])
    np.testing.assert_array_equal(system.G, [[1.0, 0.0], [0.0, 0.25]])
    np.testing.assert_array_equal(system.H, [[0.5, 0.0]])


@pytest.mark.parametrize("make", [control.ss, scipy.signal.StateSpace, lambda *all: (*all, 0)])
def test_continuous_models_are_held(make):
    system = gx.from_state_space(make(A, B, C, D), unknown=[1], dt=0.3)
    expected = scipy.signal.cont2discrete((A, B, C, D), 0.3)
    np.testing.assert_allclose(system.dynamics(X, U), expected[0] @ X, atol=1e-14)
    np.testing.assert_allclose(np.hstack([system.B, system.G]), expected[1], atol=1e-14)
    np.testing.assert_array_equal(system.H, D[:, 1:])


def test_a_plain_observer_of_a_model():
    """No unknown input, and frames of pandas for the record."""
    import pandas as pd

    system = gx.from_state_space(control.ss(DISCRETE, B[:, :1], C, D[:, :1], 0.1))
    noise = gx.Noise(gx.Interval.symmetric([0.01, 0.01]), gx.Interval.symmetric([0.05]))
    observer = gx.design_observer(system, noise, gx.Interval([-1, -1], [1, 1]), missing=False, sweeps=1)
    rng, x, truth, u = np.random.default_rng(0), np.zeros(2), [], np.sin(np.arange(30.0))[:, None]
    for row in u:
        truth.append(x)
        x = DISCRETE @ x + B[:, :1] @ row + rng.uniform(-0.01, 0.01, 2)
    y = np.array(truth) @ C.T + rng.uniform(-0.05, 0.05, (30, 1))
    initial = gx.Interval([-1, -1], [1, 1])
    est = gx.estimate(observer, initial, pd.DataFrame(y, columns=["y"]), u=pd.DataFrame(u, columns=["u"]))
    lower, upper = np.asarray(est.state.lower), np.asarray(est.state.upper)
    assert isinstance(lower, np.ndarray)
    assert lower.shape == (30, 2)
    assert ((lower <= truth) & (truth <= upper)).all()
    plain = gx.estimate(observer, initial, y.tolist(), u=u.tolist())
    np.testing.assert_array_equal(plain.state.lower, lower)


WRONG = {
    "continuous": (lambda: gx.from_state_space(control.ss(A, B, C, D)), "is continuous; give dt="),
    "continuous of SciPy": (lambda: gx.from_state_space(scipy.signal.lti(A, B, C, D)), "is continuous; give dt="),
    "another period": (lambda: gx.from_state_space((A, B, C, D, 0.1), dt=0.2), "a period of 0.1, not 0.2"),
    "tuple with dt": (lambda: gx.from_state_space((A, B, C, D), dt=0.1), r"tuple of four .* is discrete; .* D, 0\)"),
    "list with dt": (lambda: gx.from_state_space([A, B, C, D], dt=0.1), "a tuple of four matrices is discrete"),
    "some period and dt": (lambda: gx.from_state_space(control.ss(A, B, C, D, True), dt=0.1), "with dt = True is disc"),
    "B twice": (lambda: gx.from_state_space((A, B, C, D), B=B), "`B` comes from the model"),
    "no time base": (lambda: gx.from_state_space(control.ss(A, B, C, D, None)), r"dt is None\); set sys.dt"),
    "transfer function": (lambda: gx.from_state_space(control.tf([1], [1, 1])), "control.tf2ss"),
    "shape of B": (lambda: gx.from_state_space((A, B[:1], C, D)), r"B must have shape \(2, 2\), got \(1, 2\)"),
    "shape of G": (lambda: gx.from_state_space((A, B, C, D), G=[[1.0]]), r"G must have shape \(2, p\)"),
    "index": (lambda: gx.from_state_space((A, B, C, D), unknown=[2]), "indices of inputs, 0 to 1"),
    "twice": (lambda: gx.from_state_space((A, B, C, D), unknown=[1, 1]), "an input twice"),
    "period": (lambda: gx.from_state_space((A, B, C, D, -1)), "positive number, or True; got -1"),
    "sampling time": (lambda: gx.from_state_space((A, B, C, D, 0), dt=0), "`dt` must be a positive number"),
    "too long": (lambda: gx.from_state_space((A, B, C, D, 0), dt=1e6), "too long for this plant"),
}


@pytest.mark.parametrize("name", WRONG)
def test_refused(name):
    call, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(("n", "scale"), [(1, 0.1), (3, 1.0), (5, 30.0), (4, 2000.0)])
def test_exponential_and_its_error(n, scale):
    """The true entry lies within the bound, which is a few units in the last place; slow and very fast modes
    together.
    """
    rng = np.random.default_rng(n)
    matrix = rng.normal(size=(n, n)) * np.geomspace(1, scale, n)[:, None]
    matrix[np.diag_indices(n)] = -abs(matrix).sum(1)
    value, bound = exponential(matrix, 0.1)
    with mpmath.workdps(80):
        exact = mpmath.expm(mpmath.matrix(matrix.tolist()) * mpmath.mpf(0.1))
        lost = np.array([[float(abs(exact[i, j] - mpmath.mpf(value[i, j]))) for j in range(n)] for i in range(n)])
    assert (lost <= bound).all()
    assert (bound <= 2e-16 * abs(value) + 1e-40).all()
    assert (lost > bound / 3).any()  # a bound a third as large would be wrong


def test_integral_of_the_exponential():
    matrix, radius = np.array([[-1.0, 2.0], [0.5, 0.25]]), np.array([0.3, 1.0])
    found = integral_upper(matrix, radius, 0.4)
    inverse = np.linalg.solve(matrix, (exponential(matrix, 0.4)[0] - np.eye(2)) @ radius)
    np.testing.assert_allclose(found, inverse, rtol=1e-13)
