"""What XLA is told, program by program or once before it starts.

JAX is imported where it is needed only: what is set here must be set before it starts.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from functools import cache
from importlib.metadata import version

XLA_LOOP_BYTES = 1024
"""The limit of XLA itself."""

LOOP_BYTES = 2**23
"""Bytes that a turn of a loop may touch where XLA makes the whole loop one function. Beyond, and with XLA's own 1,024
bytes, every fused operation is a task of its own that costs a tenth of a microsecond a turn, however small it is.

Measured for the paper's example (300 operations after fusion, 15 kB a box): one box 18 -> 1.0 microseconds a step and
2.9 -> 1.2 s to compile; 256 boxes at once .19 -> .11 microseconds a step and box, but twice as long to compile."""

FLAGS = {
    "xla_cpu_use_multi_output_fusion": "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion=true",
    "xla_cpu_small_while_loop_byte_threshold": (
        f"--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold={LOOP_BYTES}"
    ),
}
"""By name of what they set: numbers of a step that share what they are computed from are computed together; and the
recursion over a record is one function (`LOOP_BYTES`).

Not among them: ``--xla_cpu_prefer_vector_width=512``, although it makes arithmetic up to 1.4 times faster. With it
arctan in float64 is wrong by up to 0.79 (jaxlib 0.10.2, arrays of eight numbers and more), and nothing is guaranteed.
"""

KNOWN = (0, 10), (0, 11)  # versions of jaxlib, from and before


def repeated() -> int:
    """How many operations XLA may repeat for a consumer of a number before a fence (a division) pays.

    With multi-output fusion XLA repeats less by itself. It cannot be asked for per program, only by XLA_FLAGS before
    JAX starts: see `use_flags`. Some fences stay: without any, a program that is compiled without it does not end.
    """
    return 48 if fuses() else 12


def fuses() -> bool:
    """Does XLA_FLAGS ask for multi-output fusion?"""
    return "xla_cpu_use_multi_output_fusion=true" in os.environ.get("XLA_FLAGS", "")


def loop_bytes() -> int:
    """What XLA_FLAGS allow a loop that becomes one function; XLA's own value where they say nothing."""
    found = re.findall(r"xla_cpu_small_while_loop_byte_threshold=(\d+)", os.environ.get("XLA_FLAGS", ""))
    return int(found[-1]) if found else XLA_LOOP_BYTES


def loops_are_functions() -> bool:
    """Do XLA_FLAGS allow the loop over a record to be one function? Programs are then compiled with other options."""
    return loop_bytes() > XLA_LOOP_BYTES


def extended(given: str) -> str:
    """XLA_FLAGS with `FLAGS` behind those that are given; what is set already stays as it is.

    >>> extended("--xla_dump_to=/tmp/dump") == " ".join(["--xla_dump_to=/tmp/dump", *FLAGS.values()])
    True
    """
    given = given.strip()
    if given and not given.startswith("-"):  # the name of a file that holds them
        return given
    return " ".join([given, *(flag for name, flag in FLAGS.items() if f"{name}=" not in given)]).strip()


def use_flags() -> None:
    """Put `FLAGS` into XLA_FLAGS, if this XLA knows them. Where JAX has computed something already, that is in vain."""
    given = os.environ.get("XLA_FLAGS", "")
    wanted = extended(given)
    if wanted != given.strip() and _accepted(wanted):
        os.environ["XLA_FLAGS"] = wanted


def jaxlib_version() -> tuple[int, ...]:
    """The first two parts."""
    return tuple(int(part) for part in version("jaxlib").split(".")[:2])


@cache
def _accepted(flags: str) -> bool:
    """XLA ends the process at a flag that it does not know: a version that is not known tries it in another process."""
    installed = jaxlib_version()
    if installed < KNOWN[1]:
        return installed >= KNOWN[0]
    command = [sys.executable, "-c", "import jax; jax.devices()"]
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    try:
        return subprocess.run(command, env=environment, capture_output=True, timeout=60).returncode == 0
    except (OSError, subprocess.SubprocessError):
        return False
