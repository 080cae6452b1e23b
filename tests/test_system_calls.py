"""How f and g are called: by their signature alone, never wrong in silence."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval

ONE: Any = {"G": np.zeros((1, 0)), "H": np.zeros((1, 0))}
SMALL = gx.Noise(Interval([-0.01], [0.01]), Interval([-0.1], [0.1]))
QUICK: Any = {"missing": False, "certify": False, "window": 1, "sweeps": 1}  # what is not looked at here


def _x(x):
    return x


def _both(x, u):
    return 0.5 * x + u


def _default(x, u=0.0):
    return 0.5 * x + u


def _rest(*args):
    return 0.5 * args[0] + (args[1] if len(args) > 1 else 0)


def _with_gain(x, u, gain=0.5):
    return gain * x + u


class _Model:
    def __init__(self, gain):
        self.gain = gain

    def f(self, x, u=None):
        return self.gain * x + (0 if u is None else u)

    def __call__(self, x, u):
        return self.gain * x + u


def _boxes(system, u):
    """Boxes of a run without noise, and the truth."""
    observer = gx.design_observer(
        system, SMALL, region=Interval([-20.0], [20.0]), u_region=Interval([-9.0], [9.0]), **QUICK
    )
    x = [np.array([1.0])]
    for row in u[:-1]:
        x.append(0.5 * x[-1] + row)
    est = gx.estimate(observer, Interval([0.9], [1.1]), np.array(x), u=u)
    return est, np.array(x)


@pytest.mark.parametrize(
    "f",
    [
        _both,
        _default,
        _rest,
        _with_gain,
        _Model(0.5).f,
        _Model(0.5),
        lambda x, u=None: 0.5 * x + u,
        functools.partial(_with_gain, gain=0.5),
        functools.partial(lambda x, u, gain: gain * x + u, gain=0.5),
    ],
)
def test_a_known_input_reaches_f_however_it_is_declared(f):
    u = np.array([[5.0], [5.0], [-5.0], [0.0], [3.0]])
    system = gx.System(f, _x, **ONE, m=1)
    assert system.f_takes_u
    est, truth = _boxes(system, u)
    assert not (np.asarray(est.status) & gx.Status.CONFLICT).any()
    assert ((np.asarray(est.state.lower) <= truth) & (truth <= np.asarray(est.state.upper))).all()


def test_an_optional_argument_of_another_name_is_a_parameter():
    """`lambda x, a=a: ...` binds a number; here the known input enters by B."""
    system = gx.System(lambda x, a=0.5: a * x, _x, **ONE, B=[[1.0]])
    assert not system.f_takes_u
    u = np.array([[5.0], [5.0], [-5.0], [0.0], [3.0]])
    est, truth = _boxes(system, u)
    assert ((np.asarray(est.state.lower) <= truth) & (truth <= np.asarray(est.state.upper))).all()


def test_without_known_inputs_an_optional_one_keeps_its_default():
    system = gx.System(lambda x, u=2.0: 0.5 * x + u, _x, **ONE)
    assert (system.m, system.f_takes_u) == (0, False)
    assert system.dynamics(jnp.ones(1), jnp.zeros(0)).tolist() == [2.5]


@pytest.mark.parametrize(
    ("f", "more", "words"),
    [
        (_x, {"m": 1}, "neither f, g, B nor D takes u"),
        (_x, {"B": np.zeros((1, 2))}, "neither f, g, B nor D takes u"),
        (lambda x, dt=0.1: x + dt, {"m": 1}, "The optional argument `dt` is not passed"),
        (lambda x, *, u: x + u, {"m": 1}, "keyword-only argument `u`"),
        (lambda x, *, u=0: x + u, {"m": 1}, "keyword-only argument `u`"),
        (lambda x, *, gain: gain * x, {}, "keyword-only argument `gain`"),
        (lambda: 0.0, {}, "x or (x, u)"),
        (lambda x: None, {}, "nothing (None)"),
        (lambda x: {"x": x}, {}, "dict"),
        (lambda x: x + 0j, {}, "real numbers"),
        (lambda x: x[:, None], {}, "(1, 1)"),
        (lambda x: np.sin(x), {}, "jnp.sin, not np.sin"),
        (lambda x: x if x[0] > 0 else -x, {}, "jnp.where"),
        (_both, {"m": 1.5}, "`m` must be"),
        (_both, {"m": True}, "`m` must be"),
    ],
)
def test_what_is_unclear_is_refused(f, more, words):
    with pytest.raises(ValueError, match="System") as error:
        gx.System(f, _x, **ONE, **more)
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("f", "g"),
    [
        (lambda x: [0.5 * x[0], x[0] + x[1]], lambda x: x[0]),
        (lambda x: (0.5 * x[0], x[0] + x[1]), lambda x: [x[0]]),
        (lambda x: jnp.array([0.5 * x[0], x[0] + x[1]]), lambda x: x[0] * np.float64(1)),
    ],
)
def test_lists_and_single_numbers_are_vectors(f, g):
    system = gx.System(f, g, G=np.zeros((2, 0)), H=np.zeros((1, 0)))
    x = jnp.array([2.0, 1.0])
    assert system.dynamics(x, jnp.zeros(0)).tolist() == [1.0, 3.0]
    assert system.measurement(x, jnp.zeros(0)).tolist() == [2.0]


def test_integers_are_numbers():
    system = gx.System(lambda x: jnp.zeros(1, int), lambda x: (x > 0).astype(int) + 1, **ONE)
    out = system.dynamics(jnp.ones(1, jnp.float32), jnp.zeros(0))
    assert out.dtype == jnp.float32
    assert gx.System(lambda x: 3, _x, **ONE).dynamics(jnp.ones(1), jnp.zeros(0)).tolist() == [3.0]


def test_u_of_the_wrong_length_is_refused():
    observer = gx.design_observer(
        gx.System(_both, _x, **ONE, m=1), SMALL, Interval([-1.0], [1.0]), u_region=Interval([-1.0], [1.0]), **QUICK
    )
    start, y = Interval([-1.0], [1.0]), np.zeros((3, 1))
    for u in (np.zeros((2, 1)), np.zeros((3, 2)), np.zeros(3), None):
        with pytest.raises(ValueError, match=r"estimate: .*`u`"):
            gx.estimate(observer, start, y, u=u)


def _region():
    return Interval([-2.0], [2.0])


def _closure(A):
    return lambda x: A @ x


@pytest.mark.parametrize("place", ["closure", "object", "partial", "default", "container", "helper"])
def test_numbers_that_change_behind_a_system_are_noticed(place):
    A = np.array([[0.5]])
    if place == "object":
        f = _Model(A)
    else:

        def helper(x):
            return A @ x

        by_default = lambda x, A=A: A @ x  # noqa: E731
        f = {
            "closure": _closure(A),
            "partial": functools.partial(lambda A, x: A @ x, A),
            "default": by_default,
            "container": functools.partial(lambda p, x: p["A"][0] @ x, {"A": [A]}),
            "helper": lambda x: 2 * helper(x),
        }[place]
    system = gx.System((lambda x: f.gain @ x) if place == "object" else f, _x, **ONE)
    observer = gx.design_observer(system, SMALL, region=_region(), **QUICK)
    y = np.zeros((3, 1))
    gx.estimate(observer, _region(), y)
    A[0, 0] = 0.9
    for call in (
        lambda: gx.estimate(observer, _region(), y),
        lambda: gx.start(observer, _region(), y[0]),
        lambda: gx.sweep(observer, _region(), y, SMALL),
        lambda: gx.design_observer(system, SMALL, region=_region()),
    ):
        with pytest.raises(ValueError, match="has changed since the System was made"):
            call()
    A[0, 0] = 0.5  # as it was: nothing has changed
    gx.estimate(observer, _region(), y)


def test_one_function_before_and_after_a_change_makes_two_systems():
    """Compiled programs of the first are not taken for the second."""
    A = np.array([[0.5]])
    f = _closure(A)
    widths = []
    for value in (0.5, 0.0):
        A[0, 0] = value
        observer = gx.design_observer(gx.System(f, _x, **ONE), SMALL, region=_region(), **QUICK)
        wide = Interval([-100.0], [100.0])
        widths.append(float(gx.estimate(observer, wide, np.full((2, 1), np.nan)).state.width[1, 0]))
    assert widths[0] == pytest.approx(100.02)
    assert widths[1] == pytest.approx(0.02)


def test_what_a_function_counts_by_itself_is_no_change():
    calls = 0

    def f(x):
        nonlocal calls
        calls += 1
        return 0.5 * x

    observer = gx.design_observer(gx.System(f, _x, **ONE), SMALL, region=_region(), **QUICK)
    gx.estimate(observer, _region(), np.zeros((2, 1)))
    assert calls > 0


def test_maps_of_a_system_can_be_compiled():
    system = gx.System(lambda x: 0.5 * x, lambda x: x[:1], G=[[0.0], [1.0]], H=[[0.0]])
    x, u = jnp.ones(2), jnp.zeros(0)
    assert jax.jit(system.dynamics)(x, u).tolist() == [0.5, 0.5]
    assert jax.jit(system.measurement)(x, u).tolist() == [1.0]
    assert jax.jit(system.maps)(x, u).tolist() == [0.5, 0.5, 1.0]


def test_a_table_of_which_jax_mixes_up_the_types_gets_a_remedy(monkeypatch):
    """JAX keeps the type that a table had while a design computed in float64."""
    import importlib

    simulation = importlib.import_module("gsisio_jax.plant.simulation")

    def refused(*_):
        raise ValueError("Cannot lower jaxpr with verifier errors: 'func.call' op operand type mismatch: expected ...")

    system = gx.System(lambda x: x, lambda x: x, [[1.0]], [[0.0]])
    noise = gx.Noise(gx.Interval([-1.0], [1.0]), gx.Interval([-1.0], [1.0]))
    monkeypatch.setattr(simulation, "_simulate", refused)
    with jax.enable_x64(False), pytest.raises(ValueError, match=r"simulate: .*jnp.asarray\(table\)"):
        gx.simulate(system, 0, np.zeros(1), np.zeros((2, 1)), noise)
