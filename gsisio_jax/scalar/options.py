"""What XLA can be told program by program."""

from __future__ import annotations

import os
from typing import Any

import jax


def cpu_options() -> dict[str, Any]:
    """Options of `jax.jit` for programs of long vectors: 512-bit ones, where the processor has them.

    Taken by itself, XLA's CPU backend uses vectors of 256 bits. On other backends there is nothing to say.
    """
    return {"xla_cpu_prefer_vector_width": 512} if jax.default_backend() == "cpu" else {}


def repeated() -> int:
    """How many operations XLA may repeat for a consumer of a number before a fence (a division) pays.

    With multi-output fusion XLA repeats little by itself. It cannot be asked for per program, only by XLA_FLAGS before
    JAX starts: see `flags`.
    """
    return int(os.environ.get("GS_W", 0)) or (
        48 if "xla_cpu_use_multi_output_fusion=true" in os.environ.get("XLA_FLAGS", "") else 12
    )
