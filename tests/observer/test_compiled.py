"""Programs compiled for one record give the numbers of programs around them, and tables are one constant."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.observer import compiled
from gsisio_jax.observer.fixed import Fixed

COMPILED = True

NOISE = gx.Noise(Interval.symmetric([1e-3, 1e-3]), Interval.symmetric([0.05, 0.1]))
BOX = Interval([-1.0, -1.0], [2.0, 2.0])
Y = np.array([[0.0, 1.0], [0.12, 1.1], [0.2, 1.3]])
LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=8388608"
KNOTS = np.linspace(-2, 2, 13)


@pytest.fixture(scope="module")
def observer():
    def g(x):
        return jnp.stack([x[0] + sum(0.1 * jnp.clip(x[0] - k, 0, 0.1) for k in KNOTS), x[1]])

    system = gx.System(lambda x: [x[0] + 0.1 * x[1], x[1]], g, [[0.005], [0.1]], [[0], [0]])
    return gx.design_observer(system, NOISE, Interval.symmetric([2.0, 2.0]), certify=False, window=1)


@pytest.fixture
def tried(monkeypatch):
    """Options that `compiled` hands to JAX; those of a set-up without XLA_FLAGS."""
    monkeypatch.setenv("XLA_FLAGS", "")
    seen = []
    plain = jax.jit

    def jit(function, **options):
        seen.append(options.get("compiler_options"))
        return plain(function, **options)

    monkeypatch.setattr(jax, "jit", jit)
    return seen


def test_transformations_around_a_call_change_no_number(tried):
    def program(static, traced, box, y, u, noise, hold):
        return box.lower + y[0] * noise.v.upper

    jitted, observer = compiled.compiled(program), Fixed(BOX)

    def of(y):
        return jitted(observer, None, BOX, y, None, NOISE, False)

    found = of(Y)
    others = [
        jax.vmap(of)(jnp.asarray(Y)[None])[0],
        jax.jit(of)(Y),
        jax.jit(lambda: of(Y))(),  # constants: `of` itself does not see that it is traced
        jax.lax.scan(lambda carry, _: (carry, of(Y)), 0, None, length=2)[1][1],
    ]
    for other in others:
        np.testing.assert_array_equal(found, other)
    assert jax.jacobian(of)(jnp.asarray(Y)).shape == (2, 3, 2)
    assert tried[:2] == [compiled.TASKS, None]
    assert tried.count(compiled.TASKS) == 1


@pytest.mark.parametrize(
    ("flags", "options"),
    [
        ("", compiled.TASKS),
        (LOOPS, compiled.FUNCTION),
        ("--xla_cpu_use_fusion_emitters=true", {}),
        (f"{LOOPS} --xla_backend_optimization_level=0", {}),
    ],
)  # fmt: skip
def test_options_follow_the_flags(monkeypatch, flags, options):
    monkeypatch.setenv("XLA_FLAGS", flags)
    assert compiled._options() == options


def test_options_that_this_xla_does_not_have_are_left_out(monkeypatch):
    monkeypatch.setattr(compiled, "jaxlib_version", lambda: (9, 9))
    assert compiled._knows(compiled.TASKS)
    assert not compiled._knows({"xla_cpu_no_such_option": True})


def test_tables_are_one_constant_each(observer):
    """Written out entry by entry they were three quarters of the program."""
    text = jax.jit(lambda y: gx.estimate(observer, BOX, y)).lower(Y).as_text()
    stacked = [len(found.group(1).split(",")) for found in re.finditer(r"concatenate ([^:]*) :", text)]
    assert max(stacked, default=0) < len(KNOTS)
