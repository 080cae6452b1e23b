"""A system whose f or g has no name that pickle could find it by: what to do in its place is said at once."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable
from typing import Any

_BY_VALUE = {"cloudpickle", "copy", "dill", "loky"}


def check_named(functions: dict[str, Callable[..., Any]]) -> None:
    """Refuse to be pickled where that fails, and say how an observer gets into a file or another process.

    Nothing is refused to those that take functions by value: cloudpickle and its copies in other packages, dill, copy.
    They are known by the module that calls.

    Raises:
        pickle.PicklingError: a function cannot be pickled.
    """
    caller = sys._getframe(2).f_globals.get("__name__") or ""
    if not _BY_VALUE.isdisjoint(caller.split(".")):
        return
    for name, function in functions.items():
        try:
            pickle.dumps(function)
        except Exception as error:
            raise pickle.PicklingError(
                f"pickle: `{name}` of the System must be a function with a name at the top of a module, got "
                f"{function!r} ({error}). To keep an observer in a file, call observer.save(path), and "
                "gx.load_observer(path, system) where it is needed; to send it to another process, use cloudpickle"
            ) from error
