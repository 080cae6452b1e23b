"""System, Noise, simulate: every constructor checks, and says the remedy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval


def f(x):
    return 0.5 * x


def g(x):
    return x[:1]


GOOD = {"f": f, "g": g, "G": [[1.0], [0.0]], "H": [[0.0]]}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"G": [[np.inf], [0.0]]}, "G has an entry that is not finite"),
        ({"H": [[np.nan]]}, "H has an entry that is not finite"),
        ({"G": [[0.0], [0.0]]}, "full column rank"),
        ({"G": [[1.0, 2.0], [1.0, 2.0]], "H": [[1.0, 2.0]]}, "(0.894427"),
        ({"G": [1.0, 0.0]}, "2 dimensions"),
        ({"H": [[0.0, 1.0]]}, "one column per"),
        ({"g": lambda x: x}, "must return an array of shape (1,)"),
        ({"f": lambda x: x[0]}, "must return an array of shape (2,)"),
        ({"f": lambda x: x[5:7] @ jnp.ones(3)}, "calling f"),
        ({"f": lambda x, u: x}, "say how many known inputs"),
        ({"f": lambda x, u, w: x}, "x or (x, u)"),
        ({"f": 3.0}, "must be a function"),
        ({"B": np.ones((3, 1))}, "B must have shape (2, 1)"),
        ({"B": np.ones((2, 1)), "D": np.ones((1, 2))}, "disagree"),
        ({"state_bounds": Interval([0.0], [1.0])}, "state_bounds"),
        ({"input_bounds": [0, 1]}, "input_bounds"),
    ],
)
def test_bad_systems_are_refused(change, words):
    with pytest.raises(ValueError, match="System") as error:
        gx.System(**{**GOOD, **change})
    assert words.replace("(0.894427", "0.894427") in str(error.value)


def test_sizes_and_optional_parts():
    system = gx.System(**GOOD)
    assert (system.n, system.m, system.p, system.l) == (2, 0, 1, 1)
    assert gx.System(f, g, np.zeros((2, 0)), np.zeros((1, 0))).p == 0
    with_u = gx.System(lambda x, u: x + u[0], g, GOOD["G"], GOOD["H"], m=3)
    assert with_u.m == 3
    assert with_u.f_takes_u
    assert not with_u.g_takes_u
    assert gx.System(f, g, GOOD["G"], GOOD["H"], B=np.ones((2, 2))).D.shape == (1, 2)


def test_noise_must_be_finite_boxes():
    box = Interval([-1.0], [1.0])
    with pytest.raises(ValueError, match="unknown input"):
        gx.Noise(Interval.entire(1), box)
    with pytest.raises(ValueError, match="Interval"):
        gx.Noise(box, [0.0])


def test_bounds_of_traced_values_are_not_looked_at():
    def crossed(a):
        return gx.Noise(Interval(a, -a), Interval(a, -a)).w.width

    assert jax.jit(crossed)(jnp.ones(1)).tolist() == [-2.0]
    leaves, tree = jax.tree.flatten(gx.Noise(Interval([0.0], [1.0]), Interval([0.0], [1.0])))
    jax.tree.unflatten(tree, [np.nan] * len(leaves))  # never checked while unflattening


def test_simulated_noise_is_what_the_record_holds():
    system = gx.System(lambda x, u: 0.9 * x + jnp.stack([jnp.sin(x[1]), u[0]]), g, [[1.0], [2.0]], [[3.0]], D=[[2.0]])
    noise = gx.Noise(Interval([-1e-3, 0.1], [2e-3, 0.1 + 1e-9]), Interval([-0.5], [0.25]))
    d = 1e6 * jax.random.normal(jax.random.key(0), (500, 1))
    u = jnp.ones((500, 1))
    run = gx.simulate(system, jax.random.key(1), [1.0, 2.0], d, noise, u)
    assert run.x.shape == (501, 2)
    again = run.x[1:] - jax.vmap(lambda x, u, d: system.f(x, u) + system.B @ u + system.G @ d)(run.x[:-1], u, d)
    np.testing.assert_allclose(run.w, again, atol=1e-9)
    assert noise.w.contains(run.w, margin=-1e-9).all()
    assert noise.v.contains(run.v, margin=-1e-9).all()
    # The whole range of the noise is used, in both directions.
    assert run.v.min() < -0.49
    assert run.v.max() > 0.24
    for bad, words in (
        ((jnp.zeros((5, 2)), None), "`d` must have shape"),
        ((d, None), "known inputs"),
        ((d, jnp.ones((2, 1))), "`u` must have shape"),
    ):
        with pytest.raises(ValueError, match=words):
            gx.simulate(system, jax.random.key(1), [1.0, 2.0], bad[0], noise, bad[1])
    with pytest.raises(ValueError, match="x0"):
        gx.simulate(system, jax.random.key(1), [1.0], d, noise, u)
