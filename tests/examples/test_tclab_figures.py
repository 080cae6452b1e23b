"""The figures that `gsisio_jax.examples.tclab` reasons its numbers with, computed again from the record."""

from importlib.resources import files

import numpy as np
import pytest
from scipy.optimize import least_squares

from gsisio_jax.examples import tclab

FIT = slice(0, 26)  # rows of every 20th second up to 500 s


@pytest.fixture(scope="module")
def log():
    with (files("gsisio_jax.examples") / "data" / "tclab_step.csv").open("rb") as stream:
        return np.loadtxt(stream, delimiter=",", skiprows=1)


@pytest.fixture(scope="module")
def rows(log):
    return log[:: tclab.EVERY, 3:]


def heater(start, power, convection, steps):
    found = [start]
    for _ in range(steps - 1):
        t = found[-1]
        lost = convection * (t - tclab.ROOM) + tclab.RADIATION * ((t + 273.15) ** 4 - (tclab.ROOM + 273.15) ** 4)
        found.append(t + tclab.STEP / tclab.CAPACITY * (50 * power - lost))
    return np.array(found)


def other(start, through, loss, beside):
    found = [start]
    for t in beside[:-1]:
        found.append(found[-1] + tclab.STEP * (through * (t - found[-1]) - loss * (found[-1] - tclab.ROOM)))
    return np.array(found)


def test_parameters_are_least_squares(rows):
    first = rows[5:26, 0]  # 100 to 500 s
    fit = least_squares(lambda p: heater(p[2], p[0] / 100, p[1] / 100, len(first)) - first, [1.0, 0.6, first[0]])
    assert (round(fit.x[0] / 100, 4), round(fit.x[1] / 100, 5)) == (tclab.POWER, tclab.CONVECTION)
    whole = heater(fit.x[2], fit.x[0] / 100, fit.x[1] / 100, len(rows) - 5)
    assert 0.5 < np.abs(whole - rows[5:, 0]).max() < 0.55
    hot, second = rows[FIT].T
    fit = least_squares(lambda p: other(p[2], p[0] / 1e3, p[1] / 1e3, hot) - second, [1.0, 1.0, 21.3])
    assert (round(fit.x[0] / 1e3, 5), round(fit.x[1] / 1e3, 5)) == (tclab.THROUGH_BOARD, tclab.LOSS_2)
    whole = other(fit.x[2], fit.x[0] / 1e3, fit.x[1] / 1e3, rows[:, 0])
    assert np.abs(whole - rows[:, 1]).max() < 0.5


def test_bounds_of_the_sensors(log):
    """Deviations from parabolas over 31 s, and the step of the converter."""
    at, worst, most = np.arange(-15, 16), [], []
    for values in log[:, 3:].T:
        off = [
            values[i] - np.polyval(np.polyfit(at, values[i - 15 : i + 16], 2), 0) for i in range(15, len(values) - 15)
        ]
        worst.append(np.abs(off).max())
        most.append(np.quantile(np.abs(off), 0.99))
    assert 0.54 < max(worst) < 0.55
    assert 0.37 < max(most) < 0.38
    steps = np.diff(np.unique(np.round(log[:, 3:] / 0.3223).astype(int)))
    assert set(steps) <= {1, 2, 3}
    assert np.abs(log[:, 3:] / 0.3223 - np.round(log[:, 3:] / 0.3223)).max() < 0.2
    assert (tclab.noise().v.upper > max(worst)).all()


def test_process_noise_that_the_other_sensor_needs(rows):
    """An interval recursion in NumPy: no contradiction in seconds 0 to 500 even without process noise."""

    def free(w, v):
        low, high = rows[0, 1] - v, rows[0, 1] + v
        keep = 1 - tclab.STEP * (tclab.THROUGH_BOARD + tclab.LOSS_2)
        for hot, seen in zip(rows[FIT][:-1, 0], rows[FIT][1:, 1], strict=True):
            part = tclab.STEP * (tclab.THROUGH_BOARD * hot + tclab.LOSS_2 * tclab.ROOM)
            reach = tclab.STEP * tclab.THROUGH_BOARD * v + w
            low = max(keep * low + part - reach, seen - v)
            high = min(keep * high + part + reach, seen + v)
            if low > high:
                return False
        return True

    assert free(0.0, tclab.noise().v.upper[1])
    assert free(0.0075, 0.35)
    assert not free(0.005, 0.35)
