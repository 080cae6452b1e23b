"""Programs over small arrays, rewritten as programs over single numbers.

A step of an observer is written with vectors and matrices, because that is how it is read. Compiled like that it is
slow: small trailing axes, slices and concatenations cost more than the arithmetic, and products with the zeros of a
gain are products. Written over 0-d values, `jax.vmap` makes every number a vector over the batch, and all of that is
gone. So the jaxpr of a step is unrolled:

    graph     the numbers: operations and their operands, each built once, simplified where a constant allows it
    unroll    walks through a jaxpr; an array becomes a NumPy array of numbers
    scan      `jax.lax.scan` over such a program
    program   traces the numbers that are needed as `jax.lax` operations on 0-d values
    derivative  tangents and cotangents of such a program, as programs of the same kind
    primitive   a program as one equation of JAX, which knows its derivatives

What runs a few times only is not worth compiling, and runs in NumPy:

    numpy_program     a jaxpr as NumPy operations, run one by one
    numpy_numbers     a program of numbers as such operations, without tracing it
    numpy_operations  the operations; numpy_library  what is given to JAX
    numpy_source      operations as expressions of Python, for what runs oftener; numpy_layout  those that move entries

Gains that are concrete are constants here: zeros cost nothing, signs are known, magnitudes are computed while tracing.
No simplification changes a bit of the result, but for the sign of a zero.
"""

from gsisio_jax.scalar.program import ScalarProgram, scalar_program
from gsisio_jax.scalar.scan import call, in_tasks, most_numbers, scan

__all__ = ["ScalarProgram", "call", "in_tasks", "most_numbers", "scalar_program", "scan"]
