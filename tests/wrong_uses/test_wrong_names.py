"""Arguments that a call does not have, and questions that a box does not answer: a `TypeError` in our words."""

from __future__ import annotations

import inspect
import pickle

import jax
import numpy as np
import pytest
from uses import BOX, KEY, NOISE, G, H, Y, f, g

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax._calls import named_arguments

NAMES = {
    "a letter missing": (lambda o: gx.System(f, g, G=G, H=H, state_bound=BOX), "System", "`state_bounds`"),
    "two letters turned": (lambda o: gx.design_observer(o.system, NOISE, regoin=BOX), "design_observer", "`region`"),
    "another case": (lambda o: gx.Noise(W=BOX, v=BOX), "Noise", "`w`"),
    "the beginning": (lambda o: gx.estimate(o.observer, y=Y, init=BOX), "estimate", "`initial`"),
    "shortened": (lambda o: Interval(low=[0.0], upper=[1.0]), "Interval", "`lower`"),
    "of a method": (lambda o: o.boxes.to_xarray(state_name=["a", "b"]), "to_dataset", "`state_names`"),
    "of a picture": (lambda o: gx.plot.save(o.boxes, "a.png", truths={}), "plot.save", "`truth`"),
    "of a study": (lambda o: gx.sweep(o.observer, BOX, Y, reducer="final"), "sweep", "`reduce`"),
    "underscored": (lambda o: gx.simulate(o.system, KEY, x_0=[0, 0], d=None, noise=NOISE), "simulate", "`x0`"),
}


@pytest.mark.parametrize(("use", "call", "meant"), NAMES.values(), ids=NAMES)
def test_a_misspelled_argument(objects, use, call, meant):
    with pytest.raises(TypeError) as error:
        use(objects)
    text = str(error.value)
    assert text.startswith(f"{call}: there is no argument `")
    assert f"did you mean {meant}? It takes " in text


def test_an_argument_that_is_like_no_other(objects):
    with pytest.raises(TypeError, match=r"^step: there is no argument `zzz`\. It takes observer, carry, y"):
        gx.step(objects.observer, objects.carry, Y[0], zzz=1)


def test_what_python_says_of_other_mistakes_stays(objects):
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'region'"):
        gx.design_observer(objects.system, NOISE)

    @named_arguments
    def outer(**named):
        return inner(**named)

    def inner(*, one):
        return one

    # An error from inside of a call is not about that call.
    with pytest.raises(TypeError, match="unexpected keyword argument 'two'"):
        outer(two=1)


def test_calls_are_what_they_were():
    assert list(inspect.signature(gx.start).parameters)[:3] == ["observer", "initial", "y0"]
    assert pickle.loads(pickle.dumps(gx.estimate)) is gx.estimate
    assert jax.jit(gx.hull)(BOX, BOX).lower.shape == (2,)


@pytest.mark.parametrize("ask", [bool, lambda box: not box, lambda box: box or None], ids=["bool", "not", "or"])
def test_a_box_is_neither_true_nor_false(ask):
    for box in (BOX, Interval(0.0, 1.0), Interval(np.zeros((0,)), np.zeros((0,)))):
        with pytest.raises(TypeError, match=r"neither true nor false; ask for `box is None`.*contains"):
            ask(box)
