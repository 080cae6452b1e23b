"""One tile of a study: the recursion and the reductions in one compiled scan, mapped over the cases."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import is_dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax import estimation
from gsisio_jax.estimation import AnyObserver
from gsisio_jax.study.axes import bare
from gsisio_jax.study.reduce import Context, Kept, Reduction

TARGET_BYTES = 256 * 2**20  # working set of a tile
# What XLA holds for a step, in sizes of what the scan carries: 6.1 for two states with sines, 3.7 for four with roots
# (`memory_analysis` of compiled tiles).
TEMPORARIES = 6


def run_cases(
    observer: AnyObserver,
    varying: Mapping[str, Any],
    shared: Mapping[str, Any],
    reductions: tuple[Reduction, ...],
    hold: bool,
) -> dict[str, Any]:
    """Run the observer on B cases and reduce every run as it goes along.

    Nothing of size T x B is stored but what a `Kept` reduction asks for. Compiled once for equal shapes, and then the
    results of a case depend on nothing but its numbers: equal tile sizes give equal bits.

    Args:
        observer: in the type of the data.
        varying: arguments with a leading axis B, from `Layout.take`: initial, y, u, noise, length, truth, steady; None
            where shared or absent.
        shared: the others, from `Layout.shared`.
        reductions: from `reduce.resolve`.
        hold: as in `estimate`, ``on_conflict="hold"``.

    Returns:
        Arrays (B, ...) by name, not waited for.
    """
    return _run(observer, dict(varying), dict(shared), reductions, hold)


@partial(jax.jit, static_argnames=("reductions", "hold"))
def _run(observer: AnyObserver, varying: Any, shared: Any, reductions: tuple[Reduction, ...], hold: bool) -> Any:
    return jax.vmap(lambda one: _case(observer, eqx.combine(one, shared), reductions, hold))(varying)


def _case(observer: AnyObserver, case: Any, reductions: tuple[Reduction, ...], hold: bool) -> dict[str, Any]:
    y, u, noise, length = case["y"], case["u"], case["noise"], case["length"]
    if length is not None:
        y = estimation.cut(y, length)
    begin, advance = (getattr(estimation.recursion_of(observer), name) for name in ("begin", "advance"))
    carry, first = begin(observer, case["initial"], y[0], u[0], estimation.noise_at(noise, 0), hold)
    states = _first(reductions, first, _context(case))

    def body(state: Any, row: Any) -> tuple[Any, Any]:
        carry, states = state
        k, y_k, u_k, now, x, d = row
        carry, out = advance(observer, carry, y_k, u_k, estimation.noise_of_row(noise, now), hold)
        context = Context(case["steady"], x, d)
        after, kept = [], []
        for reduction, before in zip(reductions, states, strict=True):
            if isinstance(reduction, Kept):
                after.append(None)
                kept.append(reduction.row(out, k, context))
                continue
            new = reduction.update(before, out, k, context)
            if length is not None:
                # Rows behind the end of a ragged record do not count.
                new = jax.tree.map(lambda a, b: jnp.where(k < length, a, b), new, before)
            after.append(new)
            kept.append(None)
        return (carry, after), kept

    running = [None if isinstance(r, Kept) else state for r, state in zip(reductions, states, strict=True)]
    x, d = case["truth"] if case["truth"] is not None else (None, None)
    rows = (
        jnp.arange(1, y.shape[0], dtype=jnp.int32), y[1:], u[1:],
        jax.tree.map(lambda a: a[1:], estimation.noise_rows(noise)),
        None if x is None else x[1 : y.shape[0]], None if d is None else d[: y.shape[0] - 1],
    )  # fmt: skip
    (_, running), kept = jax.lax.scan(body, (carry, running), rows)
    steps = y.shape[0] if length is None else length
    results: dict[str, Any] = {}
    for reduction, start, state, rest in zip(reductions, states, running, kept, strict=True):
        if isinstance(reduction, Kept):
            state = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, rest)
        results |= reduction.finish(state, steps, Context(case["steady"]))
    return results


def _first(reductions: tuple[Reduction, ...], out: Any, context: Context) -> list[Any]:
    states = [r.row(out, jnp.int32(0), context) if isinstance(r, Kept) else r.init(out, context) for r in reductions]
    return jax.tree.map(jnp.asarray, states)


def _context(case: Any) -> Context:
    """That of step 0, where there is no d[k-1]: zeros stand in for it if there is any truth of d at all."""
    if case["truth"] is None:
        return Context(case["steady"])
    x, d = case["truth"]
    return Context(case["steady"], x[0], None if d is None else jnp.zeros(d.shape[1:], d.dtype))


def outline(
    observer: AnyObserver,
    varying: Mapping[str, Any],
    shared: Mapping[str, Any],
    reductions: tuple[Reduction, ...],
    hold: bool,
) -> tuple[dict[str, jax.ShapeDtypeStruct], float]:
    """Shapes of the results of one case, and the bytes of working set that one case costs; nothing is compiled.

    Args:
        varying: arguments of any one case, with a leading axis of 1; the others as in `run_cases`.
    """

    def small(observer: AnyObserver, varying: Any, shared: Any) -> Any:
        case = eqx.combine(jax.tree.map(lambda a: a[0], varying), shared)
        y, rows = case["y"], case["y"].shape[0]
        first_row = estimation.noise_at(case["noise"], 0)
        begin = estimation.recursion_of(observer).begin
        carry, out = begin(observer, case["initial"], y[0], case["u"][0], first_row, hold)
        states = _first(reductions, out, _context(case))
        results: dict[str, Any] = {}
        kept: list[Any] = []
        for reduction, state in zip(reductions, states, strict=True):
            if isinstance(reduction, Kept):
                state = jax.tree.map(lambda a: jnp.broadcast_to(a, (rows, *a.shape)), state)
                kept.append(state)
            steps = rows if case["length"] is None else case["length"]
            results |= reduction.finish(state, steps, Context(case["steady"]))
        return results, (carry, out, states), kept

    results, moving, kept = jax.eval_shape(small, observer, dict(varying), dict(shared))
    # Inputs and kept rows are copied once on their way: the scan wants time first.
    count = 2 * _bytes(varying) + TEMPORARIES * _bytes(moving) + 2 * _bytes(kept) + _bytes(results)
    return results, float(count)


def tile_size(bytes_per_case: float, cases: int) -> int:
    """Cases per tile: the working set stays near `TARGET_BYTES`.

    A power of two at most, and then as small as the same number of tiles allows, so that the last one is nearly full.
    It depends on the study alone, not on the machine.

    >>> tile_size(1024.0, 100), tile_size(2048.0, 1_000_000)
    (100, 125000)
    """
    most = 2 ** int(np.log2(max(TARGET_BYTES / bytes_per_case, 1)))
    tiles = -(-cases // most)
    return -(-cases // tiles)


def _bytes(tree: Any) -> int:
    return sum(np.prod(leaf.shape, dtype=int) * np.dtype(leaf.dtype).itemsize for leaf in jax.tree.leaves(tree))


def fingerprint(
    observer: AnyObserver, arguments: Mapping[str, Any], reductions: tuple[Reduction, ...], *rest: Any
) -> str:
    """SHA-256 of all that the results of a study depend on: numbers, maps, reductions, and `rest` as text.

    f and g count by the operations that JAX traces from them, so that equal maps of another process agree. Other
    versions of JAX may round in other places, so they count as well.
    """
    system = observer.system
    maps = jax.make_jaxpr(system.maps)(np.zeros(system.n), np.zeros(system.m))
    names = [repr(r) if is_dataclass(r) else f"{type(r).__qualname__} {r.name}" for r in reductions]
    static = (getattr(observer, name, None) for name in ("bounds", "sweeps", "output_rows", "guaranteed"))
    digest = hashlib.sha256(repr((jax.__version__, str(maps.jaxpr), names, *static, *rest)).encode())
    # f and g make the structure of the observer's pytree differ between processes, but not its leaves.
    numbers = {name: bare(argument) for name, argument in arguments.items()}
    for leaf in (*maps.consts, *jax.tree.leaves(observer), *jax.tree.leaves(numbers)):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.data.cast("B") if array.size else b"")
    return digest.hexdigest()
