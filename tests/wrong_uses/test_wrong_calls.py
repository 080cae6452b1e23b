"""Calls, files and settings."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from uses import BOX, NOISE, Y, check_refused, design, f, f_of_u, plant, table

import gsisio_jax as gx
from gsisio_jax import Interval, inclusion

FILES = {
    "saved nowhere": (lambda o: o.observer.save(None), "Observer.save: `path`", "name of a file", "NoneType"),
    "saved in a folder": (lambda o: o.observer.save("."), "Observer.save: `path`", "'.' is a folder", "add a name"),
    "loaded number": (lambda o: gx.load_observer(3, o.system), "load_observer: `path`", "name of a file", "int"),
    "loaded swapped": (lambda o: gx.load_observer(o.system, "a.observer"), "load_observer: `system`", "got str"),
    "loaded box": (lambda o: gx.load_carry(".", BOX), "load_carry: `observer`", "got Interval"),
    "carry swapped": (lambda o: gx.save_carry("c", o.observer, o.carry), "save_carry: `carry`", "got Observer"),
    "carry before": (lambda o: gx.save_carry("c", o.carry, o.observer, -1), "save_carry: `step`", "at least 0", "-1"),
    "picture nowhere": (lambda o: gx.plot.save(o.boxes, 3), "plot.save: `path`", "name of a file", "int"),
    "picture of no kind": (lambda o: gx.plot.save(o.boxes, "a.foo"), "plot.save: `path`", ".png", "'a.foo'", "'a.png'"),
    "picture unnamed": (lambda o: gx.plot.save(o.boxes, "boxes"), "plot.save: `path`", "'boxes'", "say 'boxes.png'"),
    "picture in no folder": (
        lambda o: gx.plot.save(o.boxes, "no/a.png"),
        "plot.save: `path`",
        "'no/a.png'",
        "make 'no'",
    ),
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
        lambda o: gx.discretize(lambda x: jnp.cosh(x), 0.1, region=Interval.entire(2)),
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
    "G a column": (plant(G=[1.0, 0.0], H=[0.0]), "System: G must be a matrix", "(2,)", "[[a], [b]]"),
    "G and H": (plant(G=[[1.0], [0]], H=[[0.0, 1.0]]), "System: G has shape (2, 1)", "one column per unknown input"),
    "G for H": (plant(G=[[0.0]], H=[[1.0], [0.0]]), "System: ", "rows of"),
}


@table(FILES | CALLS)
def test_a_call(objects, use, words):
    check_refused(use, objects, words)
