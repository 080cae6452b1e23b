"""Run by the interpreter of another environment (`limit.py`): this file needs nothing but gsisio_jax there.

Arguments: an .npz with `lower`, `upper` (boxes, 2) and `y` (T, 2); "final widths" or "all boxes"; an .npz to write. It
prints a line when it is compiled, and one with the seconds of a run for every line it reads.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import gsisio_jax as gx  # noqa: E402


def f(x):
    return jnp.stack([0.6 * x[0] - 0.12 * x[1] + 1.1 * jnp.sin(0.3 * x[1] - 0.2 * x[0]), -0.2 * x[0] - 0.14 * x[1]])


def g(x):
    return jnp.stack([0.2 * x[0] + 0.65 * x[1] + 0.8 * jnp.sin(0.3 * x[0] + 0.2 * x[1]), jnp.sin(x[0])])


def main() -> None:
    data, kind, target = sys.argv[1:]
    given = np.load(data)
    bound = gx.Interval(np.full(2, -0.2), np.full(2, 0.2))
    system = gx.System(f, g, G=[[0, -0.1], [0.2, -0.2]], H=[[-0.1, 0.3], [0.25, -0.75]])
    region = gx.Interval(*given["region"])
    observer = gx.design_observer(system, gx.Noise(w=bound, v=bound), region, missing=False, sweeps=3)

    def one(lower, upper):
        found = gx.estimate(observer, gx.Interval(lower, upper), given["y"])
        return found.state.width[-1] if kind == "final widths" else (found.state, found.input, found.status)

    args = jax.device_put((given["lower"], given["upper"]))
    started = time.perf_counter()
    run = jax.jit(jax.vmap(one)).lower(*args).compile()
    print(time.perf_counter() - started, flush=True)
    found = jax.block_until_ready(run(*args))
    widths = found if kind == "final widths" else found[0].width
    np.savez(target, widths=np.asarray(widths))
    print("warm", flush=True)
    for _ in sys.stdin:
        started = time.perf_counter()
        jax.block_until_ready(run(*args))
        print(time.perf_counter() - started, flush=True)


if __name__ == "__main__":
    main()
