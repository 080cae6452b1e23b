"""Observers whose numbers are constants of a compiled program."""

from __future__ import annotations

import hashlib
import threading
from collections import deque
from collections.abc import Callable, Hashable
from functools import lru_cache, partial
from typing import Any
from weakref import WeakKeyDictionary, ref

import jax
import numpy as np

from gsisio_jax._memo import memory, once
from gsisio_jax.interval.box import is_concrete

RECENT = 8
"""So many are kept for a while after their observers are gone: a design tries steps that its observer takes later, and
functions and cells of a notebook make the same observer again. A program over single numbers takes some ten MB; an
observer has two or three."""
STRUCTURES = 16
"""Programs of traced observers, by their structures."""


class Fixed:
    """A pytree of concrete arrays as constants of compiled programs, which live as long as it does.

    Attributes:
        value: the pytree, its arrays in NumPy, so that their numbers are known while tracing.
    """

    def __init__(self, tree: Any):
        leaves, structure = jax.tree.flatten(tree)
        arrays = [np.asarray(leaf) for leaf in leaves]
        digest = hashlib.sha256()
        for array in arrays:
            digest.update(f"{array.dtype}{array.shape}".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        self._identity = structure, digest.digest()
        self._hash = hash(self._identity)
        self.value = jax.tree.unflatten(structure, arrays)
        self._programs: dict[Hashable, Any] = {}

    @classmethod
    def of(cls, observer: Any) -> Fixed:
        """The same object for observers of equal numbers: they share their programs."""
        # An observer does not change, and hashing takes a while.
        return once(observer, cls, lambda: _shared(cls(observer)))

    def program(self, key: Hashable, make: Callable[[Any], Any]) -> Any:
        """What `make` returned of the value for this key. It must not hold on to this object."""
        found = self._programs.get(key)
        return self._programs.setdefault(key, make(self.value)) if found is None else found

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Fixed) and self._hash == other._hash and self._identity == other._identity


# The table must not hold what equality asks for: that includes f, which may hold the observer.
_known: WeakKeyDictionary[Fixed, ref[Fixed]] = WeakKeyDictionary()
_recent: deque[Fixed] = deque(maxlen=RECENT)
_one_at_a_time = threading.RLock()  # a weak reference may run anything when it dies


def _shared(made: Fixed) -> Fixed:
    with _one_at_a_time:
        known = _known.get(made)
        found = (known and known()) or made
        if found is made:
            _known[made] = ref(made)
        if found in _recent:
            _recent.remove(found)
        _recent.append(found)
    return found


def fixed(observer: Any) -> tuple[Fixed | None, Any]:
    """The observer as constants where all its numbers are concrete, else (traced gains) as a plain argument."""
    if Fixed not in memory(observer) and not all(map(is_concrete, jax.tree.leaves(observer))):
        return None, observer
    return Fixed.of(observer), None


def chosen(static: Fixed | None, traced: Any) -> Any:
    """The observer that `fixed` has taken apart."""
    return traced if static is None else static.value


def jitted(
    function: Callable[..., Any],
    static: Fixed | None,
    traced: Any,
    names: tuple[str, ...] = (),
    jit: Callable[..., Any] = jax.jit,
    **options: Hashable,
) -> Callable[..., Any]:
    """`jax.jit` of a function of what `fixed` returns and of more, which the result takes.

    JAX keeps a program for as long as the function. Of a function of a module with the observer as an argument it would
    keep every observer, so each has functions of its own.

    Args:
        function: of `static`, `traced`, and more.
        static, traced: from `fixed`.
        names: further static arguments.
        jit: `jax.jit` or the like.
        options: of it.
    """
    if static is None:
        return partial(_of_structure(function, jax.tree.structure(traced), names, jit, **options), traced)
    return static.program(
        (function, names, jit, *options.items()),
        lambda value: jit(partial(function, None, value), static_argnames=names, **options),
    )


@lru_cache(STRUCTURES)
def _of_structure(
    function: Callable[..., Any], structure: Any, names: tuple[str, ...], jit: Callable[..., Any], **options: Hashable
) -> Callable[..., Any]:
    return jit(partial(function, None), static_argnames=names, **options)
