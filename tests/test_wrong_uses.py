"""Wrong uses of the API: each is refused at once, by a message that names the call, what is needed and the remedy.

Nothing is compiled but one small observer, which the whole table shares.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import scipy.sparse

import gsisio_jax as gx
from gsisio_jax import Interval, Noise, System, inclusion
from gsisio_jax.interval.reading import read_array
from gsisio_jax.tuning import Records

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


@pytest.fixture(scope="module")
def observer():
    return gx.design_observer(System(f, g, G=G, H=H), NOISE, BOX, missing=False, sweeps=1)


@pytest.fixture(scope="module")
def objects(observer):
    return SimpleNamespace(
        delayed=gx.design_observer(observer.system, NOISE, BOX, missing=False, sweeps=1, delay=1),
        observer=observer,
        system=observer.system,
        with_u=System(f_of_u, g, G=G, H=H, m=1),
        records=Records(BOX, Y),
        carry=gx.start(observer, BOX, Y[0])[0],
        boxes=gx.estimate(observer, BOX, Y),
    )


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


# name: (wrong call, words of the message in order of their place: the call, what was needed or came, the remedy)
READ = {
    "complex G": (plant(G=np.array([[1j], [0]]), H=[[0.0]]), "System: `G`", "complex numbers", "give .real"),
    "complex H": (plant(G=[[1.0], [0.0]], H=[[0j]]), "System: `H`", "complex numbers", "give .real"),
    "masked G": (plant(G=np.ma.array([[1.0], [2.0]], mask=[[0], [1]]), H=[[0.0]]), "`G`", "masked at index [1, 0]"),
    "sparse G": (plant(G=scipy.sparse.eye(2, 0), H=H), "System: `G`", "sparse matrix", ".toarray()"),
    "maps for matrices": (lambda o: System(G, H, f, g), "System: `G`", "got an object of type function"),
    "text in a box": (lambda o: Interval(["0"], ["1"]), "Interval: `lower`", "got text", "to_numeric"),
    "masked bound": (
        lambda o: Interval(np.ma.array([0.0], mask=True), [1.0]),
        "Interval: `lower`",
        "masked at index [0]",
    ),
    "NA bound": (lambda o: Interval(pd.Series([None], dtype="Float64"), [1.0]), "`lower`", "missing (NA)", "inf for"),
    "None bound": (lambda o: Interval([None], [1.0]), "Interval: `lower`", "missing at index [0]"),
    "no bound": (lambda o: Interval(None, 1.0), "Interval: `lower`", "nothing (None)"),
    "box of boxes": (lambda o: Interval(BOX, BOX), "Interval: `lower`", "type Interval", "the right order?"),
    "masked radius": (
        lambda o: Interval.symmetric(np.ma.array([0.1], mask=True)),
        "Interval.symmetric: `radius`",
        "mask",
    ),
    "complex bound": (lambda o: Interval([0j], [1.0]), "Interval: `lower`", "complex"),
    "large integer": (lambda o: Interval([2**53 + 1], [2**54]), "`lower`", "9007199254740993", "cannot hold", "offset"),
    "huge integer": (lambda o: Interval([0], [2**70 + 1]), "`upper`", "cannot hold"),
    "long double": (lambda o: Interval(np.longdouble([1]) / 3, [1.0]), "`lower`", "cannot hold", "astype(float)"),
    "y of dates": (estimate(BOX, pd.DataFrame({"t": DATES})), "estimate: `y`", "column 't'", "seconds"),
    "y of durations": (estimate(BOX, np.zeros((3, 1), "m8[s]")), "estimate: `y`", "dates or times", "seconds"),
    "y by name": (
        estimate(BOX, {"a": [1.0], "b": [2.0]}),
        "estimate: `y`",
        "columns by name (a, b)",
        "np.column_stack",
    ),
    "y complex": (estimate(BOX, np.zeros((3, 1), complex)), "estimate: `y`", "complex numbers", "give .real"),
    "y text": (estimate(BOX, [["1,5"]]), "estimate: `y`", "got text", "to_numeric"),
    "y text column": (
        estimate(BOX, pd.DataFrame({"a": ["x"]})),
        "estimate: `y`",
        "column 'a'",
        "type str at index [0]",
    ),
    "y ragged": (estimate(BOX, [[1.0], [1.0, 2.0]]), "estimate: `y`", "different lengths", "the same length"),
    "y ragged arrays": (estimate(BOX, [jnp.ones(1), jnp.ones(2)]), "estimate: `y`", "different shapes ((1,), (2,))"),
    "y nothing": (estimate(BOX, None), "estimate: `y`", "nothing (None)"),
    "y generator": (estimate(BOX, (k for k in range(3))), "estimate: `y`", "type generator"),
    "y of objects": (estimate(BOX, [[object()]]), "estimate: `y`", "type object at index [0, 0]"),
    "y structured": (
        estimate(BOX, np.zeros(3, [("a", float)])),
        "estimate: `y`",
        "structured",
        "structured_to_unstruct",
    ),
    "y a key": (estimate(BOX, KEY), "estimate: `y`", "a random key", "the right order?"),
    "u masked": (estimate(BOX, Y, np.ma.array(Y, mask=True)), "estimate: `u`", "masked at index [0, 0]"),
    "u is noise": (estimate(BOX, Y, NOISE), "estimate: `u`", "type Noise", "right order?"),
    "x0 masked": (simulate(0, np.ma.array([0.0, 1.0], mask=[0, 1]), D, NOISE), "simulate: `x0`", "masked at index [1]"),
    "x0 complex": (simulate(0, [0j, 0], D, NOISE), "simulate: `x0`", "complex"),
    "x0 a box": (simulate(0, BOX, D, NOISE), "simulate: `x0`", "type Interval", "right order?"),
    "x0 NaN": (simulate(0, [np.nan, 0], D, NOISE), "simulate: `x0`", "finite"),
    "d masked": (carlo(d=np.ma.array(np.zeros((3, 1)), mask=True)), "monte_carlo: `d`", "masked at index [0, 0]"),
    "runs x0 masked": (carlo(np.ma.array([0.0, 0.0], mask=[1, 0]), initial=BOX), "monte_carlo: `x0`", "masked"),
    "truth masked": (sweep(BOX, Y, truth=(np.ma.array(np.zeros((3, 2)), mask=True), None)), "sweep: `truth`", "masked"),
    "sweep y by name": (sweep(BOX, {"a": Y}), "sweep: `y`", "columns by name (a)"),
    "sweep y dates": (sweep(BOX, DATES), "sweep: `y`", "dates or times"),
    "time of dates": (sweep(BOX, Y, time=DATES), "sweep: `time`", "dates or times", "seconds"),
    "masked labels": (lambda o: gx.grid("a", Y, np.ma.array([1, 2], mask=[0, 1])), "grid: `coordinate`", "masked"),
    "records by name": (lambda o: Records(BOX, {"y": Y}), "Records: `y`", "columns by name (y)"),
    "records u masked": (
        lambda o: Records(BOX, Y, u=np.ma.array(Y, mask=True)),
        "Records: `u`",
        "masked at index [0, 0]",
    ),
    "matrix NA": (lambda o: gx.linear_image([[None, 1.0]], BOX), "linear_image: `matrix`", "missing at index [0, 0]"),
    "contains text": (lambda o: BOX.contains(["a", "b"]), "Interval.contains: `value`", "text"),
}

SWAPPED = {
    "initial and y": (estimate(Y, BOX), "estimate: `initial`", "Interval, got ndarray", "gx.Interval(lower, upper)"),
    "initial a pair": (estimate(([0, 0], [1, 1]), Y), "estimate: `initial`", "got tuple", "shape (2,)"),
    "system for observer": (
        lambda o: gx.estimate(o.system, BOX, Y),
        "estimate: `observer`",
        "got System",
        "design_obs",
    ),
    "noise a box": (estimate(BOX, Y, noise=V), "estimate: `noise`", "got Interval", "gx.Noise(w, v)"),
    "start swapped": (lambda o: gx.start(o.observer, Y[0], BOX), "start: `initial`", "got ndarray"),
    "box for carry": (lambda o: gx.step(o.observer, BOX, Y[0]), "step: `carry`", "got Interval", "gx.start"),
    "carry a pair": (lambda o: gx.step(o.observer, (BOX, 1), Y[0]), "step: `carry`", "got tuple", "gx.start"),
    "observer second": (lambda o: gx.step(BOX, o.observer, Y[0]), "step: `carry`", "got Observer"),
    "resume a box": (lambda o: gx.estimation.resume(o.observer, BOX, Y), "resume: `carry`", "got Interval"),
    "noise and system": (lambda o: gx.design_observer(NOISE, o.system, BOX), "design_observer: `system`", "got Noise"),
    "observer designed": (lambda o: gx.design_observer(o.observer, NOISE, BOX), "`system`", "got Observer"),
    "noise a tuple": (design((0.1, 0.2), BOX), "design_observer: `noise`", "got tuple", "gx.Noise(w, v)"),
    "region an array": (design(NOISE, np.zeros(2)), "design_observer: `region`", "Interval of shape (2,)", "ndarray"),
    "region a pair": (design(NOISE, ([-1, -1], [1, 1])), "design_observer: `region`", "got tuple"),
    "region misspelt": (design(NOISE, "aut"), "design_observer: `region`", '"auto"', "'aut'"),
    "region too short": (design(NOISE, V), "design_observer: `region`", "(2,)", "got shape (1,)"),
    "w and v": (design(Noise(V, W), BOX), "design_observer", "`w` must have shape (2,)", "(1,)"),
    "gains a fraction": (design(NOISE, BOX, gains=1.5), "design_observer: `gains`", "whole number", "1.5"),
    "gains a word": (design(NOISE, BOX, gains="2"), "design_observer: `gains`", "whole number", "'2'"),
    "sweeps none": (design(NOISE, BOX, sweeps=0), "design_observer", "`sweeps` must be a whole number, at least 1"),
    "delay negative": (design(NOISE, BOX, delay=-1), "design_observer: `delay`", "whole number", '"auto"', "-1"),
    "delay a fraction": (design(NOISE, BOX, delay=1.0), "design_observer: `delay`", "whole number"),
    "delay a word": (design(NOISE, BOX, delay="yes"), "design_observer: `delay`", '"auto"', "'yes'"),
    "split of none": (design(NOISE, BOX, split=0), "design_observer: `split`", "number of slices", '"auto"', "got 0"),
    "split a word": (design(NOISE, BOX, split="yes"), "design_observer: `split`", '"auto"', "'yes'"),
    "split predicted": (design(NOISE, BOX, "prediction", split=4), "design_observer: `split` must be 1", "got 4"),
    "delay predicted": (
        design(NOISE, BOX, "prediction", delay=1),
        "design_observer: `delay` must be 0 in the prediction form",
    ),
    "delay of an angle": (
        lambda o: gx.design_observer(System(f, g, G=G, H=H, periodic={0: 6.0}), NOISE, BOX, delay=1),
        "design_observer: `delay` must be 0",
        "numpy.unwrap",
    ),
    "delay in a sweep": (
        lambda o: gx.sweep(o.delayed, BOX, Y[:1]),
        "sweep: ",
        "1 step later",
        "at least 2 rows",
        "got 1",
    ),
    "delay in a run": (lambda o: gx.monte_carlo(o.delayed, 0, 4, 1, BOX), "monte_carlo: ", "at least 2 rows", "got 1"),
    "delay tuned": (
        lambda o: gx.tune_noise(o.delayed, o.records),
        "tune_noise: `observer`",
        "without `delay`",
        "DelayedObserver",
    ),
    "delay in a gradient": (
        lambda o: gx.width_sensitivity(o.delayed, BOX, Y),
        "width_sensitivity",
        "without `delay`",
        "DelayedObserver",
    ),
    "y lifted": (lambda o: gx.estimate(o.delayed, BOX, np.zeros((3, 2))), "estimate", "shape (T, 1)", "got (3, 2)"),
    "window a fraction": (design(NOISE, BOX, window=2.0), "design_observer: `window`", "whole number"),
    "missing a word": (design(NOISE, BOX, missing="no"), "design_observer: `missing`", "True or False", "'no'"),
    "certify a number": (design(NOISE, BOX, certify=1.0), "design_observer: `certify`", "True or False"),
    "form": (design(NOISE, BOX, "currant"), "design_observer: `form`", '"current" or "prediction"', "'currant'"),
    "method": (design(NOISE, BOX, bounds=["afine"]), "design_observer: `bounds`", "affine, natural", "'afine'"),
    "no method": (design(NOISE, BOX, bounds=[]), "design_observer: `bounds`", "must name some of"),
    "left inverse": (design(NOISE, BOX, "prediction", left_inverse="psudo"), "`left_inverse`", '"pseudo"', "'psudo'"),
    "no u_region": (lambda o: gx.design_observer(o.with_u, NOISE, BOX), "design_observer", "give `u_region`"),
    "u_region a list": (lambda o: gx.design_observer(o.with_u, NOISE, BOX, u_region=[0, 1]), "`u_region`", "got list"),
    "noise over time": (design(Noise(Interval.symmetric(np.ones((3, 2))), V), BOX), "design_observer", "got (3, 2)"),
    "noise an array": (lambda o: Noise(np.zeros(2), V), "Noise: `w`", "got ndarray", "Interval.symmetric"),
    "noise infinite": (lambda o: Noise(Interval.entire(2), V), "Noise", "`w` must be finite", "unknown input d"),
    "bounds a pair": (plant(state_bounds=([0, 0], [1, 1])), "System: `state_bounds`", "got tuple", "gx.Interval("),
    "a word for a key": (simulate("0", [0.0, 0.0], D, NOISE), "simulate: `key`", "integer seed", "str"),
    "many keys": (simulate(jax.random.split(KEY, 3), [0.0, 0.0], D, NOISE), "simulate: `key`", "shape (3,)"),
    "simulate a box": (simulate(0, [0.0, 0.0], D, W), "simulate: `noise`", "got Interval", "gx.Noise(w, v)"),
    "simulate observer": (lambda o: gx.simulate(o.observer, 0, [0, 0], D, NOISE), "simulate: `system`", "got Observer"),
    "simulate no d": (simulate(0, [0.0, 0.0], None, NOISE), "simulate: give the unknown input `d`", "np.zeros((T, 0))"),
    "simulate noise": (
        simulate(0, [0, 0], D, Noise(Interval.symmetric(np.ones((5, 2))), V)),
        "simulate",
        "(3, 2)",
        "(5, 2)",
    ),
    "simulate no u": (lambda o: gx.simulate(o.with_u, 0, [0, 0], D, NOISE), "simulate", "give `u` of shape (T, 1)"),
    "runs of a system": (lambda o: gx.monte_carlo(o.system, 0, 3, 3, BOX), "monte_carlo: `observer`", "got System"),
    "runs with a box": (carlo(noise=V), "monte_carlo: `noise`", "got Interval"),
    "key a fraction": (carlo(key=1.5), "monte_carlo: `key`", "integer seed", "1.5"),
    "no runs": (carlo(runs=0), "monte_carlo: `runs`", "at least 1"),
    "no steps": (carlo(steps=0), "monte_carlo: `steps`", "at least 1"),
    "x0 outside": (carlo([5.0, 0.0], initial=BOX), "monte_carlo: `x0` of x1 is 5", "-1 to 1", "larger `initial`"),
    "x0 reaches out": (carlo(Interval([-1.0, -1], [1.0, 2]), initial=BOX), "monte_carlo: `x0` of x2 is -1 to 2"),
    "confidence": (carlo(confidence=95), "monte_carlo: `confidence`", "between 0 and 1"),
    "draw": (carlo(draw="normal"), "monte_carlo: `draw`", '"uniform"', "'normal'"),
    "numpy in d": (carlo(d=lambda k, i, x: np.sin(x)), "monte_carlo: d(key, k, x)", "jnp.sin, not np.sin"),
    "sweep swapped": (sweep(Y, BOX), "sweep: `initial`", "got ndarray"),
    "sweep of a system": (lambda o: gx.sweep(o.system, BOX, Y), "sweep: `observer`", "got System"),
    "sweep with a box": (sweep(BOX, Y, V), "sweep: `noise`", "got Interval"),
    "truth an array": (sweep(BOX, Y, truth=np.zeros((3, 2))), "sweep: `truth`", "a pair (x, d)"),
    "unknown reduction": (sweep(BOX, Y, reduce=["mena"]), "sweep", "'mena'", "known are final"),
    "store a number": (sweep(BOX, Y, store=3), "store", "path of a folder", "got int"),
    "grid swapped": (lambda o: gx.grid(BOX, "noise"), "grid: `name`", "must be a word"),
    "boxes of an array": (lambda o: gx.plot.framers(np.zeros((3, 2))), "framers", "an estimate", "got ndarray"),
    "boxes of a box": (lambda o: gx.plot.framers(BOX), "framers", "an estimate", "got Interval"),
    "widths of an array": (lambda o: gx.plot.widths(Y), "widths", "an estimate", "got ndarray"),
    "curves of an array": (lambda o: gx.plot.curves(Y), "curves", "dataset of gx.sweep", "got ndarray"),
    "saved array": (lambda o: gx.plot.save(Y, "a.png"), "framers", "an estimate", "got ndarray"),
    "labels of an array": (lambda o: gx.dataset.to_dataset(Y), "to_dataset: `est`", "gx.estimate", "got ndarray"),
    "tuned system": (lambda o: gx.tune_noise(o.system, o.records), "tune_noise: `observer`", "got System"),
    "tuned array": (lambda o: gx.tune_noise(o.observer, Y), "tune_noise: `records`", "got ndarray"),
    "tuned box": (lambda o: gx.tune_noise(o.observer, o.records, W), "tune_noise: `noise`", "got Interval"),
    "records swapped": (lambda o: Records(Y, BOX), "Records: `y`", "type Interval", "right order?"),
    "allocated box": (lambda o: gx.allocate(o.system, V, BOX, [1.0, 1.0], {}), "allocate: `noise`", "got Interval"),
    "allocated observer": (
        lambda o: gx.allocate(o.observer, NOISE, BOX, [1.0, 1.0], {}),
        "allocate: `system`",
        "Observer",
    ),
    "sensitivity swapped": (
        lambda o: gx.width_sensitivity(o.observer, Y, BOX),
        "width_sensitivity: `initial`",
        "ndarray",
    ),
    "certificate of a box": (lambda o: o.observer.certificate.widths(V), "Certificate: `noise`", "got Interval"),
    "certificate of v, w": (lambda o: o.observer.certificate.widths(Noise(V, W)), "Certificate", "`w`", "(2,)", "(1,)"),
    "hull of an array": (lambda o: gx.hull(BOX, np.zeros(2)), "hull: `b`", "got ndarray", "Interval.point"),
    "hull of shapes": (lambda o: gx.hull(BOX, Interval.entire(3)), "hull", "same shape", "(2,) and (3,)"),
    "intersect an array": (lambda o: gx.intersect(np.zeros(2), BOX), "intersect: `a`", "got ndarray"),
    "image swapped": (lambda o: gx.linear_image(BOX, np.eye(2)), "linear_image: `x`", "Interval", "got ndarray"),
    "wrapped swapped": (lambda o: gx.wrapped(BOX, o.system), "wrapped: `system`", "got Interval"),
    "wrapped array": (lambda o: gx.wrapped(o.system, np.zeros(2)), "wrapped: `boxes`", "got ndarray"),
    "nearest of shape": (lambda o: gx.nearest(o.system, np.zeros(3), BOX), "nearest: `x`", "(..., 2)", "(3,)"),
    "bounds on an array": (lambda o: inclusion.natural(f)(np.zeros(2)), "inclusion.natural", "Interval of shape (n,)"),
    "bounds of a number": (lambda o: inclusion.natural(3)(BOX), "inclusion", "of a function of x", "int"),
}

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

MAPS = {
    "if": (plant(lambda x: x if x[0] > 0 else -x), "System: calling f", "jnp.where"),
    "max": (plant(lambda x: [max(x[0], 0), x[1]]), "System: calling f", "jnp.minimum"),
    "np.sin": (plant(lambda x: np.sin(x)), "System: calling f", "jnp.sin, not np.sin"),
    "np in g": (plant(g=lambda x: np.cos(x[:1])), "System: calling g", "jnp.sin, not np.sin"),
    "math": (plant(lambda x: [math.sin(x[0]), x[1]]), "System: calling f", "jnp.sin, not math.sin"),
    "range": (
        plant(lambda x: [sum(x[1] for _ in range(x[0])), x[1]]),
        "System: calling f",
        "number of turns",
        "jnp.where",
    ),
    "text of x": (plant(lambda x: [float(f"{x[0]:.2f}"), x[1]]), "System: calling f", "jax.debug.print"),
    "float": (plant(lambda x: [float(x[0]), x[1]]), "System: calling f", "float(x)"),
    "item": (plant(lambda x: x * x[0].item()), "System: calling f", "x.item()"),
    "index of x": (plant(lambda x: [(1.0, 2.0)[x[0].astype(int)], x[1]]), "System: calling f", "jnp.take"),
    "boolean index": (plant(lambda x: x[x > 0]), "System: calling f", "jnp.where"),
    "assignment": (plant(assigns), "System: calling f", "x.at[0].set(value)"),
    "matrix too large": (plant(lambda x: jnp.eye(3) @ x), "System: calling f", "one entry per row of G"),
    "unpacked": (plant(lambda x: [a for a, b, c in [x]]), "System: calling f", "one entry per row of G"),
    "index beyond": (plant(lambda x: jnp.stack([x[0], x[2]])), "System: f reads index 2", "(2,)", "row of G"),
    "index before": (plant(lambda x: jnp.stack([x[0], x[-3]])), "System: f reads index -3", "(2,)"),
    "index in jit": (plant(jax.jit(lambda x: jnp.stack([x[0], x[5]]))), "System: f reads index 5", "(2,)"),
    "indices beyond": (plant(lambda x: x[np.array([0, 7])]), "System: f reads index 7", "(2,)", "row of G"),
    "indices before": (plant(lambda x: x[jnp.array([-3, 1])]), "System: f reads index -3", "(2,)"),
    "indices in jit": (plant(jax.jit(lambda x: x[np.array([0, 7])])), "System: f reads index 7", "(2,)"),
    "indices in vmap": (
        plant(lambda x: jax.vmap(lambda i: x[i])(jnp.array([0, 5]))),
        "System: f reads index 5",
        "(2,)",
    ),
    "taken beyond": (plant(lambda x: x * jnp.take(x, 7)), "System: f reads index 7", "(2,)"),
    "of a table": (plant(lambda x: x * jnp.arange(5.0)[jnp.array([9, 1])]), "System: f reads index 9", "(5,)"),
    "of a matrix": (
        plant(lambda x: jnp.outer(x, x)[np.array([0, 1]), np.array([0, 2])]),
        "System: f reads index 2",
        "(2, 2)",
    ),
    "along an axis": (plant(lambda x: jnp.take_along_axis(x, np.array([0, 3]), 0)), "System: f reads index 3", "(2,)"),
    "by a call": (plant(lambda x: x * jax.lax.dynamic_index_in_dim(x, 4, 0, False)), "System: f reads index 4", "(2,)"),
    "set beyond": (plant(lambda x: x.at[7].set(1.0)), "System: f reads index 7", "(2,)"),
    "added beyond": (plant(lambda x: x.at[np.array([0, 7])].add(1.0)), "System: f reads index 7", "(2,)"),
    "u beyond": (plant(lambda x, u: x + u[1], m=1), "System: f reads index 1", "(1,)", "per known input"),
    "g beyond": (plant(g=lambda x: x[2]), "System: g reads index 2", "(2,)"),
    "key around": (
        plant(lambda x: x + jax.random.normal(KEY, (2,))),
        "System: f draws random numbers",
        "Noise",
        "simulate",
    ),
    "key inside": (plant(lambda x: x + jax.random.uniform(jax.random.key(1))), "System: f draws random numbers"),
    "old key": (plant(lambda x: x + jax.random.uniform(jax.random.PRNGKey(1))), "System: f draws random numbers"),
    "np.random": (plant(lambda x: x + np.random.normal(size=2)), "System: f is another function every time", "w and v"),
    "random number": (plant(lambda x: x * float(np.random.normal())), "System: f is another function every time"),
    "nothing": (plant(lambda x: None), "System: f must return", "(2,)", "nothing (None)"),
    "a class": (plant(Gain), "System: f must return", "(2,)", "Gain"),
    "a dictionary": (plant(lambda x: {"x": x}), "System: f must return", "(2,)", "dict"),
    "complex": (plant(lambda x: x * 1j), "System: f must return real numbers", "complex"),
    "bounds of if": (lambda o: inclusion.affine(lambda x: x if x[0] > 0 else -x)(BOX), "inclusion", "jnp.where"),
    "bounds of np": (lambda o: inclusion.natural(np.sin)(BOX), "inclusion", "jnp.sin, not np.sin"),
    **{
        f"bounds beyond, {method.__name__}": (
            lambda o, method=method: method(lambda x: jnp.stack([x[0], x[5]]))(BOX),
            "inclusion: the function reads index 5",
            "the box has shape (2,)",
        )
        for method in (inclusion.natural, inclusion.affine, inclusion.jacobian, inclusion.mean_value)
    },
    "bounds of a batch beyond": (
        lambda o: inclusion.batched(inclusion.natural(lambda x: x[np.array([0, 2])]))(Interval(ROWS, ROWS)),
        "inclusion: the function reads index 2",
        "(2,)",
    ),
    "bounds of a key": (
        lambda o: inclusion.natural(lambda x: x + jax.random.normal(KEY, (2,)))(BOX),
        "inclusion: the function draws random numbers",
        "a further argument, a box",
    ),
    "bounds of nothing": (lambda o: inclusion.affine(lambda x: None)(BOX), "inclusion", "nothing (None)", "an array"),
    "bounds of complex": (lambda o: inclusion.natural(lambda x: 1j * x)(BOX), "inclusion", "real", "complex", "imag"),
    "discretized beyond": (
        lambda o: gx.discretize(lambda x: jnp.stack([x[0], x[4]]), 0.1, region=BOX),
        "discretize: f reads index 4",
    ),
    "discretized key": (
        lambda o: gx.discretize(lambda x: x + jax.random.normal(KEY, (2,)), 0.1, region=BOX),
        "discretize: f draws random numbers",
    ),
    "discretized part": (lambda o: gx.discretize(lambda x: x[:1], 0.1, region=BOX), "discretize: f", "(2,)", "(1,)"),
}

FILES = {
    "saved nowhere": (lambda o: o.observer.save(None), "Observer.save: `path`", "name of a file", "NoneType"),
    "saved in a folder": (lambda o: o.observer.save("."), "Observer.save: `path`", "'.' is a folder", "add a name"),
    "loaded number": (lambda o: gx.load_observer(3, o.system), "load_observer: `path`", "name of a file", "int"),
    "loaded swapped": (lambda o: gx.load_observer(o.system, "a.observer"), "load_observer: `system`", "got str"),
    "loaded box": (lambda o: gx.load_carry(".", BOX), "load_carry: `observer`", "got Interval"),
    "carry swapped": (lambda o: gx.save_carry("c", o.observer, o.carry), "save_carry: `carry`", "got Observer"),
    "carry before": (lambda o: gx.save_carry("c", o.carry, o.observer, -1), "save_carry: `step`", "at least 0", "-1"),
    "picture nowhere": (lambda o: gx.plot.save(o.boxes, 3), "plot.save: `path`", "name of a file", "int"),
    "a word for names": (lambda o: o.boxes.to_xarray(state_names="ab"), "`state_names`", "a list of 2", "'ab'"),
    "too few names": (lambda o: o.boxes.to_xarray(state_names=["a"]), "`state_names` has 1", "has 2"),
    "one name twice": (lambda o: o.boxes.to_pandas(state_names=["a", "a"]), "to_dataset", "'a'", "of its own"),
    "times": (lambda o: o.boxes.to_xarray(time=[1, 2]), "to_dataset: `time`", "(3,)", "(2,)"),
    "time twice": (lambda o: o.boxes.to_xarray(time=[0, 1, 2.0], dt=1.0), "to_dataset", "`time` or `dt`", "both"),
    "signals": (lambda o: gx.plot.framers(o.boxes, signals=["zz"]), "framers", "'zz'", "are: x1, x2"),
    "example": (lambda o: gx.examples.load("fligth"), "examples.load", "'fligth'", "there are flight"),
}

CALLS = {
    "collected number": (lambda o: gx.estimation.collect(o.observer, 3), "collect: `outputs`", "a list", "int"),
    "collected nothing": (lambda o: gx.estimation.collect(o.observer, []), "collect: `outputs`", "a list", "none"),
    "collected boxes": (
        lambda o: gx.estimation.collect(o.observer, [o.boxes]),
        "collect: `outputs`",
        "StepOutput, got Estimate",
    ),
    "estimate for carry": (lambda o: gx.step(o.observer, o.boxes, Y[0]), "step: `carry`", "got Estimate", "gx.start"),
    "two rows for one": (lambda o: gx.step(o.observer, o.carry, [1.0, 2.0]), "step", "shape (1,), got (2,)"),
    "rounded otherwise": (lambda o: o.observer.with_rounding("up"), "Observer.with_rounding", '"nearest"', "'up'"),
    "summary of a plant": (lambda o: o.boxes.summary(o.system), "Estimate.summary: `observer`", "got System"),
    "derivative a number": (design(NOISE, BOX, derivative=3), "design_observer: `derivative`", "Interval, got int"),
    "derivative unused": (design(NOISE, BOX, derivative=BOX), '`derivative` is for form="prediction"', "'current'"),
    "voted out": (design(NOISE, BOX, tolerate=5), "design_observer: `tolerate`", "outputs, 1, got 5", "add outputs"),
    "no cells": (design(NOISE, BOX, cells=0), "design_observer: `cells`", "whole number", "got 0"),
    "hull of far steps": (lambda o: gx.tightness(o.observer, BOX, Y, steps=[99]), "tightness: `steps`", "3 rows", "99"),
    "hull of no steps": (lambda o: gx.tightness(o.observer, BOX, Y, horizon=0), "tightness: `horizon`", "at least 1"),
    "hull swapped": (lambda o: gx.tightness(o.observer, Y, BOX), "tightness: `initial`", "got ndarray"),
    "mean swapped": (lambda o: gx.mean_input(o.boxes, o.observer, Y, steps=2), "mean_input: `observer`", "Estimate"),
    "lost rows": (lambda o: o.observer.certificate.rows_until_finite(-1), "rows_until_finite: `lost`", "at least 1"),
    "certain plant": (
        lambda o: gx.tuning.optimal_widths(o.system, 1.0),
        "optimal_widths: `plant`",
        "function of theta",
    ),
    "held out": (lambda o: gx.tune_noise(o.observer, o.records, held_out=2.0), "tune_noise: `held_out`", "2.0"),
    "aim": (lambda o: gx.tune_noise(o.observer, o.records, objective="x"), "tune_noise: `objective`", "'x'"),
    "settled": (lambda o: gx.study.settle(-1), "settle: `factor`", "positive", "-1"),
    "per cent": (lambda o: gx.study.quantiles(95), "quantiles", "between 0 and 1", "95"),
    "gains of an observer": (lambda o: gx.paper.framer_gains(o.observer), "framer_gains: `system`", "got Observer"),
    "constants of a point": (
        lambda o: gx.paper.lipschitz_constants(o.system, np.ones(2)),
        "lipschitz_constants: `region`",
        "Interval, got ndarray",
    ),
    "stability swapped": (lambda o: gx.paper.stability(NOISE, o.system, BOX), "stability: `system`", "got Noise"),
    "widths of a plant": (lambda o: gx.paper.width_bounds(o.system, 1, 3), "width_bounds: `stability`", "got System"),
    "planes on a point": (lambda o: gx.paper.affine_abstraction(f, np.ones(2)), "`region`", "Interval", "got ndarray"),
    "gain of an array": (lambda o: inclusion.width_gain(np.ones((2, 2))), "width_gain: `derivative`", "got ndarray"),
    "bounds of no name": (lambda o: inclusion.register_bounds(3, f), "register_bounds: `name`", "got int", "__name__"),
    "one box as many": (lambda o: inclusion.batched(inclusion.natural(f))(BOX), "batched", "(N, n)", "(2,)"),
    "margin a word": (lambda o: BOX.contains([0, 0], "a"), "Interval.contains: `margin`", "text"),
    "step of no time": (lambda o: gx.discretize(f, 0.0, region=BOX), "discretize: `dt`", "positive", "0.0"),
    "step by a name": (lambda o: gx.discretize(f, 0.1, "rk45", region=BOX), "discretize: `method`", "rk4", "'rk45'"),
    "step swapped": (lambda o: gx.discretize(0.1, f, region=BOX), "discretize: `dt`", "type function"),
    "step on a pair": (lambda o: gx.discretize(f, 0.1, region=([0, 0], [1, 1])), "discretize: `region`", "got tuple"),
    "step everywhere": (
        lambda o: gx.discretize(lambda x: jnp.sin(x), 0.1, region=Interval.entire(2)),
        "discretize: `region` must be finite",
        "bound=False",
    ),
    "state space of a list": (lambda o: gx.from_state_space([1, 2]), "from_state_space: `sys`", "got list", "tf2ss"),
    "periods in a list": (plant(periodic=[6.0]), "System: `periodic`", "mapping", "[6.0]"),
    "period of no output": (plant(periodic={5: 6.0}), "System: `periodic`", "index 5", "0 to 0"),
    "period below 0": (plant(periodic={0: -6.0}), "System: `periodic`[0]", "positive", "-6.0"),
    "rate below 0": (plant(G=[[1.0], [0]], H=[[0.0]], input_rate=[-1]), "System: `input_rate`", "negative", "[-1.0]"),
    "rates of two": (plant(G=[[1.0], [0]], H=[[0.0]], input_rate=[1, 2]), "`input_rate`", "(1,)", "(2,)"),
    "constant for none": (
        plant(G=[[1.0], [0]], H=[[0.0]], input_constant=0),
        "`input_constant`",
        "at least 1",
        "got 0",
    ),
    "u of no size": (plant(f_of_u), "System: f or g takes u", "m=..."),
    "G a column": (plant(G=[1.0, 0.0], H=[0.0]), "System: G must be a matrix", "(2,)"),
    "G and H": (plant(G=[[1.0], [0]], H=[[0.0, 1.0]]), "System: G has shape (2, 1)", "one column per unknown input"),
    "G for H": (plant(G=[[0.0]], H=[[1.0], [0.0]]), "System: ", "rows of"),
}

WRONG = {
    f"{group}: {name}": case
    for group, cases in {
        "read": READ,
        "argument": SWAPPED,
        "shape": SHAPES,
        "map": MAPS,
        "file": FILES,
        "call": CALLS,
    }.items()
    for name, case in cases.items()
}


@pytest.mark.parametrize(("use", "words"), [(use, words) for use, *words in WRONG.values()], ids=WRONG)
def test_a_wrong_use_is_explained(objects, use, words):
    with pytest.raises(ValueError, match=r"\w") as error:
        use(objects)
    text, place = str(error.value), 0
    assert text.count("\n") < MOST_LINES
    assert len(text) < MOST_LETTERS
    for word in words:
        assert word in text[place:], f"{word!r} is not in {text!r}"
        place = text.index(word, place)


def test_a_box_is_not_taken_apart():
    with pytest.raises(TypeError, match=r"box\.lower and box\.upper"):
        _, _ = BOX
    with pytest.raises(TypeError, match=r"box\.contains\(x\)"):
        _ = 0.5 in BOX
    for wrong in (lambda: BOX + BOX, lambda: 2 * BOX, lambda: -BOX, lambda: f(BOX), lambda: BOX < BOX, lambda: BOX**2):
        with pytest.raises(TypeError, match=r"gx\.inclusion\.natural\(f\)\(box\)"):
            wrong()
    with pytest.raises(TypeError, match=r"box\.lower"):
        np.sin(BOX)
    assert BOX.contains([0.5, 2.0]).tolist() == [True, False]
    assert BOX.contains(np.zeros((5, 2))).shape == (5, 2)
    assert Interval(np.zeros((5, 1, 2)), np.ones((5, 1, 2))).contains(np.zeros((5, 3, 2))).shape == (5, 3, 2)


NAN = np.array([[1.0], [np.nan], [2.0]])


@pytest.mark.parametrize(
    "y",
    [
        MASKED,
        np.ma.array(MASKED.astype(int)),
        [MASKED[0], MASKED[1], MASKED[2]],
        [[1.0], [np.ma.masked], [2]],
        [[1.0], [None], [2.0]],
        [[1.0], [pd.NA], [2.0]],
        pd.DataFrame({"a": pd.array([1, None, 2], dtype="Int64")}),
        pd.DataFrame({"a": pd.array([1.0, None, 2.0], dtype="Float64")}),
        pd.DataFrame({"a": [1.0, None, 2.0]}),
        pd.DataFrame({"a": pd.Series([1, None, 2.0], dtype=object)}),
        [pd.Series([1.0], dtype="Float64"), pd.Series([None], dtype="Float64"), pd.Series([2.0])],
    ],
    ids=[
        "masked",
        "integers",
        "masked rows",
        "masked number",
        "None",
        "NA",
        "Int64",
        "Float64",
        "NaN",
        "object",
        "rows",
    ],
)
def test_whatever_is_marked_as_missing_is_missing(y):
    np.testing.assert_array_equal(read_array("estimate", "y", y, missing=True), NAN)


def test_a_masked_measurement_changes_no_box(observer):
    """The fill value -9999 lies outside of every box: as a measurement it would be a conflict."""
    boxes, masked = (gx.estimate(observer, BOX, y) for y in (NAN * 0.1, MASKED * 0.1))
    np.testing.assert_array_equal(masked.state.lower, boxes.state.lower)
    np.testing.assert_array_equal(masked.state.upper, boxes.state.upper)
    assert masked.status.tolist() == boxes.status.tolist()
    assert not masked.alarms()
    assert gx.estimate(observer, BOX, MASKED.data * 0.1).alarms()


def test_floating_arrays_are_not_copied():
    for array in (np.ones((3, 1)), np.ones((3, 1), np.float32), jnp.ones(2)):
        assert read_array("estimate", "y", array) is array
    traced = jax.make_jaxpr(lambda x: Interval([x[0], 0.0], [x[1], 1.0]).lower)(jnp.ones(2))
    assert traced.out_avals[0].shape == (2,)


def test_what_float64_holds_is_taken():
    assert read_array("a", "b", [2**53, -(2**60)]).tolist() == [2.0**53, -(2.0**60)]
    assert read_array("a", "b", np.longdouble([0.5, np.nan]))[0] == 0.5
    assert type(read_array("a", "b", np.ones((1, 1)).view(Own))) is np.ndarray
    assert read_array("a", "b", pd.Series([True, False])).tolist() == [1.0, 0.0]


def test_an_equinox_module_is_a_map(observer):
    """Its arrays are watched as every number that a map reads, and nothing warns of them."""
    system = System(Gain(jnp.array([0.5, 0.5])), g, G=G, H=H)
    assert hash(system.f) == hash(System(system.f.__wrapped__, g, G=G, H=H).f)
    assert inclusion.affine(system.dynamics)(BOX, np.zeros(0)).slope.tolist() == [[0.5, 0.0], [0.0, 0.5]]
    partial = System(jax.tree_util.Partial(lambda a, x: a * x, jnp.ones(2)), g, G=G, H=H)
    assert hash(partial.f)


def test_an_integer_is_a_key(observer):
    runs = [gx.simulate(observer.system, key, [0.0, 0.0], D, NOISE).y for key in (0, KEY)]
    np.testing.assert_array_equal(*runs)


def test_indices_inside_are_taken():
    """Slices may end beyond, negative indices count from the end, and computed ones are the user's own affair."""
    assert plant(lambda x: jnp.stack([x[-2], x[-1]]))(None).n == 2
    assert plant(lambda x: x[0:7])(None).n == 2
    assert plant(lambda x: jnp.roll(x, 1))(None).n == 2
    assert plant(lambda x: x[jnp.array([1, 0])])(None).n == 2
    assert plant(lambda x: x[np.array([1, -1])])(None).n == 2
    assert plant(lambda x: x.at[np.array([1, -2])].add(1.0))(None).n == 2
    for asked in ("clip", "wrap"):
        assert plant(lambda x, mode=asked: jnp.take(x, np.array([0, 7]), mode=mode))(None).n == 2
    assert plant(lambda x: jnp.take(x, np.array([0, 7]), mode="fill", fill_value=0.0))(None).n == 2
