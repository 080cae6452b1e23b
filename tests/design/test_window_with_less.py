"""Rows over several steps: with a true bound a design keeps those that it would have without it."""

import numpy as np

import gsisio_jax as gx
from gsisio_jax import Interval


def test_rows_of_the_design_without_input_bounds_are_kept():
    """A slow rotation, pushed; looked for with the widths of the design with bounds, other rows would be found."""
    ball = Interval.symmetric
    c, s = np.cos(0.2), np.sin(0.2)
    A = np.array([[c, -s, 0.3], [s, c, 0.0], [0.0, 0.0, 0.9]])
    C = np.array([[1.0, 0.0, 0.0], [0.0, 0.2, 1.0]])

    def window(**known):
        system = gx.System(lambda x: A @ x, lambda x: C @ x, G=[[0.0], [0.1], [1.0]], H=np.zeros((2, 1)), **known)
        noise = gx.Noise(ball([0.01, 0.01, 0.02]), ball([0.1, 0.3]))
        return gx.design_observer(system, noise, ball([5.0] * 3), missing=False, certify=False).window

    without, having = window(), window(input_bounds=ball([0.3]))
    assert without is not None
    for r, target in enumerate(without.targets):
        row = without.multipliers[:, r]
        mine = having.multipliers[: len(row), [i == target for i in having.targets]].transpose(1, 0, 2)
        assert np.isclose(mine, row, rtol=1e-5, atol=1e-8).all((1, 2)).any()
