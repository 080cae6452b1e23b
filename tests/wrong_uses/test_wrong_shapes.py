"""Shapes that do not fit."""

from __future__ import annotations

import numpy as np
from uses import BOX, V, Y, check_refused, estimate, table

import gsisio_jax as gx
from gsisio_jax import Interval, Noise

SHAPES = {
    "y a row": (estimate(BOX, np.zeros(3)), "estimate", "shape (T, 1)", "got (3,)", "y[:, None]"),
    "y on its side": (estimate(BOX, np.zeros((1, 3))), "estimate", "got (1, 3)", "y.T"),
    "y batched": (estimate(BOX, np.zeros((2, 3, 1))), "estimate", "got (2, 3, 1)", "jax.vmap"),
    "y empty": (estimate(BOX, np.zeros((0, 1))), "estimate", "T >= 1", "got (0, 1)"),
    "y infinite": (estimate(BOX, [[np.inf]]), "estimate", "infinite", "NaN"),
    "y too much": (lambda o: gx.start(o.observer, BOX, Y), "start", "shape (1,), got (3, 1)", "gx.estimate"),
    "initial too short": (estimate(V, Y), "estimate: `initial`", "shape (2,), got (1,)", "jax.vmap"),
    "u not wanted": (estimate(BOX, Y, np.zeros((3, 1))), "estimate: `u`", "(3, 0)", "got (3, 1)"),
    "noise of another T": (
        estimate(BOX, Y, noise=Noise(Interval.symmetric(np.ones((4, 2))), V)),
        "estimate",
        "(3, 2), got (4, 2)",
    ),
    "length beyond": (estimate(BOX, Y, length=7), "estimate: `length`", "0 and the 3 rows", "7"),
    "length a fraction": (estimate(BOX, Y, length=2.5), "estimate: `length`", "one integer", "2.5"),
    "conflict": (estimate(BOX, Y, on_conflict="ignore"), "estimate: `on_conflict`", '"restart" or "hold"', "'ignore'"),
    "rounding": (estimate(BOX, Y, rounding="up"), "estimate: `rounding`", '"outward" or "nearest"', "'up'"),
    "value of shape": (lambda o: BOX.contains(np.zeros(3)), "Interval.contains", "(3,)", "(2,)"),
    "one for many": (lambda o: Interval(Y, Y).contains(np.zeros(3)), "Interval.contains", "(3,)", "(3, 1)"),
    "one number as two": (lambda o: BOX.contains(np.zeros(1)), "Interval.contains", "(1,)", "(2,)"),
    "crossed": (lambda o: Interval([1.0], [0.0]), "Interval: bounds cross at index [0]", "lower <= upper"),
    "NaN bound": (lambda o: Interval([np.nan], [0.0]), "Interval: `lower` is NaN at index [0]", "-inf or inf"),
    "negative radius": (lambda o: Interval.symmetric([-1.0]), "Interval", "cross"),
    "negative size": (lambda o: Interval.entire(-1), "Interval.entire: `shape`", "number of components", "-1"),
    "size a fraction": (lambda o: Interval.entire(2.0), "Interval.entire: `shape`", "2.0"),
    "integer box": (lambda o: BOX.astype(int), "Interval.astype", "floating type"),
    "integer observer": (lambda o: o.observer.astype(int), "Observer.astype", "float64 or float32"),
}


@table(SHAPES)
def test_a_shape_that_does_not_fit(objects, use, words):
    check_refused(use, objects, words)
