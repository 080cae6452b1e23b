"""One tile of a study: the recursion and the reductions in one compiled scan, mapped over the cases."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import is_dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.files.program import program
from gsisio_jax.files.tree import encode
from gsisio_jax.observer import scan
from gsisio_jax.observer.checks import AnyObserver
from gsisio_jax.observer.fixed import Fixed, chosen, jitted
from gsisio_jax.plant.periodic import nearest
from gsisio_jax.scalar.options import loop_bytes
from gsisio_jax.study import later
from gsisio_jax.study.axes import bare
from gsisio_jax.study.reduction_base import Context, Kept, Reduction
from gsisio_jax.study.row_source import Rows

TARGET_BYTES = 256 * 2**20  # working set of a tile
CHUNK_BYTES = 4 * 2**20  # of a chunk, to stay in the caches of a core
CHUNKS = 256, 8192  # smallest and largest: every step of a chunk costs some microseconds, however few cases it has
# Where XLA makes the recursion one function, it is quickest with fewer cases; but it takes longer to compile, which
# pays from some steps of all cases on.
WHOLE = 32, 256
WHOLE_PAYS = 2e8
NUMBER_BYTES = 6  # that a step touches for every number that its start computes
# What XLA holds for a step, in sizes of what the scan carries: 6.1 for two states with sines, 3.7 for four with roots
# (`memory_analysis` of compiled tiles).
TEMPORARIES = 6


def run_cases(
    observer: Fixed,
    varying: Mapping[str, Any],
    shared: Mapping[str, Any],
    rows: Rows,
    reductions: tuple[Reduction, ...],
    hold: bool,
    most: int,
) -> dict[str, Any]:
    """Run the observer on B cases and reduce every run as it goes along.

    Nothing of size T x B is stored but what a `Kept` reduction asks for. Compiled once for equal observers and
    shapes, and then the results of a case depend on nothing but its numbers: equal B give equal bits.

    Args:
        observer: in the type of the data; its numbers are constants of the program.
        varying: arguments with a leading axis B, from `Layout.take`; None where shared or absent.
        shared: the others, from `Layout.shared`.
        rows: what the observer is given at every step.
        reductions: from `reductions.resolve`.
        hold: as in `estimate`, ``on_conflict="hold"``.
        most: numbers that a step may compute (`scalar.most_numbers`).

    Returns:
        Arrays (B, ...) by name, not waited for.
    """
    return compiled(observer)(dict(varying), dict(shared), rows, reductions, hold, most)


def compiled(observer: Fixed) -> Any:
    """The jitted function behind `run_cases`, of one observer."""
    return jitted(_run, observer, None, ("rows", "reductions", "hold", "most"))


def _run(
    static: Fixed | None,
    traced: Any,
    varying: Any,
    shared: Any,
    rows: Rows,
    reductions: tuple[Reduction, ...],
    hold: bool,
    most: int,
) -> Any:
    observer = chosen(static, traced)
    return jax.vmap(lambda one: _case(observer, eqx.combine(one, shared), rows, reductions, hold, most))(varying)


def _case(
    observer: AnyObserver, case: Any, source: Rows, reductions: tuple[Reduction, ...], hold: bool, most: int
) -> dict[str, Any]:
    length, steady, delay = case.get("length"), case["steady"], later.delay_of(observer)
    # The last steps lack measurements where the observer has a delay: their boxes are kept, but do not count.
    count = (source.steps(case) if length is None else length) - delay
    carry, carried, states, _, truth = _start(observer, case, source, reductions, hold)

    def body(state: Any, step: Any) -> tuple[Any, Any]:
        carry, carried, states, truth = state
        k, given = step
        if delay:
            row, carried = later.following(source, observer, case, carried, k, given)
            (x, d), truth = later.exchange(truth, row)
            k = k - delay  # the step that this row finishes
        else:
            row, carried = source.following(observer, case, carried, k, given)
            x, d = row.x, row.d
        carry, out = scan.advance(observer, carry, row.y, row.u, row.noise, hold)
        context = Context(steady, nearest(observer, x, out.state), d, row.exact)
        counts = None if length is None and not delay else (k >= 0) & (k < count)
        after, kept = [], []
        for reduction, before in zip(reductions, states, strict=True):
            if isinstance(reduction, Kept):
                after.append(None)
                kept.append(reduction.row(out, k, context))
                continue
            new = reduction.update(before, out, k, context)
            if delay:
                first = jax.tree.map(jnp.asarray, reduction.init(out, context))
                new = jax.tree.map(lambda a, b: jnp.where(k == 0, a, b), first, new)
            if counts is not None:
                # Steps behind the end of the record do not count, nor do those before it.
                new = jax.tree.map(lambda a, b: jnp.where(counts, a, b), new, before)
            after.append(new)
            kept.append(None)
        return (carry, carried, after, truth), kept

    running = [None if isinstance(r, Kept) else state for r, state in zip(reductions, states, strict=True)]
    given = later.longer(source, case, delay) if delay else source.given(case)
    steps = jnp.arange(1, source.steps(case) + delay, dtype=jnp.int32), given
    (_, carried, running, _), kept = scan.turns(observer, body, (carry, carried, running, truth), steps, most=most)
    results: dict[str, Any] = {}
    for reduction, start, state, rest in zip(reductions, states, running, kept, strict=True):
        if isinstance(reduction, Kept):
            state = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b])[delay:], start, rest)
        results |= reduction.finish(state, count, Context(steady))
    return results | source.results(carried)


def _start(
    observer: AnyObserver, case: Any, source: Rows, reductions: tuple[Reduction, ...], hold: bool
) -> tuple[Any, Any, list[Any], Any, Any]:
    """Step 0: the carry of the observer, that of the source, the states of the reductions, the boxes, and the truth
    that waits for its boxes where the observer has a delay (states and boxes say nothing yet then)."""
    row, carried = source.first(observer, case)
    carry, out = scan.begin(observer, case["initial"], row.y, row.u, row.noise, hold)
    context, zero = Context(case["steady"], nearest(observer, row.x, out.state), row.d, row.exact), jnp.int32(0)
    states = [r.row(out, zero, context) if isinstance(r, Kept) else r.init(out, context) for r in reductions]
    delay = later.delay_of(observer)
    return carry, carried, jax.tree.map(jnp.asarray, states), out, later.waiting(row, delay) if delay else None


class Outline(NamedTuple):
    """What is known of a study before anything is compiled.

    Attributes:
        shapes: of the results of one case.
        cost: bytes of working set of one case.
        step: those of them that every step goes through.
        numbers: that the start computes; 0 where it computes with arrays.
        turns: steps of a case.
    """

    shapes: dict[str, jax.ShapeDtypeStruct]
    cost: float
    step: float
    numbers: int
    turns: int

    def chunk(self, cases: int) -> int:
        """Cases that one call computes on a CPU, of so many in all."""
        return whole_chunk(self.numbers, float(cases) * self.turns, loop_bytes()) or chunk_size(self.step)


def outline(
    observer: AnyObserver,
    varying: Mapping[str, Any],
    shared: Mapping[str, Any],
    source: Rows,
    reductions: tuple[Reduction, ...],
    hold: bool,
) -> Outline:
    """Shapes of the results of one case, and what it costs; nothing is compiled.

    Args:
        varying: arguments of any one case, with a leading axis of 1; the others as in `run_cases`.
    """

    turns = 0

    def small(observer: AnyObserver, varying: Any, shared: Any) -> Any:
        nonlocal turns
        case = eqx.combine(jax.tree.map(lambda a: a[0], varying), shared)
        carry, carried, states, out, truth = _start(observer, case, source, reductions, hold)
        turns = source.steps(case)
        results: dict[str, Any] = {}
        kept: list[Any] = []
        for reduction, state in zip(reductions, states, strict=True):
            if isinstance(reduction, Kept):
                state = jax.tree.map(lambda a: jnp.broadcast_to(a, (turns, *a.shape)), state)
                kept.append(state)
            count = turns if case.get("length") is None else case["length"]
            results |= reduction.finish(state, count, Context(case["steady"]))
        return results | source.results(carried), (carry, carried, out, states, truth), kept

    traced, found = jax.make_jaxpr(small, return_shape=True)(observer, dict(varying), dict(shared))
    results, moving, kept = found
    numbers = sum(len(eqn.params["program"].operations) for eqn in traced.eqns if "program" in eqn.params)
    # Inputs and kept rows are copied once on their way: the scan wants time first.
    step = TEMPORARIES * _bytes(moving)
    cost = 2 * _bytes(varying) + step + 2 * _bytes(kept) + _bytes(results)
    return Outline(results, float(cost), float(step), numbers, turns)


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


def chunk_size(bytes_per_step: float) -> int:
    """Cases that one call of the program computes on a CPU: a power of two whose steps stay in the caches of a core.

    It depends on the study alone, neither on the machine nor on the number of threads, and so do the bits.

    >>> chunk_size(2500.0), chunk_size(1e9), chunk_size(8.0)
    (1024, 256, 8192)
    """
    return min(max(2 ** int(np.log2(max(CHUNK_BYTES / bytes_per_step, 1))), CHUNKS[0]), CHUNKS[1])


def whole_chunk(numbers: int, steps: float, loop_bytes: int) -> int:
    """Cases that one call computes where its recursion is one function; 0 where that does not pay or cannot be.

    Args:
        numbers: of a step.
        steps: of all cases together.
        loop_bytes: that XLA allows such a loop.

    >>> whole_chunk(2500, 1e9, 2**23), whole_chunk(10_000, 1e9, 2**23), whole_chunk(2500, 1e6, 2**23)
    (256, 128, 0)
    """
    if not numbers or steps < WHOLE_PAYS:
        return 0
    cases = loop_bytes // (NUMBER_BYTES * numbers)
    return min(2 ** (cases.bit_length() - 1), WHOLE[1]) if cases >= WHOLE[0] else 0


def _bytes(tree: Any) -> int:
    return sum(np.prod(leaf.shape, dtype=int) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def fingerprint(
    observer: AnyObserver, arguments: Mapping[str, Any], source: Rows, reductions: tuple[Reduction, ...], *rest: Any
) -> str:
    """SHA-256 of all that the results of a study depend on: numbers, maps, reductions, and `rest` as text.

    Functions count by the operations that JAX traces from them, so that equal ones of another process agree. Other
    versions of JAX may round in other places, so they count as well.
    """
    system = observer.system
    maps = [program(function, system.n, system.m) for function in (system.dynamics, system.measurement)]
    names = [repr(r) if is_dataclass(r) else f"{type(r).__qualname__} {r.name}" for r in reductions]
    # All that the observer is but f and g, also what is no array: numbers of cells and of sweeps, periods, targets.
    arrays: dict[str, np.ndarray] = {}
    structure = encode(observer, "observer", arrays)
    text, constants = source.identity(observer)
    digest = hashlib.sha256(repr((jax.__version__, maps, text, names, structure, *rest)).encode())
    numbers = {name: bare(argument) for name, argument in arguments.items()}
    for leaf in (*constants, *arrays.values(), *jax.tree.leaves(numbers)):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.data.cast("B") if array.size else b"")
    return digest.hexdigest()
