"""`save_carry` and `load_carry`: where an online run stands, so that it goes on after a crash."""

from __future__ import annotations

import hashlib
import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax._memo import once_per_observer
from gsisio_jax.files.container import read, restore, write
from gsisio_jax.files.systems import described, differing_maps
from gsisio_jax.files.tree import encode
from gsisio_jax.interval.box import Interval, is_concrete
from gsisio_jax.interval.reading import check_type, is_whole
from gsisio_jax.observer.checks import AnyObserver
from gsisio_jax.observer.scan import blank
from gsisio_jax.observer.types import Carry

_OBSERVER = "it is what gx.design_observer or gx.load_observer returns"


@named_arguments
def save_carry(path: str | os.PathLike[str], carry: Carry, observer: AnyObserver, step: int = 0) -> None:
    """Write where an online run stands; `load_carry` reads it. The file is there whole or not at all.

    Args:
        path: of the file; the one before is replaced.
        carry: from `start` or `step`.
        observer: the one that made it; another one would not be let in.
        step: how many measurements have been seen, for whoever goes on; kept with the carry, so that they agree.

    Raises:
        OSError: it cannot be written there; an older file is untouched.
        ValueError: the carry does not belong to the observer, or is traced.
    """
    call = "save_carry"
    check_type(call, "carry", carry, Carry, "it comes from gx.start, and then from every gx.step")
    check_type(call, "observer", observer, AnyObserver.__args__, _OBSERVER)
    if not is_whole(step) or step < 0:
        raise ValueError(f"{call}: `step` must be a number of measurements, at least 0, got {step!r}")
    if not all(map(is_concrete, jax.tree.leaves(carry))):
        raise ValueError(f"{call}: `carry` is traced by JAX, but a file needs its numbers; save it outside of jit")
    _check_fits(call, carry, observer)
    about = {"step": int(step), "observer": digests(observer), "maps": described(observer)}
    write(call, path, "carry", about, carry)


@named_arguments
def load_carry(path: str | os.PathLike[str], observer: AnyObserver) -> tuple[Carry, int]:
    """A carry that `save_carry` has written: `step` goes on from it in the same bits.

    Args:
        path: the file.
        observer: the one that made the carry, or the same one loaded from its file.

    Returns:
        The carry, and how many measurements it has seen.

    Raises:
        OSError: the file is not there, or may not be read.
        ValueError: it is no such file, is damaged, or of a version that this library does not read; the observer is
            another one, and in what; or the carry is in float64 and JAX knows only float32 here.
    """
    call = "load_carry"
    check_type(call, "observer", observer, AnyObserver.__args__, _OBSERVER)
    about, tree, arrays = read(call, path, "carry")
    saved, ours = about["observer"], digests(observer)
    differing = [name for name in {**saved, **ours} if saved.get(name) != ours.get(name)]
    if differing := [*differing_maps(about["maps"], observer.system), *differing]:
        more = f" and {len(differing) - 6} more" if len(differing) > 6 else ""
        raise ValueError(
            f"{call}: `observer` must be the one that made the carry in {os.fspath(path)}, it differs: "
            f"{', '.join(differing[:6])}{more}; load that observer from its file, or begin anew with gx.start"
        )
    return carried(call, path, tree, arrays, observer, "carry"), about["step"]


def carried(call: str, path: Any, tree: Any, arrays: dict[str, np.ndarray], observer: AnyObserver, kind: str) -> Carry:
    """The carry of a file, held against the observer that is to take it."""
    carry = restore(call, path, kind, tree, arrays)
    if any(leaf.dtype == np.float64 for leaf in jax.tree.leaves(carry)) and not jax.config.read("jax_enable_x64"):
        raise ValueError(
            f"{call}: the carry in {os.fspath(path)} must be of a type that JAX has here, it is in float64; call "
            'jax.config.update("jax_enable_x64", True) first, or begin anew with gx.start'
        )
    _check_fits(call, carry, observer)
    return jax.tree.map(jnp.asarray, carry)


@once_per_observer
def digests(observer: AnyObserver) -> dict[str, str]:
    """What tells one observer from another but for f and g: every array, and all that is no array."""
    arrays: dict[str, np.ndarray] = {}
    structure = repr(encode(observer, "observer", arrays)).encode()
    found = {"structure": hashlib.blake2b(structure, digest_size=12).hexdigest()}
    for name, array in arrays.items():
        data = f"{array.dtype}{array.shape}".encode() + np.ascontiguousarray(array).tobytes()
        found[name.removeprefix("observer.")] = hashlib.blake2b(data, digest_size=12).hexdigest()
    return found


@once_per_observer
def _shapes(observer: AnyObserver) -> Carry:
    """The carries of this observer, without numbers."""
    side = jax.ShapeDtypeStruct((observer.system.n,), jnp.result_type(float))
    return jax.eval_shape(lambda lower, upper: blank(observer, Interval.unchecked(lower, upper)), side, side)


def _check_fits(call: str, carry: Carry, observer: AnyObserver) -> None:
    """Structure and shapes of what this observer hands on, batches allowed."""
    n, like = observer.system.n, _shapes(observer)
    found, expected = jax.tree.structure(carry), jax.tree.structure(like)
    leaves = list(zip(jax.tree.leaves(carry), jax.tree.leaves(like), strict=False))
    batch = np.shape(carry.starts)
    if found != expected or any(np.shape(leaf) != (*batch, *wanted.shape) for leaf, wanted in leaves):
        raise ValueError(
            f"{call}: `carry` must be one that this observer has made, with {n} states and {observer.system.l} "
            "outputs; its parts have other shapes, or it is in another form; give the observer that gx.start was "
            "called with"
        )
