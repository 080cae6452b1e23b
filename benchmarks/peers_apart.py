"""Run by the interpreter of an environment with immrax and codac (`peers.py`); needs nothing of this library.

Arguments: "bounds" or "step", an .npz to read and one to write. It prints a line of JSON with the names of its programs
once they are compiled and their boxes are written, then one with the seconds of a run of each for every line it reads.
"""

import json
import sys
import time

import numpy as np

TRIES = 5


def seconds_of(run, clock):
    started = clock()
    run()
    return clock() - started


def bounds(given, target):
    """The bounds that immrax has for f and g of the example, vmapped and compiled, in tiles of the fastest size."""
    import immrax
    import jax
    import jax.numpy as jnp

    lower, upper = given["lower"], given["upper"]

    def maps(x):  # no jnp.stack: immrax has no rule for it
        values = [
            0.6 * x[0] - 0.12 * x[1] + 1.1 * jnp.sin(0.3 * x[1] - 0.2 * x[0]),
            -0.2 * x[0] - 0.14 * x[1],
            0.2 * x[0] + 0.65 * x[1] + 0.8 * jnp.sin(0.3 * x[0] + 0.2 * x[1]),
            jnp.sin(x[0]),
        ]
        return jnp.concatenate([value[None] for value in values])

    programs, found = {}, {}
    for name in ("natif", "jacif", "mjacif"):
        bounded = getattr(immrax, name)(maps)

        def one(low, high, bounded=bounded):
            return immrax.i2lu(bounded(immrax.interval(low, high)))

        def tiled(size, one=one):
            compiled = jax.jit(jax.vmap(one)).lower(lower[:size], upper[:size]).compile()
            starts = range(0, len(lower), size)
            parts = [[jnp.asarray(side[i : i + size]) for side in (lower, upper)] for i in starts]

            def every(keep=lambda bounds: None):
                for part in parts:
                    keep(jax.block_until_ready(compiled(*part)))

            return every

        sizes = [int(size) for size in given["tiles"] if len(lower) % size == 0]
        tries = {size: tiled(size) for size in sizes}
        least = {size: min(seconds_of(one, time.process_time) for _ in range(TRIES)) for size, one in tries.items()}
        programs[name], kept = tries[min(least, key=least.__getitem__)], []
        programs[name](kept.append)
        found[name] = np.stack([np.concatenate([np.asarray(part[side]) for part in kept]) for side in (0, 1)])
    np.savez(target, **found)
    return programs


def step(given, target):
    """Prediction by f and contraction by g, box by box, as codac's own examples write an estimator."""
    import codac

    w, v, y = float(given["w"]), float(given["v"]), given["y"]
    x = codac.VectorVar(2)
    f = codac.AnalyticFunction(
        [x],
        codac.vec(0.6 * x[0] - 0.12 * x[1] + 1.1 * codac.sin(0.3 * x[1] - 0.2 * x[0]), -0.2 * x[0] - 0.14 * x[1]),
    )
    g = codac.AnalyticFunction(
        [x], codac.vec(0.2 * x[0] + 0.65 * x[1] + 0.8 * codac.sin(0.3 * x[0] + 0.2 * x[1]), codac.sin(x[0]))
    )
    noise = codac.IntervalVector([[-w, w], [-w, w]])

    def run(keep=None):
        for low, high, rows in zip(given["lower"], given["upper"], y, strict=True):
            box = codac.IntervalVector([list(side) for side in zip(low, high, strict=True)])
            for k, row in enumerate(rows):
                if k:
                    box = f.eval(box) + noise
                seen = codac.IntervalVector([[value - v, value + v] for value in row])
                contractor = codac.CtcInverse(g, seen)
                for _ in range(3):
                    contractor.contract(box)
                if keep is not None:
                    keep.append([[box[i].lb(), box[i].ub()] for i in range(2)])

    kept = []
    run(kept)
    sides = np.array(kept).reshape(*y.shape[:2], 2, 2)
    np.savez(target, codac=np.moveaxis(sides, -1, 0))
    return {"codac": run}


def main():
    kind, source, target = sys.argv[1:]
    make, clock = {"bounds": (bounds, time.process_time), "step": (step, time.perf_counter)}[kind]
    programs = make(dict(np.load(source)), target)
    print(json.dumps(list(programs)), flush=True)
    for _ in sys.stdin:
        print(json.dumps({name: seconds_of(run, clock) for name, run in programs.items()}), flush=True)


if __name__ == "__main__":
    main()
