"""What the tables of wrong uses share: a small plant, calls with one argument wrong, and how a message must read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pandas as pd
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval, Noise, System

MOST_LINES, MOST_LETTERS = 5, 600
KEY = jax.random.key(0)
G, H = np.zeros((2, 0)), np.zeros((1, 0))
BOX, Y, D = Interval([-1.0, -1.0], [1.0, 1.0]), np.zeros((3, 1)), np.zeros((3, 0))
W, V = Interval.symmetric([0.1, 0.1]), Interval.symmetric([0.2])
NOISE = Noise(W, V)
ROWS = np.zeros((4, 2))
DATES = pd.date_range("2020", periods=3)
MASKED = np.ma.array([[1.0], [-9999.0], [2.0]], mask=[[0], [1], [0]])


def f(x):
    return 0.5 * x


def f_of_u(x, u):
    return 0.5 * x + u[0]


def g(x):
    return x[:1]


class Own(np.ndarray):
    """Somebody's subclass, with operators of its own."""


class Gain(eqx.Module):
    a: Any

    def __call__(self, x):
        return self.a * x


def assigns(x):
    x[0] = 1.0
    return x


def plant(f=f, g=g, G=G, H=H, **options):
    return lambda o: System(f, g, G=G, H=H, **options)


def design(*arguments, **options):
    return lambda o: gx.design_observer(o.system, *arguments, **options)


def estimate(*arguments, **options):
    return lambda o: gx.estimate(o.observer, *arguments, **options)


def simulate(*arguments, **options):
    return lambda o: gx.simulate(o.system, *arguments, **options)


def carlo(x0=BOX, runs=3, steps=3, key=0, **options):
    return lambda o: gx.monte_carlo(o.observer, key, runs, steps, x0, progress=False, **options)


def sweep(*arguments, **options):
    return lambda o: gx.sweep(o.observer, *arguments, progress=False, **options)


def table(cases: Mapping[str, tuple[Any, ...]]) -> Any:
    """Decorator: a test of every wrong call and of the words of its message."""
    return pytest.mark.parametrize(("use", "words"), [(use, words) for use, *words in cases.values()], ids=cases)


def check_refused(use: Callable[[Any], Any], objects: Any, words: list[str]) -> None:
    """A `ValueError` at once, with these words one after the other: the call, what was needed or came, the remedy."""
    with pytest.raises(ValueError, match=r"\w") as error:
        use(objects)
    text, place = str(error.value), 0
    assert text.count("\n") < MOST_LINES
    assert len(text) < MOST_LETTERS
    for word in words:
        assert word in text[place:], f"{word!r} is not in {text!r}"
        place = text.index(word, place)
