"""Optional packages: imported where they are used, and one line that names the extra where they are missing."""

from __future__ import annotations

import importlib
from types import ModuleType


class MissingExtra(ImportError):
    """An optional package is not installed; the message says which one and how to get it."""


def need(module: str, *, extra: str, purpose: str) -> ModuleType:
    """Import an optional module.

    Args:
        module: dotted name of the module, for example ``"matplotlib.figure"``.
        extra: the extra of ``gsisio_jax`` that brings it, for example ``"plot"``.
        purpose: what it is needed for, as the subject of a sentence, for example ``"plotting"``.

    Returns:
        The module.

    Raises:
        MissingExtra: the package is not installed. A package that is there and fails on import raises its own error.

    >>> need("json", extra="cli", purpose="the command line").dumps([1])
    '[1]'
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        package = module.partition(".")[0]
        if (error.name or "").partition(".")[0] != package:
            raise
        raise MissingExtra(
            f"{purpose} needs {package}; install it with: pip install 'gsisio_jax[{extra}]'", name=package
        ) from error
