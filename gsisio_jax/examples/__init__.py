"""Built-in examples, each a plant with sourced numbers, a record and a picture.

``gsisio examples`` lists them, ``gsisio estimate NAME`` runs one, ``gsisio examples NAME --out DIR`` writes its
configuration and its record, to start from. In Python, `load` returns an `Example`.
"""

from __future__ import annotations

import atexit
import importlib
import shutil
import tempfile
from functools import cache
from importlib.resources import files
from pathlib import Path

from gsisio_jax._calls import named_arguments
from gsisio_jax.examples.example import Example, Record

__all__ = ["Example", "Record", "config_path", "load", "names", "teaches"]

# With a configuration file of their own, whose comments reason every bound; what they teach, and their source.
_SHIPPED = {
    "flight": (
        "a real record: an alarm is a proof, here that an airliner was not where it said to be",
        "ADS-B messages received by the OpenSky network, sample of the package traffic (MIT licence)",
    ),
    "paper": (
        "feedthrough of deficient rank, the case that the library is made for, with the widths that it promises",
        "Khajenejad, Yong, Simultaneous Input and State Interval Observers for Nonlinear Systems with Rank-Deficient "
        "Direct Feedthrough",
    ),
}
_MODULES = (
    "double_integrator", "quadruple_tank", "six_tanks", "unicycle", "heading", "battery", "building", "sir", "tclab"
)  # fmt: skip


def names() -> tuple[str, ...]:
    """Names of the built-in examples.

    >>> names()[:3]
    ('flight', 'paper', 'double_integrator')
    """
    return (*_SHIPPED, *_MODULES)


def teaches() -> dict[str, str]:
    """What every example teaches, in a sentence, by name."""
    return {name: load(name).teaches for name in names()}


@named_arguments
def load(name: str) -> Example:
    """A built-in example.

    Args:
        name: one of `names()`.

    Raises:
        ValueError: there is no such example.

    >>> load("sir").teaches
    'what a model leaves out can be an input: its box tells when it was at work, and states stay certain'
    """
    _check("load", name)
    if name in _SHIPPED:
        from gsisio_jax.examples.config import from_config

        return from_config(config_path(name), name, *_SHIPPED[name])
    return importlib.import_module(f"{__name__}.{name}").example()


def config_path(name: str) -> Path:
    """Path of an example's configuration file; the data it names lie beside it. That of a simulated example is written
    into a temporary folder first, which goes with the process.

    Args:
        name: one of `names()`.

    Raises:
        ValueError: there is no such example, or the package is imported from an archive, where it has no path.

    >>> config_path("flight").name
    'flight.toml'
    """
    _check("config_path", name)
    if name not in _SHIPPED:
        return _written(name)
    path = files(__name__) / f"{name}.toml"
    if not isinstance(path, Path):
        raise ValueError(
            f"examples.config_path: {name!r} lies in an archive ({path}); install the package unpacked (pip does)"
        )
    return path


def _check(call: str, name: str) -> None:
    if name not in names():
        raise ValueError(f"examples.{call}: no example is called {name!r}; there are {', '.join(names())}")


@cache
def _written(name: str) -> Path:
    from gsisio_jax.examples.config import write_config

    folder = tempfile.mkdtemp(prefix="gsisio_example_")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return write_config(load(name), Path(folder))
