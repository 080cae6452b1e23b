"""Examples and configuration files of the command line: one is made of the other."""

from __future__ import annotations

import importlib
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from gsisio_jax._extras import need
from gsisio_jax._whole import put
from gsisio_jax.examples.example import Example, Record, Signals
from gsisio_jax.interval import Interval
from gsisio_jax.plant import Noise


def write_config(example: Example, folder: Path) -> Path:
    """Write an example as NAME.toml and its record as NAME_record.csv, to run as they are or to start from.

    Args:
        example: made by a module of this package.
        folder: where they go; files of these names are replaced.

    Returns:
        Path of NAME.toml.
    """
    record, table = example.record(), f"{example.name}_record.csv"
    columns = {"time_s": record.time}
    parts = [(example.outputs, record.y), (example.known_inputs, record.u)]
    for signals, values in ((example.states, record.x), (example.inputs, record.d)):
        parts.append((tuple((f"true_{name}", unit) for name, unit in signals), values))
    for signals, values in parts:
        if values is not None:
            columns |= {name: values[:, index] for index, (name, _) in enumerate(signals)}
    rows = [",".join("" if np.isnan(v) else repr(float(v)) for v in row) for row in zip(*columns.values(), strict=True)]
    put(folder / table, ("\n".join([",".join(columns), *rows]) + "\n").encode())
    path = folder / f"{example.name}.toml"
    put(path, _toml(example, table).encode())
    return path


def _toml(example: Example, table: str) -> str:
    names = {"state": example.states, "input": example.inputs, "output": example.outputs}
    if example.known_inputs:
        names["known_input"] = example.known_inputs
    lines = [f"# {example.teaches[0].upper()}{example.teaches[1:]}.", f"# Source: {example.source}.",
             f"# Where every number comes from: the module gsisio_jax.examples.{example.name}.",
             f'title = "{example.title}"', "", "[system]",
             f'use = "gsisio_jax.examples.{example.name}:system"', "", "[signals]"]  # fmt: skip
    for kind, signals in names.items():
        entries = ", ".join(f'{{name = "{name}", unit = "{unit}"}}' for name, unit in signals)
        lines.append(f"{kind} = [{entries}]")
    lines += ["", "[noise]"]
    for name, box in (("w", example.noise.w), ("v", example.noise.v)):
        lines.append(f"{name} = {{lower = {_list(box.lower)}, upper = {_list(box.upper)}}}")
    lines += ["", *_box("region", example.region)]
    if example.u_region is not None:
        lines += ["", *_box("u_region", example.u_region)]
    lines += ["", *_box("initial", example.initial)]
    if example.design:
        lines += ["", "[design]"]
        lines += [f"{key} = {str(value).lower()}" for key, value in example.design.items()]
    lines += ["", "[table]", f'file = "{table}"', 'time = "time_s"', f"sample_time = {example.sample_time}"]
    lines.append(f"y = {_names(example.outputs)}")
    if example.known_inputs:
        lines.append(f"u = {_names(example.known_inputs)}")
    return "\n".join(lines) + "\n"


def _box(name: str, box: Any) -> list[str]:
    if not isinstance(box, Interval):
        return [f"[{name}]", "auto = true"]
    return [f"[{name}]", f"lower = {_list(box.lower)}", f"upper = {_list(box.upper)}"]


def _list(values: Any) -> str:
    return f"[{', '.join(repr(float(value)) for value in np.asarray(values))}]"


def _names(signals: Signals) -> str:
    return str([name for name, _ in signals]).replace("'", '"')


def from_config(path: Path, name: str, teaches: str, source: str) -> Example:
    """The example that a configuration file of this package describes."""
    with open(path, "rb") as stream:
        raw = tomllib.load(stream)
    signals = {
        kind: tuple((one["name"], one.get("unit", "")) for one in raw["signals"][kind])
        for kind in ("state", "input", "output")
    }
    noise = Noise(*(_read(raw["noise"][name]) for name in ("w", "v")))
    system = _named(raw["system"]["use"])(**raw["system"].get("arguments", {}))
    table = raw["table"]
    return Example(
        name=name,
        title=raw["title"],
        teaches=teaches,
        source=source,
        system=system,
        noise=noise,
        initial=_read(raw["initial"]),
        region=_read(raw["region"]),
        states=signals["state"],
        inputs=signals["input"],
        outputs=signals["output"],
        make_record=lambda seed: _read_record(path.parent / table["file"], table, signals),
        sample_time=table["sample_time"],
        config=path,
    )


def _read(box: dict[str, Any]) -> Interval:
    return Interval.symmetric(box["radius"]) if "radius" in box else Interval(box["lower"], box["upper"])


def _named(reference: str) -> Any:
    module, _, attribute = reference.partition(":")
    return getattr(importlib.import_module(module), attribute)


def _read_record(file: Path, table: dict[str, Any], signals: dict[str, Signals]) -> Record:
    """The table on its grid, missing rows as NaN; columns named after states and inputs are the truth."""
    frame = need("pandas", extra="cli", purpose="the record of this example").read_csv(file)
    truth = frame.columns
    if "transform" in table:
        frame = _named(table["transform"])(frame)
    time = frame[table["time"]].to_numpy(dtype=float)
    rows = np.rint((time - time[0]) / table["sample_time"]).astype(int)

    def gridded(names: Iterable[str]) -> np.ndarray:
        names = list(names)
        values = np.full((rows[-1] + 1, len(names)), np.nan)
        values[rows] = frame[names].to_numpy(dtype=float)
        return values

    x, d = (
        gridded(name for name, _ in signals[kind]) if all(name in truth for name, _ in signals[kind]) else None
        for kind in ("state", "input")
    )
    return Record(time[0] + table["sample_time"] * np.arange(rows[-1] + 1), gridded(table["y"]), None, x, d)
