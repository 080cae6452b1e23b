"""The quick operators of the tests write the programs that JAX writes."""

import operator
from contextlib import nullcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.quick_operators import OPERATIONS, REVERSED, quick_operators

from gsisio_jax import Interval, inclusion

COMPILED = True  # programs are compared as they are made, not run
OF_PYTHON = {"and": operator.and_, "or": operator.or_}


def programs(function, *args):
    """As JAX writes it, and by the quick operators."""
    found = []
    for context in (nullcontext(), quick_operators()):
        jax.clear_caches()
        with context:
            found.append(jax.make_jaxpr(lambda *given: function(*given))(*args))
    return found


def equal(ours, theirs):
    assert str(ours) == str(theirs)
    for one, other in zip(ours.eqns, theirs.eqns, strict=True):
        assert str(one.params) == str(other.params)
        for a, b in zip([*one.invars, *one.outvars], [*other.invars, *other.outvars], strict=True):
            assert a.aval == b.aval
            assert getattr(a.aval, "weak_type", False) == getattr(b.aval, "weak_type", False)


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int64, np.int32, np.bool_])
@pytest.mark.parametrize("name", [*OPERATIONS, *REVERSED])
def test_every_operator_on_every_kind_of_side(name, dtype):
    function = OF_PYTHON.get(name) or getattr(operator, REVERSED.get(name, name))
    x, row, one = np.ones((2, 3), dtype), np.ones(3, dtype), np.ones((), dtype)
    numbers = [2.0, 2, 0, -1, True, 2**60 + 1, 1e300, np.inf, np.nan, 1j, dtype(1), np.float32(1.5), np.float64(1.5), x]
    tried = 0

    def each(x, y, row, one, single):
        nonlocal tried
        out = []
        for other in (y, row, one, single, jnp.asarray(2.0), x.astype(int), x > 0, *numbers):
            for pair in ((x, other), (other, x), (one, other)):
                try:
                    out.append(function(*(pair[::-1] if name in REVERSED else pair)))
                except (TypeError, OverflowError):
                    continue  # is refused, by both
                tried += 1
        return out

    with np.errstate(over="ignore"):
        equal(*programs(each, x, x, row, one, np.float32(1)))
    assert tried % 2 == 0
    assert tried > 10 or name in OF_PYTHON


def test_entries():
    def each(x, row, single):
        parts = [x[0], x[1], x[-1], x[-2], x[1][2], x[0, 1], x[:, 0], x[1:], x[None], x[np.int64(1)], row[0], row[-1]]
        return [*parts, single[0], single[-1], x[row[0].astype(int)]]

    equal(*programs(each, np.ones((2, 3)), np.ones(3), np.ones((1, 3))))
    with quick_operators(), pytest.raises(IndexError):
        jax.make_jaxpr(lambda x: np.ones(2)[5] + x[0])(np.ones(3))


def test_they_are_quick():
    """What is traced without them asks `jnp`, with them it does not."""
    asked = []
    usual = jnp.add

    def add(*sides):
        asked.append(sides)
        return usual(*sides)

    from jax._src.numpy import ufuncs

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ufuncs, "add", add)
        for quickly in (False, True):
            if quickly:
                with quick_operators():
                    jax.make_jaxpr(lambda x: x + x + 1.0)(np.ones(3))
            else:
                jax.make_jaxpr(lambda x: x + x + 1.0)(np.ones(3))
            assert len(asked) == 2


def test_the_bounds_of_a_function():
    def f(x):
        return jnp.stack([jnp.sin(x[0]) * x[1] - 0.3, x[1] / (1.0 + x[0] ** 2), jnp.where(x[1] > 0.5, x[0], 2 * x[1])])

    for way in ("natural", "affine", "jacobian", "mean_value", "tight"):
        for dtype in (np.float64, np.float32):
            sides = np.zeros(2, dtype), np.ones(2, dtype)
            equal(*programs(lambda a, b, way=way: getattr(inclusion, way)(f)(Interval.unchecked(a, b)), *sides))
