"""What is found out of an observer once. It is not kept on the observer itself: that would be part of its structure."""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable
from typing import Any


def once_per_observer(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Remember what a function of an observer returned, for as long as that observer lives."""
    known: dict[int, Any] = {}

    @functools.wraps(function)
    def remembered(observer: Any) -> Any:
        key = id(observer)
        if key not in known:
            known[key] = function(observer)
            weakref.finalize(observer, known.pop, key, None).atexit = False
        return known[key]

    return remembered
