"""Python's search for garbage, less often while programs are traced.

Tracing makes hundreds of thousands of small objects that live on. Looking through them as often as usual takes a fifth
of a design (of one with 10,000 equations 4.9 s instead of 3.6), and finds nothing.
"""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_RARE = 100_000, 20, 50
_lock = threading.Lock()
_inside = 0
_before = gc.get_threshold()


@contextmanager
def rare_collection() -> Iterator[None]:
    """While any thread is inside, garbage is looked for rarely; afterwards as before. Nothing changes where it is off,
    or rare already."""
    global _inside, _before
    with _lock:
        _inside += 1
        if _inside == 1:
            _before = gc.get_threshold()
            if 0 < _before[0] < _RARE[0]:
                gc.set_threshold(*_RARE)
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0 and gc.get_threshold() == _RARE:
                gc.set_threshold(*_before)
