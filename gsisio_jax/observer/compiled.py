"""Programs of one record, compiled as suits them."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache, partial, wraps
from typing import Any

import jax
from jax.core import Tracer

from gsisio_jax._calls import config
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.fixed import Fixed, jitted
from gsisio_jax.observer.types import Carry
from gsisio_jax.plant.system import Noise
from gsisio_jax.scalar.options import KNOWN, jaxlib_version, loops_are_functions

TASKS: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False}
"""For the compiler of one program over single numbers, with XLA's own settings. XLA's newer way of writing fused
operations takes several milliseconds for each, however small; a step has hundreds. The older way gives the same
numbers.

Measured (CPU seconds of a first call, CPU time of a step): the paper's example 8.2 -> 2.9, 34 -> 35 microseconds; a
battery with a table of 11 segments 15 -> 8, 109 -> 128 microseconds, 1.16 -> .58 GB. Over batches, where fused
operations are loops over boxes, it computes up to twice as slowly: those are compiled as usual."""

FUNCTION: dict[str, Any] = {"xla_backend_optimization_level": 1}
"""The same where `scalar.options.FLAGS` make the recursion one function: there it is LLVM that takes the time. A sum of
fifty clips 13 -> 6 CPU seconds, others the same; steps take 1.0 to 1.05 times as long, with the same numbers."""


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """`jax.jit` with the options `TASKS` or `FUNCTION`; where a transformation (`jax.vmap`, `jax.jit`, `jax.grad`) is
    around the call, without.

    Args:
        function: of `fixed(observer)` (two arguments), a box or carry, y, u, noise, and whether to hold.
    """
    options = cache(lambda: _options())

    @wraps(function)
    def kept_inside(static: Fixed | None, traced: Any, *args: Any) -> Any:
        *data, hold = args
        return jax.checkpoint(lambda *data: function(static, traced, *data, hold))(*data)

    def alone(value: Any) -> Callable[..., Any]:
        return jax.jit(partial(function, None, value), static_argnames="hold", compiler_options=options())

    @wraps(function)
    def run(static: Fixed | None, traced: Any, box: Interval | Carry, y: Any, u: Any, noise: Noise, hold: bool) -> Any:
        args = box, y, u, noise, hold
        state = box.state if isinstance(box, Carry) else box
        # Not every leaf: flattening takes longer than a step.
        data = y, u, *(side for part in (state, noise.w, noise.v) for side in (part.lower, part.upper))
        if static is not None and options() and not any(isinstance(part, Tracer) for part in data):
            try:
                return static.program(alone, alone)(*args)
            except ValueError as error:  # constants inside of another program
                if "compiler_options" not in str(error):
                    raise
        # A missing measurement is NaN, also in what a gradient outside of `jax.jit` keeps of the run: `jax_debug_nans`
        # would take that for an error. Computed again it stays inside of a program.
        return jitted(kept_inside if config.jax_debug_nans else function, static, traced, ("hold",))(*args)

    return run


def _options() -> dict[str, Any]:
    """Empty where XLA_FLAGS say otherwise, this XLA does not have them, or no processor was measured (a GPU)."""
    if jax.default_backend() != "cpu":
        return {}
    wanted = FUNCTION if loops_are_functions() else TASKS
    given = os.environ.get("XLA_FLAGS", "")
    return wanted if not any(name in given for name in wanted) and _knows(wanted) else {}


def _knows(options: dict[str, Any]) -> bool:
    """JAX refuses an option that its XLA does not have: a version that is not known tries it."""
    if KNOWN[0] <= jaxlib_version() < KNOWN[1]:
        return True
    try:
        with jax.ensure_compile_time_eval():
            jax.jit(lambda: 0, compiler_options=options)()
    except Exception:  # of whatever kind in that version
        return False
    return True
