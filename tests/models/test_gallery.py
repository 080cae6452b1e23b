"""Models as an engineer writes them: no state and no unknown input outside its box, and useful boxes."""

from functools import cache

import numpy as np
import pytest
from models.gallery import MODELS
from models.runner import estimate, misses, records

# Look-up tables and a wrapped angle: rules that have branches of their own in float32.
BOTH_PRECISIONS = ("battery", "heading", "engine", "cogging")
# Products of rounded numbers alone, and a division: what rounding to nearest leaves out.
BOTH_ROUNDINGS = ("sir", "cstr")


@cache
def designed(name):
    """Of a model: itself, its observer, and its runs."""
    model = MODELS[name]()
    return model, model.observer(), records(model)


@pytest.mark.parametrize("name", MODELS)
def test_model(name):
    model, observer, runs = designed(name)
    for run in runs:
        boxes = estimate(model, observer, run)
        assert boxes.guaranteed
        assert misses(run, boxes) == 0
        assert not np.asarray(boxes.status & 1).any(), boxes.alarms()
        widths = np.asarray(boxes.state.width)[-20:]
        typical = np.median(widths, axis=0)  # lost measurements, and turns out of the region, widen single boxes
        assert (typical <= 1.01 * np.asarray(model.wide)).all(), typical  # 1: where noise alone decides, rounded
        if model.system.p:
            assert np.isfinite(np.asarray(boxes.input.width)).any(0).all()
    if name in BOTH_PRECISIONS:
        boxes = estimate(model, observer, runs[1], np.float32)
        assert boxes.state.lower.dtype == np.float32
        assert misses(runs[1], boxes) == 0
    if name in BOTH_ROUNDINGS:
        boxes = estimate(model, observer, runs[0], rounding="nearest")
        assert not boxes.guaranteed
        assert misses(runs[0], boxes) == 0


def test_a_wrong_model_is_seen():
    """The counts above can fail: states that are moved by more than the measurements allow lie outside."""
    model, observer, runs = designed("sir")
    run = runs[1]
    boxes = estimate(model, observer, run)
    moved = run.x + np.asarray(model.noise.v.width)[0] * 3
    assert misses(type(run)(moved, run.d, run.u, run.y), boxes) > 0
