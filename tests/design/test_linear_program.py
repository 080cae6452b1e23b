"""The small modelling layer over Clarabel against the simplex, and trials of lost rows."""

import jax.numpy as jnp
import numpy as np
import pytest
import systems
from scipy import optimize

from gsisio_jax import Interval, estimate
from gsisio_jax.design.linear_program import LinearProgram, diagonal
from gsisio_jax.design.recovery import with_recovery


def test_absolute_values_and_equalities_against_the_simplex():
    """min w'|X A - B| u over X with X c = d: row by row a linear program in (x, t)."""
    rng = np.random.default_rng(0)
    A, B, c, d, w, u = (rng.normal(size=s) for s in ((3, 5), (2, 5), (3, 1), (2, 1), (2,), (5,)))
    w, u = abs(w), abs(u)
    program = LinearProgram()
    X = program.variable(2, 3)
    program.zero(X @ c - d)
    found = program.minimise((program.absolute(X @ A - B) @ u) @ w, X)
    assert found is not None
    best = 0.0
    for i in range(2):
        rows = np.block([[A.T, -np.eye(5)], [-A.T, -np.eye(5)]])
        answer = optimize.linprog(
            np.concatenate([np.zeros(3), w[i] * u]), rows, np.concatenate([B[i], -B[i]]),
            np.concatenate([c[:, 0], np.zeros(5)])[None], d[i], bounds=(None, None),
        )  # fmt: skip
        best += answer.fun
    np.testing.assert_allclose(found[0] @ c, d, atol=1e-9)
    np.testing.assert_allclose(w @ np.abs(found[0] @ A - B) @ u, best, rtol=1e-8)


def test_expressions_are_their_values():
    rng = np.random.default_rng(1)
    M, K, x = rng.normal(size=(3, 2)), rng.normal(size=(4, 3)), np.array([1.0, -2.0, 3.0])
    program = LinearProgram()
    v, Y = program.variable(3), program.variable(4, 3)
    program.zero(v - x)
    program.zero(Y - K)
    every = (diagonal(v) @ M - M, (K - Y)[:, 1:] @ M[1:], Y.sum(axis=0) + v, Y[:, [2, 0]], Y[:, 3:] @ M[:0], -v.sum())
    values = program.minimise(v.sum(), *every)
    assert values is not None
    expected = (np.diag(x) @ M - M, np.zeros((4, 2)), K.sum(axis=0) + x, K[:, [2, 0]], np.zeros((4, 2)), -x.sum())
    for value, wanted in zip(values, expected, strict=True):
        np.testing.assert_allclose(value, wanted, atol=1e-8)


def test_no_minimum():
    program = LinearProgram()
    x = program.variable(2)
    program.nonnegative(x)
    assert program.minimise(-x.sum(), x) is None
    program.nonnegative(-x - np.ones(2))
    assert program.minimise(x.sum(), x) is None


@pytest.mark.parametrize("case", [systems.s1(), systems.s5()])
def test_the_trial_of_a_lost_row_is_that_of_the_compiled_observer(case):
    observer = case.design()
    system, center = case.system, np.asarray(case.region.center)
    width = np.full(system.n, 0.01)
    u = np.zeros(0) if case.u_region is None else np.asarray(case.u_region.center)
    x, rows = jnp.asarray(center), []
    for _ in range(system.n + 5):
        rows.append(np.asarray(system.measurement(x, u)))
        x = system.dynamics(x, u)
    rows[1] = np.full(system.l, np.nan)
    initial = Interval(center - width / 2, center + width / 2)
    last = estimate(observer, initial, np.array(rows), np.tile(u, (len(rows), 1))).state[-1]
    finite = bool(np.isfinite(last.lower).all() and np.isfinite(last.upper).all())
    assert with_recovery(observer, width, Interval(u, u)).recoverable is finite is observer.certificate.recoverable
