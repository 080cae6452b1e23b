"""Programs that run once or a few times, compiled in a fraction of the time: XLA's expensive passes left out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

from gsisio_jax.scalar.options import loops_are_functions

# For the compiler of one program; nothing global is changed. The numbers are the same up to rounding.
FUNCTION: dict[str, Any] = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""Where XLA_FLAGS make a loop one function (`scalar.options.FLAGS`)."""

TASKS: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False, **FUNCTION}
"""Where it is a sequence of tasks. Without its emitters XLA writes out an expression for each of its uses: in one
function of a loop these multiply, and the step of the flight takes more than 14 GB to compile."""


def quickly(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`jax.jit`, for a program whose compilation costs more than its run; on CPU only, elsewhere as usual."""
    if jax.default_backend() != "cpu":
        return jax.jit(function, **options)
    return jax.jit(function, compiler_options=FUNCTION if loops_are_functions() else TASKS, **options)
