"""Uses that a second search found: what changes from call to call, words for numbers, models of other packages."""

from __future__ import annotations

import itertools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal
from uses import (
    BOX,
    KEY,
    NOISE,
    D,
    Y,
    carlo,
    check_refused,
    design,
    estimate,
    f,
    f_of_u,
    simulate,
    sweep,
    table,
)

import gsisio_jax as gx
from gsisio_jax import Interval, inclusion

MANY = Interval([[-1.0, -1.0], [0.0, 0.0]], [[1.0, 1.0], [1.0, 1.0]])
COUNT = itertools.count()
RNG = np.random.default_rng(0)


def model(a=0.5, b=1.0, dt: Any = 0.1):
    return scipy.signal.StateSpace([[a]], [[b]], [[1.0]], [[0.0]], **({} if dt is None else {"dt": dt}))


CHANGING = {
    "numpy.random, natural": lambda o: inclusion.natural(lambda x: x + np.random.normal(size=2))(BOX),
    "numpy.random, affine": lambda o: inclusion.affine(lambda x: x * float(np.random.normal()))(BOX),
    "numpy.random, jacobian": lambda o: inclusion.jacobian(lambda x: x * np.random.rand())(BOX),
    "numpy.random, mean value": lambda o: inclusion.mean_value(lambda x: x * np.random.rand())(BOX),
    "numpy.random, tight": lambda o: inclusion.tight(lambda x: x * np.random.rand())(BOX),
    "numpy.random, remainder": lambda o: inclusion.remainder(lambda x: x * np.random.rand())(BOX),
    "numpy.random, decomposition": lambda o: inclusion.decomposition(lambda x: x * np.random.rand())(BOX),
    "numpy.random, bound": lambda o: inclusion.bound(lambda x: x * np.random.rand(), ["affine"])(BOX),
    "numpy.random, batched": lambda o: inclusion.batched(inclusion.natural(lambda x: x * np.random.rand()))(MANY),
    "a generator": lambda o: inclusion.natural(lambda x: x * RNG.normal())(BOX),
    "the time": lambda o: inclusion.affine(lambda x: x - time.perf_counter())(BOX),
    "a counter": lambda o: inclusion.natural(lambda x: x * next(COUNT))(BOX),
}
CHANGED = "inclusion: the function is another function every time", "numpy.random", "outside of it"
BOUNDS = {
    **{name: (use, *CHANGED) for name, use in CHANGING.items()},
    "one argument too many": (lambda o: inclusion.natural(f)(BOX, 1.0), "inclusion: the function takes (x)", "partial"),
    "no known input": (
        lambda o: inclusion.affine(f_of_u)(BOX),
        "inclusion: the function takes (x, u)",
        "hands args on",
    ),
    "a word": (lambda o: inclusion.jacobian(lambda x: "a")(BOX), "inclusion: the function must return an array", "str"),
    "over a point": (lambda o: inclusion.affine(f)(BOX).over(np.zeros(2)), "AffineForm.over: `box`", "got ndarray"),
    "batched number": (lambda o: inclusion.batched(3), "inclusion.batched: `bounds`", "inclusion.natural(f)", "int"),
    "batched chunk": (
        lambda o: inclusion.batched(inclusion.natural(f), chunk=0),
        "batched: `chunk`",
        "at least 1",
        "0",
    ),
    "bounded by a word": (lambda o: inclusion.bound(f, ["afine"])(BOX), "inclusion.bound: `bounds`", "'afine'"),
    "bounded by nothing": (lambda o: inclusion.bound(f, [])(BOX), "inclusion.bound: `bounds`", "none"),
    "rounding a word": (lambda o: inclusion.natural(f, "down")(BOX), "inclusion.natural: `rounding`", "'down'"),
    "function for a box": (lambda o: inclusion.natural(BOX)(f), "inclusion.natural: the first argument", "Interval"),
    "derivative a number": (
        lambda o: inclusion.register_bounds("x", f, 3),
        "register_bounds: `natural` and `derivative`",
    ),
}
BOXES = {
    "no such type": (lambda o: BOX.astype("floot"), "Interval.astype", "float64, float32", "'floot'"),
    "a type of fewer bits": (lambda o: BOX.astype(jnp.bfloat16), "Interval.astype", "got bfloat16", "take float32"),
    "traced noise": (
        lambda o: jax.jit(lambda r: gx.design_observer(o.system, r, BOX))(NOISE),
        "design_observer: `noise`",
        "traced",
        "optimal_widths",
        "noise=",
    ),
    "traced region": (
        lambda o: jax.jit(lambda r: gx.design_observer(o.system, NOISE, r))(BOX),
        "design_observer: `region`",
        "traced",
    ),
    "no number": (lambda o: NOISE.astype("int8"), "Interval.astype", "'int8'"),
    "margin NaN": (lambda o: BOX.contains([0, 0], margin=np.nan), "Interval.contains: `margin` is NaN"),
    "contains a box": (lambda o: BOX.contains(BOX), "Interval.contains: `value`", "type Interval"),
    "half a component": (lambda o: Interval.entire(2.5), "Interval.entire: `shape`", "2.5"),
    "fewer than none": (lambda o: Interval.entire(-2), "Interval.entire: `shape`", "-2"),
    "no radius": (lambda o: Interval.symmetric(None), "Interval.symmetric: `radius`", "nothing (None)"),
    "point of a box": (lambda o: Interval.point(BOX), "Interval: `lower`", "type Interval"),
    "crossed": (lambda o: Interval([1.0, 0], [0.0, 1]), "Interval: bounds cross at index [0]", "lower <= upper"),
    "infinite matrix": (lambda o: gx.linear_image([[np.inf, 1.0]], BOX), "linear_image: `matrix` must be finite"),
    "matrix NaN": (lambda o: gx.linear_image([[np.nan, 1.0]], BOX), "linear_image: `matrix` must be finite"),
    "met with nothing": (lambda o: gx.intersect(BOX, None), "intersect: `b`", "got NoneType", "Interval.point"),
    "observer to half": (lambda o: o.observer.astype("float16"), "Observer.astype", "float64 or float32", "float16"),
    "half a type": (lambda o: o.observer.with_rounding(None), "Observer.with_rounding", "got None"),
}
MODELS = {
    "NaN in a model": (lambda o: gx.from_state_space(model(np.nan)), "from_state_space: A", "not finite"),
    "infinite model": (lambda o: gx.from_state_space(model(b=np.inf)), "from_state_space: B", "not finite"),
    "continuous model": (
        lambda o: gx.from_state_space(model(dt=None)),
        "from_state_space: the model is continuous",
        "dt=",
    ),
    "transfer function": (
        lambda o: gx.from_state_space(scipy.signal.TransferFunction([1], [1, 1], dt=0.1)),
        "from_state_space: `sys`",
        "to_ss()",
    ),
    "dt of a tuple": (
        lambda o: gx.from_state_space((np.eye(2), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1))), dt=0.1),
        "from_state_space: `dt` is for a continuous model",
        "a tuple of four matrices is discrete",
        "(A, B, C, D, 0)",
    ),
    "no model": (lambda o: gx.from_state_space(None), "from_state_space: `sys`", "NoneType"),
    "one matrix": (lambda o: gx.from_state_space(np.eye(2)), "from_state_space: `sys`", "got ndarray"),
    "G of another model": (
        lambda o: gx.from_state_space(model(), G=np.ones((3, 1))),
        "G must have shape (1, p)",
        "(3, 1)",
    ),
    "no such input": (lambda o: gx.from_state_space(model(), unknown=[7]), "`unknown`", "0 to 0", "[7]"),
    "step in text": (lambda o: gx.discretize(f, "0.1", region=BOX), "discretize: `dt`", "text"),
    "step NaN": (lambda o: gx.discretize(f, np.nan, region=BOX), "discretize: `dt`", "nan"),
    "endless step": (lambda o: gx.discretize(f, np.inf, region=BOX), "discretize: `dt`", "inf"),
    "no order": (lambda o: gx.discretize(f, 0.1, "taylor", region=BOX, order=0), "discretize: `order`", "got 0"),
    "discretized System": (lambda o: gx.discretize(o.system, 0.1, region=BOX), "discretize: `f`", "got System"),
    "discretized matrix": (lambda o: gx.discretize(np.eye(2), 0.1, region=BOX), "discretize: `f`", "got ndarray"),
    "discretized if": (
        lambda o: gx.discretize(lambda x: -x if x[0] > 0 else x, 0.1, region=BOX),
        "discretize",
        "jnp.where",
    ),
    "discretized np.random": (
        lambda o: gx.discretize(lambda x: x + np.random.normal(size=2), 0.1, region=BOX),
        "discretize: f is another function every time",
    ),
    "G of another plant": (
        lambda o: gx.discretize(f, 0.1, region=BOX, G=np.ones((3, 1))),
        "discretize: `G`",
        "(2, p)",
        "(3, 1)",
    ),
}
RUNS = {
    "window without end": (design(NOISE, BOX, window=10**6), "design_observer: `window`", "at most 1000", '"auto"'),
    "window of none": (design(NOISE, BOX, window=0), "design_observer: `window`", "at least 1", "got 0"),
    "names of numbers": (
        lambda o: o.boxes.to_pandas(state_names=[1, 2]),
        "to_dataset: `state_names`",
        "2 words",
        "got 1",
    ),
    "step backwards": (lambda o: o.boxes.to_xarray(dt=-1.0), "to_dataset: `dt`", "above 0", "-1.0"),
    "reduced to a number": (carlo(reduce=42), "monte_carlo: `reduce`", '"final"', "got int"),
    "reduced to nothing": (sweep(BOX, Y, reduce=[]), "sweep: `reduce`", "at least one"),
    "box for runs": (
        lambda o: gx.monte_carlo(o.observer, KEY, BOX, 3, 3, progress=False),
        "`runs`",
        "got Interval",
        "order",
    ),
    "runs in text": (carlo(runs="10"), "monte_carlo: `runs`", "'10'"),
    "axis of nothing": (lambda o: gx.grid("a", None), "grid: the value of 'a'", "leading axis", "None"),
    "axis without entries": (lambda o: gx.grid("a", []), "grid: the value of 'a'", "an empty list"),
    "axis without name": (lambda o: gx.grid("", [BOX]), "grid: `name`", "''"),
    "quantile of a word": (lambda o: gx.study.quantiles("a"), "quantiles", "between 0 and 1", "'a'"),
    "truth of a picture": (
        lambda o: gx.plot.framers(o.boxes, truth=np.zeros((3, 2))),
        "framers: `truth`",
        "by signal name",
        "ndarray",
    ),
    "a file for y": (estimate(BOX, "log.csv"), "estimate: `y`", "got text"),
    "a generator for a key": (simulate(RNG, [0.0, 0.0], D, NOISE), "simulate: `key`", "integer seed", "Generator"),
    "key of nothing": (simulate(None, [0.0, 0.0], D, NOISE), "simulate: `key`", "NoneType"),
    "stop": (estimate(BOX, Y, on_conflict="stop"), "estimate: `on_conflict`", '"restart" or "hold"', "'stop'"),
    "infinite measurement": (estimate(BOX, np.full((3, 1), np.inf)), "estimate: a measurement is infinite", "NaN"),
    "number for y": (lambda o: gx.step(o.observer, o.carry, 0.0), "step: measurements", "(1,)", "()"),
    "dictionary for y": (lambda o: gx.step(o.observer, o.carry, {"a": 1.0}), "step: ", "columns by name (a)"),
    "record for y": (lambda o: gx.start(o.observer, BOX, Y), "start: measurements", "(3, 1)", "gx.estimate"),
}


@table(BOUNDS | BOXES | MODELS | RUNS)
def test_a_use_is_explained(objects, use, words):
    check_refused(use, objects, words)


def test_a_function_that_stays_itself_is_taken():
    """Counters of the user's own may run, as long as no number of the function changes."""
    seen = []
    found = inclusion.natural(lambda x: seen.append(1) or 2.0 * x)(BOX)
    np.testing.assert_array_equal(found.upper, [2.0, 2.0])
