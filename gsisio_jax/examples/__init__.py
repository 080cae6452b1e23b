"""Built-in examples: each is a configuration file of the command line, its data and, where needed, its own functions.

``gsisio estimate flight --out DIR`` runs one by name; its TOML file is the place to start a configuration from.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

_NAMES = ("flight", "paper")


def names() -> tuple[str, ...]:
    """Names of the built-in examples.

    >>> names()
    ('flight', 'paper')
    """
    return _NAMES


def config_path(name: str) -> Path:
    """Path of an example's configuration file; the data it names lie beside it.

    Args:
        name: one of `names()`.

    Raises:
        ValueError: there is no such example, or the package is imported from an archive, where it has no path.

    >>> config_path("flight").name
    'flight.toml'
    """
    if name not in _NAMES:
        raise ValueError(f"examples.config_path: no example is called {name!r}; there are {', '.join(_NAMES)}")
    path = files(__name__) / f"{name}.toml"
    if not isinstance(path, Path):
        raise ValueError(
            f"examples.config_path: {name!r} lies in an archive ({path}); install the package unpacked (pip does)"
        )
    return path
