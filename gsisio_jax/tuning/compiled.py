"""Programs that run once or a few times, compiled in a fraction of the time: XLA's expensive passes left out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

# For the compiler of one program; nothing global is changed. The numbers are the same up to rounding.
QUICK: dict[str, Any] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
}


def quickly(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`jax.jit`, for a program whose compilation costs more than its run; on CPU only, elsewhere as usual."""
    if jax.default_backend() != "cpu":
        return jax.jit(function, **options)
    return jax.jit(function, compiler_options=QUICK, **options)
