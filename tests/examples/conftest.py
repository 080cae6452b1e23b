"""The flight on its grid, and the oracle's boxes of it."""

from __future__ import annotations

import importlib.util
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest

from gsisio_jax import examples
from gsisio_jax.examples import flight

_ORACLE = Path(__file__).parents[1] / "oracles" / "linear_observer.py"


@pytest.fixture(scope="session")
def oracle() -> ModuleType:
    spec = importlib.util.spec_from_file_location("linear_observer_oracle", _ORACLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up by name
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def config() -> dict:
    with open(examples.config_path("flight"), "rb") as stream:
        return tomllib.load(stream)


@pytest.fixture(scope="session")
def table(config) -> pd.DataFrame:
    return pd.read_csv(examples.config_path("flight").parent / config["table"]["file"])


@pytest.fixture(scope="session")
def measured(table) -> pd.DataFrame:
    return flight.measurements(table)


@pytest.fixture(scope="session")
def grid(measured, config) -> np.ndarray:
    """Outputs in the order of the configuration on the full grid, shape (T, 4)."""
    seconds = np.arange(measured.time_s.iloc[0], measured.time_s.iloc[-1] + 1.0)
    return measured.set_index("time_s")[config["table"]["y"]].reindex(seconds).to_numpy()


@pytest.fixture(scope="session")
def by_axis(grid) -> np.ndarray:
    """The same, shape (T, axes, 2): position and velocity of east and north."""
    return grid.reshape(-1, 2, 2).transpose(0, 2, 1)


@pytest.fixture(scope="session")
def oracle_run(oracle, by_axis, config):
    w, v = config["noise"]["w"]["radius"], config["noise"]["v"]["radius"]
    return oracle.observe(
        by_axis,
        position_noise=v[0],
        velocity_noise=v[2],
        process_noise=(w[0], w[2]),
        speed_bound=config["system"]["arguments"]["speed_bound"],
        position_bound=config["initial"]["upper"][0],
    )
