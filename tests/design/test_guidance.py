"""What would help is computed: every suggestion works when it is followed, and what is not suggested does not."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval


def ball(*radii):
    return Interval.symmetric(radii)


def chain(x):
    return jnp.stack([x[0] + 0.1 * x[1], x[1] - 0.1 * jnp.sin(x[0]), 0.5 * x[2]])


def plant(measured=(0,), **known):
    """A pendulum and a state apart, an unknown torque; some of its states are measured."""
    rows = list(measured)
    return gx.System(
        chain, lambda x: jnp.stack([x[i] for i in rows]), G=[[0.0], [0.1], [0.0]], H=np.zeros((len(rows), 1)), **known
    )  # fmt: skip


def design(system, **options):
    noise = gx.Noise(ball(0.01, 0.01, 0.01), Interval.symmetric([0.1] * system.l))
    return gx.design_observer(system, noise, ball(2.0, 2.0, 2.0), **{"missing": False, **options})


def test_suggestions_of_a_plant_without_an_observer_work_and_the_others_do_not():
    with pytest.raises(gx.ObserverDoesNotExist) as error:
        design(plant())
    head, *lines = str(error.value).splitlines()
    assert "delay=1" in head
    assert lines == [
        "Tried one by one (no two of them together), each of these is enough:",
        "  measure state 2 as well: widths settle;",
        "  `input_bounds` with two finite sides for input 1: widths settle;",
        "  `state_bounds` with two finite sides for state 2: widths settle.",
    ]
    inf = np.inf
    for system in (
        plant((0, 1)),
        plant(input_bounds=ball(3.0)),
        plant(state_bounds=ball(inf, 2.0, inf)),
    ):
        assert design(system).certificate.certified
    for system in (plant((0, 2)), plant(state_bounds=ball(2.0, inf, 2.0))):
        with pytest.raises(gx.ObserverDoesNotExist):
            design(system)


def test_where_one_thing_more_is_not_enough_two_are_tried():
    """Two arms with a torque each, whose angles are measured: each torque needs something."""

    def arms(more=(), **known):
        def f(x):
            return jnp.stack([x[0] + 0.1 * x[2], x[1] + 0.1 * x[3], x[2] - 0.1 * jnp.sin(x[0]), x[3] - 0.1 * x[1]])

        rows = [0, 1, *more]
        G = np.array([[0.0, 0], [0, 0], [0.1, 0], [0, 0.1]])
        system = gx.System(f, lambda x: jnp.stack([x[i] for i in rows]), G=G, H=np.zeros((len(rows), 2)), **known)
        noise = gx.Noise(ball(*[0.01] * 4), Interval.symmetric([0.1] * len(rows)))
        return gx.design_observer(system, noise, ball(*[2.0] * 4), missing=False, window=1)

    with pytest.raises(gx.ObserverDoesNotExist) as error:
        arms()
    _, head, *lines = str(error.value).splitlines()
    assert "neither one more state measured nor one more bound" in head
    assert head.endswith("two together are:")
    inf = np.inf
    ways = {
        "measure states 3 and 4 as well": {"more": (2, 3)},
        "`input_bounds` with two finite sides for inputs 1 and 2": {"input_bounds": ball(3.0, 3.0)},
        "`state_bounds` with two finite sides for states 3 and 4": {"state_bounds": ball(inf, inf, 2.0, 2.0)},
        "measure state 3 as well, and `input_bounds` with two finite sides for input 2": {
            "more": (2,), "input_bounds": ball(inf, 3.0),
        },
        "measure state 3 as well, and `state_bounds` with two finite sides for state 4": {
            "more": (2,), "state_bounds": ball(inf, inf, inf, 2.0),
        },
    }  # fmt: skip
    for way, known in ways.items():
        assert f"  {way}: widths settle;" in lines
        assert arms(**known).certificate.certified
    for known in ({"more": (2,)}, {"more": (2,), "input_bounds": ball(3.0, inf)}):
        with pytest.raises(gx.ObserverDoesNotExist):
            arms(**known)


def test_where_two_things_more_are_not_enough_that_is_said():
    blind = gx.System(lambda x: 0.5 * x, lambda x: x[:1], G=np.eye(4), H=np.zeros((1, 4)))
    noise = gx.Noise(ball(*[0.01] * 4), ball(0.1))
    with pytest.raises(gx.ObserverDoesNotExist, match=r"is enough by itself, nor are two of them together\.$"):
        gx.design_observer(blind, noise, ball(*[2.0] * 4), missing=False)


def test_a_smaller_region_is_proposed_only_where_it_works():
    """g = x + 1.2 sin x: steep enough on a smaller region, and its first box is finite everywhere."""
    noise = gx.Noise(ball(0.1), ball(0.1))

    def scalar(g, region):
        return gx.design_observer(gx.System(lambda x: 0.5 * x, g, [[1.0]], [[0.0]]), noise, region, missing=False)

    with pytest.raises(gx.NoDesignFound) as error:
        scalar(lambda x: x + 1.2 * jnp.sin(x), ball(3.0))
    scale = float(str(error.value).split("Scaled by ")[1].split(" ")[0])
    assert scalar(lambda x: x + 1.2 * jnp.sin(x), ball(3.0 * scale)).certificate.certified
    # x**2 - 2 x: slopes vanish at 1; around 0 there is a gain, but no first box, so nothing smaller is proposed.
    with pytest.raises(gx.NoDesignFound) as error:
        scalar(lambda x: x**2 - 2 * x, Interval([-1.5], [1.5]))
    assert "A smaller region about the same centre alone does not help" in str(error.value)
    assert "Scaled by" not in str(error.value)
    with pytest.raises(gx.NoDesignFound, match="a smaller region alone does not help"):
        scalar(lambda x: x**2 - 2 * x, Interval([-0.1], [0.1]))


def test_what_would_make_widths_settle_is_noted():
    drift = gx.System(lambda x: x, lambda x: x[:1], G=[[1.0], [0.0], [0.0]][:2], H=[[0.0]])
    noise = gx.Noise(ball(0.1, 0.1), ball(0.1))
    found = gx.design_observer(drift, noise, Interval.entire(2), missing=False).certificate
    assert not found.certified
    assert found.notes == (
        "widths would settle with one of these (tried): measure state 2 as well; or `state_bounds` with two finite "
        "sides for state 2",
    )


A_FOUR = np.array([[0.7, 0.1, 0, 0], [0, 0.6, 0.1, 0], [0, 0, 0.8, 0.1], [0.1, 0, 0, 0.5]])
GAPS = {
    # A bounded nonlinearity, one output of two states that the input moves.
    "tanh chain": (
        lambda x: jnp.stack([0.8 * x[0] + 0.1 * jnp.tanh(x[1]), 0.6 * x[1] + 0.1 * x[0], 0.5 * x[2] + 0.2 * x[1]]),
        lambda x: [x[0] + 0.3 * x[2]], [[1.0], [0.0], [0.5]], [[0.0]], 3,
    ),
    # Two inputs, one of them in an output: the bounds of some states say where others are, but not to boxes.
    "four states": (
        lambda x: A_FOUR @ x, lambda x: [x[0] + x[3], x[1]], [[1.0, 0], [0, 0], [0, 0], [0.5, 0]],
        [[0.0, 0], [0, 1.0]], 4,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", GAPS)
def test_what_is_said_to_bring_boxes_back_does_and_nothing_else(name):
    """Every sensor and bound by itself, against the recovery of a design with it."""
    f, g, G, H, n = GAPS[name]
    p = len(G[0])

    def promise(more=(), **known):
        rows = np.vstack([H, np.zeros((len(more), p))])
        system = gx.System(f, lambda x: jnp.stack([*g(x), *(x[i] for i in more)]), G=G, H=rows, **known)
        noise = gx.Noise(ball(*[0.01] * n), ball(*[0.1] * len(rows)))
        region = ball(*[2.0] * n)
        return gx.design_observer(system, noise, region, window=1, cells=1, sweeps=1, certify=False).certificate

    def only(size, i, radius):
        return ball(*np.where(np.arange(size) == i, radius, np.inf))

    found = promise()
    assert found.recoverable is False
    bound = "`{}_bounds` with two finite sides for {} "
    changes = [("measure state {} as well", i, {"more": (i,)}) for i in range(n)]
    changes += [(bound.format("input", "input") + "{}", j, {"input_bounds": only(p, j, 3.0)}) for j in range(p)]
    changes += [(bound.format("state", "state") + "{}", i, {"state_bounds": only(n, i, 2.0)}) for i in range(n)]
    said = {}
    for way in found.notes[-1].partition("(tried): ")[2].split("; or "):
        kind, numbers = re.match(r"(.*(?:state|input) )([\d, or]+)", way).groups()
        said[kind] = set(re.findall(r"\d+", numbers))
    for text, index, known in changes:
        expected = str(index + 1) in said.get(text.partition("{")[0], ())
        assert promise(**known).recoverable is expected, (text, index)


def test_what_would_bring_boxes_back_after_a_lost_row_is_noted():
    """y sees x1 - x2 and an input moves both: y[k-1] is needed, and after a lost row it is not there. Any single state
    that is measured ends that."""
    example = gx.examples.load("paper")
    found = gx.design_observer(example.system, example.noise, example.region).certificate
    assert found.recoverable is False
    assert found.notes[-1].startswith("after a lost row boxes would become finite again with one of these (tried): ")
    system = example.system
    seen = gx.System(
        system.f, lambda x: jnp.concatenate([system.g(x), x[:1]]), system.G, np.vstack([system.H, np.zeros((1, 2))])
    )
    noise = gx.Noise(example.noise.w, Interval.symmetric([0.2, 0.2, 0.2]))
    assert "measure state 1" in found.notes[-1]
    assert gx.design_observer(seen, noise, example.region).certificate.recoverable
