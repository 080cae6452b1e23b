"""What a design chooses where nothing is said: the window; and how far ``gains="auto"`` goes. Nothing is compiled."""

import jax
import numpy as np
import pytest
import systems

import gsisio_jax as gx
from benchmarks import dials
from benchmarks.tightness import PLANTS
from gsisio_jax import Interval
from gsisio_jax.design.gain_growth import grown
from gsisio_jax.design.window_search import Search

AUTO = {"missing": False, "window": "auto"}


def test_no_window_where_the_measurements_say_nothing_twice():
    """The example of the paper has as many unknown inputs as outputs: one step is exact for fixed slopes."""
    assert systems.s1().design(**AUTO).window is None


def test_a_window_where_boxes_shrink_slowly():
    """A step of the four tanks gains under one per cent, forty per cent in the end."""
    window = systems.s7().design(**AUTO).window
    assert window is not None
    assert window.length > 1


def test_the_default_looks_for_a_window():
    turn = 0.95 * np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    system = gx.System(lambda x: turn @ x, lambda x: x, G=np.zeros((2, 0)), H=np.zeros((2, 0)))
    noise = gx.Noise(Interval.symmetric([0.02, 0.02]), Interval.symmetric([0.05, 2.0]))
    default = gx.design_observer(system, noise, Interval.entire(2), missing=False)
    one = gx.design_observer(system, noise, Interval.entire(2), missing=False, window=1)
    assert default.window is not None
    assert default.certificate.steady_width[1] < 0.8 * one.certificate.steady_width[1]


def _chain(states, turn):
    A = np.kron(np.eye(states // 2), turn)
    system = gx.System(lambda x: A @ x, lambda x: x, G=np.zeros((states, 0)), H=np.zeros((states, 0)))
    noise = gx.Noise(Interval.symmetric([0.02, 0.02] * (states // 2)), Interval.symmetric([0.05, 2.0] * (states // 2)))
    return gx.design_observer(system, noise, Interval.entire(states), missing=False)


def test_larger_plants_get_a_window_or_are_told_of_it():
    turn = 0.95 * np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    assert _chain(12, turn).window is not None
    told = _chain(22, turn)
    assert told.window is None
    assert told.certificate.notes[-1].endswith("`window=3` may give narrower boxes")


def test_a_window_is_found_where_no_step_promises_a_width():
    """Position of three integrators: one step promises nothing, the outputs of several determine all. Boxes were 10
    times as wide with "auto", which saw no use of a window in units that one step gives such states."""
    A = np.array([[1, 0.1, 0], [0, 1, 0.1], [0, 0, 1]])
    system = gx.System(lambda x: A @ x, lambda x: x[:1], G=np.zeros((3, 0)), H=np.zeros((1, 0)))
    noise = gx.Noise(Interval.symmetric([1e-4] * 3), Interval.symmetric([0.01]))
    y = gx.simulate(system, jax.random.key(0), [0.0, 1, 0], np.zeros((100, 0)), noise).y
    widths = []
    for window in ("auto", 20):
        observer = gx.design_observer(system, noise, Interval.entire(3), window=window)
        widths.append(gx.estimate(observer, Interval.symmetric([1.0, 2, 1]), y).state.width[-1])
    assert (widths[0][1:] < 1.3 * widths[1][1:]).all()


def _costs(monkeypatch, cost):
    """Makes the design take that for how many times as long a step takes, given what it would have taken."""
    asked = []
    own = Search.cost

    def told(search, kept):
        asked.append(own(search, kept))
        return cost(asked[-1])

    monkeypatch.setattr(Search, "cost", told)
    return asked


@pytest.mark.parametrize("name", ["rotation", "full_rank"])
def test_a_step_costs_about_what_the_design_thinks(name, monkeypatch):
    """By the numbers that it computes; the rest is for the older steps in the carry, which take time and no numbers."""
    asked = _costs(monkeypatch, lambda cost: cost)
    task = dials.linear(PLANTS[name]())
    one, chosen = (dials.operations_of(task.design(**options), task) for options in ({"window": 1}, {}))
    assert 1 < chosen / one < asked[-1] < 1.25 * chosen / one


def test_a_window_is_thinned_to_what_its_time_is_worth(monkeypatch):
    """All rows bring full_rank five per cent and take twice the time."""
    asked = _costs(monkeypatch, lambda cost: cost)
    task = dials.linear(PLANTS["full_rank"]())
    rows = [len(task.design().window.targets)]
    assert asked[0] > 2
    assert asked[-1] < 1.7
    _costs(monkeypatch, lambda cost: 1.1)
    rows.append(len(task.design().window.targets))
    assert rows[0] <= 15 < rows[1]
    _costs(monkeypatch, lambda cost: 3.0)
    assert task.design().window is None


@pytest.mark.parametrize(("shares", "count"), [([0.5, 0.2, 0.1, 0.004, 0.5], 4), ([0.009], 1), ([], 1)])
def test_the_bank_grows_until_a_gain_brings_under_one_per_cent(shares, count):
    """Gain k narrows the first state by shares[k]; the second one never changes."""
    gains = iter(np.full((1, 1), k + 1.0) for k in range(len(shares)))

    def widths(bank):
        return np.tile([np.prod([1 - share for share in shares[: len(bank) - 1]]), 1.0], (3, 1))

    bank = grown([np.zeros((1, 1))], lambda share: next(gains, None), widths)
    assert [gain.item() for gain in bank] == list(range(count))


def test_it_does_not_grow_where_no_run_can_be_had():
    bank = [np.zeros((1, 1))]
    assert grown(bank, lambda share: np.ones((1, 1)), lambda gains: None) == bank


def test_automatic_gains_are_fewer_than_all_and_narrow_the_first_boxes():
    observer = systems.s1().design(missing=False, gains="auto")
    assert 1 < len(observer.gains.residual) < 8


@pytest.mark.parametrize("gains", ["all", 0, 1.5, True])
def test_gains_that_cannot_be(gains):
    with pytest.raises(ValueError, match=r'`gains` must be a whole number, at least 1 or "auto", got'):
        systems.s1().design(gains=gains)
