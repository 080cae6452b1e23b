"""`Observer.save` and `load_observer`: a design that outlives its process."""

from __future__ import annotations

import os
from typing import Any

import jax

from gsisio_jax._calls import named_arguments
from gsisio_jax.files.container import read, restore, write
from gsisio_jax.files.systems import Compare, check_system, described
from gsisio_jax.interval.box import is_concrete
from gsisio_jax.interval.reading import check_type
from gsisio_jax.plant.system import System


def save_observer(path: str | os.PathLike[str], observer: Any) -> None:
    """What `Observer.save` does."""
    if not all(map(is_concrete, jax.tree.leaves(observer))):
        raise ValueError(
            "Observer.save: the observer is traced by JAX, but a file needs its numbers; save it outside of jit, vmap "
            "and grad"
        )
    write("Observer.save", path, "observer", described(observer), observer)


@named_arguments
def load_observer(path: str | os.PathLike[str], system: System, compare: Compare = "program") -> Any:
    """An observer that `Observer.save` has written. Its boxes are those of the observer that was saved, bit for bit.

    The file has every number of the design, but not f and g: they come from `system`, which must be the one that the
    observer was designed for. Sizes, G, H, B, D, bounds and periods must be equal; f and g must be the same programs
    (`jax.make_jaxpr`, all constants included). Where the file comes from another version of JAX, or from another
    setting of ``jax_enable_x64``, programs cannot be compared, and values at 16 points of the region are: this finds
    another model, not a difference that shows elsewhere alone. Bounds given to `inclusion.register_bounds` are not
    compared.

    Args:
        path: the file.
        system: the plant, made as it was for the design.
        compare: "values" also takes an f or g that is written in another way, if the values at the 16 points are the
            same to rounding.

    Returns:
        Observer | DelayedObserver | PredictionObserver: in the floating type of the one that was saved. What was
        designed in float64 stays so also where ``jax_enable_x64`` is off, and is brought to float32 with the data.

    Raises:
        OSError: the file is not there, or may not be read.
        ValueError: it is no such file, is damaged, or of a version that this library does not read; or the system is
            another one, and what differs.
    """
    call = "load_observer"
    check_type(call, "system", system, System)
    if compare not in ("program", "values"):
        raise ValueError(f'{call}: `compare` must be "program" or "values", got {compare!r}')
    system.check_unchanged(call)
    about, tree, arrays = read(call, path, "observer")
    observer = restore(call, path, "observer", tree, arrays, system)
    check_system(call, os.fspath(path), observer.system, about, system, compare)
    return observer
