"""Room for deep calls: the frames of what a slow call does lie in one piece of memory.

CPython up to 3.14 keeps the frames of Python functions in pieces of 16 KiB. A loop whose calls begin in a new piece
gets it from the system and gives it back at every turn, which takes up to a hundred times as long as the call
(https://github.com/python/cpython/issues/142183; the last releases of 3.13 and 3.14 keep one piece). Tracing goes a
hundred frames deep; begun some fifty frames further down, as in a notebook, up to a third of a design was lost.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import Any, TypeVar

Call = TypeVar("Call", bound=Callable[..., Any])

_WORDS = 1 << 16
"""A frame of so many needs a piece of 1 MiB, of which it leaves the half: a thousand frames. None of it is touched."""


def with_room(function: Call) -> Call:
    """The same function, called where a thousand frames find room. It costs ten microseconds."""
    if sys.version_info >= (3, 15):
        return function

    def call(*arguments: Any, **named: Any) -> Any:
        __tracebackhide__ = True
        return function(*arguments, **named)

    call.__code__ = call.__code__.replace(co_stacksize=_WORDS)
    return functools.wraps(function)(call)  # type: ignore[return-value]
