"""Rows of windows are dual solutions that HiGHS finds one from the other: each against its own cold primal program."""

import numpy as np
import pytest
from scipy.optimize import linprog

from gsisio_jax.design.row_solver import RowSolver
from gsisio_jax.design.window_program import WindowProgram


def primal(program, state, size, drift):
    """The least ``size |parts| + drift parts``, with parts as differences of nonnegative unknowns; None: no row."""
    k, count = program.parts.shape
    e = len(program.equal)
    rows = np.block([[program.parts, -np.eye(k), np.eye(k)], [program.equal, np.zeros((e, 2 * k))]])
    found = linprog(
        np.concatenate([np.zeros(count), size + drift, size - drift]), A_eq=rows,
        b_eq=-np.concatenate([program.offset[:, state], program.equal_offset[:, state]]),
        bounds=[(None, None)] * count + [(0, None)] * (2 * k), method="highs",
    )  # fmt: skip
    return found.fun if found.status == 0 else None


@pytest.mark.parametrize("seed", range(3))
def test_the_best_row_of_every_program_of_a_sequence(seed, capfd):
    rng = np.random.default_rng(seed)
    k, count, e, n = 12, 5, 2, 3
    equal_offset = rng.normal(size=(e, n))
    equal = rng.normal(size=(e, count))
    if seed == 2:  # what must vanish cannot, for the last state
        equal[1], equal_offset[1] = 0, [0, 0, 1]
    program = WindowProgram(rng.normal(size=(k, count)), rng.normal(size=(k, n)), equal, equal_offset)
    for _ in range(20):
        size = rng.uniform(0, 1, k) * 10.0 ** rng.integers(-2, 6, k)
        drift = rng.uniform(-1, 1, k) * size
        for state in range(n):
            for sign in (-1, 1):
                best, least = program.best(state, size, sign * drift), primal(program, state, size, sign * drift)
                if least is None:
                    assert best is None
                    continue
                parts, value = best
                np.testing.assert_allclose(value, least, rtol=1e-6, atol=1e-9)
                np.testing.assert_allclose(size @ np.abs(parts) + sign * drift @ parts, least, rtol=1e-5, atol=1e-6)
                # They are parts of one row, whose multipliers cancel what must vanish.
                x = np.linalg.lstsq(
                    np.vstack([program.parts, equal]),
                    np.concatenate([parts - program.offset[:, state], -equal_offset[:, state]]),
                )[0]
                np.testing.assert_allclose(program.parts @ x + program.offset[:, state], parts, atol=1e-7)
                np.testing.assert_allclose(equal @ x + equal_offset[:, state], 0, atol=1e-7)
    assert (seed == 2) == (program.best(2, size, drift) is None)
    assert capfd.readouterr().out == ""  # the solver keeps quiet


def test_programs_without_anything_that_must_vanish():
    parts = np.array([[1.0], [1.0]])
    x, value = RowSolver(parts, np.zeros((0, 1))).multipliers(np.array([-1.0, 3.0]), np.array([1.0, 2.0]), np.zeros(2))
    assert value == pytest.approx(4)  # |x - 1| + 2 |x + 3|
    assert x == pytest.approx([-3])
