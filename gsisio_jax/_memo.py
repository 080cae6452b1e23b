"""What is found of an object once. It is kept beside the fields of the object, and is no part of its pytree."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

T = TypeVar("T")


class Remembers:
    """Base class, beside `equinox.Module`, of what remembers things; copies and pickles begin with nothing.

    The memory is a slot. An entry of ``__dict__`` would be part of the structure of the pytree, so that an observer
    would have another one after its first use; a table of weak references would keep an observer alive for ever whose
    f is a method of the object that holds it.
    """

    __slots__ = ("_memory",)

    _memory: dict[Hashable, Any]

    def __getstate__(self) -> dict[str, Any]:
        return vars(self).copy()


_slot: Any = Remembers._memory  # past the `__getattribute__` of Equinox, which takes as long as the rest of a look-up
_one_at_a_time = threading.Lock()


def memory(owner: Remembers) -> dict[Hashable, Any]:
    """What is remembered of an object; it lives as long as the object."""
    try:
        return _slot.__get__(owner)
    except AttributeError:
        pass
    with _one_at_a_time:
        try:
            return _slot.__get__(owner)  # another thread has just begun it
        except AttributeError:
            _slot.__set__(owner, {})
            return _slot.__get__(owner)


def once(owner: Remembers, key: Hashable, make: Callable[[], T]) -> T:
    """What `make` returns, the same object for every call. Threads that call at once may all make it; one is kept."""
    known = memory(owner)
    return known[key] if key in known else known.setdefault(key, make())


def once_per_observer(function: Callable[[Any], T]) -> Callable[[Any], T]:
    """Remember what a function of an observer returned, for as long as that observer lives."""

    @functools.wraps(function)
    def remembered(observer: Any) -> T:
        return once(observer, remembered, lambda: function(observer))

    return remembered
