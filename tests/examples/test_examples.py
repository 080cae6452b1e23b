"""The built-in examples are complete: configuration, data and functions fit together."""

from __future__ import annotations

import importlib
import tomllib

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from gsisio_jax import examples
from gsisio_jax.examples import paper


def _attribute(reference: str):
    module, _, name = reference.partition(":")
    return getattr(importlib.import_module(module), name)


@pytest.mark.parametrize("name", ["flight", "paper"])
def test_configuration_fits_its_system_and_data(name):
    path = examples.config_path(name)
    config = tomllib.loads(path.read_text(encoding="utf-8"))
    system = _attribute(config["system"]["use"])(**config["system"].get("arguments", {}))
    sizes = {"state": system.n, "input": system.p, "output": system.l}
    assert {kind: len(config["signals"][kind]) for kind in sizes} == sizes
    assert len(config["noise"]["w"]["radius"]) == system.n
    assert len(config["noise"]["v"]["radius"]) == system.l == len(config["table"]["y"])
    for box in ("region", "initial"):
        assert len(config[box]["lower"]) == len(config[box]["upper"]) == system.n
    frame = pd.read_csv(path.parent / config["table"]["file"])
    if "transform" in config["table"]:
        frame = _attribute(config["table"]["transform"])(frame)
    assert {config["table"]["time"], *config["table"]["y"]} <= set(frame.columns)
    assert np.all(np.diff(frame[config["table"]["time"]]) >= config["table"]["sample_time"])
    if "draw" in config["outputs"]:
        pytest.importorskip("matplotlib")
        assert callable(_attribute(config["outputs"]["draw"]))


def test_unknown_example():
    for call in (examples.config_path, examples.load):
        with pytest.raises(ValueError, match="no example is called 'flihgt'; there are flight, paper, double"):
            call("flihgt")


def test_shipped_record_of_the_paper_example():
    frame = pd.read_csv(examples.config_path("paper").parent / "data" / "paper_record.csv")
    record = paper.record()
    assert list(frame.columns) == list(record)
    for name, column in record.items():
        np.testing.assert_allclose(frame[name], column, rtol=0.0, atol=1e-12)


def test_noise_of_the_shipped_record_is_inside_its_bounds():
    record = paper.record()
    x, d, y = (np.stack([record[f"{letter}1"], record[f"{letter}2"]]) for letter in "xdy")
    v = y - paper.output_map(x, np) - paper.H @ d
    w = x[:, 1:] - (paper.state_map(x, np) + paper.G @ d)[:, :-1]
    assert np.abs(v).max() <= paper.NOISE
    assert np.abs(w).max() <= paper.NOISE
    assert (x[:, 0] >= paper.INITIAL_LOWER).all()
    assert (x[:, 0] <= paper.INITIAL_UPPER).all()


def test_flight_system_moves_a_target():
    system = _attribute("gsisio_jax.examples.flight:system")()
    x, d = np.array([1.0, 2.0, 3.0, 4.0]), np.array([2.0, -2.0])
    np.testing.assert_allclose(np.asarray(system.f(jnp.asarray(x))) + system.G @ d, [5.0, 5.0, 5.0, 2.0], rtol=1e-6)
    np.testing.assert_array_equal(system.state_bounds.upper, [np.inf, np.inf, 351.0, 351.0])
