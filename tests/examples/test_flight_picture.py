"""The picture is drawn from a dataset as the command line writes it."""

from __future__ import annotations

import json

import numpy as np
import pytest

xarray = pytest.importorskip("xarray")
pytest.importorskip("matplotlib")
from gsisio_jax.examples.flight_picture import draw  # noqa: E402


def _dataset(config, grid, run):
    lower, upper = (x.transpose(0, 2, 1).reshape(len(x), 4) for x in (run.lower, run.upper))
    last = np.full((1, 2), np.nan)
    inputs = [np.concatenate([x, last]) for x in (run.input_lower, run.input_upper)]
    variables = {}
    for signals, sides in (("state", (lower, upper)), ("input", inputs)):
        for index, signal in enumerate(config["signals"][signals]):
            for side, values in zip(("lower", "upper"), sides, strict=True):
                variables[f"{signal['name']}_{side}"] = ("time", values[:, index], {"units": signal["unit"]})
    for index, signal in enumerate(config["signals"]["output"]):
        variables[f"measured_{signal['name']}"] = ("time", grid[:, index], {"units": signal["unit"]})
    alarms = [
        {"time": float(row), "kind": "state", "index": 0, "gap": float(run.gap[row].max()), "text": "state"}
        for row in np.flatnonzero(run.conflict)
    ]
    attributes = {"title": config["title"], "alarms": json.dumps(alarms)}
    return xarray.Dataset(variables, coords={"time": np.arange(len(grid), dtype=float)}, attrs=attributes)


def test_picture_of_the_whole_flight(config, grid, oracle_run, tmp_path):
    path = tmp_path / "flight.png"
    draw(_dataset(config, grid, oracle_run), path)
    width, height = np.frombuffer(path.read_bytes()[16:24], dtype=">u4")
    assert (width, height) == (1600, 1000)


def test_picture_without_alarms_and_with_open_boxes(config, grid, oracle_run, tmp_path):
    dataset = _dataset(config, grid, oracle_run).isel(time=slice(0, 400))
    dataset.attrs["alarms"] = "[]"
    dataset["east_lower"][:2] = -np.inf
    draw(dataset, tmp_path / "part.png")
    assert (tmp_path / "part.png").stat().st_size > 10_000


def test_picture_of_an_alarm_without_a_position(config, grid, oracle_run, tmp_path):
    dataset = _dataset(config, grid, oracle_run).isel(time=slice(0, 300))
    dataset.attrs["alarms"] = json.dumps([{"time": 200.0, "kind": "output", "index": 2, "gap": 3.0, "text": "output"}])
    draw(dataset, tmp_path / "part.png")
    assert (tmp_path / "part.png").stat().st_size > 10_000
