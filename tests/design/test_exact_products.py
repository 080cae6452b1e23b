"""Products of fractions over whole numbers are those of fractions, and no fraction is added or multiplied for them."""

from fractions import Fraction

import numpy as np
import pytest

from gsisio_jax.observer.residuals import exact, product


@pytest.mark.parametrize(("rows", "inner", "columns"), [(3, 4, 2), (1, 1, 1), (2, 0, 3), (0, 2, 2)])
def test_they_are_equal(rows, inner, columns):
    rng = np.random.default_rng(rows)
    a, b = (
        rng.normal(size=shape) * 10.0 ** rng.integers(-300, 9, shape) for shape in ((rows, inner), (inner, columns))
    )
    a[:1, :1] = 0
    found, expected = product(exact(a), exact(b)), exact(a).dot(exact(b))
    assert found.shape == expected.shape == (rows, columns)
    assert (found == expected).all()


def test_no_arithmetic_of_fractions(monkeypatch):
    a, b = exact(np.eye(2) / 3), exact(np.full((2, 2), 0.1))
    expected = a.dot(b)
    for name in ("__add__", "__mul__"):
        monkeypatch.setattr(Fraction, name, None)
    assert (product(a, b) == expected).all()
